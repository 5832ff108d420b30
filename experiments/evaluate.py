"""Evaluate priors, or what fine-tuning has saved, in simulation or on "real" systems."""

import contextlib
import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from envs import extend, gaps
from envs.gaps import SIM
from envs.types import UserError
from experiments.runner import cli, options
from experiments.runner.cli import Json
from experiments.runner.options import Impl, Out
from experiments.runner.progress import doing
from experiments.runner.real_systems import (
    ENOUGH,
    REMOTE,
    TOGETHER,
    advice,
    by_scene,
    connect,
    described,
    is_robot,
    is_stepped,
)
from experiments.runner.real_systems import check as check_real
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import DEFAULT, get_method
from sgft_jax.presets import DEFAULT_PRESET

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
    file.toml:name. Or gymnasium:NAME (docs/gymnasium.md) or remote[:HOST[:PORT]] (docs/real-robot.md), where every
    episode is a real one. Those of a robot are kept in <out>/evaluate/<task>/remote/real."""
    set: tuple[str, ...] = ()
    """Changes to the real systems, e.g. --set latency=0.05 action_scale=[1,0.5]; of a Gymnasium environment keyword
    arguments of gymnasium.make."""
    episodes: int = 200
    """Episodes per policy and system."""
    video: Path | None = None
    """Folder for films, SYSTEM-POLICY.mp4: the first episode of each policy in each simulated system."""
    json: Json = False
    out: Out = Path("runs")
    preset: str = DEFAULT_PRESET
    """Expert: pretraining preset whose priors to take where neither --prior nor --run is given."""
    seed: int = 0
    """Expert: another seed draws other worlds and episodes."""
    impl: Impl = "auto"


def main(args: EvaluateArgs) -> None:
    """Evaluates and prints."""
    results = evaluate(args)
    if args.json:
        print(json.dumps(results))
        return
    for system in results["systems"]:
        steps = f", {system['real_steps']:,} real steps" if "real_steps" in system else ""
        print(f"{results['task']}, {system['where']}, {results['episodes']} episodes for each policy{steps}:")
        for one in system["policies"]:
            low, high = (100 * x for x in one["success/interval"])
            exploded = f", {100 * one['exploded']:.1f} % exploded" if one["exploded"] else ""
            success = f"success {100 * one['success']:.1f} % [{low:.1f}, {high:.1f}], "
            judged = success if results["score"] == "success" else ""
            print(f"  {one['policy']}: {judged}return {one['return']:.3f}{exploded}")
            if "video" in one:
                print(f"    {one['video']}")
        if "next" in system:
            print(system["next"])


def evaluate(args: EvaluateArgs) -> dict[str, Any]:
    """Success with its 95 % Wilson interval, mean return and share of exploded episodes of every policy everywhere."""
    args = replace(args, real=gaps.expand(args.real))
    folders, task = check(args)
    groups = by_scene(extend.name_of(task), args.real)
    results = [_evaluate(replace(args, real=reals), folders, task) for reals in groups]
    systems = dict(zip(itertools.chain(*groups), itertools.chain(*(one["systems"] for one in results)), strict=True))
    return {**results[0], "systems": [systems[real] for real in args.real]}


def _evaluate(args: EvaluateArgs, folders: list[Path], task: str) -> dict[str, Any]:
    """The same on real systems that share a program. folders: of the policies."""
    import jax
    import jax.numpy as jnp

    import envs
    from envs.rollout import heldout_worlds, padded, real_env
    from experiments.runner.pictures import film_episode
    from experiments.runner.recorded import RecordedSystem
    from experiments.runner.training import describe, play
    from sgft_jax.algorithms import algorithm_of, make_policy
    from sgft_jax.io.priors import load_priors, variant_of
    from sgft_jax.io.real import RealStore
    from sgft_jax.stacking import member, part, stack
    from sgft_jax.systems.simulated import Simulated

    env = envs.make(task, args.impl, **variant_of(folders))
    reals = [None if real == SIM else described(env, real, args.set) for real in args.real]
    priors = load_priors(folders, env)
    card, stepped = priors[0].card, is_stepped(args.real[0])
    key_worlds, key_episodes = jax.random.split(jax.random.fold_in(jax.random.key(_SEED), args.seed))
    members = stack([prior.params for prior in priors] * len(reals))
    system: Any
    with contextlib.ExitStack() as last:
        if stepped:
            system = connect(env, args.real, args.set, members=len(priors), gamma=card["gamma"], home=args.out)
            last.callback(system.close)
        else:
            world = real_env(env, [gap for gap in reals if gap])
            with doing(f"building {args.episodes:,} worlds for each system", 3 + 0.01 * args.episodes * len(reals)):
                pools = [padded(heldout_worlds(world, gap, key_worlds, args.episodes), args.episodes) for gap in reals]
            which = jnp.repeat(jnp.arange(len(pools)), len(priors))
            system = Simulated(world, stack(pools), which, gamma=card["gamma"])
        if is_robot(args.real[0]):  # what it does is kept
            store = RealStore(args.out / "evaluate" / env.name / REMOTE)
            system = RecordedSystem(system, [store], done=len(store), explore=False, sync_every=1)
        with doing(f"playing {args.episodes} episodes for each policy", None if stepped else 20, once=not stepped):
            played = play(system, make_policy(card, env), members, key_episodes, args.episodes)

    def results_of(i: int, k: int) -> dict[str, Any]:
        """Of the k-th policy on the i-th system. The film is that of its first episode."""
        folder, episodes = folders[k], member(played, i * len(priors) + k)
        results = {"policy": str(folder), **describe(episodes)}
        if args.video is not None:
            path = args.video / f"{gaps.title(args.real[i])}-{folder.name}.mp4"
            results["video"] = film_episode(system.env, system.pools, i, member(episodes, 0), path)
        return results

    fits = algorithm_of(card).name == get_method(DEFAULT).prior and not card.get("system")
    advised = args.run is None and fits and env.score == "success" and args.episodes >= ENOUGH
    systems = []
    for i, gap in enumerate(reals):
        facts: dict[str, Any] = {"where": "in simulation" if gap is None else f"on the {gap.name} real system"}
        facts |= {"policies": [results_of(i, k) for k in range(len(priors))]}
        if stepped:
            facts["real_steps"] = int(part(played, i, len(priors)).valid.sum())
        if advised and gap is not None:
            chosen = {"task": task, "prior": args.prior or folders[0].parent, "set": args.set, "out": args.out}
            succeeded = part(played, i, len(priors)).success
            facts["next"] = advice(int((~succeeded).sum()), succeeded.size, args.real[i], **chosen)
        systems.append(facts)
    return {"task": env.name, "score": env.score, "impl": env.impl, "episodes": args.episodes, "systems": systems}


def check(args: EvaluateArgs) -> tuple[list[Path], str]:
    """The folders of the policies and their task; raises UserError for what is wrong in the arguments and on disk."""
    if args.prior is not None and args.run is not None:
        raise UserError("--prior and --run exclude each other: name what to evaluate once")
    if args.best and args.run is None:
        raise UserError("--best: name the fine-tuning run with --run")
    if args.prior is None and args.run is None and args.task is None:
        raise UserError("nothing to evaluate: name a folder with --prior or --run, or a task with --task")
    options.at_least_one(args, "episodes")
    options.seed_list(args.seed, 1)
    options.each_once(args, "real")
    reals = [real for real in args.real if real != SIM]
    if len(reals) < len(args.real) and any(map(is_stepped, reals)):
        raise UserError(f"--real {' '.join(args.real)}: {TOGETHER}")
    if args.set and not reals:
        raise UserError(f"--set {args.set[0]}: changes a real system; name one with --real")
    if reals and is_robot(reals[0]):
        check_folder(args.out / "evaluate")
    if args.video is not None:
        check_folder(args.video, "--video")
        options.without_repeats("--real", [gaps.title(real) for real in args.real])  # a film is called after its system
        if any(map(is_stepped, reals)):
            raise UserError(f"--video: films simulated systems, and {reals[0]} is not one; leave one of the two out")
    if args.task is not None:
        check_real(args.task, reals, args.set)
    home = args.run / "best" if args.best and args.run else args.run or args.prior
    folders = options.prior_folders(home, out=args.out, task=args.task or "", preset=args.preset)
    task = options.task_of_priors(folders, args.task)
    check_real(task, reals, args.set)
    return folders, task


if __name__ == "__main__":
    cli.run_main(main, EvaluateArgs, __doc__ or "")
