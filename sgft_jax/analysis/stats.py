"""Statistics over seeds and episodes: interquartile mean, bootstrap intervals, success intervals, curve summaries.

Pure functions of NumPy arrays; nothing here runs under jit.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

# A mean over seeds that is 0.9 in exact arithmetic is often a little less in floating point.
_ROUNDING = 1e-9


class Interval(NamedTuple):
    """An estimate with its confidence bounds; floats or arrays of one shape."""

    estimate: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Censored(NamedTuple):
    """A statistic of runs of which some may have ended before they could tell.

    least, most: what it is if all that was not seen is as small as it can be, and as large; equal where it is known. A
    lower bound has most = inf, an upper bound least = 0, and of nothing at all is known [0, inf].
    """

    least: Interval
    most: Interval


def iqm(scores: ArrayLike, *, axis: int = 0) -> np.ndarray:
    """Interquartile mean: the mean of the middle half, a quarter of the values cut at each end (rounded down).

    Source: Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice".
    """
    return np.asarray(stats.trim_mean(np.asarray(scores, np.float64), 0.25, axis=axis))


def iqm_interval(scores: ArrayLike, *, level: float = 0.95, resamples: int = 2000, seed: int = 0) -> Interval:
    """IQM over seeds with its percentile-bootstrap interval, pointwise along a curve.

    scores: [n_seeds] or [n_seeds, ...points], finite. The percentile method (that of rliable) gives a band of no
    width where all seeds agree. One seed says nothing about spread: the bounds are then nan. Raises ValueError if
    there is no seed or a score is not finite.
    """
    scores = np.asarray(scores, np.float64)
    if scores.shape[0] == 0 or not np.isfinite(scores).all():
        raise ValueError("scores need at least one seed and finite values")
    estimate = iqm(scores)
    if scores.shape[0] == 1:
        return Interval(estimate, np.full_like(estimate, np.nan), np.full_like(estimate, np.nan))
    bounds = stats.bootstrap(
        (scores,),
        iqm,
        axis=0,
        vectorized=True,
        n_resamples=resamples,
        batch=100,
        confidence_level=level,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(estimate, np.asarray(bounds.low), np.asarray(bounds.high))


def success_interval(
    successes: int, trials: int, *, level: float = 0.95, method: Literal["wilson", "exact"] = "wilson"
) -> Interval:
    """Success rate of `trials` independent episodes with its interval; "exact" is Clopper-Pearson (conservative)."""
    bounds = stats.binomtest(int(successes), int(trials)).proportion_ci(confidence_level=level, method=method)
    return Interval(np.asarray(successes / trials), np.asarray(bounds.low), np.asarray(bounds.high))


def transitions_to(transitions: ArrayLike, success: ArrayLike, threshold: float) -> int | None:
    """Real transitions used at the first evaluation whose success is at least `threshold`; None if there is none.

    transitions, success: [n_evaluations], in order; later drops below the threshold do not count against it.
    """
    reached = np.asarray(success, np.float64) >= threshold - _ROUNDING
    return int(np.asarray(transitions)[np.argmax(reached)]) if reached.any() else None


def transitions_interval(
    transitions: ArrayLike,
    success: ArrayLike,
    threshold: float,
    *,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Censored:
    """`transitions_to` of the mean over seeds, with its percentile-bootstrap interval over seeds.

    transitions: [n_evaluations], in order. success: [n_seeds, n_evaluations]. A mean that never gets there needs at
    least the last of `transitions`, at most inf. Bounds are evaluations, not points between them; of one seed, nan.
    """
    success = np.asarray(success, np.float64)
    weights = _resampled(np.random.default_rng(seed), success.shape[0], resamples)
    needs = _needs(transitions, success, threshold, weights)
    return Censored(*(_percentiles(each, level, seeds=success.shape[0]) for each in needs))


def ratio_interval(
    numerator: tuple[ArrayLike, ArrayLike],
    denominator: tuple[ArrayLike, ArrayLike],
    threshold: float,
    *,
    paired: bool,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Censored:
    """The transitions of one method over those of another, as of `transitions_interval`, with its interval.

    numerator, denominator: (transitions [n], success [n_seeds, n]) of either. paired: they have the same seeds, which
    are resampled together, else each has its own. Raises ValueError if paired ones differ in number.

    A resample in which the numerator never gets to the threshold says how large the ratio is at least, one in which the
    denominator never does how large at most. If neither does the ratio may be anything from 0 to inf, and so it is
    taken if one is there from the start, where nothing was to be learned. Such resamples stay: without them only those
    of fast seeds would count. So `least.low` and `most.high` enclose the interval that longer runs would have given.
    """
    seeds = (np.shape(numerator[1])[0], np.shape(denominator[1])[0])
    weights, own = _resampled_both(np.random.default_rng(seed), seeds, resamples, paired=paired)
    above_least, above_most = _needs(*numerator, threshold, weights)
    below_least, below_most = _needs(*denominator, threshold, own)
    tells = (above_least > 0) & (below_least > 0)
    ratios = (
        np.divide(above_least, below_most, out=np.zeros_like(above_least), where=tells),
        np.divide(above_most, below_least, out=np.full_like(above_most, np.inf), where=tells),
    )
    return Censored(*(_percentiles(each, level, seeds=min(seeds)) for each in ratios))


def difference_interval(
    above: ArrayLike, below: ArrayLike, *, paired: bool, level: float = 0.95, resamples: int = 2000, seed: int = 0
) -> Interval:
    """Mean over seeds of one method's scores minus that of another's, with its percentile-bootstrap interval.

    above, below: [n_seeds] of either. paired: as in `ratio_interval`. Of one seed the bounds are nan.
    """
    above, below = np.asarray(above, np.float64), np.asarray(below, np.float64)
    weights, own = _resampled_both(np.random.default_rng(seed), (len(above), len(below)), resamples, paired=paired)
    differences = weights @ above / len(above) - own @ below / len(below)
    return _percentiles(differences, level, seeds=min(len(above), len(below)))


def _resampled_both(
    rng: np.random.Generator, seeds: tuple[int, int], resamples: int, *, paired: bool
) -> tuple[np.ndarray, np.ndarray]:
    """`_resampled` of either method, the same if they are paired; raises ValueError if such ones differ in number."""
    if paired and seeds[0] != seeds[1]:
        raise ValueError(f"paired methods need the same seeds, not {seeds[0]} and {seeds[1]} of them")
    weights = _resampled(rng, seeds[0], resamples)
    return weights, weights if paired else _resampled(rng, seeds[1], resamples)


def _resampled(rng: np.random.Generator, seeds: int, resamples: int) -> np.ndarray:
    """[1 + resamples, seeds] how often each seed is drawn: once in the first row, which is that of the estimate."""
    return np.vstack([np.ones(seeds), rng.multinomial(seeds, np.full(seeds, 1 / seeds), size=resamples)])


def _needs(
    transitions: ArrayLike, success: ArrayLike, threshold: float, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The least and the most transitions until the mean is at the threshold, [resamples] each."""
    transitions, success = np.asarray(transitions, np.float64), np.asarray(success, np.float64)
    reached = weights @ success / success.shape[0] >= threshold - _ROUNDING
    least = np.where(reached.any(1), transitions[np.argmax(reached, axis=1)], transitions[-1])
    return least, np.where(reached.any(1), least, np.inf)


def _percentiles(values: np.ndarray, level: float, *, seeds: int) -> Interval:
    """The first value with percentiles of the others, which are values themselves: nothing lies halfway to inf."""
    if seeds == 1:
        return Interval(values[0], np.asarray(np.nan), np.asarray(np.nan))
    ordered = np.sort(values[1:])
    outside = int(len(ordered) * (1 - level) / 2)
    return Interval(values[0], ordered[outside], ordered[-1 - outside])


def area_under(transitions: ArrayLike, success: ArrayLike) -> np.ndarray:
    """Mean success over the real transitions of a curve, from 0 to 1: its area by trapezoids over its length.

    transitions: [n], increasing, n > 1. success: [..., n]. Returns [...]: high where learning is early and lasts.
    """
    transitions = np.asarray(transitions, np.float64)
    return np.trapezoid(np.asarray(success, np.float64), transitions) / (transitions[-1] - transitions[0])


def first_dip(success: ArrayLike) -> float:
    """How far fine-tuning fell below where it started: zero-shot success minus the lowest of the curve.

    success: [n_evaluations], the zero-shot evaluation first. Never negative, as the curve contains its start.
    """
    success = np.asarray(success, np.float64)
    return float(success[0] - success.min())
