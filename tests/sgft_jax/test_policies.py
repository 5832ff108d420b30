"""Policies that are an actor network alone: the density of what they do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.networks import make_actor, make_affine_actor, tanh_gaussian_sample
from sgft_jax.models.normalizer import identity, normalize
from sgft_jax.policies import ActorParams, actor_policy

NETWORK = NetworkConfig((8,))


@pytest.mark.parametrize("head", ["gaussian", "affine"])
def test_the_density_is_that_of_the_draw(key, head):
    """The same key draws the same action; the density of the draw knows what tanh has squashed."""
    network = make_actor(3, 2, NETWORK) if head == "gaussian" else make_affine_actor(3, 2, NETWORK, output_gain=1.0)
    params = ActorParams(network.init(key), identity(3))
    policy, obs = actor_policy(3, 2, NETWORK, head), jnp.array([0.3, -1.0, 2.0])
    assert policy.log_prob is not None
    for seed in range(5):
        drawn = jax.random.key(seed)
        action, _ = policy.act(params, (), obs, drawn, explore=True)
        moments = network.apply(params.actor, normalize(params.normalizer, obs))
        again, wanted = tanh_gaussian_sample(moments, drawn)
        np.testing.assert_array_equal(action, again)
        np.testing.assert_allclose(policy.log_prob(params, obs, action), wanted, atol=1e-3)


def test_an_action_at_the_bound_has_a_finite_density(key):
    policy = actor_policy(3, 2, NETWORK, "gaussian")
    params = ActorParams(make_actor(3, 2, NETWORK).init(key), identity(3))
    assert policy.log_prob is not None
    assert jnp.isfinite(policy.log_prob(params, jnp.zeros(3), jnp.array([1.0, -1.0])))


def test_noise_that_is_cut_off_has_none():
    assert actor_policy(3, 2, NETWORK, "deterministic").log_prob is None
