"""Whole episodes in one of several stacked pools."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import toy

from envs.rollout import pick, play_episode, pool_size


def test_an_episode_in_a_stacked_pool_is_that_in_the_pool_alone(key):
    env = toy.make()
    stacked = jax.tree.map(lambda x: x.reshape(2, 5, *x.shape[1:]), env.sample_worlds(key, 10))
    assert pool_size(stacked) == 5
    push = lambda carry, obs, key: (-obs[:2], carry)  # noqa: E731
    play = functools.partial(play_episode, env, policy=push, carry=(), gamma=1.0, length=2)

    @jax.jit
    @jax.vmap
    def both(key, which):
        return play(stacked, key=key, which=which), play(pick(stacked, which), key=key)

    together, alone = both(jax.random.split(key, 6), jnp.array([0, 1, 1, 0, 1, 0]))
    jax.tree.map(np.testing.assert_array_equal, together, alone)
    assert len(set(together.world.tolist())) > 1
