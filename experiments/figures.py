"""Draw the figures again from the fine-tuning runs on disk, and put all methods of a real system in one table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import envs
from envs import gaps
from experiments import cli
from experiments.results import LEVELS, Curve, area, describe_run, read_curve
from sgft_jax import plot
from sgft_jax.jsonfile import read_json
from sgft_jax.log import EVAL
from sgft_jax.methods import METHODS
from sgft_jax.runs import CONFIG
from sgft_jax.stats import iqm_interval
from sgft_jax.types import UserError

BUDGETS = (10, 20, 50, 100)  # rollouts at which the table compares, as far as a run got
ORDER = tuple(reversed(METHODS))  # SGFT first, so that it keeps its colour whatever else there is
_SAME = 0.05  # of success: evaluations of one policy in two programs differ by as much, on a GPU
_LEGEND = (
    "Success on the real system: interquartile mean over seeds with its 95 % bootstrap interval, in per cent. "
    "Transitions to 90 or 98 %: when the mean over seeds first got there; > where the run ended before. Deepest dip: "
    "how far that mean ever fell below zero-shot, in percentage points. Area: mean success over real transitions up "
    "to where the shortest run of the table ends. Robot minutes: of the run, without resets."
)


@dataclass(frozen=True)
class FiguresArgs:
    """Reads <out>/finetune, writes <out>/figures."""

    task: str | None = None
    """push, push-towel, push-ball, hammer or insert; default: every task that has runs."""
    out: Path = Path("runs")
    """Parent of all run folders."""


class Comparison(NamedTuple):
    """All methods on one real system. curves: by method, in the order of `ORDER`, each followed by its variants. notes:
    what is missing or odd.
    """

    task: str
    real: str
    curves: dict[str, Curve]
    notes: list[str]


def main(args: FiguresArgs) -> None:
    """Draws, prints the tables, and says where they are."""
    path = figures(args)
    print(path.read_text())
    print(f"written: {path}")


def figures(args: FiguresArgs) -> Path:
    """One figure per real system and results.md, whose path is returned; raises UserError if there is no run."""
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
    sections = [_section(c, draw(c, target / f"{c.task}-{c.real}.png")) for c in drawn]
    missing = [f"- {c.task}/{c.real}: {note}" for c in comparisons for note in c.notes]
    if untouched := _untouched(task, {(c.task, c.real) for c in comparisons}):
        missing.append(f"- no run on {', '.join(untouched)}")
    if missing:
        sections.append("\n".join(["## Missing", "", *missing]))
    text = "\n\n".join(["# Fine-tuning results", _LEGEND, *sections])
    path = target / "results.md"
    path.write_text(text + "\n")
    return path


def read_comparison(folder: Path) -> Comparison:
    """What the runs of <out>/finetune/<task>/<real>/<method>[_<variant>]/<seeds>/ say."""
    curves: dict[str, Curve] = {}
    notes = []
    runs = {name: sorted(folder.glob(f"{name}/*/{EVAL}")) for name in _names(folder)}
    if absent := [method for method in ORDER if not runs[method]]:
        notes.append(f"no run of {', '.join(absent)}")
    for name in [name for name in runs if runs[name]]:
        curve, more = _choose(name, [run.parent for run in runs[name]])
        notes += more
        if curve is not None:
            curves[name] = curve
    return Comparison(folder.parent.name, folder.name, curves, notes)


def _names(folder: Path) -> list[str]:
    """All methods, each with the variants of it that have a folder; then the folders of people's own methods."""
    there = sorted(path.name for path in folder.iterdir() if path.is_dir())
    names = [name for method in ORDER for name in (method, *(n for n in there if n.startswith(f"{method}_")))]
    return names + [name for name in there if name not in names]


def draw(comparison: Comparison, path: Path) -> Path:
    """Learning curves of all methods on one real system.

    Methods that plan start from priors of their own: zero-shot is a line where that of all is about the same.
    """
    starts = [float(iqm_interval(curve.success[:, 0]).estimate) for curve in comparison.curves.values()]
    return plot.learning_curves(
        path,
        {method: (curve.transitions, curve.success) for method, curve in comparison.curves.items()},
        title=f"{comparison.task} on the {comparison.real} real system",
        zero_shot=starts[0] if max(starts) - min(starts) < _SAME else None,
        **_robot_time(comparison.curves),
    )


def columns(budgets: Sequence[int], common: int) -> list[str]:
    """The names of the cells in a `row`."""
    return [
        "method", "seeds", "zero-shot", *(f"{n} rollouts" for n in budgets), "at the end (rollouts)",
        *(f"transitions to {level} %" for level in LEVELS), f"area to {common} rollouts", "deepest dip",
        "robot minutes",
    ]  # fmt: skip


def row(method: str, curve: Curve, budgets: Sequence[int], common: int) -> list[str]:
    """The cells of one method, with its success after so many rollouts. common: rollouts that all methods got to."""
    facts = describe_run(curve)
    reached = [facts[f"to_{level}"]["mean_curve"] for level in LEVELS]
    return [
        method,
        str(curve.success.shape[0]),
        _percent(curve.success[:, 0]),
        *(_at(curve, rollouts) for rollouts in budgets),
        f"{_percent(curve.success[:, -1])} ({curve.rollouts[-1]})",
        *(f"> {curve.transitions[-1]:,}" if n is None else f"{n:,}" for n in reached),
        _percent(area(curve, common)) if common else "-",
        f"{100 * facts['dip']['mean']:.0f}",
        f"{curve.robot_minutes[-1]:.1f}",
    ]


def _at(curve: Curve, rollouts: int) -> str:
    """Success at the evaluation after exactly so many rollouts."""
    (index,) = np.nonzero(curve.rollouts == rollouts)
    return _percent(curve.success[:, index[-1]]) if index.size else "-"


def _percent(success: np.ndarray) -> str:
    band = iqm_interval(success)
    interval = f" [{100 * band.low:.0f}, {100 * band.high:.0f}]" if len(success) > 1 else ""
    return f"{100 * band.estimate:.0f}{interval}"


def _choose(method: str, folders: list[Path]) -> tuple[Curve | None, list[str]]:
    """Of several runs of a method the one with the most seeds, then rollouts; runs that share seeds are not pooled."""
    found: list[tuple[int, int, Path, Curve]] = []
    notes = []
    for folder in folders:
        try:
            curve = read_curve(folder)
        except UserError as error:
            notes.append(f"{method}: {error}")
            continue
        found.append((curve.success.shape[0], int(curve.rollouts[-1]), folder, curve))
    if not found:
        return None, notes
    found.sort(key=lambda run: run[:2])
    *others, (_, rollouts, folder, curve) = found
    notes += [f"{method}: {other.name} left out, {folder.name} has more seeds or rollouts" for *_, other, _ in others]
    if (wanted := _wanted(folder)) and rollouts < wanted:
        notes.append(f"{method}: unfinished, {rollouts} of {wanted} rollouts")
    return curve, notes


def _wanted(folder: Path) -> int | None:
    """The rollouts that a run was started for."""
    if not (folder / CONFIG).exists():
        return None
    return read_json(folder / CONFIG).get("config", {}).get("rollouts")


def _robot_time(curves: Mapping[str, Curve]) -> dict[str, Any]:
    """Steps per rollout and seconds per step, from the first curve that goes beyond zero-shot; {} if none does."""
    for curve in curves.values():
        if curve.transitions[-1] > 0:
            steps = int(curve.transitions[-1])
            seconds = 60 * float(curve.robot_minutes[-1]) / steps
            return {"rollout_length": steps // int(curve.rollouts[-1]), "control_dt": seconds}
    return {}


def _section(comparison: Comparison, figure: Path) -> str:
    title = f"{comparison.task} on the {comparison.real} real system"
    lengths = [int(curve.rollouts[-1]) for curve in comparison.curves.values()]
    budgets = [n for n in BUDGETS if n <= max(lengths)]
    head = columns(budgets, min(lengths))
    lines = [head, ["---"] * len(head), *(row(*item, budgets, min(lengths)) for item in comparison.curves.items())]
    table = ["| " + " | ".join(cells) + " |" for cells in lines]
    return "\n".join([f"## {title}", "", *table, "", f"![{title}]({figure.name})"])


def _untouched(task: str | None, seen: set[tuple[str, str]]) -> list[str]:
    """Gaps that come with a task and that no run has met."""
    tasks = envs.TASKS if task is None else [task]
    return [f"{name}/{gap}" for name in tasks for gap in gaps.presets(name) if (name, gap) not in seen]


if __name__ == "__main__":
    cli.run_main(main, FiguresArgs, __doc__ or "")
