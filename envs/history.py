"""Observations that hold the last actions: with commands that arrive late, measurements alone are no state."""

from collections.abc import Callable

import jax.numpy as jnp

from envs.base import Entry, Env, EnvState, World
from sgft_jax.types import Array, Key


def with_previous_actions(env: Env, n: int) -> Env:
    """The same task with `n` more vectors at the end of its observation: the last actions, the newest first.

    They are what the policy commanded, before any effect of the system, and zero before the first step. Whatever reads
    observations sees them: policy, critic, V_sim and dynamics models. n = 0 returns the task as it is. Source: states
    of delayed decision processes (Katsikopoulos and Engelbrecht 2003).
    """
    if n == 0:
        return env
    measured = env.obs_dim

    def inside(state: EnvState) -> tuple[EnvState, Array]:
        """The state as the task knows it, and the actions [n, act_dim]."""
        physics, actions = state.physics
        own = state._replace(physics=physics, obs=state.obs[:measured], true_obs=state.true_obs[:measured])
        return own, actions

    def outside(state: EnvState, actions: Array) -> EnvState:
        told = actions.reshape(-1)
        return state._replace(
            physics=(state.physics, actions),
            obs=jnp.concatenate([state.obs, told]),
            true_obs=jnp.concatenate([state.true_obs, told]),
        )

    def reset(world: World, key: Key) -> EnvState:
        return outside(env.reset(world, key), jnp.zeros((n, env.act_dim)))

    def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
        own, actions = inside(state)
        return outside(env.step(world, own, action, key), jnp.concatenate([action[None], actions[:-1]]))

    def of_transition(function: Callable[..., Array] | None) -> Callable[..., Array] | None:
        if function is None:
            return None
        return lambda obs, action, next_obs: function(obs[:measured], action, next_obs[:measured])

    success = env.success
    return env._replace(
        observation=(*env.observation, Entry("previous_actions", "1", n * env.act_dim)),
        previous_actions=n,
        reset=reset,
        step=step,
        reward=of_transition(env.reward),
        terminated=of_transition(env.terminated),
        success=None if success is None else lambda obs: success(obs[:measured]),
        trace=lambda physics: env.trace(physics[0]),
    )
