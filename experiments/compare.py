"""Run every method on every task and real system, cell by cell, and draw what there is.

A cell is one fine-tuning run of all seeds, with the method's own defaults or, with --tuned, the options that
`experiments.studies.tune` chose.
Cells that are finished are left alone, begun ones go on where they stopped: the same command,
given again, does what is missing. The real systems of a task that a method has got equally far on are stepped together
in one program.

`python -m experiments.compare hybrid` compares methods that learn from real data and a simulator, see its --help.
"""

import glob
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

from envs import extend, gaps
from envs.types import UserError, unknown
from experiments.figures import FiguresArgs, figures
from experiments.runner import cli, grid, hybrid_grid, tuned
from experiments.runner.grid import FINETUNING, Cell, GridArgs, check_begun, look_up, work
from experiments.runner.hybrid_grid import HybridGridArgs
from sgft_jax.analysis.hybrid import Results, ranks, summary
from sgft_jax.io.runs import NO_DATA
from sgft_jax.methods import DEFAULT, NAMES
from sgft_jax.train.schedule import describe, name_of

HYBRID = "hybrid"  # first word of the command line for methods that learn from real data and a simulator
_HYBRID_HELP = """Run every method on every data set and simulator, cell by cell; print tables and draw curves.

A cell is one run of `experiments.hybrid` with all seeds. Methods without a simulator run once for each data set, those
without data once for each simulator. Cells that are finished are left alone, begun ones go on where they stopped: the
same command, given again, does what is missing. All simulators and seeds of a method and data set share one program.
"""
_RANKS = (
    "Spearman's correlation of the methods' means here with those after {:,} updates (there), with a 95 % bootstrap "
    "interval that draws seeds; methods in either order, the best first."
)


@dataclass(frozen=True)
class CompareArgs(GridArgs):
    """A grid of fine-tuning runs; everything not named here is as `experiments.finetune` has it."""

    tuned: bool = False
    """Start from the options that `experiments.studies.tune` chose for each task and method; the runs are a variant
    of their own, `tuned`, beside those with the defaults."""
    reference: str | None = None
    """Compare the others with METHOD or METHOD:VARIANT; default: with the best of each table."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line; its first word may be `hybrid`."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == [HYBRID]:
        cli.run_main(compare_hybrid, HybridGridArgs, _HYBRID_HELP, argv=words[1:], default=hybrid_grid.defaults)
    else:
        cli.run_main(compare, CompareArgs, __doc__ or "", argv=words)


def compare(args: CompareArgs) -> None:
    """Runs what is missing, then draws; raises UserError in the end if some cells could not run."""
    chosen = cells(args)
    if args.tuned:
        check_begun(chosen)  # tuning may have chosen again since
    work(chosen, args, lambda cells: _draw(args) if any(cell.done for cell in cells) else None)


def _draw(args: CompareArgs) -> None:
    print(figures(FiguresArgs(out=args.out, reference=args.reference)).read_text())


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
    runs = [grid.run_of(args, *place) for place in itertools.product(args.tasks, args.reals, args.methods)]
    return [look_up(FINETUNING, tuned.apply(run) if args.tuned else run) for run in runs]


def compare_hybrid(args: HybridGridArgs) -> None:
    """Runs what is missing, then shows tables and curves; raises UserError in the end if some cells could not run."""
    args = hybrid_grid.checked(args)
    if args.released is not None:
        _show(args, hybrid_grid.released(args, args.released))
        return
    chosen = hybrid_grid.cells_of(args)
    check_begun(chosen)
    if args.export is not None:
        hybrid_grid.export(args.export, chosen)
        return
    work(chosen, args, lambda cells: _show(args, hybrid_grid.results(args, hybrid_grid.finished(cells))))


def tables(args: HybridGridArgs, results: Results) -> str:
    """The tables as Markdown."""
    texts = summary(results, reference=args.reference, seeds=args.seeds, schedule=describe(args.schedule))
    if args.released is not None and args.beside is not None:
        others = replace(args, schedule=replace(args.schedule, updates=args.beside))
        texts += [_RANKS.format(args.beside), ranks(results, hybrid_grid.released(others, args.released))]
    return "\n\n".join(texts)


def _show(args: HybridGridArgs, results: Results) -> None:
    """Tables on the screen and in a file, and a figure of curves for each data set; nothing without any curve."""
    if not results.curves:
        return
    from sgft_jax.analysis.figures import learning_curves  # brings Matplotlib

    folder, name = args.out / "figures", f"hybrid-{extend.name_of(args.task)}-{gaps.title(args.real)}"
    folder.mkdir(parents=True, exist_ok=True)
    path, text = folder / f"{name}-{args.score}.md", tables(args, results)
    path.write_text(text + "\n")
    print(f"{text}\n\nwritten: {path}")
    for data in results.data:
        panels = results.panels(data)
        if any(panels.values()):
            title = f"{' on '.join(filter(None, [results.task, data]))}, schedule {name_of(args.schedule)}"
            print(f"written: {learning_curves(folder / f'{name}-{data or NO_DATA}.png', panels, title=title)}")


if __name__ == "__main__":
    main()
