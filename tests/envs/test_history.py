"""Observations with previous actions: what they hold, and that the task under them is the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

import envs
from envs.history import with_previous_actions
from envs.rollout import play_episode
from envs.types import UserError

N, TOY = 2, toy.make()


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
