"""Evaluate priors, or what fine-tuning has saved, in simulation or on "real" systems."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from envs import gaps
from envs.gaps import SIM
from experiments import cli
from experiments.options import Impl, at_least_one, check_task, prior_folders, without_repeats
from sgft_jax.io.jsonfile import read_json
from sgft_jax.presets import DEFAULT_PRESET
from sgft_jax.types import UserError

_SEED = 2**31 + 2  # held out from training and from the choice of the prior


@dataclass(frozen=True)
class EvaluateArgs:
    """One evaluation without exploration, every policy in the same episodes."""

    prior: Path | None = None
    """Folder of a prior, or of several (prior/seed-*); default: those of <out>/pretrain/<task>/<preset>."""
    run: Path | None = None
    """Folder of a fine-tuning run instead: its last policies."""
    best: bool = False
    """Of that run the policies that did best in the real rollouts, not the last ones."""
    task: str | None = None
    """A task by name, or a Python file with a task of your own; default: the task of the prior."""
    real: tuple[str, ...] = (SIM,)
    """Where: sim (the training domain without sensor noise), gaps by name, or .toml/.json files: all gaps of a file, or
    file.toml:name."""
    set: tuple[str, ...] = ()
    """Changes to the real systems, e.g. --set latency=0.05 action_scale=[1,0.5]."""
    episodes: int = 200
    """Episodes per policy and system."""
    json: bool = False
    """Print one JSON object and nothing else."""
    out: Path = Path("runs")
    """Parent of all run folders."""
    preset: str = DEFAULT_PRESET
    """Expert: pretraining preset whose priors to take where neither --prior nor --run is given."""
    seed: int = 0
    """Expert: another seed draws other worlds and episodes."""
    impl: Impl = "auto"


def main(args: EvaluateArgs) -> None:
    """Evaluates and prints."""
    found = evaluate(args)
    if args.json:
        print(json.dumps(found))
        return
    for system in found["systems"]:
        print(f"{found['task']}, {system['where']}, {found['episodes']} episodes for each policy:")
        for one in system["policies"]:
            low, high = (100 * x for x in one["success/interval"])
            exploded = f", {100 * one['exploded']:.1f} % exploded" if one["exploded"] else ""
            print(
                f"  {one['policy']}: success {100 * one['success']:.1f} % [{low:.1f}, {high:.1f}], "
                f"return {one['return']:.3f}{exploded}"
            )


def evaluate(args: EvaluateArgs) -> dict[str, Any]:
    """Success with its 95 % Wilson interval, mean return and share of exploded episodes of every policy everywhere."""
    args = replace(args, real=gaps.each(args.real))
    folders, task = check(args)
    import jax
    import jax.numpy as jnp

    import envs
    from envs.pools import heldout_worlds, load_gap, padded, real_env
    from experiments.evaluation import describe, play
    from experiments.stacking import member, part, stack
    from sgft_jax.io.priors import load_priors, observed_by
    from sgft_jax.policies import make_policy
    from sgft_jax.systems.simulated import Simulated

    env = envs.make(task, args.impl, **observed_by(folders))
    found = [load_gap(env, real, () if real == SIM else args.set) for real in args.real]
    priors = load_priors(folders, env)
    card, system_env = priors[0].card, real_env(env, [gap for gap in found if gap])
    key_worlds, key_episodes = jax.random.split(jax.random.fold_in(jax.random.key(_SEED), args.seed))
    pools = [heldout_worlds(system_env, gap, key_worlds, args.episodes) for gap in found]
    system = Simulated(
        system_env,
        stack([padded(pool, args.episodes) for pool in pools]),
        jnp.repeat(jnp.arange(len(pools)), len(priors)),
        gamma=card["gamma"],
    )
    members = stack([prior.params for prior in priors] * len(pools))
    played = play(system, make_policy(card, env), members, key_episodes, args.episodes)

    def of_system(i: int) -> list[dict[str, Any]]:
        own = part(played, i, len(priors))
        return [{"policy": str(folder), **describe(member(own, k))} for k, folder in enumerate(folders)]

    where = ["in simulation" if gap is None else f"on the {gap.name} real system" for gap in found]
    systems = [{"where": name, "policies": of_system(i)} for i, name in enumerate(where)]
    return {"task": env.name, "impl": env.impl, "episodes": args.episodes, "systems": systems}


def check(args: EvaluateArgs) -> tuple[list[Path], str]:
    """The folders of the policies and their task; raises UserError for what is wrong in the arguments and on disk."""
    if args.prior is not None and args.run is not None:
        raise UserError("--prior and --run exclude each other: name what to evaluate once")
    if args.best and args.run is None:
        raise UserError("--best: name the fine-tuning run with --run")
    if args.prior is None and args.run is None and args.task is None:
        raise UserError("nothing to evaluate: name a folder with --prior or --run, or a task with --task")
    at_least_one(args, "episodes")
    if not args.real:
        raise UserError("--real: name at least one")
    without_repeats("--real", args.real)
    reals = [real for real in args.real if real != SIM]
    if args.set and not reals:
        raise UserError(f"--set {args.set[0]}: changes a real system; name one with --real")
    if args.task is not None:
        check_task(args.task, reals)
    home = args.run / "best" if args.best and args.run else args.run or args.prior
    folders = prior_folders(home, out=args.out, task=args.task or "", preset=args.preset)
    task = args.task or read_json(folders[0] / "prior.json")["task"]
    check_task(task, reals)
    return folders, task


if __name__ == "__main__":
    cli.run_main(main, EvaluateArgs, __doc__ or "")
