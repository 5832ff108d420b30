"""Tables in Markdown, and how the numbers of a learning curve are written in them. Pure functions."""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from experiments.results import LEVELS, Curve, area, dip, left_behind
from sgft_jax.analysis.stats import Censored, Interval, iqm_interval, transitions_interval

BUDGETS = (10, 20, 50, 100)  # rollouts at which tables compare, as far as a run got
NONE = "-"


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of these cells."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows))


def columns(budgets: Sequence[int], common: int) -> list[str]:
    """The names of the cells in a `row`."""
    return [
        "method", "seeds", "zero-shot", *(f"{n} rollouts" for n in budgets), "at the end (rollouts)",
        *(f"transitions to {level} %" for level in LEVELS), f"area to {common} rollouts", "deepest dip",
        "robot minutes",
    ]  # fmt: skip


def row(method: str, curve: Curve, budgets: Sequence[int], common: int) -> list[str]:
    """The cells of one method, with its success after so many rollouts. common: rollouts that all methods got to."""
    return [
        method,
        seeds(curve),
        percent(curve.success[:, 0]),
        *(at(curve, rollouts) for rollouts in budgets),
        end(curve),
        *(transitions(curve, level) for level in LEVELS),
        area_to(curve, common),
        f"{100 * dip(curve):.0f}",
        f"{curve.robot_minutes[-1]:.1f}",
    ]


def seeds(curve: Curve) -> str:
    """How many there are."""
    return str(curve.success.shape[0])


def percent(success: np.ndarray) -> str:
    """Interquartile mean over seeds [seeds] with its 95 % interval, in per cent."""
    return points(iqm_interval(success))


def points(band: Interval) -> str:
    """A number of 0 to 1 with its interval, if it has one, in per cent or percentage points."""
    interval = "" if np.isnan(band.low) else f" [{100 * band.low:.0f}, {100 * band.high:.0f}]"
    return f"{100 * band.estimate:.0f}{interval}"


def at(curve: Curve, rollouts: int) -> str:
    """Success at the evaluation after exactly so many rollouts."""
    (index,) = np.nonzero(curve.rollouts == rollouts)
    return percent(curve.success[:, index[-1]]) if index.size else NONE


def end(curve: Curve) -> str:
    """Success at the last evaluation, and after how many rollouts that was."""
    return f"{percent(curve.success[:, -1])} ({curve.rollouts[-1]})"


def transitions(curve: Curve, level: int) -> str:
    """Real transitions until the mean over seeds is at so many per cent, or how many were not enough."""
    return censored(transitions_interval(curve.transitions, curve.success, level / 100), digits=0)


def censored(found: Censored, *, digits: int) -> str:
    """An estimate with its interval; each number a bound, "> 4.1" or "< 0.4", where runs ended too early to tell it.

    Of an interval known to lie between two others it is the one that encloses both. "-" where nothing can be said; a
    bound stands alone where all resamples give the same.
    """
    estimate, low, high = ((float(least), float(most)) for least, most in zip(*found, strict=True))
    shown = _bound(*estimate, estimate[0], digits)
    if shown == NONE or math.isnan(low[0]):
        return shown
    ends = _bound(*low, low[0], digits), _bound(*high, high[1], digits)
    alone = estimate[0] < estimate[1] and ends == (shown, shown)
    return shown if alone else f"{shown} [{', '.join(ends)}]"


def _bound(least: float, most: float, number: float, digits: int) -> str:
    """What is known of a number that is at least and at most so much; `number` if both are."""
    if least == 0 and math.isinf(most):
        return NONE
    unit = 10**digits
    if math.isinf(most):  # a bound must stay one when it is rounded, and 0.7 * 10 not be a little more than 7
        return f"> {math.floor(round(least * unit, 6)) / unit:,.{digits}f}"
    if least == 0 < most:
        return f"< {math.ceil(round(most * unit, 6)) / unit:,.{digits}f}"
    return f"{number:,.{digits}f}"


def area_to(curve: Curve, rollouts: int) -> str:
    """Mean success over the real transitions up to so many rollouts; needs an evaluation after one of them."""
    return percent(area(curve, rollouts)) if np.sum(curve.rollouts <= rollouts) > 1 else NONE


def behind(curve: Curve) -> str:
    """Seeds that end below 90 %, of how many."""
    return f"{left_behind(curve)} of {seeds(curve)}"


def rollouts_axis(curves: Iterable[Curve]) -> str:
    """The words at an axis of rollouts: how much robot time the longest of these runs took."""
    longest = max(curves, key=lambda curve: curve.rollouts[-1])
    return f"rollouts ({longest.rollouts[-1]}: {longest.robot_minutes[-1]:.1f} min of robot time)"
