"""Observations that hold more than sensors measure, such as the last actions."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from envs.base import Entry, Env, EnvState, World
from envs.types import Array, Key, PyTree


def with_previous_actions(env: Env, n: int) -> Env:
    """The same task with `n` more vectors at the end of its observation: the last actions, the newest first.

    They are what the policy commanded, before any effect of the system, and zero before the first step. Whatever reads
    observations sees them: policy, critic, V_sim and dynamics models. n = 0 returns the task as it is. Source: states
    of delayed decision processes (Katsikopoulos and Engelbrecht 2003).
    """
    if n == 0:
        return env
    longer = extended(
        env,
        Entry("previous_actions", "1", n * env.act_dim),
        tell=lambda world, state, actions: actions.reshape(-1),
        start=lambda: jnp.zeros((n, env.act_dim)),
        remember=lambda actions, action: jnp.concatenate([action[None], actions[:-1]]),
        recall=lambda facts: facts.reshape(n, env.act_dim),
    )
    return longer._replace(previous_actions=n)


def extended(
    env: Env,
    entry: Entry,
    *,
    tell: Callable[[World, EnvState, PyTree], Array],
    start: Callable[[], PyTree],
    remember: Callable[[PyTree, Array], PyTree],
    recall: Callable[[Array], PyTree],
) -> Env:
    """The same task with one more entry at the end of its observation; rewards and success are what they were.

    tell(world, state of `env`, memory) -> [entry.size]. start() -> memory of an episode. remember(memory, action) ->
    memory. recall(what was told [entry.size]) -> memory.
    """
    inner_dim = env.obs_dim

    def outside(world: World, state: EnvState, memory: PyTree) -> EnvState:
        facts = tell(world, state, memory)
        return state._replace(
            physics=(state.physics, memory),
            obs=jnp.concatenate([state.obs, facts]),
            true_obs=jnp.concatenate([state.true_obs, facts]),
        )

    def reset(world: World, key: Key) -> EnvState:
        return outside(world, env.reset(world, key), start())

    def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
        physics, memory = state.physics
        inner = state._replace(physics=physics, obs=state.obs[:inner_dim], true_obs=state.true_obs[:inner_dim])
        return outside(world, env.step(world, inner, action, key), remember(memory, action))

    def of_transition(function: Callable[..., Array] | None) -> Callable[..., Array] | None:
        if function is None:
            return None
        return lambda obs, action, next_obs: function(obs[:inner_dim], action, next_obs[:inner_dim])

    success, restore = env.success, env.restore
    return env._replace(
        observation=(*env.observation, entry),
        reset=reset,
        step=step,
        restore=None
        if restore is None
        else lambda world, obs, key: outside(world, restore(world, obs[:inner_dim], key), recall(obs[inner_dim:])),
        reward=of_transition(env.reward),
        terminated=of_transition(env.terminated),
        success=None if success is None else lambda obs: success(obs[:inner_dim]),
        trace=lambda physics: env.trace(physics[0]),
    )


def with_memory(env: Env, measured: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """[..., obs_dim] what a policy reads where steps are taken outside jit, from what sensors say.

    measured: [..., measured_dim]. actions: [..., previous_actions, act_dim], the last ones, the newest first. Of the
    system it tells the middle of every range, see `envs.system.concealed`.
    """
    memory = actions.reshape(*measured.shape[:-1], -1)
    return np.concatenate(
        [measured, memory, np.zeros((*measured.shape[:-1], len(env.system)))], axis=-1, dtype=np.float32
    )


def remember(actions: np.ndarray, action: np.ndarray) -> np.ndarray:
    """The last actions [..., n, act_dim], the newest first, after one more [..., act_dim]."""
    return np.concatenate([action[..., None, :], actions], axis=-2)[..., : actions.shape[-2], :]
