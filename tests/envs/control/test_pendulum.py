"""The pendulum of the paper: its dynamics by hand, friction that a torque undoes, and the course of an episode."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import gaps
from envs.control import pendulum
from envs.rollout import real_worlds

TASK = "envs.control.pendulum"
KEY = jax.random.key(0)
NONE, FRICTION = jnp.zeros(2), jnp.array([0.5, 7.0])


def moved(state, torque, params=NONE):
    return np.asarray(pendulum.move(jnp.array(state), jnp.float32(torque), params))


@pytest.mark.parametrize(
    ("state", "torque", "wanted"),
    [
        ((0.0, 0.0), 0.0, (0.0, 0.0)),  # upright
        ((0.5, 1.0), 2.0, (0.55, 1.0 + 0.05 * (9.81 * np.sin(0.5) + 2.0))),
        ((np.pi - 0.01, 1.0), 0.0, (-np.pi + 0.04, 1.0 + 0.05 * 9.81 * np.sin(0.01))),  # round
        ((0.0, 5.9), 20.0, (0.295, 6.0)),  # not faster than that
    ],
)
def test_a_step_is_the_papers(state, torque, wanted):
    np.testing.assert_allclose(moved(state, torque), wanted, atol=1e-5)


def test_friction_brakes_and_a_torque_undoes_it():
    """p_real(s, a - e(s)) = p_sim(s, a): feasible next states are alike, actions differ."""
    for state in ((0.3, 1.0), (0.3, -0.02), (-2.0, 3.0)):
        error = pendulum.friction(jnp.array(state), FRICTION)
        assert np.sign(error) == -np.sign(state[1])
        np.testing.assert_allclose(moved(state, 4.0 - error, FRICTION), moved(state, 4.0), atol=1e-5)
    np.testing.assert_allclose(pendulum.friction(jnp.array([0.0, 2.0]), FRICTION), -8.0, atol=1e-3)


def episode(effects, steps=3):
    """A world with friction, the states of a few steps by half of the torque, and their physics."""
    env = envs.make(TASK)
    gap = gaps.from_dict(env, "real", {"params": {"damping": 0.5, "dry": 7.0}, "effects": effects})
    world = jax.tree.map(lambda x: x[0, 0], real_worlds(env, [gap], KEY))
    states = [env.reset(world, KEY)]
    for _ in range(steps):
        states.append(env.step(world, states[-1], jnp.array([0.5]), KEY))
    return env, world, states


def test_a_gap_is_friction_and_rewards_are_of_the_state_before():
    env, world, states = episode({})
    np.testing.assert_array_equal(world.theta.params, FRICTION)
    for before, after in itertools.pairwise(states):
        np.testing.assert_allclose(after.physics.state, moved(before.physics.state, 10.0, FRICTION), atol=1e-5)
        np.testing.assert_allclose(after.reward, pendulum.reward_of(before.physics.state), atol=1e-5)
        np.testing.assert_allclose(env.reward(before.true_obs, None, after.true_obs), after.reward, atol=1e-4)
        np.testing.assert_allclose(jnp.arctan2(after.obs[1], after.obs[0]), after.physics.state[0], atol=1e-5)


def test_a_late_command_is_the_one_before():
    _, _, states = episode({"latency": 0.049}, steps=1)
    before, after = states
    np.testing.assert_allclose(after.physics.state, moved(before.physics.state, 0.2, FRICTION), atol=1e-5)


def test_the_torque_has_a_limit_also_where_it_is_late():
    _, _, (_, before, after) = episode({"action_bias": 0.9, "latency": 0.02}, steps=2)
    np.testing.assert_allclose(after.physics.state, moved(before.physics.state, 20.0, FRICTION), atol=1e-5)


def test_an_episode_ends_by_time_and_success_is_upright_and_still():
    env, world, (start, *_) = episode({}, steps=0)
    late = start._replace(time=jnp.int32(98))
    assert not env.step(world, late, jnp.zeros(1), KEY).truncated
    assert env.step(world, late._replace(time=jnp.int32(99)), jnp.zeros(1), KEY).truncated
    for obs, wanted in (((1.0, 0.0, 0.0), True), ((1.0, 0.0, 0.6), False), ((np.cos(0.2), np.sin(0.2), 0.0), False)):
        assert bool(env.success(jnp.array(obs))) == wanted
    again = env.restore(world, jnp.array([np.cos(0.4), np.sin(0.4), -1.0]), KEY)
    np.testing.assert_allclose(again.physics.state, (0.4, -1.0), atol=1e-5)
