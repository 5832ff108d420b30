"""Reports on V_sim against hand-computed numbers."""

import jax.numpy as jnp
import numpy as np
import pytest

from sgft_jax.models import networks, value
from sgft_jax.types import Normalizer


def test_returns_by_hand():
    # G_2 = 3 + 0.5 * 8 = 7; G_1 = 2 + 0 * 7 = 2 (terminated); G_0 = 1 + 0.5 * 2 = 2
    returns = value.discounted_returns(jnp.array([1.0, 2, 3]), jnp.array([0.5, 0, 0.5]), jnp.float32(8))
    assert returns.tolist() == [2.0, 2.0, 7.0]


def test_explained_variance_by_hand():
    returns = np.array([0.0, 2.0])  # variance 1

    def explained(values):
        return value.report(values, returns)["value/explained_variance"]

    assert explained(returns + 5) == 1.0  # a constant offset costs nothing
    assert explained(np.zeros(2)) == 0.0
    assert explained(returns / 2) == 0.75  # the residual {0, 1} has variance 1 / 4


def test_predict_normalises(key):
    network = value.make_v_sim(2, networks.NetworkConfig((8,)))
    params, statistics = network.init(key), Normalizer(jnp.array([1.0, 2]), jnp.array([2.0, 4]))
    got = value.predict(network, params, statistics, jnp.array([3.0, 10.0]))
    np.testing.assert_allclose(got, network.apply(params, jnp.array([1.0, 2.0])), rtol=1e-6)


def test_report():
    names = ("bias", "bias_of_range", "explained_variance", "rank_correlation")
    assert value.report([1.0, 2.0], [0.0, 1.0]) == pytest.approx({f"value/{name}": 1.0 for name in names})
