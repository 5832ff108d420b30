"""Draw gaps from a distribution, write them to a file, measure and sort them, and choose a frozen set of them.

Solved by the simulator's policy (80 % and more), partial, or failed (below 20 %); trivial where identifying commands
(scale, rotation, bias) and constant errors of sensors from one rollout suffices (90 %). What the table beside the file
holds already is not measured again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from envs.files import read_toml
from envs.types import UserError
from experiments.runner import cli
from experiments.runner.gaps_args import PLAIN, check_episodes, folders_of_priors
from experiments.runner.options import Impl, at_least_one, check_task, seed_list
from sgft_jax.io.runs import check_folder
from sgft_jax.presets import PRESETS, PretrainConfig


@dataclass(frozen=True)
class DrawArgs:
    """One table: a line per drawn gap of a task."""

    count: int
    """How many gaps; they go to <out>/gaps/<task>/seed-<seed>.toml. Gap i of a seed is always the same."""
    task: str = "push"
    """A task by name (python -m experiments.tasks lists them), or a Python file with a task of your own."""
    distribution: Path | None = None
    """A .toml file of families to draw from; default: the one that comes with the task."""
    plan: bool = False
    """Also measure what sgft-mpc does at its start, plans by the prior's models."""
    judge: bool = False
    """Also train policies that see their previous actions, in one program, on every gap that nothing measured so far
    masters (90 %): a gap counts only if something does."""
    judge_preset: str = PLAIN
    """Pretraining preset of that training; --config.* changes it."""
    choose: int = 0
    """Choose so many of the measured gaps for a frozen set, evenly over strata and families. A gap that a policy
    trained there (--judge) did not master is never chosen."""
    to: Path | None = None
    """With --choose: the .toml file of the frozen set; one that holds other gaps is never replaced."""
    overwrite: bool = False
    """Measure again what the table holds with other settings; default: refuse."""
    prior: Path | None = None
    """Folder of a prior, or of several (prior/seed-*); default: those of <out>/pretrain/<task>/<preset>."""
    preset: str = PLAIN
    """Pretraining preset of the priors."""
    seeds: int = 1
    """Policies trained per gap with --judge; the best one counts."""
    episodes: int = 256
    """Evaluation episodes per policy and gap, at least 200."""
    out: Path = Path("runs")
    """Parent of all run folders."""
    seed: int = 0
    """What is drawn; also the first seed of the training on real systems."""
    impl: Impl = "auto"
    config: PretrainConfig = field(default_factory=lambda: PRESETS[PLAIN])
    """Expert: single settings of that training; the defaults are those of --judge-preset."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(draw, DrawArgs, __doc__ or "", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> DrawArgs:
    """The defaults of the preset; `draw` refuses a preset that does not exist."""
    judge_preset = cli.preview(argv, judge_preset=PLAIN).judge_preset
    return DrawArgs(tyro.MISSING, judge_preset=judge_preset, config=PRESETS.get(judge_preset, PRESETS[PLAIN]))


def draw(args: DrawArgs) -> dict[str, Any]:
    """Draws, measures, prints a table, writes and returns it. Raises UserError for what is wrong with the options."""
    cli.choose("--judge-preset", args.judge_preset, PRESETS)
    at_least_one(args, "count")
    check_episodes(args)
    _check_choice(args)
    if args.distribution is not None:
        read_toml(args.distribution)
    check_folder(args.out / "gaps")
    seeds = seed_list(args.seed, args.seeds)
    check_task(args.task)
    folders = folders_of_priors(args.prior, args.out, args.task, args.preset)
    from experiments.studies.gaps_drawn import run

    return run(args, seeds, folders)


def _check_choice(args: DrawArgs) -> None:
    """Raises UserError for a frozen set of more gaps than are drawn, or one that cannot be written."""
    if not 0 <= args.choose <= args.count:
        raise UserError(f"--choose is {args.choose}: must be from 1 to the {args.count} of --count")
    if bool(args.choose) != bool(args.to):
        raise UserError("--choose N and --to FILE.toml: give both, the number of gaps and where they go")
    if args.to and args.to.suffix != ".toml":
        raise UserError(f"--to {args.to}: must end in .toml")
    if args.to:
        check_folder(args.to.parent, "--to")


if __name__ == "__main__":
    main()
