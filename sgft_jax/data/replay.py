"""A ring buffer on the device. Pure functions of a state that the caller donates; one buffer, vmapped over seeds."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.mesh import running_count, set_rows
from envs.types import Array, Key, PyTree, Transition, UserError
from sgft_jax.types import Batch

__all__ = ["ReplayState", "add_batch", "add_episode", "blank", "full", "init", "obs_std", "sample"]


class ReplayState(NamedTuple):
    """data: rows on a leading [capacity] axis, transitions or what is kept beside them.

    position: [] int32 next row to write; size: [] int32 rows held.
    """

    data: Any
    position: Array
    size: Array


def blank(obs_dim: int, act_dim: int) -> Transition:
    """A transition of zeros with the dtypes that are stored: the example that `init` needs."""
    obs, zero = jnp.zeros(obs_dim), jnp.float32(0)
    return Transition(obs, jnp.zeros(act_dim), zero, zero, obs)


def init(example: PyTree, capacity: int) -> ReplayState:
    """An empty buffer for rows shaped like `example` (one row, no batch axis)."""
    if capacity < 1:
        raise UserError(f"replay capacity {capacity}: must be at least 1")
    data = jax.tree.map(lambda x: jnp.zeros((capacity, *jnp.shape(x)), jnp.asarray(x).dtype), example)
    return ReplayState(data, jnp.int32(0), jnp.int32(0))


def full(rows: Transition) -> ReplayState:
    """A buffer that is filled by given rows [N, ...] and by nothing else: a fixed set of data to sample."""
    n = rows.reward.shape[0]
    if n < 1:
        raise UserError("replay: a fixed set needs at least 1 transition")
    return ReplayState(jax.tree.map(jnp.asarray, rows), jnp.int32(0), jnp.int32(n))


def add_batch(state: ReplayState, batch: PyTree, valid: Array | None = None) -> ReplayState:
    """Append the valid rows, overwriting the oldest. batch: [n, ...] with n <= capacity; valid: [n] bool, default all.

    Invalid rows get an index beyond the end, where they are dropped: they take no space and are never sampled.
    """
    capacity, n = (jax.tree.leaves(rows)[0].shape[0] for rows in (state.data, batch))
    if n > capacity:
        raise UserError(f"replay: {n} transitions at once do not fit a capacity of {capacity}; raise the capacity")
    valid = jnp.ones(n, bool) if valid is None else valid
    count = running_count(valid)
    rows = jnp.where(valid, (state.position + count - 1) % capacity, capacity)
    data = set_rows(state.data, rows, batch)
    return ReplayState(data, (state.position + count[-1]) % capacity, jnp.minimum(state.size + count[-1], capacity))


def add_episode(state: ReplayState, rows: Transition, valid: Array) -> ReplayState:
    """Append the valid rows [T] of one episode, as `sequences.add_episode` does."""
    return add_batch(state, rows, valid)


def obs_std(state: ReplayState) -> Array:
    """Standard deviation [obs_dim] of the observations that are held; rows not yet written do not count."""
    held = (jnp.arange(state.data.reward.shape[0]) < state.size)[:, None]
    count = jnp.maximum(state.size, 1)
    mean = jnp.sum(state.data.obs, axis=0, where=held) / count
    return jnp.sqrt(jnp.sum(jax.vmap(lambda obs: (obs - mean) ** 2)(state.data.obs), axis=0, where=held) / count)


def sample(state: ReplayState, key: Key, n: int) -> Batch:
    """Draw n rows uniformly with replacement from what is held; zeros while the buffer is empty."""
    rows = jax.random.randint(key, (n,), 0, jnp.maximum(state.size, 1))
    return Batch(*jax.tree.map(lambda d: d[rows], state.data))
