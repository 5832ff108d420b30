"""Draw learning curves and print tables, from the fine-tuning runs on disk or from released tables."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments import cli
from sgft_jax.analysis import figures as draw
from sgft_jax.analysis import tables
from sgft_jax.analysis.curves import Curve, Found, by_priors, from_main_priors, read_data, read_runs
from sgft_jax.analysis.release import export
from sgft_jax.types import UserError, unknown


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
    out: Path = Path("runs")
    """Parent of all run folders; the figures and tables.md go to <out>/figures."""
    data: Path | None = None
    """Folder of released tables to read instead of runs, such as docs/data."""
    export: Path | None = None
    """Instead of drawing, write what the runs say into this folder as CSV tables, which --data reads back."""


def main(args: FiguresArgs) -> None:
    """Draws, prints the tables, and says where they are; or exports."""
    if args.export is not None:
        print("\n".join(f"written: {path}" for path in export(args.out, args.export)))
        return
    path = figures(args)
    print(path.read_text())
    print(f"written: {path} and the figures beside it")


def figures(args: FiguresArgs) -> Path:
    """The figures and tables.md, whose path is returned; raises UserError if there is no run to draw."""
    found = read_data(args.data) if args.data else read_runs(args.out)
    curves = _chosen(found, args)
    target = args.out / "figures"
    sections = ["# Fine-tuning results", tables.LEGEND]
    for gap in dict.fromkeys(curve.gap for curve in curves):
        sections += _overview(gap, [curve for curve in curves if curve.gap == gap], target)
    for task, gap in dict.fromkeys((curve.task, curve.gap) for curve in curves):
        own = [curve for curve in curves if (curve.task, curve.gap) == (task, gap)]
        sections += _section(f"{task} on the {gap} real system", own, target / f"{task}-{gap}.png")
    if found.notes:
        sections.append("\n".join(["## Left out or unfinished", "", *(f"- {note}" for note in found.notes)]))
    path = target / "tables.md"
    path.write_text("\n\n".join(sections) + "\n")
    return path


def _chosen(found: Found, args: FiguresArgs) -> list[Curve]:
    """The curves that the arguments ask for; raises UserError if one of them names nothing or nothing is left."""
    if not found.curves:
        command = f"python -m experiments.finetune --task {args.task or 'push'}"
        raise UserError(f"{args.out / 'finetune'}: holds no evaluated run to draw; make one with: {command}")
    task = [args.task] if args.task else []
    asked = {"task": task, "gap": args.gaps, "method": args.methods, "priors": args.priors}
    curves = [curve for curve in found.curves if args.variants or not curve.variant]
    for field, wanted in asked.items():
        there = sorted({getattr(curve, field) for curve in curves})
        if missing := [name for name in wanted if name not in there]:
            raise UserError(unknown(f"run of the {field}", missing[0], there))
        curves = [curve for curve in curves if not wanted or getattr(curve, field) in wanted]
    if not curves:
        raise UserError(
            "no run fits all of --task, --gaps, --methods, --priors and --no-variants; leave one of them out"
        )
    return curves


def _overview(gap: str, curves: Sequence[Curve], target: Path) -> list[str]:
    """All tasks on one gap, methods with their defaults from the same priors; [] for a single task."""
    tasks = {task: from_main_priors(c for c in curves if c.task == task) for task in sorted({c.task for c in curves})}
    tasks = {task: own for task, own in tasks.items() if own}
    if len(tasks) < 2:
        return []
    title = f"All tasks, {gap} real systems"
    shown = tables.leading(tasks, draw.MOST)
    panels = {task: [curve for curve in own if curve.name in shown] for task, own in tasks.items()}
    path = draw.learning_curves(
        target / f"overview-{gap}.png", {t: own for t, own in panels.items() if own}, title=title
    )
    return [f"## {title}", f"![{title}]({path.name})", tables.areas_by_task(tasks)]


def _section(title: str, curves: Sequence[Curve], path: Path) -> list[str]:
    """One task and gap: a panel for each set of priors and for each method with variants, tables for each set."""
    panels: dict[str, list[Curve]] = {}
    texts = []
    for priors, own in by_priors(curves).items():
        words = f"priors {priors}" if priors else "priors unknown"
        panels[words] = [curve for curve in own if not curve.variant]
        for method in dict.fromkeys(curve.method for curve in own if curve.variant):
            panels[f"{method} and its variants, {words}"] = [curve for curve in own if curve.method == method]
        texts += [f"### {title}, {words}", tables.summary(own), tables.differences(own)]
    draw.learning_curves(path, {words: own for words, own in panels.items() if own}, title=title)
    return [f"## {title}", f"![{title}]({path.name})", *filter(None, texts)]


if __name__ == "__main__":
    cli.run_main(main, FiguresArgs, __doc__ or "")
