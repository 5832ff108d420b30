"""What `experiments.collect` asks of its command line, and the files that it writes. Imports no JAX."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

from envs import extend
from envs.gaps import SIM, title
from envs.types import UserError
from experiments.runner.options import Impl, at_least_one, check_task, seed_list, task_of_priors
from sgft_jax.io.cards import resolve_shipped
from sgft_jax.io.runs import check_folder

LEVELS = {"halfcheetah": 4770.0, "walker2d": 2850.0}  # mean returns of D4RL's medium sets, v2
PAIR = ("medium-replay", "medium")
ROBOTS = {"wheel-legged": 0.0, "wheel-legged-forward": 0.2}  # tasks with an operator, and the speed it wants, m/s
_LOG, _SET = 16_588, 1_000_000  # transitions of H2O+'s logs of the robot, and of D4RL's medium sets


@dataclass(frozen=True)
class CollectArgs:
    """Data sets of one real system, one pair for each seed."""

    task: str = "halfcheetah"
    """A task by name (python -m experiments.tasks lists them), or a Python file with a task of your own."""
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
    seed: int = 0
    """Expert: first seed."""
    environments: int = 8
    """Expert: environments that learning steps together. Many would fill the experience with early, poor episodes."""
    updates: int = 1_000_000
    """Expert: updates, and so steps of learning, after which it gives up."""
    eval_every: int = 10_000
    """Expert: updates between looks at the level."""
    eval_episodes: int = 20
    """Expert: episodes of the exploring policy that decide whether it is reached."""
    impl: Impl = "auto"


def name_of(args: CollectArgs, kind: str, seed: int) -> str:
    """What a data set is called: `halfcheetah-medium-regenerated-seed-0`."""
    return f"{_system_name(args)}-{kind}-regenerated-seed-{seed}"


def _system_name(args: CollectArgs) -> str:
    """Of the real system: the task, and its gap if there is one."""
    return extend.name_of(args.task) + ("" if args.real == SIM else f"-{title(args.real)}")


def is_d4rls(args: CollectArgs) -> bool:
    """Whether the sets are made as D4RL's were, and may be judged by these."""
    return args.real == SIM and args.policy is None and args.level in (None, LEVELS.get(args.task))


def transitions_of(args: CollectArgs) -> int:
    """Transitions of the set of one policy, or of the log of an operator."""
    return args.transitions if args.transitions is not None else _LOG if args.operator else _SET


def targets(args: CollectArgs) -> list[Path]:
    """The files that a call writes. Minari's folder beside a file has its name with `-v0` for the ending."""
    if args.operator:
        name = f"{extend.name_of(args.task)}-{title(args.real)}-operator"
        return [args.out / f"{name}-seed-{seed}.txt" for seed in seed_list(args.seed, args.seeds)]
    if args.policy is not None:
        policy = resolve_shipped(args.policy)
        words = (_system_name(args), policy.parent.parent.name, policy.name)
        return [args.out / f"{'-'.join(filter(None, words))}.hdf5"]
    seeds = seed_list(args.seed, args.seeds)
    return [args.out / f"{name_of(args, kind, seed)}.hdf5" for seed in seeds for kind in PAIR]


def check(args: CollectArgs) -> float:
    """The level; raises UserError for what is wrong in the arguments and on disk."""
    args = replace(args, transitions=transitions_of(args))
    at_least_one(args, "transitions", "environments", "updates", "eval_every", "eval_episodes")
    seed_list(args.seed, args.seeds)
    check_task(args.task, [] if args.real == SIM else [args.real])
    if args.operator and args.task not in ROBOTS:
        raise UserError(f"--operator: {extend.name_of(args.task)} has none, only {', '.join(ROBOTS)}")
    if args.operator and args.policy is not None:
        raise UserError("--operator and --policy exclude each other: record one of them")
    if args.level is not None:
        _check_level(args.level, args)
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
    if there := [path for path in targets(args) if path.exists() and not args.overwrite]:
        raise UserError(f"{there[0]}: exists already; --overwrite replaces it, another --out keeps both")
    return level or 0.0


def _check_level(level: float, args: CollectArgs) -> None:
    """Raises UserError where nothing learns until the level is reached, or where nothing reaches it."""
    if args.policy is not None or args.operator:
        other = "--operator" if args.operator else "--policy"
        raise UserError(f"--level {level:g}: ends learning, and with {other} nothing learns; leave one of them out")
    if not math.isfinite(level):
        raise UserError(f"--level {level:g}: must be a finite number")
