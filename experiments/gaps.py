"""Measure what gaps do: success of the simulator's policies on each real system, and of a policy trained right there.

A gap is worth studying only if pretraining alone does not bridge it and a policy that does exists: it is admissible if
zero-shot success is at most 40 % and training on the real system itself reaches 95 %.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from envs import extend
from envs.gaps import expand, presets
from envs.types import UserError
from experiments.runner import cli, options
from experiments.runner.options import Impl, Task
from sgft_jax.io.runs import check_folder
from sgft_jax.presets import PRESETS, PretrainConfig

PLAIN = "fast"  # strata are those of priors that know the task's own domain alone


@dataclass(frozen=True)
class MeasureArgs:
    """How gaps are measured."""

    task: Task = "push"
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


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(measure, GapsArgs, __doc__ or "", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> GapsArgs:
    """The defaults of the preset; `measure` refuses a preset that does not exist."""
    preset = cli.preview(argv, preset=PLAIN).preset
    return GapsArgs(preset=preset, config=PRESETS.get(preset, PRESETS[PLAIN]))


def measure(args: GapsArgs) -> dict[str, Any]:
    """Measures, prints a table, writes and returns the summary. Raises UserError for what is wrong with the options."""
    checked = check(args)
    from experiments.runner.gaps_run import run

    return run(*checked)


def check(args: GapsArgs) -> tuple[GapsArgs, list[int], list[Path]]:
    """The arguments with every gap of a file, the seeds, and the folders of the priors; UserError for what is wrong."""
    cli.choose("--preset", args.preset, PRESETS)
    check_episodes(args)
    args = replace(args, presets=expand(args.presets))
    options.without_repeats("--presets", args.presets)
    check_folder(args.out / "gaps")
    seeds, task = options.seed_list(args.seed, args.seeds), extend.name_of(args.task)
    options.check_task(args.task, args.presets)
    if not (args.presets or presets(task)):
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


if __name__ == "__main__":
    main()
