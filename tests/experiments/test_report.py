import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

import envs
from experiments.runner.report import make_report, numbers
from sgft_jax.learners.sac import SACConfig, extract_params, make_sac
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.policies import sac_policy
from sgft_jax.types import Normalizer

pytestmark = pytest.mark.heavy  # all of them compile

NETWORK = NetworkConfig(hidden=(4,))


def reported(env, *, dynamics_bias=0.0, value_bias=0.0):
    """Report of a prior whose value and model are zero but for their biases; gamma 0.5, 3 trajectories."""
    learner = make_sac(SACConfig(4, 2, network=NETWORK, ensemble_size=2))
    shapes, rng = (
        jax.eval_shape(lambda key: extract_params(learner.init(key)), jax.random.key(0)),
        np.random.default_rng(0),
    )
    prior = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    actor = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), shapes.actor)
    prior = prior._replace(actor=actor, normalizer=Normalizer(jnp.zeros(4), jnp.ones(4)))
    prior.value["Dense_1"]["bias"] += value_bias
    prior.dynamics["Dense_1"]["bias"] += dynamics_bias
    pool = envs.sample_worlds(env, jax.random.key(1), 2, effects={"obs_noise": 0.0})
    report = make_report(env, sac_policy(4, 2, NETWORK), pool, prior, jax.random.key(2), gamma=0.5, trajectories=3)
    return jax.tree.map(np.asarray, report)


def with_step(change):
    env = toy.make()
    return env._replace(step=lambda world, state, action, key: change(env.step(world, state, action, key)))


@pytest.mark.slow
@pytest.mark.parametrize("bias", [0.0, 4.0])
def test_returns_look_past_the_time_limit(bias):
    """Reward 1 for ever at gamma 0.5: 20 steps and ceil(3 / 0.5) = 6 more, then V_sim stands for the rest.

    The state of step t has 26 - t rewards ahead: G = 2 (1 - 0.5^(26 - t)) + 0.5^(26 - t) V.
    """
    report = reported(with_step(lambda s: s._replace(reward=jnp.float32(1))), value_bias=bias)
    left = 26 - np.arange(20)
    expected = 2 * (1 - 0.5**left) + 0.5**left * bias  # the last: 2 * 127 / 128 = 1.984375 for V = 0
    np.testing.assert_allclose(report.returns.reshape(3, 20), np.tile(expected, (3, 1)), rtol=1e-6)
    np.testing.assert_allclose(report.values, bias)
    assert report.counts.all()
    assert numbers(report)["value/bias"] == pytest.approx(bias - expected.mean(), abs=1e-5)


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


def test_exploded_trajectories_do_not_count():
    """Every start to the left explodes at once: of these three, some."""
    report = reported(with_step(lambda s: s._replace(invalid=(s.physics.qpos[0] < 0) & (s.time == 1))))
    counts = report.counts.reshape(3, 20)
    assert (counts.all(1) | ~counts.any(1)).all() and 0 < counts.sum() < 60
    assert all(np.isfinite(x).all() for x in report)
