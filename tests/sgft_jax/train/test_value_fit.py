"""The stage of V_sim on a point mass whose true value is known by playing it out."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

import envs
from envs.observations import all_varying
from envs.types import Policy
from sgft_jax.learners.sac import SACParams
from sgft_jax.models import networks, value
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.presets import PRESETS
from sgft_jax.train import value_fit
from sgft_jax.types import Normalizer

GAMMA = 0.9
CONFIG = replace(
    PRESETS["cpu"],
    gamma=GAMMA,
    network=NetworkConfig((64, 64)),
    ensemble_size=2,
    value_episodes=2048,
    value_updates=4000,
    value_left=0.3,
    batch_size=128,
)
ENV = toy.make()._replace(training={"obs_noise": 0.0, "action_scale": [[0.3, 0.3], [1.7, 1.7]]})
SYSTEM = all_varying(ENV)


def act(params, carry, obs, key, *, explore):
    """Towards the origin, against the speed."""
    return jnp.clip(-2.0 * obs[:2] - 0.3 * obs[2:4], -1.0, 1.0), carry


def policy_of(config):
    network = value.make_v_sim(4, config.network)
    predict = functools.partial(value.predict, network)
    return Policy(
        lambda: (), act, lambda params, obs, system=None: predict(params.value, params.normalizer, obs, system)
    )


@functools.cache
def fitted():
    pool = envs.sample_worlds(ENV, jax.random.key(0), 256)
    params = SACParams(None, None, None, None, Normalizer(jnp.zeros(4), jnp.ones(4)))
    fit = jax.jit(functools.partial(value_fit.fit_value, ENV, SYSTEM, policy_of(CONFIG), CONFIG))
    return params._replace(value=fit(pool, params, jax.random.key(1)))


@functools.cache
def held():
    """Of episodes in worlds that the fit has not seen."""
    pool = envs.sample_worlds(ENV, jax.random.key(2), 256)
    measure = functools.partial(value_fit.hold, ENV, SYSTEM, policy_of(CONFIG), GAMMA, 256)
    return jax.tree.map(np.asarray, jax.jit(measure)(pool, fitted(), jax.random.key(3)))


def test_what_varies_is_what_the_value_is_told():
    assert [(v.name, v.index) for v in SYSTEM] == [
        ("mass", 0),
        ("friction", 0),
        ("action_scale", 0),
        ("action_scale", 1),
    ]


def test_where_nothing_varies_the_value_is_told_nothing():
    pool, params = envs.sample_worlds(ENV, jax.random.key(0), 4), SACParams(*[None] * 4, Normalizer(jnp.zeros(4), 1.0))
    fit = functools.partial(value_fit.fit_value, ENV, (), policy_of(CONFIG), CONFIG)
    value_of = jax.eval_shape(fit, pool, params, jax.random.key(1))
    told = jax.eval_shape(lambda: value.make_v_sim(4, CONFIG.network, system=0).init(jax.random.key(0)))
    assert jax.tree.structure(value_of) == jax.tree.structure(told)


def test_lambda_returns_by_hand():
    rewards, discounts, values = jnp.array([1.0, 2.0]), jnp.array([0.5, 0.5]), jnp.array([9.0, 4.0, 8.0])
    # G_1 = 2 + 0.5 * 8 = 6; G_0 = 1 + 0.5 (0.75 * 4 + 0.25 * 6) = 3.25
    assert value.lambda_returns(rewards, discounts, values, mixed=0.25).tolist() == [3.25, 6.0]
    monte_carlo = value.discounted_returns(rewards, discounts, values[-1])
    assert value.lambda_returns(rewards, discounts, values, mixed=1.0).tolist() == monte_carlo.tolist()


@pytest.mark.heavy
def test_the_value_is_right_off_the_path_and_knows_the_system():
    rows = held()
    assert rows.intact.all() and np.ptp(rows.returns) > 5
    told, plain = (value.report(x, rows.returns) for x in (rows.told, rows.value))
    assert told["value/explained_variance"] > 0.97 and told["value/rank_correlation"] > 0.95
    assert abs(told["value/bias_of_range"]) < 0.02 and abs(plain["value/bias_of_range"]) < 0.02
    assert plain["value/explained_variance"] < told["value/explained_variance"] - 0.01


def test_a_ladder_of_random_actions_comes_before_the_policy():
    pool, params = envs.sample_worlds(ENV, jax.random.key(0), 4), None
    play = functools.partial(
        value_fit.play_ladder, ENV, SYSTEM, policy_of(CONFIG), pool, params, gamma=GAMMA, length=25
    )
    rows = jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(0), 64))
    assert rows.obs.shape == (64, 26, 4) and rows.system.shape == (64, 4)
    assert rows.switch.min() >= 0 and 15 < rows.switch.max() < 20
    assert jnp.abs(rows.system).max() <= 1.0


def test_a_single_network_is_a_value_of_observations_alone(key):
    config = NetworkConfig((8,))
    single, obs = networks.make_value(3, config), jnp.array([0.1, -0.2, 0.3])
    params = single.init(key)
    assert value.make_v_sim(3, config).apply(params, obs) == single.apply(params, obs)


def test_an_ensemble_is_the_mean_of_its_members(key):
    config, obs, system = NetworkConfig((8,)), jnp.array([0.1, -0.2, 0.3]), jnp.array([0.5, -0.5])
    network = value.make_v_sim(3, config, system=2, members=3)
    params, member = network.init(key), networks.make_value(6, config)
    one = [jax.tree.map(lambda x, i=i: x[i], params) for i in range(3)]
    told, plain = jnp.array([*obs, *system, 1.0]), jnp.array([*obs, 0.0, 0.0, 0.0])
    for read, got in ((told, network.apply(params, obs, system)), (plain, network.apply(params, obs))):
        np.testing.assert_allclose(got, jnp.mean(jnp.stack([member.apply(p, read) for p in one])), rtol=1e-5)


def test_explainable_variance_by_hand():
    # states differ by +-1, worlds by +-1 around each: half of the variance; the same world twice: nothing is left over
    replays = np.array([[0.0, 0.0, -2.0], [2.0, 2.0, 0.0]])
    assert value.explainable(replays)["value/system_explainable_variance"] == 1.0
    assert value.explainable(replays)["value/explainable_variance"] == pytest.approx(1 - 2.0 / 2.0)
