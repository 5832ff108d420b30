"""Rewards that are not a task's own."""

import jax
import jax.numpy as jnp
import pytest

import envs
from envs import gaps
from envs.franka.push import EDGE
from envs.rollout import real_env
from envs.types import UserError


@pytest.fixture(scope="module")
def env():
    return envs.make("push", "c", previous_actions=2, sparse=True)


def test_success_alone_is_paid(env, key):
    world = jax.tree.map(lambda x: x[0], envs.sample_worlds(env, key, 1))
    state, still = env.reset(world, key), jnp.zeros(env.act_dim)
    solved = state.obs.at[2].set(EDGE - 0.01)
    assert [float(env.reward(state.obs, still, obs)) for obs in (state.obs, solved)] == [0.0, 1.0]
    for obs, paid in ((state.obs, 0.0), (solved, 1.0)):
        begun = env.restore(world, obs, key)
        after = env.step(world, begun, still, key)
        assert begun.reward == 0.0 and after.reward == after.success == paid and after.reward.dtype == jnp.float32


def test_a_real_system_of_another_scene_pays_alike(env):
    patches = gaps.load(env, "envs/gaps/development/push-unexplained.toml:push-4-03")
    assert patches.scene and real_env(env, [patches]).sparse


def test_what_has_no_success_is_refused():
    with pytest.raises(UserError, match="judged by its return"):
        envs.make("halfcheetah", "c", sparse=True)
