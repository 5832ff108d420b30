"""Robust fits against SciPy: Student's t, the prior, what counts as evidence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from sgft_jax.models import robust

SCALE = 0.5  # of all residuals below: a lower bound that none of them reaches
SLOPE = np.array([[1.0], [0.5], [-1.0], [2.0], [1.0]])
ROWS = np.array([[0.4], [0.1], [-0.5], [0.9], [9.0]])  # y = 0.45 x, and one that nothing explains


def fit(rows, slope, belief, held=None, bound=np.inf):
    """The fit of y = p x to rows y and slopes x, [n, k]."""
    held = np.ones(len(rows), bool) if held is None else held
    return _fit(jnp.asarray(rows), slope, jnp.array([belief]), held, bound)


@jax.jit
def _fit(y, slope, belief, held, bound):
    scale = jnp.full(y.shape[1], SCALE)
    return robust.most_probable(lambda p: y - p[0] * slope, jnp.zeros((1, 1)), belief, y, held, scale, bound=bound)


def cost(p, rows, slope, belief):
    """Nats of p [] by SciPy's distributions, up to a constant."""
    student = stats.multivariate_t(shape=SCALE**2 * np.eye(rows.shape[1]), df=3)
    return -student.logpdf(rows - p * slope).sum() - stats.norm.logpdf(p, scale=belief)


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("belief", [10.0, 0.2])
@pytest.mark.parametrize("twice", [False, True])
def test_the_most_probable_point_is_that_of_students_t_and_the_prior(belief, twice):
    """Of residuals with one and with two entries; the outlier hardly counts, a narrow prior much."""
    rows, slope = (np.tile(x, 2 if twice else 1) for x in (ROWS, SLOPE))
    rows = rows * np.array([1.0, 0.7])[: rows.shape[1]]
    known = optimize.minimize_scalar(cost, (0.0, 0.5), args=(rows, slope, belief)).x
    point, evidence = fit(rows, slope, belief)
    np.testing.assert_allclose(point, known, atol=2e-3)
    gained = cost(0.0, rows, slope, belief) - cost(known, rows, slope, belief)
    assert evidence == pytest.approx(gained, abs=2e-3) and gained > 0.1
    assert abs(known) < (0.5 if belief > 1 else 0.3)


def test_where_no_row_is_held_the_prior_decides():
    point, evidence = fit(ROWS, SLOPE, 0.2, held=np.zeros(len(ROWS), bool))
    assert point[0] == 0 and evidence == 0


def test_rows_that_are_not_held_and_bounds():
    some = np.arange(len(ROWS)) < 3
    point, evidence = fit(ROWS, SLOPE, 1.0, held=some)
    alone, same = fit(ROWS[some], SLOPE[some], 1.0)
    np.testing.assert_allclose(point, alone, atol=1e-6)
    assert evidence == pytest.approx(float(same), abs=1e-6)
    assert fit(ROWS, SLOPE, 1.0, bound=0.1)[0][0] == pytest.approx(0.1)


@pytest.mark.heavy
def test_spreads_are_robust_and_never_nothing():
    values = jnp.array([[1.0, 0.0], [-2.0, 0.0], [3.0, 0.0], [1e6, 0.0]])
    held = jnp.array([True, True, True, False])
    np.testing.assert_allclose(robust.robust_std(values, held), [2.96, 0.0])
    np.testing.assert_allclose(robust.spread_of(0.001 * values, values, held), [0.0296, 0.0], atol=2e-6)
    assert (robust.spread_of(values, values, held) > 0).all()
    np.testing.assert_array_equal(robust.robust_std(values, jnp.zeros(4, bool)), 0.0)
