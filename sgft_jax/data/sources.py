"""Sources of batches: real rows from a replay, simulated rows from a fixed set, and mixtures of both.

The state of every source here is (replay of the real system, `SimulatedData` or None), but for `two_buffers`. Real rows
come first, but for `beside`.
"""

import jax
import jax.numpy as jnp

from envs.types import Array, Key
from sgft_jax.data import replay, sequences
from sgft_jax.types import Batch, Source

__all__ = ["beside", "blend", "mixture", "real_rows", "real_windows", "simulated_rows", "two_buffers"]

State = tuple  # (ReplayState or SequenceState, SimulatedData or None)


def real_rows(n: int) -> Source:
    """`n` rows of the real system."""
    return Source(lambda state, key: replay.sample(state[0], key, n), n_real=n)


def real_windows(n: int, length: int) -> Source:
    """`n` windows [n, length] of consecutive real steps."""
    return Source(lambda state, key: sequences.sample(state[0], key, n, length), n_real=n)


def simulated_rows(n: int) -> Source:
    """`n` rows of the simulator: what learns before the first real rollout."""
    return Source(lambda state, key: Batch(*state[1].draw(key, n), is_sim=jnp.ones(n, bool)), n_real=0, n_sim=n)


def mixture(n_real: int, n_sim: int) -> Source:
    """`n_real` real rows, then `n_sim` simulated ones. Source: symmetric sampling of RLPD (Ball et al. 2023)."""
    if not n_sim:
        return real_rows(n_real)

    def sample(state: State, key: Key) -> Batch:
        key_real, key_sim = jax.random.split(key)
        return _mixed(replay.sample(state[0], key_real, n_real), Batch(*state[1].draw(key_sim, n_sim)))

    return Source(sample, n_real, n_sim)


def two_buffers(n_real: int, n_sim: int) -> Source:
    """`n_real` rows of a fixed real set, then `n_sim` rows that a policy collects in a simulator.

    The state is (`replay.full` of the set, replay of the simulator). Source: H2O (Niu et al. 2022).
    """

    def sample(state: tuple[replay.ReplayState, replay.ReplayState], key: Key) -> Batch:
        key_real, key_sim = jax.random.split(key)
        return _mixed(replay.sample(state[0], key_real, n_real), replay.sample(state[1], key_sim, n_sim))

    return Source(sample, n_real, n_sim)


def beside(first: Source, second: Source) -> Source:
    """The rows of `first`, then rows that `second` draws from the same state: a learner may treat them differently."""

    def sample(state: State, key: Key) -> Batch:
        key_first, key_second = jax.random.split(key)
        both = first.sample(state, key_first), second.sample(state, key_second)
        return jax.tree.map(lambda *x: jnp.concatenate(x), *both)

    return Source(sample, first.n_real + second.n_real, first.n_sim + second.n_sim)


def _mixed(real: Batch, simulated: Batch) -> Batch:
    """Real rows, then simulated ones, and which are which."""
    n_real, n_sim = real.reward.shape[0], simulated.reward.shape[0]
    rows = jax.tree.map(lambda *x: jnp.concatenate(x), real, simulated)
    return rows._replace(is_sim=jnp.arange(n_real + n_sim) >= n_real)


def blend(source: Source, share: Array | float) -> Source:
    """A mixture of equal halves of n rows each, thinned to n rows of which a `share` [] is simulated.

    The share may be traced, so that it can follow a schedule; hence both halves are drawn.
    """
    n = source.n_real

    def sample(state: State, key: Key) -> Batch:
        rows = source.sample(state, key)
        simulated = jnp.arange(n) >= n - jnp.round(share * n)
        return jax.tree.map(lambda x: jnp.where(simulated.reshape(-1, *[1] * (x.ndim - 1)), x[n:], x[:n]), rows)

    return Source(sample, n)
