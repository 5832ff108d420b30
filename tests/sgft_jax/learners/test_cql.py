"""CQL: the penalty by hand and by integral, and what it does to actions that the data lack."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import UserError
from sgft_jax.learners import cql, sac
from sgft_jax.models import networks
from sgft_jax.types import Batch

NET = networks.NetworkConfig((16,))
ROWS = 32


def batch_of(key, action):
    """[ROWS] rows of one state that pay 1 and end."""
    one, obs = jnp.ones(ROWS), jnp.zeros((ROWS, 1))
    return Batch(obs, jnp.broadcast_to(action, (ROWS, 1)), one, 0.0 * one, obs)


def uniform(obs, key):
    """A policy that does anything."""
    return jax.random.uniform(key, (1,), minval=-1), -jnp.log(2.0)


def test_soft_maximum_by_hand():
    """Two actions of density 1/2 and 1/4 whose Q is 0, then log 3: log(2 + 4), log(6 + 12)."""
    q = jnp.array([[0.0, np.log(3)], [0.0, np.log(3)]])
    got = cql.soft_maximum(q, jnp.log(jnp.array([0.5, 0.25])))
    np.testing.assert_allclose(got, np.log([6, 18]), rtol=1e-6)


def penalty(q, samples, key, conservatism=2.0):
    config = cql.CQLConfig(1, 1, samples=samples, conservatism=conservatism)

    def critic(params, obs, action):
        return q(obs, action)

    return jax.jit(lambda key: cql.penalty(config, critic, None, uniform, batch_of(key, 0.5), key))(key)


def test_the_penalty_of_flat_critics_is_known(key):
    """Both say 7: log sum of 30 exp(7) / (1/2) - 7 = log 60, times 2 critics and 2."""
    got = penalty(lambda obs, action: jnp.full(2, 7.0), 10, key)
    assert got == pytest.approx(2 * 2 * np.log(60), rel=1e-5)


def test_the_penalty_is_an_integral(key):
    """Per draw, exp Q / density averages the integral of exp(a) over actions, 2 sinh 1; the data's Q is 0.5."""
    got = penalty(lambda obs, action: action, 2000, key, conservatism=1.0)
    assert got == pytest.approx(np.log(6000 * 2 * np.sinh(1)) - 0.5, abs=0.02)


@pytest.mark.slow
def test_actions_that_the_data_lack_are_worth_less(key):
    batch, seen = batch_of(key, -0.5), {}
    for conservatism in (0.0, 1.0):
        learner = cql.make_cql(
            cql.CQLConfig(1, 1, network=NET, conservatism=conservatism), sac.SACHyper(lr_critic=1e-2, alpha=1e-4)
        )
        fit = jax.jit(
            lambda s, learner=learner: jax.lax.scan(
                lambda s, k: learner.update(s, batch, k), s, jax.random.split(key, 300)
            )[0]
        )
        q = networks.make_critic(1, 1, NET).apply
        state = fit(learner.init(key))
        seen[conservatism] = [float(q(state.critic.params, jnp.zeros(1), jnp.array([a])).min()) for a in (-0.5, 0.8)]
    assert seen[0.0][0] == pytest.approx(1.0, abs=0.05)
    assert seen[1.0][0] - seen[1.0][1] > 1.0 + seen[0.0][0] - seen[0.0][1]


@pytest.mark.heavy
def test_the_entropy_is_not_in_the_target(key):
    batch = batch_of(key, 0.0)._replace(discount=jnp.ones(ROWS), reward=jnp.zeros(ROWS))
    learner = cql.make_cql(cql.CQLConfig(1, 1, network=NET))
    state, update = jax.jit(learner.init)(key), jax.jit(learner.update)
    targets = []
    for alpha in (1e-4, 5.0):
        at = state.replace(log_alpha=state.log_alpha._replace(params=jnp.log(jnp.float32(alpha))))
        metrics = update(at, batch, key)[1]
        assert metrics["actor/alpha"] == pytest.approx(alpha, rel=1e-2)
        targets.append(float(metrics["critic/target_mean"]))
    assert targets[0] == targets[1] != 0


def test_defaults_and_options():
    config = cql.CQLConfig(17, 6)
    assert (config.conservatism, config.samples, config.network.hidden) == (2.0, 10, (256, 256))
    with pytest.raises(UserError, match="option samples is 0"):
        cql.CQLConfig(1, 1, samples=0)
