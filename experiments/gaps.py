"""Measure what gaps do: success of the simulator's policies on each real system, and of a policy trained right there.

A gap is worth studying only if pretraining alone does not bridge it and a policy that does exists: it is admissible if
zero-shot success is at most 40 % and training on the real system itself reaches 95 %.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from envs import gaps
from experiments import cli
from experiments.options import Impl, check_task, prior_folders, seed_list, without_repeats
from experiments.pretrain import DEFAULT_PRESET
from sgft_jax import extend
from sgft_jax.presets import PRESETS, PretrainConfig
from sgft_jax.types import UserError


@dataclass(frozen=True)
class GapsArgs:
    """One table: a line per gap of a task."""

    task: str = "push"
    """A task by name (python -m experiments.tasks lists them), or a Python file with a task of your own."""
    presets: tuple[str, ...] = ()
    """Gaps to measure, by name or as .toml/.json files; default: all that come with the task."""
    prior: Path | None = None
    """Folder of a prior, or of several (prior/seed-*); default: those of <out>/pretrain/<task>/<preset>."""
    preset: str = DEFAULT_PRESET
    """Pretraining preset of the priors, and of the training on the real systems; --config.* changes the latter."""
    train: bool = True
    """Also train on every real system, all of them in one program; --no-train measures zero-shot success only."""
    seeds: int = 1
    """Policies trained per gap."""
    episodes: int = 256
    """Evaluation episodes per policy and gap, at least 200."""
    out: Path = Path("runs")
    """Parent of all run folders; the summary goes to <out>/gaps/<task>/summary.json."""
    seed: int = 0
    """Expert: first seed of the training on real systems."""
    impl: Impl = "auto"
    config: PretrainConfig = field(default_factory=lambda: PRESETS[DEFAULT_PRESET])
    """Expert: single settings of that training; the defaults are those of the preset."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(measure, GapsArgs, __doc__ or "", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> GapsArgs:
    """The defaults of the preset; `measure` refuses a preset that does not exist."""
    preset = cli.preview(argv, preset=DEFAULT_PRESET).preset
    return GapsArgs(preset=preset, config=PRESETS.get(preset, PRESETS[DEFAULT_PRESET]))


def measure(args: GapsArgs) -> dict[str, Any]:
    """Measures, prints a table, writes and returns the summary."""
    cli.choose("--preset", args.preset, PRESETS)
    if args.episodes < 200:
        raise UserError(f"--episodes is {args.episodes}: a success rate needs at least 200 to tell 40 % from 50 %")
    without_repeats("--presets", args.presets)
    seeds, task = seed_list(args.seed, args.seeds), extend.name_of(args.task)
    check_task(args.task, args.presets)
    if not (args.presets or gaps.presets(task)):
        raise UserError(f"{task} comes with no gaps; name .toml or .json files with --presets")
    folders = prior_folders(args.prior, out=args.out, task=args.task, preset=args.preset)
    from experiments.gaps_run import run

    return run(args, seeds, folders)


if __name__ == "__main__":
    main()
