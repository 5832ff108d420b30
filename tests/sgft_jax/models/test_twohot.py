"""Symmetric logarithm and two-hot regression, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import UserError
from sgft_jax.models import twohot

BINS = twohot.Bins()
FIVE = twohot.Bins(5, -2.0, 2.0)  # centres -2, -1, 0, 1, 2


def test_symlog_by_hand():
    x = jnp.array([0.0, np.e - 1, -(np.e**2 - 1)])
    np.testing.assert_allclose(twohot.symlog(x), [0.0, 1.0, -2.0], rtol=1e-6)
    np.testing.assert_allclose(twohot.symexp(jnp.array([0.0, 1.0, -2.0])), x, rtol=1e-6)


def test_symexp_inverts_symlog():
    x = jnp.array([-2e4, -30.0, -0.5, -1e-6, 0.0, 1e-6, 0.5, 30.0, 2e4])
    np.testing.assert_allclose(twohot.symexp(twohot.symlog(x)), x, rtol=1e-5)


@pytest.mark.parametrize("function", [twohot.symlog, twohot.symexp])
def test_slope_at_zero_is_one(function):
    assert jax.grad(function)(0.0) == 1.0


def test_the_default_bins_are_the_published_ones():
    assert BINS.centres.shape == (101,) and BINS.centres[50] == 0
    np.testing.assert_allclose(jnp.diff(BINS.centres), 0.2, rtol=1e-4)


def test_encode_by_hand():
    def weights(symlog_x):
        return twohot.encode(twohot.symexp(jnp.float32(symlog_x)), FIVE)

    np.testing.assert_allclose(weights(0.25), [0, 0, 0.75, 0.25, 0], atol=1e-6)
    np.testing.assert_allclose(weights(-1.9), [0.9, 0.1, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(weights(1.0), [0, 0, 0, 1, 0], atol=1e-6)
    # beyond the range everything sits on the last bin
    np.testing.assert_allclose(weights(7.0), [0, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(weights(-7.0), [1, 0, 0, 0, 0], atol=1e-6)


def test_decode_inverts_encode():
    x = jnp.array([-2e4, -123.0, -0.3, 0.0, 0.01, 1.0, 77.7, 2e4])
    encoded = jax.vmap(lambda x: twohot.encode(x, BINS))(x)
    np.testing.assert_allclose(encoded.sum(1), 1.0, rtol=1e-5)
    assert jnp.all((encoded > 0).sum(1) <= 2)
    decoded = jax.vmap(lambda w: twohot.decode(jnp.log(w), BINS))(encoded)
    np.testing.assert_allclose(decoded, x, rtol=1e-3, atol=1e-5)


def test_zero_logits_decode_to_zero():
    assert twohot.decode(jnp.zeros(101), BINS) == pytest.approx(0.0, abs=1e-5)


def test_cross_entropy_by_hand():
    three = twohot.Bins(3, -1.0, 1.0)
    logits = jnp.log(jnp.array([0.2, 0.5, 0.3])) + 4.0  # a constant changes nothing
    # symlog(x) = 0.5 lies half-way between the bins 0 and 1: -(log 0.5 + log 0.3) / 2
    loss = twohot.cross_entropy(logits, jnp.float32(np.expm1(0.5)), three)
    assert loss == pytest.approx(-(np.log(0.5) + np.log(0.3)) / 2, rel=1e-5)
    # untrained: log 101 whatever the target
    assert twohot.cross_entropy(jnp.zeros(101), jnp.float32(3.0), BINS) == pytest.approx(np.log(101), rel=1e-5)


def test_impossible_bins_are_refused():
    for bad in ((1, -1.0, 1.0), (5, 1.0, 1.0)):
        with pytest.raises(UserError, match="bins"):
            twohot.Bins(*bad)
