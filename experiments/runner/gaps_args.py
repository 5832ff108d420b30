"""What `experiments.gaps` and the study that draws gaps ask of their command lines. Imports no JAX."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from envs import extend, gaps
from envs.types import UserError
from experiments.runner import cli, options
from experiments.runner.options import Impl
from sgft_jax.io.runs import check_folder
from sgft_jax.presets import PRESETS, PretrainConfig

PLAIN = "fast"  # strata are those of priors that know the task's own domain alone


@dataclass(frozen=True)
class MeasureArgs:
    """How gaps are measured."""

    task: str = "push"
    """A task by name (python -m experiments.tasks lists them), or a Python file with a task of your own."""
    prior: Path | None = None
    """Folder of a prior, or of several (prior/seed-*); default: those of <out>/pretrain/<task>/<preset>."""
    preset: str = PLAIN
    """Pretraining preset of the priors, and of the training on the real systems; --config.* changes the latter."""
    seeds: int = 1
    """Policies trained per gap."""
    episodes: int = 256
    """Evaluation episodes per policy and gap, at least 200."""
    out: Path = Path("runs")
    """Parent of all run folders; the results go to <out>/gaps/<task>."""
    seed: int = 0
    """The first seed of the training on real systems."""
    impl: Impl = "auto"
    config: PretrainConfig = field(default_factory=lambda: PRESETS[PLAIN])
    """Expert: single settings of that training; the defaults are those of the preset."""


@dataclass(frozen=True)
class GapsArgs(MeasureArgs):
    """One table: a line per gap of a task."""

    presets: tuple[str, ...] = ()
    """Gaps to measure, by name or as .toml/.json files (all gaps of a file, or file.toml:name); default: all that come
    with the task."""
    train: bool = True
    """Also train on every real system, all of them in one program; --no-train measures zero-shot success only."""


def check(args: GapsArgs) -> tuple[GapsArgs, list[int], list[Path]]:
    """The arguments with every gap of a file, the seeds, and the folders of the priors; UserError for what is wrong."""
    cli.choose("--preset", args.preset, PRESETS)
    check_episodes(args)
    args = replace(args, presets=gaps.each(args.presets))
    options.without_repeats("--presets", args.presets)
    check_folder(args.out / "gaps")
    seeds, task = options.seed_list(args.seed, args.seeds), extend.name_of(args.task)
    options.check_task(args.task, args.presets)
    if not (args.presets or gaps.presets(task)):
        raise UserError(f"{task} comes with no gaps; name .toml or .json files with --presets")
    return args, seeds, folders_of_priors(args)


def check_episodes(args: MeasureArgs) -> None:
    """Raises UserError for too few evaluation episodes to tell gaps apart, or too many."""
    options.at_least_one(args, "episodes")
    if args.episodes < 200:
        raise UserError(f"--episodes is {args.episodes}: a success rate needs at least 200 to tell 40 % from 50 %")


def folders_of_priors(args: MeasureArgs) -> list[Path]:
    """The folders of the priors that play; raises UserError where there are none, or they are of another task."""
    folders = options.prior_folders(args.prior, out=args.out, task=args.task, preset=args.preset)
    options.task_of_priors(folders, args.task)
    return folders
