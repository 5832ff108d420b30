"""Simulated data that fine-tuning begins with: whole episodes of every prior's exploring policy."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env, World
from envs.rollout import Episode, play_episode
from envs.types import Array, Key, Policy, PyTree, Transition
from sgft_jax.data import replay
from sgft_jax.types import SimulatedData, Simulation

__all__ = ["simulate"]

_AT_ONCE = 1024  # episodes played together


class SimulatedRows(NamedTuple):
    """Transitions of the simulator, one set for each of P priors, shared by all members.

    replay: [P, ...]. returns: [P, episodes] of the task, undiscounted.
    """

    replay: replay.ReplayState
    returns: Array

    def of(self, which: Array) -> SimulatedData:
        """The set of prior `which` [], without a copy of it."""

        def draw(key: Key, n: int) -> Transition:
            rows = jax.random.randint(key, (n,), 0, jnp.maximum(self.replay.size[which], 1))
            return jax.tree.map(lambda x: x[which, rows], self.replay.data)

        return SimulatedData(draw, self.returns[which])


def simulate(
    env: Env,
    policy: Policy,
    pool: World,
    priors: PyTree,
    key: Key,
    needs: Simulation,
    *,
    gamma: float,
    heard: Callable[[float], None] = lambda share: None,
) -> SimulatedRows:
    """Whole episodes of every prior's exploring policy in simulated worlds.

    pool: worlds [W] of the training domain. priors: params [P, ...]. needs: how many transitions, and the largest share
    of random actions: in the i-th of n episodes a share i / (n - 1) * needs.ladder of the actions is uniformly random.
    heard(share) is told from time to time how much of it has been played.
    """
    parts, at_once = _parts(env, needs)
    keys = jax.random.split(key, jax.tree.leaves(priors)[0].shape[0])
    keys = jax.vmap(lambda key: jax.random.split(key, parts))(keys)
    shares = jnp.linspace(0.0, needs.ladder, parts * at_once).reshape(parts, at_once)
    one = functools.partial(_simulate, env, policy, pool, gamma=gamma)
    play = jax.jit(jax.vmap(one, (0, 0, 0, None)), donate_argnums=1)
    held, returns = jax.jit(functools.partial(_empty, env, parts * at_once, len(keys)))(), []
    for i in range(parts):
        held, of_part = jax.block_until_ready(play(priors, held, keys[:, i], shares[i]))
        returns.append(of_part)
        heard((i + 1) / parts)
    return SimulatedRows(held, jnp.concatenate(returns, axis=1))


def shapes(env: Env, needs: Simulation, priors: int) -> SimulatedRows:
    """Shapes and types of what `simulate` returns for so many priors."""
    parts, at_once = _parts(env, needs)
    n = parts * at_once
    return jax.eval_shape(lambda: SimulatedRows(_empty(env, n, priors), jnp.zeros((priors, n))))


def _parts(env: Env, needs: Simulation) -> tuple[int, int]:
    """In how many parts episodes are played, and how many there are in each."""
    n = -(-needs.transitions // env.episode_length)
    at_once = min(n, _AT_ONCE)
    return -(-n // at_once), at_once


def _empty(env: Env, episodes: int, priors: int) -> replay.ReplayState:
    size = episodes * env.episode_length
    return jax.vmap(lambda _: replay.init(replay.blank(env.obs_dim, env.act_dim), size))(jnp.arange(priors))


def _simulate(
    env: Env,
    policy: Policy,
    pool: World,
    params: PyTree,
    held: replay.ReplayState,
    key: Key,
    shares: Array,
    *,
    gamma: float,
) -> tuple[replay.ReplayState, Array]:
    """One part: what is held with its rows, and the returns of its episodes. shares: [n] of random actions."""

    def play(key: Key, share: Array) -> Episode:
        def act(carry: PyTree, obs: Array, key: Key) -> tuple[Array, PyTree]:
            key_policy, key_replace, key_random = jax.random.split(key, 3)
            action, carry = policy.act(params, carry, obs, key_policy, explore=True)
            random = jax.random.uniform(key_random, (env.act_dim,), minval=-1.0, maxval=1.0)
            return jnp.where(jax.random.uniform(key_replace) < share, random, action), carry

        return play_episode(env, pool, act, policy.init_carry(), key, gamma=gamma)

    episodes = jax.vmap(play)(jax.random.split(key, len(shares)), shares)
    rows, valid = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (episodes.transitions, episodes.valid))
    return replay.add_batch(held, rows, valid), episodes.total_reward
