"""Draw learning curves and print tables, from the fine-tuning runs on disk or from released tables."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from envs import extend, gaps
from envs.types import UserError, unknown
from experiments.runner import cli, options
from sgft_jax.io.runs import check_folder

if TYPE_CHECKING:
    from sgft_jax.analysis.curves import Curve, Records


@dataclass(frozen=True)
class FiguresArgs:
    """A figure and tables for each task and gap, and of all tasks for each gap."""

    task: str | None = None
    """Only this task; default: all that have runs."""
    gaps: tuple[str, ...] = ()
    """Only these real systems, such as default; default: all that have runs."""
    methods: tuple[str, ...] = ()
    """Only these methods; default: all that have runs."""
    priors: tuple[str, ...] = ()
    """Only runs from these sets of priors, as the tables name them; default: all."""
    variants: bool = True
    """Also show variants (runs with other options), in panels beside their methods; --no-variants leaves them out."""
    reference: str | None = None
    """Compare the others with METHOD or METHOD:VARIANT; default: with the best of each table."""
    out: Path = Path("runs")
    """Parent of all run folders; the figures and tables.md go to <out>/figures."""
    data: Path | None = None
    """Folder of released tables to read instead of runs, such as docs/data."""
    export: Path | None = None
    """Instead of drawing, write what the runs say into this folder as CSV tables, which --data reads back."""


def main(args: FiguresArgs) -> None:
    """Draws, prints the tables, and says where they are; or exports."""
    if args.export is not None:
        from sgft_jax.analysis.release import export

        check_folder(args.export, "--export")
        print("\n".join(f"written: {path}" for path in export(args.out, args.export)))
        return
    path = figures(args)
    print(path.read_text())
    print(f"written: {path} and the figures beside it")


def figures(args: FiguresArgs) -> Path:
    """The figures and tables.md, whose path is returned; raises UserError if there is no run to draw."""
    from sgft_jax.analysis.release import read

    check_folder(args.out / "figures")
    runs = read(args.out, args.data)
    if not runs.curves:
        raise UserError(_nothing(args, runs.notes))
    task = (extend.name_of(args.task),) if args.task else ()
    chosen = select(runs, variants=args.variants, task=task, gap=args.gaps, method=args.methods, priors=args.priors)
    return write_results(chosen, args.out / "figures", reference=args.reference)


def _nothing(args: FiguresArgs, notes: list[str]) -> str:
    """Why there is nothing to draw. notes: a line for each run that was left out."""
    if args.data:
        command = f"python -m experiments.figures --export {args.data}"
        return f"{args.data}: its curves-*.csv hold no run; write some with: {command}"
    message = f"{args.out / 'finetune'}: holds no evaluated run to draw"
    if notes:
        return f"{message}: {notes[0]}" + (f"; and {len(notes) - 1} more" if len(notes) > 1 else "")
    task, real = args.task or "push", gaps.usual(extend.name_of(args.task or "push"))
    made = options.command("finetune", task=task, real=None if real == "default" else real)
    return f"{message}; make one with: {made}"


def select(records: "Records", *, variants: bool = True, **wanted: Sequence[str]) -> "Records":
    """Only the curves of certain tasks, gaps, methods or priors: names by field of `Curve`, empty for all.

    Raises UserError if no curve has one of the names, or if nothing is left.
    """
    curves = [curve for curve in records.curves if variants or not curve.variant]
    for field, names in wanted.items():
        known = sorted({getattr(curve, field) for curve in curves})
        if missing := [name for name in names if name not in known]:
            raise UserError(unknown(f"run of the {field}", missing[0], known))
        curves = [curve for curve in curves if not names or getattr(curve, field) in names]
    if not curves:
        raise UserError(f"no run matches all of the chosen: {', '.join(name for name in wanted if wanted[name])}")
    return records._replace(curves=curves)


def write_results(records: "Records", target: Path, *, reference: str | None = None) -> Path:
    """A figure and tables for each task and gap, and of all tasks for each gap; returns the path of tables.md.

    reference: METHOD or METHOD:VARIANT that the others are compared with, see `tables.summary`; UserError without it.
    """
    from sgft_jax.analysis import tables

    if reference and reference not in (names := {curve.spec for curve in records.curves}):
        raise UserError(unknown("--reference", reference, names))
    sections = ["# Fine-tuning results", tables.LEGEND]
    for gap in dict.fromkeys(curve.gap for curve in records.curves):
        sections += _overview(gap, [curve for curve in records.curves if curve.gap == gap], target)
    for task, gap in dict.fromkeys((curve.task, curve.gap) for curve in records.curves):
        chosen = [curve for curve in records.curves if (curve.task, curve.gap) == (task, gap)]
        sections += _section(f"{task} on the {gap} real system", chosen, target / f"{task}-{gap}.png", reference)
    if records.notes:
        sections.append("\n".join(["## Left out or unfinished", "", *(f"- {note}" for note in records.notes)]))
    path = target / "tables.md"
    path.write_text("\n\n".join(sections) + "\n")
    return path


def _overview(gap: str, curves: "Sequence[Curve]", target: Path) -> list[str]:
    """All tasks on one gap, methods with their defaults from the same priors; [] for a single task."""
    from sgft_jax.analysis import tables
    from sgft_jax.analysis.curves import from_main_priors
    from sgft_jax.analysis.figures import MOST, learning_curves

    tasks = {task: from_main_priors(c for c in curves if c.task == task) for task in sorted({c.task for c in curves})}
    tasks = {task: chosen for task, chosen in tasks.items() if chosen}
    if len(tasks) < 2:
        return []
    title = f"All tasks, {gap} real systems"
    shown = tables.leading(tasks, MOST)
    panels = {task: [curve for curve in chosen if curve.name in shown] for task, chosen in tasks.items()}
    path = learning_curves(target / f"overview-{gap}.png", panels, title=title)
    return [f"## {title}", f"![{title}]({path.name})", tables.areas_by_task(tasks)]


def _section(title: str, curves: "Sequence[Curve]", path: Path, reference: str | None) -> list[str]:
    """One task and gap: a panel for each set of priors and for each method with variants, a table for each set."""
    from sgft_jax.analysis import tables
    from sgft_jax.analysis.curves import by_priors
    from sgft_jax.analysis.figures import learning_curves

    panels: dict[str, list[Curve]] = {}
    texts = []
    for priors, members in by_priors(curves).items():
        words = f"priors {priors}" if priors else "priors unknown"
        panels[words] = [curve for curve in members if not curve.variant]
        for method in dict.fromkeys(curve.method for curve in members if curve.variant):
            panels[f"{method} and its variants, {words}"] = [curve for curve in members if curve.method == method]
        texts += [f"### {title}, {words}", tables.summary(members, reference)]
    learning_curves(path, panels, title=title)
    return [f"## {title}", f"![{title}]({path.name})", *texts]


if __name__ == "__main__":
    cli.run_main(main, FiguresArgs, __doc__ or "")
