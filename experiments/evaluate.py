"""Evaluate a prior, or what fine-tuning has saved, in simulation or on a "real" system."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import envs
from envs.gaps import SIM
from envs.mujoco.worlds import Impl
from envs.pools import heldout_worlds, load_gap, real_env
from experiments import cli, stacking
from experiments.evaluation import describe, play
from experiments.options import prior_folders
from sgft_jax.io.jsonfile import read_json
from sgft_jax.io.priors import load_priors
from sgft_jax.policies import make_policy
from sgft_jax.systems.simulated import Simulated
from sgft_jax.types import UserError

_SEED = 2**31 + 2  # held out from training and from the choice of the prior


@dataclass(frozen=True)
class EvaluateArgs:
    """One evaluation of the mean action, every policy in the same episodes."""

    prior: Path | None = None
    """Folder of a prior, or of several (prior/seed-*); default: those of <out>/pretrain/<task>/<preset>."""
    run: Path | None = None
    """Folder of a fine-tuning run instead: its final policies."""
    task: str | None = None
    """push, push-towel, push-ball, hammer or insert; default: the task of the prior."""
    preset: str = "fast"
    """Pretraining preset whose priors to take where neither --prior nor --run is given."""
    real: str = SIM
    """Where: sim (the training domain without sensor noise), the name of a gap, or a .toml/.json file."""
    set: tuple[str, ...] = ()
    """Changes to the real system, e.g. --set latency=0.05 action_scale=[1,0.5]."""
    impl: Impl = "auto"
    """Who steps the physics: MJX's own code, MuJoCo Warp, or MuJoCo's C engine. auto: $SGFT_IMPL, or else c on a CPU,
    warp on an NVIDIA GPU where it is installed, jax elsewhere."""
    episodes: int = 200
    """Episodes per policy."""
    seed: int = 0
    """Another seed draws other worlds and episodes."""
    json: bool = False
    """Print one JSON object and nothing else."""
    out: Path = Path("runs")
    """Parent of all run folders."""


def main(args: EvaluateArgs) -> None:
    """Evaluates and prints."""
    found = evaluate(args)
    if args.json:
        print(json.dumps(found))
        return
    for one in found["policies"]:
        low, high = one["success/interval"]
        print(
            f"{one['policy']}: success {one['success']:.3f} [{low:.3f}, {high:.3f}], return {one['return']:.3f}, "
            f"exploded {one['exploded']:.3f}  ({found['episodes']} episodes of {found['task']}, {found['where']})"
        )


def evaluate(args: EvaluateArgs) -> dict[str, Any]:
    """Success with its 95 % Wilson interval, mean return and share of exploded episodes of every policy."""
    if args.prior is not None and args.run is not None:
        raise UserError("--prior and --run exclude each other: name what to evaluate once")
    if args.episodes < 1:
        raise UserError(f"--episodes is {args.episodes}: must be at least 1")
    if args.prior is None and args.run is None and args.task is None:
        raise UserError("nothing to evaluate: name a folder with --prior or --run, or a task with --task")
    task = envs.name_of(args.task or "push")
    folders = prior_folders(args.run or args.prior, out=args.out, task=task, preset=args.preset)
    env = envs.make(args.task or read_json(folders[0] / "prior.json")["task"], args.impl)
    gap = load_gap(env, args.real, args.set)
    priors = load_priors(folders, env)
    card, params = priors[0].card, stacking.stack([prior.params for prior in priors])
    env = real_env(env, [gap] if gap else [])
    key_worlds, key_episodes = jax.random.split(jax.random.fold_in(jax.random.key(_SEED), args.seed))
    worlds = stacking.stack([heldout_worlds(env, gap, key_worlds, args.episodes)])
    system = Simulated(env, worlds, jnp.zeros(len(priors), jnp.int32), gamma=card["gamma"])
    outcome = play(system, make_policy(card, env), params, key_episodes, args.episodes)
    policies = [{"policy": str(f), **describe(stacking.member(outcome, i))} for i, f in enumerate(folders)]
    where = "in simulation" if gap is None else f"on the {gap.name} real system"
    return {"task": env.name, "impl": env.impl, "where": where, "episodes": args.episodes, "policies": policies}


if __name__ == "__main__":
    cli.run_main(main, EvaluateArgs, __doc__ or "")
