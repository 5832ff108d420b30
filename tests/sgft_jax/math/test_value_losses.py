"""Value losses: numbers by hand, minimisers by their equations, and what cut-off and shift do to gradients."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sgft_jax.math import losses

f = jnp.float32
NUMBERS = {"expectile": 0.7, "alpha": 1.0, "cut": 5.0}


def of_row(kind, y, **numbers):
    """The loss of one row with Q - V = y, V = 1."""
    each = losses.in_sample_loss(kind, jnp.ones(1), f(y) + jnp.ones(1), jnp.ones(1, bool), **{**NUMBERS, **numbers})
    return float(each[0])


def total(kind, value, q, **numbers):
    q = jnp.asarray(q, jnp.float32)
    values = jnp.full(q.shape, value)
    return jnp.mean(losses.in_sample_loss(kind, values, q, q > -np.inf, **{**NUMBERS, **numbers}))


def minimiser(kind, q, **numbers):
    """The V at which the slope changes its sign."""
    slope = jax.jit(jax.grad(lambda v: total(kind, v, q, **numbers)))
    low, high = f(min(q)), f(max(q))
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if slope(middle) < 0 else (low, middle)
    return float(middle)


def test_expectile_by_hand():
    assert of_row("iql", 2.0) == pytest.approx(2.8)  # 0.7 * 4
    assert of_row("iql", -2.0) == pytest.approx(1.2)  # 0.3 * 4
    assert of_row("iql", -2.0, expectile=0.5) == of_row("iql", 2.0, expectile=0.5) == 2.0


def test_expectile_of_one_pair():
    assert losses.expectile_loss(f(0.0), f(2.0), expectile=0.75) == 3.0  # V below Q: 0.75 * 2^2
    assert losses.expectile_loss(f(2.0), f(0.0), expectile=0.75) == 1.0  # V above Q: 0.25 * 2^2
    # d/dV = -2 * 0.75 * 2, and Q is a constant
    grads = jax.grad(lambda v, q: losses.expectile_loss(v, q, expectile=0.75), argnums=(0, 1))(f(0.0), f(2.0))
    assert grads == (-3.0, 0.0)


def test_expectile_refuses_a_batch():
    with pytest.raises(AssertionError):
        losses.expectile_loss(jnp.ones(3), f(1.0), expectile=0.7)


def test_sparse_by_hand():
    assert of_row("sql", 1.0) == pytest.approx(1.25)  # 1.5^2 - 1
    assert of_row("sql", -3.0) == pytest.approx(3.0)  # the bracket is negative: only -y is left
    assert of_row("sql", 1.0, alpha=2.0) == pytest.approx(1.25**2 - 0.5)


@pytest.mark.parametrize("loss", [losses.exponential_loss, losses.gumbel_loss])
def test_exponential_by_hand(loss):
    assert loss(f(1.0), f(1.0), f(0.0), alpha=2.0, cut=5.0) == 1.0  # exp(0) - 0
    assert loss(f(1.0), f(3.0), f(0.0), alpha=2.0, cut=5.0) == pytest.approx(np.e - 1, rel=1e-6)  # 1.718
    assert loss(f(1.0), f(3.0), f(1.0), alpha=2.0, cut=5.0) == pytest.approx((np.e - 1) / np.e, rel=1e-6)


@pytest.mark.parametrize(
    ("kind", "numbers", "q", "expected"),
    [
        ("iql", {"expectile": 0.7}, [0, 2], 1.4),
        ("iql", {"expectile": 0.5}, [0, 2], 1.0),
        ("sql", {}, [0, 2], 1.0),
        ("sql", {}, [0, 6], 4.0),
        ("sql", {"alpha": 2.0}, [0, 6], 3.0),  # both count: the mean
        ("eql", {}, [0, 2], 1.43378),
        ("xql", {}, [0, 2], 1.43378),
        ("eql", {"alpha": 2.0}, [0, 2], 2 * np.log((1 + np.e) / 2)),
        ("xql", {"alpha": 0.5}, [0, 1, 2], 0.5 * np.log((1 + np.e**2 + np.e**4) / 3)),
    ],
)
def test_minimisers(kind, numbers, q, expected):
    assert minimiser(kind, q, **numbers) == pytest.approx(expected, abs=2e-4)


@pytest.mark.parametrize("kind", ["eql", "xql"])
def test_the_shift_does_not_move_the_minimiser_and_bounds_the_loss(kind):
    """exp(y) of these rows would be 148; shifted, no row is above 1 + 5 exp(-5)."""
    each = losses.in_sample_loss(kind, jnp.zeros(3), jnp.array([0.0, 4.0, 30.0]), jnp.ones(3, bool), **NUMBERS)
    assert jnp.all(each <= 1.0 + 1e-6)
    shift = partial(losses.shift_of, alpha=1.0, cut=5.0)
    shifts = [shift(jnp.zeros(2), jnp.array(q), jnp.ones(2, bool)) for q in ([0.0, 3], [9.0, 0])]
    assert [float(x) for x in shifts] == [3.0, 5.0]
    far_below = shift(jnp.zeros(2), jnp.full(2, -50.0), jnp.ones(2, bool))
    assert far_below == -1.0 and np.isfinite(total(kind, f(0.0), [-50.0, -40.0]))
    through = jax.grad(lambda v: shift(v * jnp.ones(2), jnp.ones(2), jnp.ones(2, bool)))
    assert through(f(0.0)) == 0.0


def test_rows_that_do_not_count_do_not_shift():
    counted = jnp.array([True, False])
    assert losses.shift_of(jnp.zeros(2), jnp.array([1.0, 4.0]), counted, alpha=1.0, cut=5.0) == 1.0


@pytest.mark.parametrize("cut", [5.0, 7.0])
def test_gradients_above_the_cut(cut):
    """d/dV of EQL is exp(-shift) / alpha, of XQL nothing; below they agree: -exp(y) + 1."""
    slope = {
        name: jax.grad(lambda v, loss=loss: loss(v, f(9.0), f(0.0), alpha=1.0, cut=cut))
        for name, loss in (("eql", losses.exponential_loss), ("xql", losses.gumbel_loss))
    }
    assert slope["eql"](f(0.0)) == 1.0 and slope["xql"](f(0.0)) == 0.0
    for each in slope.values():
        assert each(f(9.1 - cut)) == pytest.approx(1 - np.exp(cut - 0.1), rel=1e-5)
        assert np.isfinite(each(f(-1000.0)))


@pytest.mark.parametrize("kind", ["iql", "sql", "eql", "xql"])
def test_q_is_a_constant_and_ranks_are_checked(kind):
    counted = jnp.ones(3, bool)

    def loss(values, q):
        return jnp.sum(losses.in_sample_loss(kind, values, q, counted, **NUMBERS))

    to_value, to_q = jax.grad(loss, argnums=(0, 1))(jnp.zeros(3), jnp.array([-1.0, 0.5, 2.0]))
    assert jnp.all(to_q == 0) and jnp.any(to_value != 0)
    with pytest.raises((AssertionError, ValueError)):
        loss(jnp.zeros((3, 1)), jnp.zeros(3))
