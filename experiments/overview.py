"""All tasks at once: every method's learning curve on the default real system, and who needs how many times fewer.

The figure is that of Figure 4 of the SGFT paper.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments import tables
from experiments.comparison import (
    DEFAULT,
    Comparison,
    Part,
    figure_order,
    is_sgft,
    names_of,
    on_default,
    same_seeds,
    shared_variants,
    split,
)
from experiments.results import LEVELS, Curve, left_behind, reached
from sgft_jax.analysis import plot
from sgft_jax.analysis.stats import ratio_interval
from sgft_jax.methods import METHODS

_LEVEL = LEVELS[0]
_LEGEND = (
    f"Real transitions until the mean over seeds is at {_LEVEL} %, with its 95 % bootstrap interval; > where the run "
    f"ended before; in parentheses the seeds that end below {_LEVEL} %, if there are any."
)
_TIMES = (
    "How many times as many transitions the best method that is not SGFT needs: the one that got there after the "
    "fewest or, if none did, ended highest. Runs that ended before it got there, or before its own end, are named: "
    "nobody knows what they would have needed. > where it ended without, < where SGFT did, - where both did or nothing "
    "was to be learned. The 95 % bootstrap interval draws the seeds of both methods together where they are the same, "
    "and takes for granted which method is best. SGFT is what shapes rewards and shortens the horizon, or plans H "
    "steps that end in a frozen V_sim."
)


def overview(comparisons: Sequence[Comparison], target: Path, order: Sequence[str]) -> Part:
    """Figure and tables of all tasks with runs on the default real system.

    target: the folder of the figures. order: of the methods in all figures, which gives them their colours.
    """
    tasks = on_default(comparisons)
    if not tasks:
        return Part([], [f"all tasks: no run on a real system {DEFAULT}"])
    texts = ["## All tasks"]
    for variant, panels in _panels(tasks).items():
        title = "Fine-tuning on the default real systems" + (f", {variant}" if variant else "")
        path = target / ("_".join(filter(None, ["overview", variant])) + ".png")
        texts.append(f"![{title}]({_draw(panels, path, title, order).name})")
    best = {task: best_other(comparison.curves) for task, comparison in tasks.items()}
    own = [name for name in names_of(tasks.values()) if is_sgft(name)]
    texts += [_LEGEND, _table(tasks)]
    if not own or not any(best.values()):
        return Part(texts, [f"all tasks: how many times fewer takes {DEFAULT} runs of SGFT and of another method"])
    return Part([*texts, _TIMES, _comparison(tasks, best, own)], [])


def times_fewer(comparison: Comparison, other: str, own: str) -> str:
    """How many times as many transitions to 90 % one run needs as another, with its interval: "5.2 [3.9, > 7.1]".

    "> 3.2" if at least so many, "-" if none can say.
    """
    curves = comparison.curves
    above, below = ((curve.transitions, curve.success) for curve in (curves[other], curves[own]))
    # Seed i starts from the same prior and meets the same real starts in every method, so what makes it easy or hard
    # does so for both, and resampling it together keeps that out of the spread of the ratio.
    paired = same_seeds(comparison, other, own)
    return tables.censored(ratio_interval(above, below, _LEVEL / 100, paired=paired), digits=1)


def best_other(curves: Mapping[str, Curve]) -> str | None:
    """Of the methods that are not SGFT the one that got to 90 % after the fewest transitions.

    If none did, the one that ended with the highest mean success, of equals after the fewest transitions.
    """
    others = _others(curves)
    there = {name: n for name in others if (n := reached(curves[name], _LEVEL)) is not None}
    if there:
        return min(there, key=there.__getitem__)
    end = lambda name: (-curves[name].success[:, -1].mean(), curves[name].transitions[-1])  # noqa: E731
    return min(others, key=end, default=None)


def ended_before(curves: Mapping[str, Curve], best: str) -> list[str]:
    """Methods that are not SGFT and ended, without 90 %, before the best of them got there or ended: may be better."""
    there = reached(curves[best], _LEVEL)
    until = curves[best].transitions[-1] if there is None else there
    return [n for n in _others(curves) if curves[n].transitions[-1] < until]


def _others(curves: Mapping[str, Curve]) -> list[str]:
    """Methods that are not SGFT and learned at all. A method of one's own is nobody's baseline."""
    return [n for n, c in curves.items() if split(n)[0] in METHODS and not is_sgft(n) and c.transitions[-1] > 0]


def _panels(tasks: Mapping[str, Comparison]) -> dict[str, dict[str, dict[str, Curve]]]:
    """[variant][task][name]: the methods themselves, and variants that several methods have, such as `tuned`."""
    found = {}
    for variant in ["", *shared_variants(names_of(tasks.values()))]:
        panels = {t: {n: x for n, x in c.curves.items() if split(n)[1] == variant} for t, c in tasks.items()}
        found[variant] = {task: curves for task, curves in panels.items() if curves}
    return found


def _draw(panels: Mapping[str, Mapping[str, Curve]], path: Path, title: str, order: Sequence[str]) -> Path:
    """Over rollouts, as in the paper: episodes of the tasks differ in length, and what a robot does is episodes."""
    order = figure_order(order, dict.fromkeys(name for curves in panels.values() for name in curves))
    return plot.curve_panels(
        path,
        {task: {name: (x.rollouts, x.success) for name, x in curves.items()} for task, curves in panels.items()},
        over={task: tables.rollouts_axis(curves.values()) for task, curves in panels.items()},
        title=title,
        order=order,
        thick=[name for name in order if is_sgft(name)],
    )


def _table(tasks: Mapping[str, Comparison]) -> str:
    """Rows of methods, columns of tasks."""

    def cell(comparison: Comparison, name: str) -> str:
        if name not in comparison.curves:
            return tables.NONE
        curve = comparison.curves[name]
        return tables.transitions(curve, _LEVEL) + (f" ({tables.behind(curve)})" if left_behind(curve) else "")

    names = names_of(tasks.values())
    return tables.markdown(["method", *tasks], [[name, *(cell(c, name) for c in tasks.values())] for name in names])


def _comparison(tasks: Mapping[str, Comparison], best: Mapping[str, str | None], own: Sequence[str]) -> str:
    """The methods `own` in rows against the best other method of each task."""

    def cell(task: str, name: str) -> str:
        other, comparison = best[task], tasks[task]
        return times_fewer(comparison, other, name) if other and name in comparison.curves else tables.NONE

    def against(task: str, name: str | None) -> str:
        if not name:
            return tables.NONE
        curves = tasks[task].curves
        early = ", ".join(f"{n} at {int(curves[n].transitions[-1]):,}" for n in ended_before(curves, name))
        return f"{name}: {tables.transitions(curves[name], _LEVEL)}" + (f"; ended before: {early}" if early else "")

    rows = [
        ["best that is not SGFT", *(against(*each) for each in best.items())],
        *([name, *(cell(task, name) for task in tasks)] for name in own),
    ]
    return tables.markdown(["", *tasks], rows)
