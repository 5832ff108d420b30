"""Previous actions and the system in observations: what they hold, and that the task under them is the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
from compiled import compiled

import envs
from envs.base import Varying
from envs.observations import blurred, concealed, varying, with_previous_actions, with_system
from envs.rollout import play_episode
from envs.types import UserError

TOY = toy.make()
EFFECTS = {"action_scale": [[0.5, 1.0], [1.5, 1.0]], "action_rotation": [-0.4, 0.4], "obs_noise": 0.01}
SYSTEM = varying(TOY, {"friction": 4.0}, EFFECTS)
SEEN = compiled(with_system(with_previous_actions(TOY, 1), SYSTEM))


def world(effects, params=None):
    worlds = envs.sample_worlds(SEEN, jax.random.key(0), 1, params=params or {}, effects=effects)
    return jax.tree.map(lambda x: x[0], worlds)


def test_what_varies_is_listed_and_constants_are_dropped():
    assert (
        Varying("mass", 0, 0.8, 1.2),
        Varying("action_scale", 0, 0.5, 1.5),
        Varying("action_rotation", 0, pytest.approx(-0.4), pytest.approx(0.4)),
    ) == SYSTEM
    assert [v.name for v in varying(TOY)] == ["mass", "friction"]
    with pytest.raises(UserError, match="varies"):
        varying(TOY, {"mass": 1.0, "friction": 4.0})


def test_observations_end_with_the_system_of_the_episode_scaled_and_clipped(key):
    there = world({"action_scale": [0.75, 1.0], "action_rotation": 0.8}, {"mass": 1.1})
    state = SEEN.reset(there, key)
    for _ in range(2):
        np.testing.assert_allclose(state.obs[-3:], [0.5, -0.5, 1.0], atol=1e-5)
        state = SEEN.step(there, state, jnp.ones(2), key)
    np.testing.assert_array_equal(state.obs[-5:-3], 1.0)  # the previous action, before them
    assert SEEN.measured == TOY.observation and SEEN.obs_dim == TOY.obs_dim + 2 + 3


def test_what_an_episode_draws_is_told(key):
    states = jax.vmap(SEEN.reset, (None, 0))(world(EFFECTS), jax.random.split(key, 8))
    np.testing.assert_allclose(states.obs[:, -1], states.effects.action_rotation / 0.4, atol=1e-5)
    assert states.obs[:, -1].std() > 0.1


@pytest.mark.heavy
def test_a_real_system_tells_the_middle_and_is_the_same_otherwise(key):
    pool = envs.sample_worlds(SEEN, key, 2, effects=EFFECTS)

    def steer(carry, obs, key):
        return jnp.tanh(-obs[:2]), carry

    def play(env):
        return jax.jit(lambda: play_episode(env, pool, steer, (), key, gamma=0.9))()

    open_, silent = play(SEEN), play(concealed(SEEN))
    np.testing.assert_array_equal(silent.transitions.next_obs[:, -3:], 0.0)
    np.testing.assert_array_equal(open_.transitions.obs[:, :-3], silent.transitions.obs[:, :-3])
    np.testing.assert_array_equal(open_.transitions.reward, silent.transitions.reward)


def test_noise_is_on_what_is_told_alone_and_new_at_every_step(key):
    there, noisy = world({"action_scale": [0.75, 1.0], "action_rotation": 0.0}, {"mass": 1.1}), blurred(SEEN, 0.3)

    @jax.jit
    def play(key):
        def step(state, key):
            after = noisy.step(there, state, jnp.zeros(2), key)
            return after, after

        return jax.lax.scan(step, noisy.reset(there, key), jax.random.split(key, 400))[1]

    states = play(key)
    told = np.asarray(states.obs)[:, -3:]
    np.testing.assert_allclose(told.mean(axis=0), [0.5, -0.5, 0.0], atol=0.07)
    np.testing.assert_allclose(told.std(axis=0), 0.3, atol=0.05)
    assert np.abs(states.true_obs[-1, : TOY.obs_dim] - states.obs[-1, : TOY.obs_dim]).max() < 0.1


@pytest.mark.heavy
def test_the_simulator_says_what_a_recorded_step_does_in_the_system_that_is_told(key):
    """With a bias of the sensors, and whatever the step's own noise was."""
    biased = {**EFFECTS, "obs_bias": [[0.0] * 4, [0.2] * 4], "latency_jitter": [0.0, 0.02]}
    env = compiled(with_system(with_previous_actions(TOY, 1), varying(TOY, {}, biased)))
    there = jax.tree.map(lambda x: x[0], envs.sample_worlds(env, key, 1, effects=biased | {"obs_noise": 0.0}))
    before, action = env.reset(there, key), jnp.array([0.6, -0.9])
    expected = (env.step(there, before, action, key).obs - before.obs)[: env.measured_dim]
    change = jax.jit(env.simulator())
    np.testing.assert_allclose(change(before.obs, action), expected, atol=1e-5)
    other = before.obs.at[-len(env.system) :].add(0.3)
    assert jnp.abs(change(other, action) - expected).max() > 1e-2


@pytest.mark.slow
def test_what_the_simulator_says_has_a_derivative_by_the_system(key):
    change, obs = SEEN.simulator(), SEEN.reset(world(EFFECTS), key).obs
    action = jnp.array([0.5, 0.25])
    slope = jax.jacfwd(lambda told: change(obs.at[-3:].set(told), action))(jnp.zeros(3))
    # At mass 1 a step adds dt F / m = 0.1 * 4 * scale * action to the velocity; the ranges' halves are 0.2, 0.5, 0.4.
    np.testing.assert_allclose(slope[2:], [[-0.04, 0.1, -0.04], [-0.02, 0.0, 0.08]], atol=2e-3)


def test_tasks_that_cannot_be_set_to_what_is_measured_have_no_simulator_to_ask():
    blind = with_system(with_previous_actions(TOY._replace(restore=None), 1), SYSTEM)
    assert blind.simulator is None


def test_nothing_to_tell_is_the_task_itself():
    assert with_system(TOY, ()) is TOY and concealed(TOY) is TOY


N = 2


@pytest.fixture(scope="module")
def seen():
    return with_previous_actions(TOY, N)


def test_the_last_actions_end_the_observation_newest_first(seen, key):
    world = jax.tree.map(lambda x: x[0], envs.sample_worlds(seen, key, 1))
    state = seen.reset(world, key)
    np.testing.assert_array_equal(state.obs[-2 * seen.act_dim :], 0)
    for i, action in enumerate(actions := [jnp.full(seen.act_dim, 0.1 * (i + 1)) for i in range(3)]):
        state = seen.step(world, state, action, jax.random.fold_in(key, i))
    np.testing.assert_allclose(state.obs[-2 * seen.act_dim :], jnp.concatenate([actions[2], actions[1]]), rtol=1e-6)


@pytest.mark.heavy
def test_the_task_is_the_same(seen, key):
    """Same world, start and noise; a policy that ignores the actions earns the same."""
    pool = envs.sample_worlds(TOY, key, 2)

    def steer(carry, obs, key):
        return jnp.tanh(-obs[: TOY.act_dim]), carry

    plain, wrapped = (play_episode(env, pool, steer, (), key, gamma=0.9) for env in (TOY, seen))
    np.testing.assert_array_equal(plain.transitions.obs, wrapped.transitions.obs[:, : TOY.obs_dim])
    np.testing.assert_array_equal(plain.transitions.reward, wrapped.transitions.reward)
    row = jax.tree.map(lambda x: x[0], wrapped.transitions)
    np.testing.assert_allclose(seen.reward(row.obs, row.action, row.next_obs), row.reward, rtol=1e-5)


def test_errors_of_sensors_are_of_what_is_measured(seen):
    assert seen.measured_dim == TOY.obs_dim == seen.obs_dim - N * seen.act_dim
    gap = envs.gaps.from_dict(seen, "off", {"effects": {"obs_bias": [0.1] * TOY.obs_dim}})
    assert envs.gaps.worlds(seen, gap, jax.random.key(0)).theta.effects.low.obs_bias.shape == (256, seen.measured_dim)
    with pytest.raises(UserError, match="needs"):
        envs.gaps.from_dict(seen, "off", {"effects": {"obs_bias": [0.1] * seen.obs_dim}})


def test_none_is_the_task_itself():
    assert with_previous_actions(TOY, 0) is TOY
