import numpy as np
import pytest
from scipy import stats as scipy_stats

from sgft_jax.math.stats import (
    bootstrap_interval,
    difference_interval,
    iqm,
    mean,
    paired_improvement,
    probability_of_improvement,
    rank_correlation,
    success_interval,
)


def test_iqm_by_hand():
    # Eight values: two cut at each end, (2 + 3 + 4 + 5) / 4 = 3.5; the outlier 100 does not matter.
    assert iqm([0, 1, 2, 3, 4, 5, 6, 100]) == 3.5
    # Five values: int(1.25) = 1 cut at each end, (1 + 2 + 3) / 3 = 2.
    assert iqm([0, 1, 2, 3, 4]) == 2.0
    # Along seeds, for every point of the curve.
    np.testing.assert_array_equal(iqm(np.array([[0, 9], [1, 9], [3, 9], [100, 9]])), [2.0, 9.0])


def test_interval_is_vectorised_over_the_curve():
    scores = np.random.default_rng(0).uniform(size=(10, 7, 2))
    interval = bootstrap_interval(scores)
    assert interval.estimate.shape == interval.low.shape == interval.high.shape == (7, 2)
    assert (interval.low < interval.estimate).all() and (interval.estimate < interval.high).all()
    again = bootstrap_interval(scores)
    np.testing.assert_array_equal(interval.low, again.low)


def test_interval_covers_the_truth_about_as_often_as_it_says():
    """400 experiments of 10 normal seeds, true IQM 0: percentile intervals cover a little less than 95 %."""
    scores = np.random.default_rng(1).normal(size=(10, 400))
    interval = bootstrap_interval(scores)
    covered = ((interval.low <= 0) & (interval.high >= 0)).mean()
    assert 0.85 < covered < 0.97


def test_wider_level_is_wider():
    scores = np.random.default_rng(2).normal(size=10)
    narrow, wide = bootstrap_interval(scores, level=0.5), bootstrap_interval(scores, level=0.99)
    assert wide.low < narrow.low < narrow.high < wide.high


def test_seeds_that_agree_give_a_band_of_no_width():
    interval = bootstrap_interval(np.ones((4, 3)))
    for values in interval:
        np.testing.assert_array_equal(values, np.ones(3))


@pytest.mark.parametrize("seeds", [1, 2])
def test_too_few_seeds_have_no_interval(seeds):
    """Two seeds that agree by chance would have an interval of no width."""
    interval = bootstrap_interval([[0.2, 0.4]] * seeds)
    np.testing.assert_allclose(interval.estimate, [0.2, 0.4])
    assert np.isnan(interval.low).all() and np.isnan(interval.high).all()


@pytest.mark.parametrize("scores", [np.zeros((0, 3)), [0.1, np.nan]])
def test_no_seeds_or_nan_are_refused(scores):
    with pytest.raises(ValueError, match="at least one seed and finite"):
        bootstrap_interval(scores)


def test_wilson_by_hand():
    """8 of 10, z = 1.96: centre (0.8 + z^2/20) / (1 + z^2/10) = 0.7167, half-width 0.2266: [0.490, 0.943]."""
    z = scipy_stats.norm.ppf(0.975)
    centre = (0.8 + z**2 / 20) / (1 + z**2 / 10)
    half = z / (1 + z**2 / 10) * np.sqrt(0.8 * 0.2 / 10 + z**2 / 400)
    interval = success_interval(8, 10)
    np.testing.assert_allclose(interval, np.array([0.8, centre - half, centre + half]), rtol=1e-12)
    np.testing.assert_allclose(interval, (0.8, 0.490, 0.943), atol=1e-3)


def test_exact_interval_by_hand():
    """10 of 10: Clopper-Pearson's lower bound solves p^10 = 0.025, p = 0.025^(1/10) = 0.6915."""
    interval = success_interval(10, 10, method="exact")
    np.testing.assert_allclose(interval, (1.0, 0.025**0.1, 1.0))
    assert success_interval(0, 10).low == 0.0


def test_interval_over_seeds_agrees_with_scipy():
    scores = np.random.default_rng(1).normal(0.5, 0.1, 12)
    ours = bootstrap_interval(scores, resamples=20_000)
    theirs = scipy_stats.bootstrap((scores,), iqm, method="percentile", n_resamples=20_000, rng=2)
    np.testing.assert_allclose(ours[1:], theirs.confidence_interval, atol=0.005)


def test_the_prior_is_the_random_factor():
    """Three priors at 0, 0.5 and 1, their seeds alike. A resample is all of the first prior in 1 of 27 cases, more than
    the 2.5 % outside either bound, so the interval reaches from 0 to 1, however many seeds there are; drawn one by one
    the seeds pretend to know the mean well.
    """
    priors = np.repeat([4, 7, 9], 20)
    scores = np.repeat([0.0, 0.5, 1.0], 20)
    by_prior = bootstrap_interval(scores, statistic=mean, priors=priors)
    assert by_prior == (0.5, 0.0, 1.0)
    by_seed = bootstrap_interval(scores, statistic=mean)
    assert by_seed.low > 0.3 and by_seed.high < 0.7


def test_seeds_vary_within_the_drawn_priors_too():
    """Priors that are alike leave the spread of the seeds: about that of seeds drawn one by one."""
    scores = np.random.default_rng(3).normal(size=30)
    by_prior = bootstrap_interval(scores, statistic=mean, priors=np.arange(30) % 3, resamples=20_000)
    plain = bootstrap_interval(scores, statistic=mean, resamples=20_000)
    width = (by_prior.high - by_prior.low) / (plain.high - plain.low)
    assert 0.9 < width < 1.8


def test_two_priors_have_no_interval():
    assert np.isnan(bootstrap_interval(np.arange(10.0), priors=np.arange(10) % 2).low)


def test_strata_are_drawn_within():
    """Two tasks of three seeds each: without spread within a task there is none at all."""
    strata = [0, 0, 0, 1, 1, 1]
    assert bootstrap_interval([0.0] * 3 + [1.0] * 3, statistic=mean, strata=strata) == (0.5, 0.5, 0.5)
    assert bootstrap_interval([0.0] * 3 + [1.0] * 3, statistic=mean).low < 0.5


def test_priors_are_drawn_within_strata():
    """Two tasks, three priors each with two alike seeds: only which priors are drawn matters, in each task for itself.
    Three zeros in the first task have a probability of 1 in 27, six of 27^-2.
    """
    scores, strata = [0, 0, 0, 0, 1, 1] * 2, [0] * 6 + [1] * 6
    found = bootstrap_interval(scores, statistic=mean, priors=[0, 0, 1, 1, 2, 2] * 2, strata=strata, resamples=20_000)
    assert found.estimate == pytest.approx(1 / 3) and (found.low, found.high) == pytest.approx((0.0, 2 / 3))
    apart = bootstrap_interval([0.0] * 6 + [1.0] * 6, statistic=mean, priors=[0, 0, 1, 1, 2, 2] * 2, strata=strata)
    assert apart == (0.5, 0.5, 0.5)
    assert np.isnan(bootstrap_interval(scores, priors=[0] * 6 + [0, 0, 1, 1, 2, 2], strata=strata).low)


def test_what_makes_a_seed_good_for_both_methods_is_not_in_the_spread_of_the_difference():
    above, below = np.array([0.75, 0.25, 0.5]), np.array([0.5, 0.0, 0.25])
    assert difference_interval(above, below) == (0.25, 0.25, 0.25)
    with pytest.raises(ValueError, match="not 3 and 2"):
        difference_interval(above, below[:2])


def test_a_difference_that_depends_on_the_prior_has_a_wide_interval():
    """+0.4 from one prior and -0.2 from two others: the mean is 0, and any of the three may be all of a resample."""
    difference, priors = np.tile([0.4, -0.2, -0.2], 10), np.tile([0, 1, 2], 10)
    found = difference_interval(difference, np.zeros(30), priors=priors)
    np.testing.assert_allclose(found, (0.0, -0.2, 0.4), atol=1e-12)


def test_probability_of_improvement_by_hand():
    """0.5 beats 0.2, ties with 0.5 and loses to 0.9: 1.5 of 3; 1.0 beats all three: 4.5 of 6."""
    assert probability_of_improvement([0.5, 1.0], [0.2, 0.5, 0.9]) == 0.75
    assert probability_of_improvement([1.0, 1.0], [0.0]) == 1.0


def test_improvement_is_paired_by_prior_and_the_prior_is_the_random_factor():
    """From a bad prior all are bad: 0.1 against 0, 0.6 against 0.5, 1 against 1 and 0.9. In all, (1 + 1 + 0.75) / 3.
    Unpaired it would be 7.5 of 12. A prior of one method alone does not count.
    """
    above, below = [0.1, 0.6, 1.0, 9.0], [0.0, 0.5, 1.0, 0.9]
    found = paired_improvement(above, below, [4, 5, 6, 7], [4, 5, 6, 6])
    assert found.estimate == pytest.approx(2.75 / 3) and (found.low, found.high) == pytest.approx((0.75, 1.0))
    two = paired_improvement(above[:2] * 50, below[:2] * 50, [4, 5] * 50, [4, 5] * 50)
    assert two.estimate == 1 and np.isnan(two.low)  # however many seeds
    same = np.random.default_rng(0).normal(size=60)
    assert paired_improvement(same, same, np.arange(60) % 6, np.arange(60) % 6).estimate == 0.5


def test_rank_correlation_is_spearman_s_and_has_an_interval():
    pairs = np.random.default_rng(0).integers(0, 6, (40, 2)).astype(float)  # with ties
    assert rank_correlation(pairs) == pytest.approx(scipy_stats.spearmanr(*pairs.T).statistic)
    assert rank_correlation([[1, 10], [2, 20], [3, 15]]) == pytest.approx(0.5)
    assert rank_correlation([[1, 10], [1, 20]]) == 0
    band = bootstrap_interval(pairs, statistic=rank_correlation, priors=np.arange(40) % 8)
    assert -1 <= band.low < band.estimate < band.high <= 1
