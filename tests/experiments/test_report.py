import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

import envs
from envs.types import Policy
from experiments.runner.report import alike, make_judges, make_report, value_numbers
from sgft_jax.learners.sac import SACConfig, extract_params, make_sac
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.policies import sac_policy
from sgft_jax.train.value_fit import hold
from sgft_jax.types import Normalizer

pytestmark = pytest.mark.heavy  # all of them compile

NETWORK = NetworkConfig(hidden=(4,))


def reported(env, *, dynamics_bias=0.0):
    """Report of a prior whose model is zero but for its bias; gamma 0.5, 3 trajectories."""
    learner = make_sac(SACConfig(4, 2, network=NETWORK, ensemble_size=2))
    shapes, rng = (
        jax.eval_shape(lambda key: extract_params(learner.init(key)), jax.random.key(0)),
        np.random.default_rng(0),
    )
    prior = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    actor = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), shapes.actor)
    prior = prior._replace(actor=actor, normalizer=Normalizer(jnp.zeros(4), jnp.ones(4)))
    prior.dynamics["Dense_1"]["bias"] += dynamics_bias
    pool = envs.sample_worlds(env, jax.random.key(1), 2, effects={"obs_noise": 0.0})
    report = make_report(env, sac_policy(4, 2, NETWORK), pool, prior, jax.random.key(2), gamma=0.5, trajectories=3)
    return jax.tree.map(np.asarray, report)


def with_step(change):
    env = toy.make()
    return env._replace(step=lambda world, state, action, key: change(env.step(world, state, action, key)))


def held(env, *, bias=0.0, episodes=16):
    """What a prior promises and earns at gamma 0.5, whose V_sim is `bias` everywhere and whose actions are 0."""
    policy = Policy(lambda: (), lambda params, carry, *_, explore: (jnp.zeros(2), carry), lambda *_: jnp.float32(bias))
    pool = envs.sample_worlds(env, jax.random.key(1), 2, effects={"obs_noise": 0.0})
    return jax.tree.map(np.asarray, hold(env, (), policy, 0.5, episodes, pool, None, jax.random.key(2)))


@pytest.mark.slow
@pytest.mark.parametrize("bias", [0.0, 4.0])
def test_returns_look_past_the_time_limit(bias):
    """Reward 1 for ever at gamma 0.5: 20 steps and 7 more, where 0.5^7 < 1 % is left; then V_sim stands for the rest.

    The state of step t has 27 - t rewards ahead: G = 2 (1 - 0.5^(27 - t)) + 0.5^(27 - t) V, with t from 0 to 19.
    """
    rows = held(with_step(lambda s: s._replace(reward=jnp.float32(1))), bias=bias)
    possible = 2 * (1 - 0.5 ** np.arange(8, 28)) + 0.5 ** np.arange(8, 28) * bias
    assert np.abs(rows.returns[:, None] - possible).min(axis=1).max() < 1e-6
    np.testing.assert_allclose(rows.value, bias)
    assert rows.intact.all() and (rows.told == rows.value).all()


@pytest.mark.slow
def test_replays_tell_what_no_observation_tells():
    """A point at rest; what it earns is its world's mass, which sensors do not show. Some masses differ from others."""
    env = with_world(lambda world, s: s._replace(reward=world.theta.params[0]))
    policy = Policy(lambda: (), lambda params, carry, *_, explore: (jnp.zeros(2), carry), lambda *_: jnp.float32(0))
    judges = make_judges(env, (), policy, 0.5, episodes=8, members=1)
    pool = envs.sample_worlds(env, jax.random.key(1), 16, effects={"obs_noise": 0.0})
    rows = jax.tree.map(lambda x: np.asarray(x)[0], judges.hold(*stacked(pool, jnp.zeros(2), jax.random.key(2))))
    found = value_numbers(judges, env, rows, pool, jnp.zeros(2), jax.random.key(3), 8)
    assert found["value/system_explainable_variance"] == pytest.approx(1.0, abs=1e-3)
    assert found["value/explainable_variance"] < 0.5
    pairs = alike(env, pool, rows.world, rows.obs[0], jax.random.key(4)).theta.params
    assert pairs.shape == (8, 17, 2) and (pairs[:, 0] == pairs[:, 1]).all() and len(np.unique(pairs[..., 0])) > 8


def stacked(*trees):
    return (jax.tree.map(lambda x: x[None], tree) for tree in trees)


def with_world(change):
    env = toy.make()
    return env._replace(step=lambda world, state, action, key: change(world, env.step(world, state, action, key)))


def test_a_model_of_no_change_errs_like_standing_still():
    report = reported(toy.make())
    assert report.model_error.shape == (10,) and (report.still_error > 0).all()
    np.testing.assert_allclose(report.model_error, report.still_error, rtol=1e-5)


def test_model_error_grows_by_its_bias():
    """Nothing moves, and both members predict 0.1 standard deviations of drift a step: 0.1, 0.2, ... 1.0."""
    at_rest = toy.make()
    still = at_rest._replace(step=lambda world, state, action, key: state._replace(time=state.time + 1))
    report = reported(still, dynamics_bias=0.1)
    np.testing.assert_allclose(report.model_error, 0.1 * np.arange(1, 11), rtol=1e-4)
    np.testing.assert_allclose(report.still_error, 0.0, atol=1e-6)


@pytest.mark.slow
def test_exploded_trajectories_do_not_count():
    """Every start to the left explodes at once: of these, some."""
    rows = held(with_step(lambda s: s._replace(invalid=(s.physics.qpos[0] < 0) & (s.time == 1))))
    assert 0 < rows.intact.sum() < len(rows.intact)
    assert all(np.isfinite(x).all() for x in rows)
