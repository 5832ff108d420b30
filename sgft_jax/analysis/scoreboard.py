"""How methods did on a set of gaps that nobody chose: by stratum, and against each other. Pure.

The prior is the random factor: member i of a curve began from prior i, on every gap, and intervals draw members.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from envs.types import UserError
from sgft_jax.analysis.curves import (
    LEVEL,
    Curve,
    area,
    at,
    common_grid,
    deepest_fall,
    transitions_until_held,
    zero_shot,
)
from sgft_jax.analysis.tables import NONE, number, plain
from sgft_jax.math.stats import ENOUGH, Interval, bootstrap_interval, mean

HEAD = ("stratum", "method", "gaps", "start", "area", "end", "90 % held at the end")
HEAD += ("90 % held ever, after transitions", "deepest fall: zero-shot / own start", "loss at the end", "training")
_RESAMPLES = 1000

Played = Mapping[str, Curve]  # by gap


def row(method: str, stratum: str, played: Played, others: Iterable[Curve] = ()) -> list[str]:
    """The line of a method on the gaps of one stratum, a cell for each of HEAD.

    Start, area and end: mean score over gaps, with its interval. Held at the end: gaps whose mean was at least 90 % at
    the last two evaluations. Held ever: gaps whose mean was at any two evaluations in a row, and the median over these
    gaps of the real transitions until the first of the two. Deepest fall: how far the mean of any gap ever was below
    the simulator's policy, where that was evaluated from these priors, and below its start, with the gap. Loss: how far
    the mean of any gap ended below its start. Training: mean score of the training rollouts, if anybody kept them.

    others: curves of other methods, in which the simulator's policy is looked up where this method begins with plans or
    with another policy. Raises UserError where gaps have different numbers of members.
    """
    curves, others = list(played.values()), list(others)
    if len(sizes := sorted({len(curve.seeds) for curve in curves})) > 1:
        raise UserError(f"{method}: ran with {sizes[0]} seeds on some gaps and with {sizes[-1]} on others")
    means = {gap: curve.values.mean(0) for gap, curve in played.items()}
    falls = {gap: float(values[0] - values.min()) for gap, values in means.items()}
    worst = max(falls, key=lambda gap: falls[gap])
    held = sum(bool((values[-2:] >= LEVEL).all()) for values in means.values())
    taken = [n for curve in curves if (n := transitions_until_held(curve)) is not None]
    below = max(_policy_fall(curve, others) for curve in curves)
    loss = max(float(values[0] - values[-1]) for values in means.values())
    trained = [np.nanmean(curve.training) for curve in curves if curve.training is not None]
    starts, ends = ([curve.values[:, i] for curve in curves] for i in (0, -1))
    scores = (starts, _areas(played, list(played), common_grid(curves)), ends)
    return [
        stratum,
        method,
        str(len(curves)),
        *(number(bootstrap_interval(np.mean(members, axis=0), statistic=mean)) for members in scores),
        f"{held} of {len(curves)}",
        f"{len(taken)} of {len(curves)}" + (f", {np.median(taken):.0f}" if taken else ""),
        f"{NONE if np.isnan(below) else _percent(below)} / {_percent(falls[worst])}"
        + (f" ({worst})" if falls[worst] >= 0.005 else ""),
        _percent(max(loss, 0)),
        _percent(np.mean(trained)) if trained else "",
    ]


def _percent(share: float | np.floating) -> str:
    return f"{100 * share:.0f}"


def brief(curve: Curve | None) -> str:
    """A method on one gap, "start: area / end / deepest fall"; nothing where it did not run."""
    if curve is None:
        return ""
    (areas,) = _areas({curve.gap: curve}, [curve.gap], common_grid([curve]))
    scores = (curve.values[:, 0].mean(), areas.mean(), curve.values[:, -1].mean(), deepest_fall(curve))
    start, *others = (plain(float(score), curve.score) for score in scores)
    return f"{start}: {' / '.join(others)}"


def _policy_fall(curve: Curve, others: Sequence[Curve]) -> float:
    """How far the mean ever was below the simulator's policy; nan where that was not evaluated."""
    begun = (curve.task, curve.gap, curve.priors)
    same = [other for other in (curve, *others) if (other.task, other.gap, other.priors) == begun]
    before = zero_shot(curve, same)
    return np.nan if before is None else deepest_fall(curve, before)


def duel(reference: Played, other: str, played: Played) -> list[str] | None:
    """The reference against one method, on the gaps and evaluations that they share; None without such a gap.

    Its name, the number of gaps on which the reference's mean area is at least its own, and the probability that a run
    of the reference has the larger area, over all pairs of runs, mean over gaps.
    """
    gaps = [gap for gap in reference if gap in played]
    if not gaps:
        return None
    grid = common_grid([runs[gap] for runs in (reference, played) for gap in gaps])
    above, below = _areas(reference, gaps, grid), _areas(played, gaps, grid)
    ahead = int((above.mean(1) >= below.mean(1)).sum())
    return [other, f"{ahead} of {len(gaps)}", number(improvement(above, below))]


def pooled(played: Played) -> Curve:
    """A method on several gaps as one curve: member by member the mean over them, at the evaluations that they share.

    Tasks have rollouts of different lengths, so the curve knows neither transitions nor minutes (nan).
    """
    curves = list(played.values())
    first, grid = curves[0], common_grid(curves)
    points = [[point for n in grid if (point := at(curve, n)) is not None] for curve in curves]
    values, nothing = np.mean(points, axis=0).T, np.array(np.nan)
    return replace(first, x=grid, scores={first.score: values}, transitions=nothing, minutes=nothing, training=None)


def _areas(played: Played, gaps: Sequence[str], grid: np.ndarray) -> np.ndarray:
    """[gaps, members]"""
    areas = [values for gap in gaps if (values := area(played[gap], grid)) is not None]
    assert len(areas) == len(gaps)
    return np.stack(areas)


def improvement(above: np.ndarray, below: np.ndarray) -> Interval:
    """P(above > below) over all pairs of runs, mean over gaps; [gaps, members] each. Ties count half. Draws members."""
    a, b = above[:, :, None], below[:, None, :]
    wins = ((a > b) + 0.5 * (a == b)).mean(0)  # [members of one, members of the other], mean over gaps
    estimate = np.asarray(wins.mean())
    if min(wins.shape) < ENOUGH:
        return Interval(estimate, np.asarray(np.nan), np.asarray(np.nan))
    rng = np.random.default_rng(0)
    drawn = [wins[np.ix_(*(rng.integers(n, size=n) for n in wins.shape))].mean() for _ in range(_RESAMPLES)]
    return Interval(estimate, *np.quantile(drawn, (0.025, 0.975)))
