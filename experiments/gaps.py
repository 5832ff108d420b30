"""Measure what gaps do: success of the simulator's policies on each real system, and of a policy trained right there.

A gap is worth studying only if pretraining alone does not bridge it and a policy that does exists: it is admissible if
zero-shot success is at most 40 % and training on the real system itself reaches 95 %.

With --draw N, gaps are drawn from a distribution, written to a file and sorted: solved by the simulator's policy (80 %
and more), partial, or failed (below 20 %); trivial where identifying commands (scale, rotation, bias) and constant
errors of sensors from one rollout suffices (90 %). What the table beside the file holds already is not measured again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from envs import extend, gaps
from envs.files import read_toml
from envs.types import UserError
from experiments.runner import cli
from experiments.runner.options import (
    Impl,
    at_least_one,
    check_task,
    not_negative,
    prior_folders,
    seed_list,
    task_of_priors,
    without_repeats,
)
from sgft_jax.io.runs import check_folder
from sgft_jax.presets import PRESETS, PretrainConfig

PLAIN = "fast"  # strata are those of priors that know the task's own domain alone


@dataclass(frozen=True)
class GapsArgs:
    """One table: a line per gap of a task."""

    task: str = "push"
    """A task by name (python -m experiments.tasks lists them), or a Python file with a task of your own."""
    presets: tuple[str, ...] = ()
    """Gaps to measure, by name or as .toml/.json files (all gaps of a file, or file.toml:name); default: all that come
    with the task."""
    draw: int = 0
    """Draw so many gaps instead and write them to <out>/gaps/<task>/seed-<seed>.toml; gap i of a seed is always the
    same."""
    distribution: Path | None = None
    """With --draw: a .toml file of families to draw from; default: the one that comes with the task."""
    plan: bool = False
    """With --draw: also measure what sgft-mpc does at its start, plans by the prior's models."""
    judge: bool = False
    """With --draw: also train policies that see their previous actions, in one program, on every gap that nothing
    measured so far masters (90 %): a gap counts only if something does."""
    judge_preset: str = PLAIN
    """Pretraining preset of that training; --config.* changes it."""
    choose: int = 0
    """With --draw: choose so many of the measured gaps for a frozen set, evenly over strata and families. A gap that a
    policy trained there (--judge) did not master is never chosen."""
    to: Path | None = None
    """With --choose: the .toml file of the frozen set; one that holds other gaps is never replaced."""
    overwrite: bool = False
    """With --draw: measure again what the table holds with other settings; default: refuse."""
    prior: Path | None = None
    """Folder of a prior, or of several (prior/seed-*); default: those of <out>/pretrain/<task>/<preset>."""
    preset: str = PLAIN
    """Pretraining preset of the priors, and of the training on the real systems; --config.* changes the latter."""
    train: bool = True
    """Also train on every real system, all of them in one program; --no-train measures zero-shot success only. Drawn
    gaps have --judge instead."""
    seeds: int = 1
    """Policies trained per gap; of drawn gaps the best one counts."""
    episodes: int = 256
    """Evaluation episodes per policy and gap, at least 200."""
    out: Path = Path("runs")
    """Parent of all run folders; the summary goes to <out>/gaps/<task>/summary.json."""
    seed: int = 0
    """What is drawn; also the first seed of the training on real systems."""
    impl: Impl = "auto"
    config: PretrainConfig = field(default_factory=lambda: PRESETS[PLAIN])
    """Expert: single settings of that training; the defaults are those of the preset."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(measure, GapsArgs, __doc__ or "", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> GapsArgs:
    """The defaults of the presets; `measure` refuses a preset that does not exist."""
    chosen = cli.preview(argv, preset=PLAIN, judge_preset=PLAIN, draw=0)
    training = chosen.judge_preset if chosen.draw else chosen.preset
    return GapsArgs(
        preset=chosen.preset, judge_preset=chosen.judge_preset, config=PRESETS.get(training, PRESETS[PLAIN])
    )


def measure(args: GapsArgs) -> dict[str, Any]:
    """Measures, prints a table, writes and returns the summary."""
    for option in ("preset", "judge_preset"):
        cli.choose(f"--{option.replace('_', '-')}", getattr(args, option), PRESETS)
    at_least_one(args, "episodes")
    if args.episodes < 200:
        raise UserError(f"--episodes is {args.episodes}: a success rate needs at least 200 to tell 40 % from 50 %")
    _check_draw(args)
    args = replace(args, presets=gaps.each(args.presets))
    without_repeats("--presets", args.presets)
    check_folder(args.out / "gaps")
    if args.to:
        check_folder(args.to.parent, "--to")
    seeds, task = seed_list(args.seed, args.seeds), extend.name_of(args.task)
    check_task(args.task, args.presets)
    if not (args.draw or args.presets or gaps.presets(task)):
        raise UserError(f"{task} comes with no gaps; name .toml or .json files with --presets")
    folders = prior_folders(args.prior, out=args.out, task=args.task, preset=args.preset)
    task_of_priors(folders, args.task)
    if args.draw:
        from experiments.studies.gaps_draw import run
    else:
        from experiments.runner.gaps_run import run

    return run(args, seeds, folders)


def _check_draw(args: GapsArgs) -> None:
    not_negative(args, "draw")
    if args.draw and args.presets:
        raise UserError(f"--presets {args.presets[0]}: names gaps, and --draw draws them; give one of the two")
    names = ("distribution", "plan", "judge", "choose", "to", "overwrite")
    if odd := [name for name in names if getattr(args, name) and not args.draw]:
        raise UserError(f"--{odd[0]}: is for drawn gaps; say how many with --draw")
    if args.distribution is not None:
        read_toml(args.distribution)
    if not 0 <= args.choose <= args.draw:
        raise UserError(f"--choose is {args.choose}: must be from 1 to the {args.draw} of --draw")
    if bool(args.choose) != bool(args.to):
        raise UserError("--choose N and --to FILE.toml: give both, the number of gaps and where they go")
    if args.to and args.to.suffix != ".toml":
        raise UserError(f"--to {args.to}: must end in .toml")


if __name__ == "__main__":
    main()
