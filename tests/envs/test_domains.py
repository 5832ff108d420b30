"""The uniform domain, and the one in which actuators and sensors differ too."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

import envs
from envs.domains import parameter_ranges, sample_worlds, uniform, with_actuators
from envs.effects import draw
from envs.observations import varying
from envs.types import UserError

ENV = toy.make()  # mass in [0.8, 1.2], friction in [3.5, 4.5]


def test_draws_fill_the_ranges(key):
    domain = uniform(ENV, {"friction": [2.0, 6.0]})
    theta = domain.sample(domain.init(), key, 500)
    assert theta.params.shape == (500, 2) and theta.effects.low.action_scale.shape == (500, 2)
    for values, low, high in zip(theta.params.T, (0.8, 2.0), (1.2, 6.0), strict=True):
        margin = 0.02 * (high - low)
        assert low <= values.min() < low + margin and high - margin < values.max() <= high
    np.testing.assert_allclose(theta.effects.high.obs_noise, 0.005)  # the simulator's own


def test_the_density_is_one_over_the_volume():
    domain = uniform(ENV, {"friction": 4.0})
    theta = jax.tree.map(lambda x: x[0], domain.sample(domain.init(), jax.random.key(0), 1))
    inside = theta._replace(params=jnp.array([1.1, 4.0]))
    np.testing.assert_allclose(domain.log_prob((), inside), -np.log(0.4), rtol=1e-5)
    for params in ([1.3, 4.0], [1.1, 4.1]):
        assert domain.log_prob((), theta._replace(params=jnp.array(params))) == -jnp.inf
    state = domain.update(domain.init(), theta, jnp.zeros(()))
    assert state == domain.init()


def test_worlds_can_be_made_of_any_theta():
    """A domain of one's own names thetas itself; the environment only compiles them."""
    domain = uniform(ENV)
    theta = domain.sample((), jax.random.key(0), 2)._replace(params=np.array([[5.0, 1.0], [6.0, 2.0]]))
    world = ENV.make_worlds(theta)
    assert world.theta.params.tolist() == [[5.0, 1.0], [6.0, 2.0]] and world.theta.params.dtype == jnp.float32


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"mas": 1.0}, r"'mas' is neither a parameter nor an effect of toy; did you mean 'mass'\?"),
        ({"latency": 0.1}, "'latency' is an effect of toy, not one of its parameters"),
        ({"mass": -1.0}, "parameter 'mass' must be at least 0.01, got -1.0"),
        ({"mass": [0.0, 1.0]}, r"parameter 'mass' must be at least 0.01, got \[0.0, 1.0\]"),
        ({"mass": [1.2, 1.0]}, r"parameter 'mass' needs a value or a range \[low, high\]"),
        ({"friction": float("nan")}, "parameter 'friction' needs a value"),
        ({"friction": [1.0, 2.0, 3.0]}, "parameter 'friction' needs a value"),
        ({"friction": "high"}, "parameter 'friction' needs a value"),
        ({"friction": 1e30}, "parameter 'friction' must be at most 4500, got 1e"),
        ({"mass": [1.0, 1e6]}, "parameter 'mass' must be at most 1200, got"),
    ],
)
def test_impossible_parameters_are_named(params, message):
    with pytest.raises(UserError, match=message):
        envs.sample_worlds(ENV, jax.random.key(0), 1, params=params)


def test_relations_are_checked_at_both_ends_of_both_ranges():
    """Only light masses with much friction are impossible: neither all low nor all high ends show it."""
    asked = []

    def check(theta):
        asked.append(theta)
        return "too light for its friction" if theta["mass"] < 1 and theta["friction"] > 4 else None

    env = ENV._replace(check=check)
    with pytest.raises(UserError, match="toy: too light for its friction"):
        parameter_ranges(env, {})
    asked.clear()
    parameter_ranges(env, {"mass": [1.0, 1.2]})
    assert {tuple(theta.values()) for theta in asked} == {(1.0, 3.5), (1.0, 4.5), (1.2, 3.5), (1.2, 4.5)}
    parameter_ranges(env, {"mass": 1.0, "friction": 5.0})


def test_what_differs_between_episodes():
    env = with_actuators(ENV)
    ranges = jax.tree.map(lambda x: x[0], sample_worlds(env, jax.random.key(0), 1).theta.effects)
    found = jax.jit(jax.vmap(functools.partial(draw, ranges)))(jax.random.split(jax.random.key(1), 400))
    for name, low, high in (
        ("action_scale", 0.7, 1.4),
        ("action_bias", -0.15, 0.15),
        ("latency", 0.0, 0.6 * env.control_dt),
        ("latency_jitter", 0.0, 0.1 * env.control_dt),
    ):
        values, margin = np.asarray(getattr(found, name)), 0.05 * (high - low)
        assert low <= values.min() < low + margin and high - margin < values.max() <= high, name
    assert not np.asarray(found.action_rotation).any() or env.cartesian
    np.testing.assert_allclose(found.obs_noise, 0.005)  # the simulator's own


def test_a_task_may_have_ranges_of_its_own():
    env = with_actuators(ENV._replace(actuators={"action_scale": 1.0, "obs_noise": [0.0, 0.01]}))
    names = {v.name: (v.low, v.high) for v in varying(env)}
    assert "action_scale" not in names and names["obs_noise"] == (0.0, np.float32(0.01))
    assert names["latency"] == (0.0, np.float32(0.6 * env.control_dt))
