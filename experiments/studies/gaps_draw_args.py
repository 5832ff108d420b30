"""What `gaps_draw` asks of its command line. Imports no JAX."""

from dataclasses import dataclass
from pathlib import Path

from envs.files import read_toml
from envs.types import UserError
from experiments.runner import cli
from experiments.runner.gaps_args import PLAIN, MeasureArgs, check_episodes, folders_of_priors
from experiments.runner.options import at_least_one, check_task, seed_list
from sgft_jax.io.runs import check_folder
from sgft_jax.presets import PRESETS


@dataclass(frozen=True, kw_only=True)
class DrawArgs(MeasureArgs):
    """One table: a line per drawn gap of a task."""

    count: int
    """How many gaps; they go to <out>/gaps/<task>/seed-<seed>.toml. Gap i of a seed is always the same."""
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
    preset: str = PLAIN
    """Pretraining preset of the priors."""
    seed: int = 0
    """What is drawn; also the first seed of the training on real systems."""


def check(args: DrawArgs) -> tuple[list[int], list[Path]]:
    """The seeds and the folders of the priors; raises UserError for what is wrong with the options."""
    cli.choose("--judge-preset", args.judge_preset, PRESETS)
    at_least_one(args, "count")
    check_episodes(args)
    _check_choice(args)
    if args.distribution is not None:
        read_toml(args.distribution)
    check_folder(args.out / "gaps")
    seeds = seed_list(args.seed, args.seeds)
    check_task(args.task)
    return seeds, folders_of_priors(args)


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
