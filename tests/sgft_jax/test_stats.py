import numpy as np
import pytest
from scipy import stats as scipy_stats

from sgft_jax.stats import area_under, first_dip, iqm, iqm_interval, success_interval, transitions_to


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


def test_area_under_a_curve():
    """0 to 1 within 10, then 1 until 40: (10 / 2 + 30) / 40 = 0.875; a constant is its own mean."""
    assert area_under([0, 10, 40], [0.0, 1.0, 1.0]) == pytest.approx(0.875)
    np.testing.assert_allclose(area_under([100, 110, 140], [[0.0, 1.0, 1.0], [0.3, 0.3, 0.3]]), [0.875, 0.3])


def test_first_dip():
    assert first_dip([0.5, 0.2, 0.9]) == pytest.approx(0.3)
    assert first_dip([0.5, 0.6, 0.9]) == 0.0
    assert first_dip([0.5]) == 0.0
