"""How methods did on a set of gaps that nobody chose: by stratum, and against each other. Pure.

The prior is the random factor: member i of a curve began from prior i, on every gap, and intervals draw members.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

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
from sgft_jax.math.stats import ENOUGH, Interval, bootstrap_interval, mean

_RESAMPLES = 1000


class Row(NamedTuple):
    """A method on the gaps of one stratum.

    gaps: their number. start, area, end: mean score over gaps, with its interval. held: gaps whose mean was at least
    90 % at the last two evaluations. reached: gaps whose mean was at any two evaluations in a row; transitions: median
    over these gaps of the real transitions until the first of the two, nan without any. fall: how far the mean of any
    gap ever was below its start; worst: that gap. policy_fall: the same below the simulator's policy, nan where that
    was not evaluated from these priors. loss: how far the mean of any gap ended below its start. training: mean score
    of the training rollouts, nan where nobody kept them.
    """

    method: str
    stratum: str
    gaps: int
    start: Interval
    area: Interval
    end: Interval
    held: int
    reached: int
    transitions: float
    policy_fall: float
    fall: float
    worst: str
    loss: float
    training: float


class Duel(NamedTuple):
    """A reference compared with another method.

    gaps: number of gaps on which both ran. ahead: on how many the reference's mean area is at least the other's.
    better: probability that a run of the reference has the larger area, over all pairs of runs, mean over gaps.
    """

    other: str
    gaps: int
    ahead: int
    better: Interval


Played = Mapping[str, Curve]  # by gap


def row(method: str, stratum: str, played: Played, others: Iterable[Curve] = ()) -> Row:
    """The line of a method on these gaps.

    others: curves of other methods, in which the simulator's policy is looked up where this method begins with plans or
    with another policy. Raises UserError where gaps have different numbers of members.
    """
    curves, others = list(played.values()), list(others)
    if len(sizes := sorted({len(curve.seeds) for curve in curves})) > 1:
        raise UserError(f"{method}: ran with {sizes[0]} seeds on some gaps and with {sizes[-1]} on others")
    grid = common_grid(curves)
    means = {gap: curve.values.mean(0) for gap, curve in played.items()}
    falls = {gap: float(each[0] - each.min()) for gap, each in means.items()}
    worst = max(falls, key=lambda gap: falls[gap])
    taken = [n for curve in curves if (n := transitions_until_held(curve)) is not None]
    trained = [np.nanmean(curve.training) for curve in curves if curve.training is not None]
    return Row(
        method,
        stratum,
        len(curves),
        start=_over([curve.values[:, 0] for curve in curves]),
        area=_over(_areas(played, list(played), grid)),
        end=_over([curve.values[:, -1] for curve in curves]),
        held=sum(bool((each[-2:] >= LEVEL).all()) for each in means.values()),
        reached=len(taken),
        transitions=float(np.median(taken)) if taken else np.nan,
        policy_fall=max(_policy_fall(curve, others) for curve in curves),
        fall=falls[worst],
        worst=worst,
        loss=max(float(each[0] - each[-1]) for each in means.values()),
        training=float(np.mean(trained)) if trained else np.nan,
    )


def _over(scores: Sequence[np.ndarray] | np.ndarray) -> Interval:
    """The mean over gaps of scores [gaps, members], with its interval over members."""
    return bootstrap_interval(np.mean(scores, axis=0), statistic=mean)


def _policy_fall(curve: Curve, others: Sequence[Curve]) -> float:
    """How far the mean ever was below the simulator's policy; nan where that was not evaluated."""
    begun = (curve.task, curve.gap, curve.priors)
    before = zero_shot(curve, [one for one in (curve, *others) if (one.task, one.gap, one.priors) == begun])
    return np.nan if before is None else deepest_fall(curve, before)


def duel(reference: Played, other: str, played: Played) -> Duel:
    """The reference against one method, on the gaps and evaluations that they share; ValueError if there is none."""
    gaps = [gap for gap in reference if gap in played]
    if not gaps:
        raise ValueError(f"{other} shares no gap with the reference")
    grid = common_grid([*(reference[gap] for gap in gaps), *(played[gap] for gap in gaps)])
    own, theirs = _areas(reference, gaps, grid), _areas(played, gaps, grid)
    ahead = int((own.mean(1) >= theirs.mean(1)).sum())
    return Duel(other, len(gaps), ahead, improvement(own, theirs))


def pooled(played: Played) -> Curve:
    """A method on several gaps as one curve: member by member the mean over them, at the evaluations that they share.

    Tasks have rollouts of different lengths, so the curve knows neither transitions nor minutes (nan).
    """
    curves = list(played.values())
    grid = common_grid(curves)
    score = curves[0].score
    nothing = np.full(len(grid), np.nan)
    points = (at(curve, n) for n in grid for curve in curves)
    each = np.stack([point for point in points if point is not None])  # of a common grid none is
    values = each.reshape(len(grid), len(curves), -1).mean(1).T
    return replace(curves[0], x=grid, scores={score: values}, transitions=nothing, minutes=nothing, training=None)


def _areas(played: Played, gaps: Sequence[str], grid: np.ndarray) -> np.ndarray:
    """[gaps, members]"""
    found = [area(played[gap], grid) for gap in gaps]
    assert all(each is not None for each in found)
    return np.stack([each for each in found if each is not None])


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
