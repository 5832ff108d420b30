"""Run every method on every task and real system, cell by cell, and draw what there is.

A cell is one fine-tuning run of all seeds, with the method's own defaults or, with --tuned, the options that
`experiments.studies.tune` chose.
Cells that are finished are left alone, begun ones go on where they stopped: the same command,
given again, does what is missing. The real systems of a task that a method has got equally far on are stepped together
in one program.
"""

import glob
from dataclasses import dataclass, replace

from envs import gaps
from envs.types import UserError, unknown
from experiments.figures import FiguresArgs, figures
from experiments.runner import cli, grid, tuned
from experiments.runner.cells import Cell, check_begun, complete
from experiments.runner.finetune_args import FinetuneArgs
from experiments.runner.grid import GridArgs
from sgft_jax.methods import DEFAULT, NAMES


@dataclass(frozen=True)
class CompareArgs(GridArgs):
    """A grid of fine-tuning runs; everything not named here is as `experiments.finetune` has it."""

    tuned: bool = False
    """Start from the options that `experiments.studies.tune` chose for each task and method; the runs are a variant
    of their own, `tuned`, beside those with the defaults."""
    reference: str | None = None
    """Compare the others with METHOD or METHOD:VARIANT; default: with the best of each table."""


def main(args: CompareArgs) -> None:
    """Runs what is missing, then draws; raises UserError in the end if some cells could not run."""
    failed = compare(args)
    if args.dry:
        return
    if any(cell.done for cell in cells(args)):
        print(figures(FiguresArgs(out=args.out, reference=args.reference)).read_text())
    if failed:
        raise UserError(f"{len(failed)} of the cells did not run: {'; '.join(failed)}")


def compare(args: CompareArgs) -> list[str]:
    """Works through the cells in order; returns a line for each that could not run."""
    found = cells(args)
    if args.tuned:
        check_begun(found)  # tuning may have chosen again since
    return complete(found, args)


def cells(args: CompareArgs) -> list[Cell]:
    """The grid, methods innermost, so that every task and real system is compared early."""
    args = replace(args, reals=gaps.each(args.reals))
    grid.check(args)
    name = (args.reference or DEFAULT).partition(":")[0]
    if name not in (*NAMES, *args.methods) and not any(args.out.glob(f"finetune/*/*/{glob.escape(name)}*")):
        raise UserError(unknown("--reference", name, {*NAMES, *args.methods}))
    if args.tuned:
        for task in args.tasks:
            tuned.check_fair(args.out, task, args.methods, args.reals)
    names = [(task, real, method) for task in args.tasks for real in args.reals for method in args.methods]
    return [grid.look_up(_run_of(args, *each)) for each in names]


def _run_of(args: CompareArgs, task: str, real: str, method: str) -> FinetuneArgs:
    run = grid.run_of(args, task, real, method)
    return tuned.apply(run) if args.tuned else run


if __name__ == "__main__":
    cli.run_main(main, CompareArgs, __doc__ or "")
