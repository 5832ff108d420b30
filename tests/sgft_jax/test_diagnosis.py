"""What rollouts say of V_sim, where the answer is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import Transition
from sgft_jax.diagnosis import Rollouts, honesty, promises


def test_promises_are_held_against_what_followed():
    """Reward 1 for ever at gamma 0.5 is worth 2; V_sim says 5, also of what comes after the last step."""
    zeros, ones = jnp.zeros((2, 4, 1)), jnp.ones((2, 4))
    rollouts = Rollouts(Transition(zeros, zeros, ones, 0.5 * ones, zeros), ones > 0, jnp.ones(2, bool))
    values, returns = promises(lambda obs: 5.0 + obs[0], rollouts)
    np.testing.assert_allclose(values, 5.0)
    np.testing.assert_allclose(returns, [2.0 + 3.0 * 0.5 ** np.array([4, 3, 2, 1])] * 2)


def test_what_follows_the_last_valid_step_counts_for_nothing():
    obs, valid = jnp.arange(6.0)[None, :, None], jnp.array([[True, True, True, False, False, False]])
    reward = jnp.where(valid, 1.0, jnp.nan)
    rows = Transition(obs, obs, reward, jnp.full((1, 6), 0.5), jnp.where(valid[..., None], obs + 1, jnp.nan))
    values, returns = promises(lambda obs: obs[0], Rollouts(rows, valid, jnp.ones(1, bool)))
    cut = jax.tree.map(lambda x: x[:, :3], (rows, valid))
    for whole, short in zip(
        (values, returns), promises(lambda obs: obs[0], Rollouts(*cut, jnp.ones(1, bool))), strict=True
    ):
        np.testing.assert_allclose(whole[:, :3], short)
    np.testing.assert_allclose(returns[0, :3], [1.75 + 0.125 * 3, 1.5 + 0.25 * 3, 1 + 0.5 * 3])


def test_means_and_order_are_those_of_valid_steps():
    values, valid = np.random.default_rng(0).uniform(0, 10, (4, 6)), np.ones((4, 6), bool)
    valid[0, 3:] = False
    returns = np.where(valid, values - 3.0, 1e6)
    mean = values[valid].mean()
    assert honesty(values, returns, valid) == pytest.approx(
        {"promised": mean, "returned": mean - 3.0, "rank_correlation": 1.0}
    )
    assert honesty(values, -values, valid)["rank_correlation"] == pytest.approx(-1.0)
    assert honesty(values, 0 * values, valid)["rank_correlation"] == 0
