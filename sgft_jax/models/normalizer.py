"""Observation statistics of the random-action data set, fixed once training starts."""

from typing import cast

import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics

from envs.types import Array
from sgft_jax.types import Batch, Normalizer

__all__ = ["finish", "identity", "init", "normalize", "normalize_rows", "of", "update"]

Statistics = running_statistics.RunningStatisticsState

# Raw units are metres and radians. Entries that random actions hardly move (a nail, a far puck) would otherwise turn
# centimetres, which matter later, into tens of standard deviations of sensor noise.
STD_FLOOR = 1e-2


def init(obs_dim: int) -> Statistics:
    """Empty statistics of observations [obs_dim]."""
    return running_statistics.init_state(jnp.zeros(obs_dim))


def update(statistics: Statistics, obs: Array, valid: Array | None = None) -> Statistics:
    """Fold in a batch. obs: [N, obs_dim] raw units; valid: [N] bool, the rows that count (the others may be NaN)."""
    valid = jnp.ones(obs.shape[0], bool) if valid is None else valid
    obs = jnp.where(valid[:, None], obs, 0.0)
    with jax.numpy_rank_promotion("allow"):  # brax subtracts a [obs_dim] mean from the batch
        new = running_statistics.update(statistics, obs, weights=valid.astype(jnp.float32))
    return jax.tree.map(lambda n, o: jnp.where(jnp.any(valid), n, o), new, statistics)


def finish(statistics: Statistics, *, std_floor: float = STD_FLOOR) -> Normalizer:
    """The fixed normaliser of these statistics, with std at least `std_floor` (raw units)."""
    mean, std = cast(Array, statistics.mean), cast(Array, statistics.std)
    return Normalizer(mean, jnp.maximum(std, std_floor))


def of(obs: Array) -> Normalizer:
    """That of fixed data. obs: [N, obs_dim] raw units."""
    return finish(update(init(obs.shape[1]), obs))


def identity(obs_dim: int) -> Normalizer:
    """Leaves observations as they are."""
    return Normalizer(jnp.zeros(obs_dim), jnp.ones(obs_dim))


def normalize(normalizer: Normalizer, obs: Array) -> Array:
    """From raw units [obs_dim] to [obs_dim] standard deviations from the mean. Not clipped: the tail is the task."""
    return (obs - normalizer.mean) / normalizer.std


def normalize_rows(normalizer: Normalizer, batch: Batch) -> Batch:
    """A batch [B, ...] whose observations are in units of `normalize`."""
    rows = jax.vmap(normalize, (None, 0))
    return batch._replace(obs=rows(normalizer, batch.obs), next_obs=rows(normalizer, batch.next_obs))
