"""Statistics over seeds and episodes: interquartile means, bootstrap intervals, success intervals, comparisons.

Pure functions of NumPy arrays; nothing here runs under jit.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

ENOUGH = 3  # members (seeds or priors) below which a bootstrap interval says nothing about spread


class Interval(NamedTuple):
    """An estimate with its confidence bounds: floats or arrays of one shape; bounds are nan where nothing is known."""

    estimate: np.ndarray
    low: np.ndarray
    high: np.ndarray


def iqm(scores: ArrayLike, *, axis: int = 0) -> np.ndarray:
    """Interquartile mean: the mean of the middle half, a quarter of the values cut at each end (rounded down).

    Source: Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice".
    """
    from scipy import stats

    return np.asarray(stats.trim_mean(np.asarray(scores, np.float64), 0.25, axis=axis))


def mean(scores: ArrayLike, *, axis: int = 0) -> np.ndarray:
    """The mean, as a statistic for `bootstrap_interval`."""
    return np.asarray(scores, np.float64).mean(axis)


def rank_correlation(pairs: ArrayLike, *, axis: int = 0) -> np.ndarray:
    """Spearman's of pairs [n, 2], also as a statistic for `bootstrap_interval`; 0 where one of the two is constant.

    axis: along which the pairs are; the two members of a pair are along the last one.
    """
    from scipy import stats

    ranks = stats.rankdata(np.asarray(pairs, np.float64), axis=axis)
    centred = ranks - ranks.mean(axis=axis, keepdims=True)
    first, second = (np.square(centred[..., i]).sum(axis) for i in (0, 1))
    return np.prod(centred, axis=-1).sum(axis) / np.maximum(np.sqrt(first * second), 1e-9)


def bootstrap_interval(
    scores: ArrayLike,
    *,
    statistic: Callable[..., np.ndarray] = iqm,
    priors: ArrayLike | None = None,
    strata: ArrayLike | None = None,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """A statistic over members with its percentile-bootstrap interval, pointwise along a curve.

    scores: [members] or [members, ...points], finite. priors: [members], the prior that each member began from; the
    prior is then the random factor: each resample draws priors, and then members of each drawn prior (hierarchical
    bootstrap). strata: [members], such as the task of each; each resample draws within each of them (stratified
    bootstrap, that of rliable), priors first if there are any. The bounds are nan for fewer than `ENOUGH` members, or
    priors, in a stratum: so few cannot show how much others would differ. Raises ValueError if there is no member or a
    score is not finite.
    """
    scores = np.asarray(scores, np.float64)
    if scores.shape[0] == 0 or not np.isfinite(scores).all():
        raise ValueError("scores need at least one seed and finite values")
    estimate = statistic(scores)
    groups = _groups(np.zeros(scores.shape[0]) if strata is None else strata)
    drawn_first = np.arange(scores.shape[0]) if priors is None else np.asarray(priors)
    units = min(len(np.unique(drawn_first[group])) for group in groups)
    if units < ENOUGH:
        return Interval(estimate, np.full_like(estimate, np.nan), np.full_like(estimate, np.nan))
    rng = np.random.default_rng(seed)
    drawn = np.concatenate([_draws(rng, group, resamples, priors) for group in groups], axis=1)
    values = np.concatenate(
        [statistic(scores[some], axis=1) for some in np.array_split(drawn, max(resamples // 200, 1))]
    )
    low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return Interval(estimate, low, high)


def difference_interval(
    above: ArrayLike, below: ArrayLike, *, priors: ArrayLike | None = None, level: float = 0.95
) -> Interval:
    """Mean paired difference of two methods' scores with its bootstrap interval.

    above, below: [members], member i of both from the same prior with the same seed, so that what makes it easy or hard
    does so for both. priors: as for `bootstrap_interval`. Raises ValueError if the numbers of members differ.
    """
    above, below = np.asarray(above, np.float64), np.asarray(below, np.float64)
    if above.shape != below.shape:
        raise ValueError(f"paired methods need the same members, not {len(above)} and {len(below)} of them")
    return bootstrap_interval(above - below, statistic=mean, priors=priors, level=level)


def probability_of_improvement(above: ArrayLike, below: ArrayLike) -> float:
    """Probability that a random member of one method scores higher than one of another; ties count half.

    above, below: [members] of either, not necessarily equally many. Source: Agarwal et al. 2021 (Mann-Whitney U).
    """
    above, below = np.asarray(above, np.float64), np.asarray(below, np.float64)
    from scipy import stats

    test: Any = stats.mannwhitneyu(above, below, method="asymptotic")
    return float(test.statistic) / (len(above) * len(below))


def paired_improvement(
    above: ArrayLike, below: ArrayLike, above_priors: ArrayLike, below_priors: ArrayLike
) -> Interval:
    """`probability_of_improvement` within each prior that both methods share; mean over these priors, and its interval.

    above, below: [members] of either. above_priors, below_priors: the prior of each. Raises ValueError where none is
    shared.
    """
    above, below, above_priors, below_priors = map(np.asarray, (above, below, above_priors, below_priors))
    shared = np.intersect1d(above_priors, below_priors)
    of_priors = [probability_of_improvement(above[above_priors == p], below[below_priors == p]) for p in shared]
    return bootstrap_interval(of_priors, statistic=mean)


def success_interval(
    successes: int, trials: int, *, level: float = 0.95, method: Literal["wilson", "exact"] = "wilson"
) -> Interval:
    """Success rate of `trials` independent episodes with its interval; "exact" is Clopper-Pearson (conservative)."""
    from scipy import stats

    bounds = stats.binomtest(int(successes), int(trials)).proportion_ci(confidence_level=level, method=method)
    return Interval(np.asarray(successes / trials), np.asarray(bounds.low), np.asarray(bounds.high))


def _draws(rng: "np.random.Generator", members: np.ndarray, resamples: int, priors: ArrayLike | None) -> np.ndarray:
    """[resamples, drawn] of these members in each resample."""
    if priors is None:
        return rng.choice(members, (resamples, len(members)))
    groups = [members[group] for group in _groups(np.asarray(priors)[members])]
    size = -(-len(members) // len(groups))  # of each drawn prior, so that a resample is about as large as the data
    table = np.stack([rng.choice(group, (resamples, len(groups), size)) for group in groups])
    drawn = rng.integers(len(groups), size=(resamples, len(groups)))
    rows, places = np.arange(resamples)[:, None], np.arange(len(groups))
    return table[drawn, rows, places].reshape(resamples, -1)


def _groups(labels: ArrayLike) -> list[np.ndarray]:
    """The members of each label."""
    labels = np.asarray(labels)
    return [np.flatnonzero(labels == label) for label in np.unique(labels)]
