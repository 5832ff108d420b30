"""Impure: figures and tables of many runs in one folder: what `experiments.figures` writes."""

from collections.abc import Sequence
from pathlib import Path

from envs.types import UserError, unknown
from sgft_jax.analysis import figures, tables
from sgft_jax.analysis.curves import Curve, Found, by_priors, from_main_priors


def select(records: Found, *, variants: bool = True, **wanted: Sequence[str]) -> Found:
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
    return Found(curves, records.notes)


def write_results(records: Found, target: Path, *, reference: str | None = None) -> Path:
    """A figure and tables for each task and gap, and of all tasks for each gap; returns the path of tables.md.

    reference: METHOD or METHOD:VARIANT that the others are compared with, see `tables.summary`; UserError without it.
    """
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


def _overview(gap: str, curves: Sequence[Curve], target: Path) -> list[str]:
    """All tasks on one gap, methods with their defaults from the same priors; [] for a single task."""
    tasks = {task: from_main_priors(c for c in curves if c.task == task) for task in sorted({c.task for c in curves})}
    tasks = {task: chosen for task, chosen in tasks.items() if chosen}
    if len(tasks) < 2:
        return []
    title = f"All tasks, {gap} real systems"
    shown = tables.leading(tasks, figures.MOST)
    panels = {task: [curve for curve in chosen if curve.name in shown] for task, chosen in tasks.items()}
    path = figures.learning_curves(target / f"overview-{gap}.png", panels, title=title)
    return [f"## {title}", f"![{title}]({path.name})", tables.areas_by_task(tasks)]


def _section(title: str, curves: Sequence[Curve], path: Path, reference: str | None) -> list[str]:
    """One task and gap: a panel for each set of priors and for each method with variants, a table for each set."""
    panels: dict[str, list[Curve]] = {}
    texts = []
    for priors, members in by_priors(curves).items():
        words = f"priors {priors}" if priors else "priors unknown"
        panels[words] = [curve for curve in members if not curve.variant]
        for method in dict.fromkeys(curve.method for curve in members if curve.variant):
            panels[f"{method} and its variants, {words}"] = [curve for curve in members if curve.method == method]
        texts += [f"### {title}, {words}", tables.summary(members, reference)]
    figures.learning_curves(path, panels, title=title)
    return [f"## {title}", f"![{title}]({path.name})", *texts]
