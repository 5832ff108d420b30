"""Statistics over seeds and episodes: interquartile mean, bootstrap intervals, success intervals, curve summaries.

Pure functions of NumPy arrays; nothing here runs under jit.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats


class Interval(NamedTuple):
    """An estimate with its confidence bounds; floats or arrays of one shape."""

    estimate: np.ndarray
    low: np.ndarray
    high: np.ndarray


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
    reached = np.asarray(success, np.float64) >= threshold
    return int(np.asarray(transitions)[np.argmax(reached)]) if reached.any() else None


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
