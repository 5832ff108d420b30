"""Draw the figures again from the fine-tuning runs on disk, and put all methods of a real system in one table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import envs
from envs import gaps
from experiments import ablations, cli, overview, tables
from experiments.comparison import (
    Comparison,
    beside_its_method,
    colour_order,
    figure_order,
    names_of,
    read_comparison,
    shared_variants,
    split,
)
from experiments.results import Curve
from sgft_jax.analysis import plot
from sgft_jax.analysis.stats import iqm_interval
from sgft_jax.types import UserError

_SAME = 0.05  # of success: evaluations of one policy in two programs differ by as much, on a GPU
_LEGEND = (
    "Success on the real system: interquartile mean over seeds with its 95 % bootstrap interval, in per cent. "
    "Transitions to 90 or 98 %: when the mean over seeds first got there, with its 95 % interval; > where the "
    "run ended before. Deepest dip: how far that mean ever fell below zero-shot, in percentage points. Area: mean "
    "success over real transitions up to where the shortest run of the table ends. Seeds behind: those that end below "
    "90 %. Robot minutes: of the run, without resets."
)


@dataclass(frozen=True)
class FiguresArgs:
    """Reads <out>/finetune, writes <out>/figures."""

    task: str | None = None
    """push, push-towel, push-ball, hammer or insert; default: every task that has runs."""
    out: Path = Path("runs")
    """Parent of all run folders; also docs/data or another folder that `experiments.export` wrote."""


def main(args: FiguresArgs) -> None:
    """Draws, prints the tables, and says where they are."""
    path = figures(args)
    print(path.read_text())
    print(f"written: {path}")


def figures(args: FiguresArgs) -> Path:
    """The figures and results.md, whose path is returned; raises UserError if there is no run."""
    task = None if args.task is None else envs.name_of(args.task)
    home = args.out / "finetune"
    folders = sorted(p for p in home.glob(f"{task or '*'}/*") if p.is_dir())
    comparisons = [read_comparison(folder) for folder in folders]
    drawn = [c for c in comparisons if c.curves]
    if not drawn:
        command = f"python -m experiments.finetune --task {args.task or 'push'}"
        raise UserError(f"{home}: holds no evaluated run to draw; make one with: {command}")
    target = args.out / "figures"
    target.mkdir(parents=True, exist_ok=True)
    order = colour_order(names_of(drawn))
    singles = [_section(c, draw(c, target, order)) for c in drawn]
    above = overview.overview(drawn, target, order)
    below = [
        ablations.transforms(drawn),
        ablations.horizons(drawn, target),
        ablations.severity(drawn, target, order),
    ]
    sections = [*above.sections, *singles, *(text for part in below for text in part.sections)]
    missing = [f"- {c.task}/{c.real}: {note}" for c in comparisons for note in c.notes]
    missing += [f"- {note}" for part in (above, *below) for note in part.missing]
    if untouched := _untouched(task, {(c.task, c.real) for c in comparisons}):
        missing.append(f"- no run on {', '.join(untouched)}")
    if missing:
        sections.append("\n".join(["## Missing", "", *missing]))
    text = "\n\n".join(["# Fine-tuning results", _LEGEND, *sections])
    path = target / "results.md"
    path.write_text(text + "\n")
    return path


def draw(comparison: Comparison, target: Path, order: Sequence[str]) -> dict[str, Path]:
    """Learning curves of all methods on one real system: figures in the folder `target`, by their titles.

    order: of the methods in all figures, which gives colours. A variant that several of them have, as `tuned`, has a
    figure of its own, and so have the other variants of a method, beside it. Methods that plan start from priors of
    their own: zero-shot is a line where that of all is about the same.
    """
    drawn = {}
    for part, curves in _apart(comparison.curves, shared_variants(order)).items():
        title = _title(comparison) + (f", {part}" if part else "")
        name = "_".join(filter(None, [f"{comparison.task}-{comparison.real}", part]))
        starts = [float(iqm_interval(curve.success[:, 0]).estimate) for curve in curves.values()]
        drawn[title] = plot.learning_curves(
            target / f"{name}.png",
            {method: (curve.transitions, curve.success) for method, curve in curves.items()},
            title=title,
            zero_shot=starts[0] if max(starts) - min(starts) < _SAME else None,
            order=figure_order(order, curves),
            **_robot_time(curves),
        )
    return drawn


def _apart(curves: Mapping[str, Curve], shared: Sequence[str]) -> dict[str, dict[str, Curve]]:
    """[part][name]: methods under "", shared variants under their names, other ones after their method under its name;
    a variant of a method that has not been run stands for it among the methods.
    """
    found: dict[str, dict[str, Curve]] = {}
    for name, curve in curves.items():
        method, variant = split(name)
        part = variant if variant in shared else method if beside_its_method(name, curves) else ""
        if part == method:
            found.setdefault(part, {})[method] = curves[method]
        found.setdefault(part, {})[name] = curve
    return dict(sorted(found.items()))


def _title(comparison: Comparison) -> str:
    return f"{comparison.task} on the {comparison.real} real system"


def _robot_time(curves: Mapping[str, Curve]) -> dict[str, Any]:
    """Steps per rollout and seconds per step, from the first curve that goes beyond zero-shot; {} if none does."""
    for curve in curves.values():
        if curve.transitions[-1] > 0:
            steps = int(curve.transitions[-1])
            seconds = 60 * float(curve.robot_minutes[-1]) / steps
            return {"rollout_length": steps // int(curve.rollouts[-1]), "control_dt": seconds}
    return {}


def _section(comparison: Comparison, drawn: Mapping[str, Path]) -> str:
    lengths = [int(curve.rollouts[-1]) for curve in comparison.curves.values()]
    budgets = [n for n in tables.BUDGETS if n <= max(lengths)]
    rows = [tables.row(*item, budgets, min(lengths)) for item in comparison.curves.items()]
    table = tables.markdown(tables.columns(budgets, min(lengths)), rows)
    return "\n\n".join([f"## {_title(comparison)}", table, *(f"![{t}]({path.name})" for t, path in drawn.items())])


def _untouched(task: str | None, seen: set[tuple[str, str]]) -> list[str]:
    """Gaps that come with a task and that no run has met."""
    tasks = envs.TASKS if task is None else [task]
    return [f"{name}/{gap}" for name in tasks for gap in gaps.presets(name) if (name, gap) not in seen]


if __name__ == "__main__":
    cli.run_main(main, FiguresArgs, __doc__ or "")
