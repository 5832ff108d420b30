import numpy as np
import pytest
from scipy import stats as scipy_stats

from sgft_jax.analysis.stats import (
    area_under,
    difference_interval,
    first_dip,
    iqm,
    iqm_interval,
    ratio_interval,
    success_interval,
    transitions_interval,
    transitions_to,
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
    interval = iqm_interval(scores)
    assert interval.estimate.shape == interval.low.shape == interval.high.shape == (7, 2)
    assert (interval.low < interval.estimate).all() and (interval.estimate < interval.high).all()
    again = iqm_interval(scores)
    np.testing.assert_array_equal(interval.low, again.low)


def test_interval_covers_the_truth_about_as_often_as_it_says():
    """400 experiments of 10 normal seeds, true IQM 0: percentile intervals cover a little less than 95 %."""
    scores = np.random.default_rng(1).normal(size=(10, 400))
    interval = iqm_interval(scores)
    covered = ((interval.low <= 0) & (interval.high >= 0)).mean()
    assert 0.85 < covered < 0.97


def test_wider_level_is_wider():
    scores = np.random.default_rng(2).normal(size=10)
    narrow, wide = iqm_interval(scores, level=0.5), iqm_interval(scores, level=0.99)
    assert wide.low < narrow.low < narrow.high < wide.high


def test_seeds_that_agree_give_a_band_of_no_width():
    interval = iqm_interval(np.ones((4, 3)))
    for values in interval:
        np.testing.assert_array_equal(values, np.ones(3))


def test_one_seed_has_no_interval():
    interval = iqm_interval([[0.2, 0.4]])
    np.testing.assert_array_equal(interval.estimate, [0.2, 0.4])
    assert np.isnan(interval.low).all() and np.isnan(interval.high).all()


@pytest.mark.parametrize("scores", [np.zeros((0, 3)), [0.1, np.nan]])
def test_no_seeds_or_nan_are_refused(scores):
    with pytest.raises(ValueError, match="at least one seed and finite"):
        iqm_interval(scores)


def test_wilson_by_hand():
    """8 of 10, z = 1.96: centre (0.8 + z^2/20) / (1 + z^2/10) = 0.7167, half-width 0.2266: [0.490, 0.943]."""
    z = scipy_stats.norm.ppf(0.975)
    centre = (0.8 + z**2 / 20) / (1 + z**2 / 10)
    half = z / (1 + z**2 / 10) * np.sqrt(0.8 * 0.2 / 10 + z**2 / 400)
    interval = success_interval(8, 10)
    np.testing.assert_allclose(interval, (0.8, centre - half, centre + half), rtol=1e-12)
    np.testing.assert_allclose(interval, (0.8, 0.490, 0.943), atol=1e-3)


def test_exact_interval_by_hand():
    """10 of 10: Clopper-Pearson's lower bound solves p^10 = 0.025, p = 0.025^(1/10) = 0.6915."""
    interval = success_interval(10, 10, method="exact")
    np.testing.assert_allclose(interval, (1.0, 0.025**0.1, 1.0))
    assert success_interval(0, 10).low == 0.0


def test_transitions_to():
    transitions = [0, 500, 1000, 1500]
    assert transitions_to(transitions, [0.1, 0.7, 0.5, 0.9], 0.7) == 500  # the first, later drops do not count
    assert transitions_to(transitions, [0.1, 0.7, 0.5, 0.9], 0.8) == 1500
    assert transitions_to(transitions, [0.1, 0.7, 0.5, 0.9], 0.05) == 0
    assert transitions_to(transitions, [0.1, 0.7, 0.5, 0.9], 0.95) is None


def test_a_mean_that_misses_the_threshold_by_rounding_is_there():
    seeds = [0.94, 0.84, 0.92]  # 2.7 of three
    assert np.mean(seeds) < 0.9
    assert transitions_to([500], [np.mean(seeds)], 0.9) == 500
    assert transitions_interval([0, 500], np.transpose([np.zeros(3), seeds]), 0.9).most.estimate == 500


FAST, LATE, NEVER = [0, 1, 1, 1], [0, 0, 0, 1], [0, 0, 0, 0]  # at 500, at 1,500, not within 1,500 transitions
TRANSITIONS = [0, 500, 1000, 1500]


def test_interval_of_transitions_by_hand():
    """Of two seeds the first is drawn twice in a quarter of the resamples; the others wait for the second."""
    found = transitions_interval(TRANSITIONS, [FAST, LATE], 0.9)
    assert found.least == found.most == (1500, 500, 1500)
    found = transitions_interval(TRANSITIONS, [FAST, NEVER], 0.9)
    assert found.least == (1500, 500, 1500) and found.most == (np.inf, 500, np.inf)
    found = transitions_interval(TRANSITIONS, [NEVER, NEVER], 0.9)
    assert found.least == (1500,) * 3 and found.most == (np.inf,) * 3


@pytest.mark.parametrize(("threshold", "high"), [(0.35, 500), (0.45, 500), (0.55, np.inf), (0.75, np.inf)])
def test_a_bound_is_open_where_more_than_a_fortieth_of_the_resamples_are(threshold, high):
    """Two of ten seeds never get there. They are 5 or more of a resample, too many for 0.55, in 3.3 % of them, and 6
    or more, too many for 0.45, in 0.6 %.
    """
    found = transitions_interval(TRANSITIONS, [FAST] * 8 + [NEVER] * 2, threshold)
    assert found.most == (500, 500, high) and found.least == (500, 500, min(high, 1500))


def test_interval_of_transitions_agrees_with_scipy():
    rng = np.random.default_rng(3)
    transitions = np.arange(60) * 40
    success = np.clip(transitions / 1600 + rng.normal(0, 0.2, (10, 1)) + rng.normal(0, 0.02, (10, 60)), 0, 1)
    found = transitions_interval(transitions, success, 0.8)
    theirs = scipy_stats.bootstrap(
        [np.arange(10)],
        lambda seeds: float(transitions_to(transitions, success[seeds].mean(0), 0.8)),
        vectorized=False,
        n_resamples=2000,
        method="percentile",
        rng=rng,
    ).confidence_interval
    assert found.least == found.most and theirs.low < found.least.estimate < theirs.high
    np.testing.assert_allclose(found.least[1:], theirs, atol=40)  # one evaluation: the draws differ


def slower(curve, times=2):
    transitions, success = curve
    return np.asarray(transitions) * times, success


def test_what_makes_a_seed_slow_for_both_methods_is_not_in_the_spread_of_the_ratio():
    """The one method is at any time where the other was at half of it: twice as many, whatever seeds are drawn."""
    curve = (TRANSITIONS, [FAST, LATE])
    paired = ratio_interval(slower(curve), curve, 0.9, paired=True)
    assert paired.least == paired.most == (2, 2, 2)
    # Drawn apart: 2 * 500 / 1,500 in 3 / 16 of the resamples and 2 * 1,500 / 500 in as many.
    apart = ratio_interval(slower(curve), curve, 0.9, paired=False)
    assert apart.least == apart.most
    np.testing.assert_allclose(apart.least, (2, 2 / 3, 6))


def test_ratio_of_runs_that_ended_too_early():
    """The bounds by hand; the censored seed is in three quarters of the resamples."""
    known, open_ended = (TRANSITIONS, [FAST, FAST]), (TRANSITIONS, [FAST, NEVER])
    found = ratio_interval(open_ended, known, 0.9, paired=True)
    assert found.least == (3, 1, 3) and found.most == (np.inf, 1, np.inf)  # 1,500 or more, over 500
    found = ratio_interval(known, open_ended, 0.9, paired=True)
    assert found.least == (0, 0, 1) and found.most == (1 / 3, 1 / 3, 1)
    found = ratio_interval(open_ended, open_ended, 0.9, paired=True)
    assert found.least == (0, 0, 1) and found.most == (np.inf, 1, np.inf)


def test_no_ratio_where_nothing_was_to_be_learned():
    there, zero_shot = (TRANSITIONS, np.ones((2, 4))), ([0], np.zeros((2, 1)))
    for pair in ((there, (TRANSITIONS, [FAST, LATE])), ((TRANSITIONS, [FAST, LATE]), there), (there, there)):
        found = ratio_interval(*pair, 0.9, paired=True)
        assert found.least == (0, 0, 0) and found.most == (np.inf,) * 3
    for pair in ((zero_shot, there), (there, zero_shot), (zero_shot, zero_shot)):  # runs without a real rollout
        assert ratio_interval(*pair, 0.9, paired=True).most == (np.inf,) * 3


@pytest.mark.parametrize("paired", [True, False])
@pytest.mark.parametrize("ends", [(60, 30), (30, 60), (35, 25), (60, 60)])
def test_bounds_of_short_runs_enclose_those_of_long_ones(paired, ends):
    rng = np.random.default_rng(4)
    transitions = np.arange(60) * 40
    curves = [
        np.clip(transitions / scale + rng.normal(0, 0.3, (6, 1)) + rng.normal(0, 0.1, (6, 60)), 0, 1)
        for scale in (1500, 900)
    ]
    whole = ratio_interval(*((transitions, success) for success in curves), 0.8, paired=paired)
    assert whole.least == whole.most
    cut = ratio_interval(
        *((transitions[:n], success[:, :n]) for n, success in zip(ends, curves, strict=True)), 0.8, paired=paired
    )
    assert (np.array(cut.least) <= whole.least).all() and (np.array(cut.most) >= whole.most).all()
    assert (cut == whole) == (ends == (60, 60))


def test_one_seed_has_no_interval_of_transitions():
    one = (TRANSITIONS, [FAST])
    found = transitions_interval(*one, 0.9)
    assert found.least.estimate == found.most.estimate == 500 and np.isnan([found.least[1:], found.most[1:]]).all()
    found = ratio_interval(slower((TRANSITIONS, [FAST, LATE])), one, 0.9, paired=False)
    assert found.least.estimate == 6 and np.isnan(found.least[1:]).all()


def test_pairs_need_as_many_seeds():
    with pytest.raises(ValueError, match="not 2 and 1"):
        ratio_interval((TRANSITIONS, [FAST, LATE]), (TRANSITIONS, [FAST]), 0.9, paired=True)
    with pytest.raises(ValueError, match="not 2 and 1"):
        difference_interval([0.5, 0.7], [0.5], paired=True)


def test_what_makes_a_seed_good_for_both_methods_is_not_in_the_spread_of_the_difference():
    """One method is always 0.25 above the other; drawn apart, two seeds 0.5 apart leave anything from -0.25 to 0.75."""
    assert difference_interval([0.75, 0.25], [0.5, 0.0], paired=True) == (0.25, 0.25, 0.25)
    assert difference_interval([0.75, 0.25], [0.5, 0.0], paired=False) == (0.25, -0.25, 0.75)
    assert difference_interval([0.75, 0.25], [0.5], paired=False)[0] == 0.0
    assert np.isnan(difference_interval([0.75], [0.5], paired=True)[1:]).all()


def test_interval_of_a_difference_agrees_with_scipy():
    above, below = np.random.default_rng(1).normal([[0.5], [0.2]], 0.1, (2, 12))
    ours = difference_interval(above, below, paired=True, resamples=20_000)
    theirs = scipy_stats.bootstrap((above - below,), np.mean, method="percentile", n_resamples=20_000, rng=2)
    np.testing.assert_allclose(ours[1:], theirs.confidence_interval, atol=0.003)
    assert ours.estimate == pytest.approx((above - below).mean())


def test_area_under_a_curve():
    """0 to 1 within 10, then 1 until 40: (10 / 2 + 30) / 40 = 0.875; a constant is its own mean."""
    assert area_under([0, 10, 40], [0.0, 1.0, 1.0]) == pytest.approx(0.875)
    np.testing.assert_allclose(area_under([100, 110, 140], [[0.0, 1.0, 1.0], [0.3, 0.3, 0.3]]), [0.875, 0.3])


def test_first_dip():
    assert first_dip([0.5, 0.2, 0.9]) == pytest.approx(0.3)
    assert first_dip([0.5, 0.6, 0.9]) == 0.0
    assert first_dip([0.5]) == 0.0
