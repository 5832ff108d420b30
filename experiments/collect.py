"""Record data sets of a real system in the layouts of D4RL and Minari.

SAC learns in the system itself until its exploring policy returns --level on average. Its whole experience becomes
`medium-replay`, episodes of the final policy become `medium`, as in D4RL. With --policy, episodes of an existing policy
are recorded instead. With --operator, a noisy controller keeps a wheel-legged robot upright; its log is a text file.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from envs import extend
from envs.gaps import SIM, title
from envs.types import UserError
from experiments.runner import cli
from experiments.runner.options import FirstSeed, Impl, Task, at_least_one, check_task, seed_list, task_of_priors
from sgft_jax.io.cards import resolve_shipped
from sgft_jax.io.runs import check_folder

LEVELS = {"halfcheetah": 4770.0, "walker2d": 2850.0}  # mean returns of D4RL's medium sets, v2
PAIR = ("medium-replay", "medium")
ROBOTS = {"wheel-legged": 0.0, "wheel-legged-forward": 0.2}  # tasks with an operator, and the speed it wants, m/s
_LOG, _SET = 16_588, 1_000_000  # transitions of H2O+'s logs of the robot, and of D4RL's medium sets


@dataclass(frozen=True)
class CollectArgs:
    """Data sets of one real system, one pair for each seed."""

    task: Task = "halfcheetah"
    real: str = SIM
    """The real system: a gap by name or as a file, or sim for the task as it is."""
    policy: Path | None = None
    """Folder of a policy that another command has left (policy/seed-0, prior/seed-0): record it, learn nothing."""
    operator: bool = False
    """Of a wheel-legged robot: record someone who keeps it up by hand, learn nothing."""
    level: float | None = None
    """Mean return at which learning stops; default: that of D4RL's medium set, where there is one."""
    transitions: int | None = None
    """Transitions of the set of one policy, or of the log of an operator; default: 1,000,000 and 16,588."""
    seeds: int = 1
    """Number of seeds, all in one program."""
    out: Path = Path("runs/data")
    """Folder for the files."""
    overwrite: bool = False
    """Replace files of the same name."""
    seed: FirstSeed = 0
    environments: int = 8
    """Expert: environments that learning steps together. Many would fill the experience with early, poor episodes."""
    updates: int = 1_000_000
    """Expert: updates, and so steps of learning, after which it gives up."""
    eval_every: int = 10_000
    """Expert: updates between looks at the level."""
    eval_episodes: int = 20
    """Expert: episodes of the exploring policy that decide whether it is reached."""
    impl: Impl = "auto"


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(collect, CollectArgs, __doc__ or "", argv=argv)


def collect(args: CollectArgs) -> list[dict[str, Any]]:
    """Records and writes; returns what each file holds."""
    args = resolved(args)
    level, files = check(args), targets(args)
    from experiments.runner import collect_run  # JAX starts here

    if args.operator:
        return collect_run.operate(args, files, speed=ROBOTS[args.task])
    if args.policy is not None:
        return [collect_run.record(args, files[0])]
    return collect_run.teach(args, level, files, PAIR if is_d4rls(args) else ("", ""))


def resolved(args: CollectArgs) -> CollectArgs:
    """With every option that was left open."""
    count = args.transitions if args.transitions is not None else _LOG if args.operator else _SET
    return replace(args, transitions=count, policy=args.policy and resolve_shipped(args.policy))


def is_d4rls(args: CollectArgs) -> bool:
    """Whether the sets are made as D4RL's were, and may be judged by these."""
    return args.real == SIM and args.policy is None and args.level in (None, LEVELS.get(args.task))


def targets(args: CollectArgs) -> list[Path]:
    """The files that a call writes, of seeds that learn a pair for each one: `walker2d-medium-regenerated-seed-0.hdf5`.

    Minari's folder beside a file has its name with `-v0` for the ending.
    """
    seeds, task = seed_list(args.seed, args.seeds), extend.name_of(args.task)
    if args.operator:
        return [args.out / f"{task}-{title(args.real)}-operator-seed-{seed}.txt" for seed in seeds]
    system = task if args.real == SIM else f"{task}-{title(args.real)}"
    if args.policy is not None:
        policy = resolve_shipped(args.policy)
        return [args.out / f"{'-'.join(filter(None, (system, policy.parent.parent.name, policy.name)))}.hdf5"]
    return [args.out / f"{system}-{kind}-regenerated-seed-{seed}.hdf5" for seed in seeds for kind in PAIR]


def check(args: CollectArgs) -> float:
    """The level; raises UserError for what is wrong in the arguments and on disk."""
    at_least_one(resolved(args), "transitions", "environments", "updates", "eval_every", "eval_episodes")
    seed_list(args.seed, args.seeds)
    check_task(args.task, [] if args.real == SIM else [args.real])
    if args.operator and args.task not in ROBOTS:
        raise UserError(f"--operator: {extend.name_of(args.task)} has none, only {', '.join(ROBOTS)}")
    if args.operator and args.policy is not None:
        raise UserError("--operator and --policy exclude each other: record one of them")
    if args.level is not None and (args.policy is not None or args.operator):
        which = f"with {'--operator' if args.operator else '--policy'} nothing learns; leave one of them out"
        raise UserError(f"--level {args.level:g}: ends learning, and {which}")
    if args.level is not None and not math.isfinite(args.level):
        raise UserError(f"--level {args.level:g}: must be a finite number")
    level = args.level if args.level is not None else LEVELS.get(extend.name_of(args.task))
    if args.policy is None and level is None and not args.operator:
        raise UserError(f"--level: say at which mean return learning stops; only {', '.join(LEVELS)} have a default")
    if args.policy is not None:
        if not (args.policy / "prior.json").exists():
            raise UserError(
                f"--policy {args.policy}: {'holds no policy' if args.policy.is_dir() else 'no such folder'}"
            )
        task_of_priors([args.policy], args.task)
    check_folder(args.out)
    if existing := [path for path in targets(args) if path.exists() and not args.overwrite]:
        raise UserError(f"{existing[0]}: exists already; --overwrite replaces it, another --out keeps both")
    return level or 0.0


if __name__ == "__main__":
    main()
