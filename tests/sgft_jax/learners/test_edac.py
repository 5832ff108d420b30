"""EDAC: alignment of gradients by hand, that it falls, and that SAC-N is a special case."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import UserError
from sgft_jax.learners import edac, sac
from sgft_jax.models import networks
from sgft_jax.types import Batch

NET = networks.NetworkConfig((16,))
ROWS = 16


def batch_of(key):
    key_obs, key_action = jax.random.split(key)
    obs, action = jax.random.normal(key_obs, (ROWS, 2)), jax.random.uniform(key_action, (ROWS, 3), minval=-1)
    return Batch(obs, action, jnp.sum(action, axis=1), jnp.zeros(ROWS), obs)


@pytest.mark.parametrize(
    ("grads", "expected"),
    [
        ([[1, 0], [5, 0]], 2.0),  # 1 + 1, over one other member
        ([[1, 0], [0, 1]], 0.0),
        ([[1, 0], [-2, 0]], -2.0),
        ([[1, 0], [1, 0], [0, 3]], 1.0),  # two of six pairs agree: 2 / 2
        ([[3, 4], [4, 3]], 2 * 24 / 25),
    ],
)
def test_alignment_by_hand(grads, expected):
    assert edac.alignment(jnp.array(grads, jnp.float32)) == pytest.approx(expected, abs=1e-5)


def test_a_flat_critic_does_no_harm():
    value, grad = jax.value_and_grad(edac.alignment)(jnp.array([[0.0, 0.0], [1.0, 1.0]]))
    assert value == 0.0 and jnp.all(jnp.isfinite(grad))


def test_the_gradients_of_one_action_cannot_be_turned():
    """They have only a sign, so the diversity of a task with one action does nothing."""
    assert jnp.allclose(jax.grad(edac.alignment)(jnp.array([[0.5], [-2.0], [3.0]])), 0.0, atol=1e-6)


@pytest.mark.slow
def test_diversity_keeps_gradients_apart(key):
    """Rewards are linear: without it all critics point the same way, at an alignment of 4."""
    batch, seen = batch_of(key), {}
    critic = networks.make_critic(2, 3, NET, members=4)
    for diversity in (0.0, 5.0):
        config = edac.EDACConfig(2, 3, network=NET, critics=4, diversity=diversity)
        learner = edac.make_edac(config, sac.SACHyper(lr_critic=1e-2))
        fit = jax.jit(
            lambda s, learner=learner: jax.lax.scan(
                lambda s, k: learner.update(s, batch, k), s, jax.random.split(key, 300)
            )[0]
        )
        params = fit(learner.init(key)).critic.params
        grads = jax.vmap(lambda o, a, p=params: jax.jacrev(lambda a: critic.apply(p, o, a))(a))(batch.obs, batch.action)
        seen[diversity] = float(jax.vmap(edac.alignment)(grads).mean())
    assert seen[0.0] > 3.5 and seen[5.0] < seen[0.0] - 1.0


@pytest.mark.heavy
def test_without_diversity_it_is_sac_with_many_critics(key):
    structure = sac.SACConfig(2, 3, network=NET, critics=4, train_dynamics=False)
    learners = edac.make_edac(edac.EDACConfig(2, 3, network=NET, critics=4, diversity=0.0)), sac.make_sac(structure)
    batch = batch_of(key)
    states = [jax.jit(lambda k, x=x: x.update(x.init(k), batch, k)[0])(key) for x in learners]
    for one, other in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_array_equal(one, other)


def test_defaults_and_options():
    config = edac.EDACConfig(17, 6)
    assert (config.critics, config.diversity, config.network.hidden) == (10, 1.0, (256, 256, 256))
    with pytest.raises(UserError, match="option critics is 1: must be at least 2"):
        edac.EDACConfig(1, 1, critics=1)
