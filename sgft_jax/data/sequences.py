"""A ring of time slots on the device, for learners that roll a model along consecutive transitions.

A slot holds one step of every environment, also of those whose physics exploded, so that the successor of a row is
found one slot further. Pure functions of a state that the caller donates; one buffer, vmapped over seeds.
"""

import jax
import jax.numpy as jnp
from flax import struct

from envs.mesh import running_count, set_rows
from envs.types import Array, Key, Transition, UserError
from sgft_jax.types import Batch

__all__ = ["SequenceState", "add", "add_episode", "end_episodes", "full", "init", "sample", "sample_episodes"]


class SequenceState(struct.PyTreeNode):
    """A ring of `slots` time slots for `n_envs` environments; row = slot * n_envs + environment.

    data: rows on a leading [slots * n_envs] axis. valid: which hold a transition that may be learned from.
    last: which end an episode. position: [] int32 next slot to write. size: [] int32 slots held. fixed: all rows are
    valid and stay as they are, so that a draw need not count which are.
    """

    data: Transition
    valid: Array
    last: Array
    position: Array
    size: Array
    n_envs: int = struct.field(pytree_node=False)
    fixed: bool = struct.field(pytree_node=False, default=False)

    @property
    def slots(self) -> int:
        """Time slots there are."""
        return self.valid.shape[-1] // self.n_envs


def init(example: Transition, slots: int, n_envs: int = 1) -> SequenceState:
    """An empty ring for transitions shaped like `example` (one transition, no batch axis)."""
    if slots < 1 or n_envs < 1:
        raise UserError(f"sequence ring of {slots} slots for {n_envs} environments: both must be at least 1")
    rows = slots * n_envs
    data = jax.tree.map(lambda x: jnp.zeros((rows, *jnp.shape(x)), jnp.asarray(x).dtype), example)
    no = jnp.zeros(rows, bool)
    return SequenceState(data, no, jnp.copy(no), jnp.int32(0), jnp.int32(0), n_envs)


def full(rows: Transition, last: Array) -> SequenceState:
    """A ring that is filled by given rows [N, ...] of one environment: a fixed set of data. last: [N] bool."""
    n = rows.reward.shape[0]
    if n < 1:
        raise UserError("sequence ring: a fixed set needs at least 1 transition")
    data = jax.tree.map(jnp.asarray, rows)
    return SequenceState(data, jnp.ones(n, bool), jnp.asarray(last), jnp.int32(0), jnp.int32(n), 1, fixed=True)


def add(state: SequenceState, rows: Transition, valid: Array, last: Array) -> SequenceState:
    """Write one step of every environment over the oldest slot.

    rows: [n_envs, ...]. valid: [n_envs] bool, not exploded. last: [n_envs] bool, terminated or truncated here: the
    environment's next row begins another episode.
    """
    if valid.shape[0] != state.n_envs:
        raise UserError(f"sequence ring: one step of {valid.shape[0]} environments, but it is for {state.n_envs}")
    index = state.position * state.n_envs + jnp.arange(state.n_envs)
    return _write(state, index, rows, valid, last, jnp.int32(1))


def add_episode(state: SequenceState, rows: Transition, valid: Array) -> SequenceState:
    """Write one whole episode into a ring of one environment.

    rows: [T, ...] with T <= slots. valid: [T] bool; invalid rows take no space, and the row before them ends what came
    before, as does the last one.
    """
    steps, slots = valid.shape[0], state.slots
    if state.n_envs != 1:
        raise UserError(f"sequence ring: an episode needs a ring of 1 environment, this one is for {state.n_envs}")
    if steps > slots:
        raise UserError(f"sequence ring: an episode of {steps} steps does not fit {slots} slots; raise the capacity")
    count = running_count(valid)
    index = jnp.where(valid, (state.position + count - 1) % slots, slots)
    last = valid & ~jnp.concatenate([valid[1:], jnp.zeros(1, bool)])
    return _write(state, index, rows, valid, last, count[-1])


def end_episodes(state: SequenceState) -> SequenceState:
    """The same ring, where no episode goes on after the newest slot."""
    newest = (state.position - 1) % state.slots
    slot = jnp.arange(state.last.shape[0]) // state.n_envs
    return state.replace(last=state.last | (slot == newest))


def _write(
    state: SequenceState, index: Array, rows: Transition, valid: Array, last: Array, steps: Array
) -> SequenceState:
    if state.fixed:
        raise UserError("sequence ring: it is full of a fixed set of data, which takes no further rows")
    data, valid, last = set_rows((state.data, state.valid, state.last), index, (rows, valid, last))
    position, size = (state.position + steps) % state.slots, jnp.minimum(state.size + steps, state.slots)
    return state.replace(data=data, valid=valid, last=last, position=position, size=size)


def sample(state: SequenceState, key: Key, n: int, length: int) -> Batch:
    """Draw n windows [n, length, ...], each starting at a valid row drawn uniformly with replacement.

    `valid` [n, length] is True for the leading steps that belong to the window; the rows of the others are zeros.

    A window is cut, by its mask, before an invalid row, after the last row of an episode and at the newest slot. Were
    windows redrawn until they fit, the last rows of an episode, where it is won or lost, would come up less often and
    with the small weights of late steps, and rows of an episode shorter than `length` never. Masked, every stored row
    is as often the first of a window as any other.
    Nothing is valid while the ring is empty. Draw the windows of several updates at once: counting the valid rows
    visits the whole ring, unless it is `fixed`.
    """
    if state.fixed:
        return _windows(state, jax.random.randint(key, (n,), 0, state.valid.shape[0]), jnp.ones((), bool), length)
    return _draw(state, state.valid, key, n, length)


def sample_episodes(state: SequenceState, key: Key, n: int, length: int) -> Batch:
    """The same, but windows begin where episodes begin: whole episodes, also unfinished ones, if none is longer.

    The ring's first row must begin an episode. Once the ring is full, its oldest rows count as the middle of one.
    Nothing is valid while no episode begins in the ring.
    """
    slot = jnp.arange(state.valid.shape[0]) // state.n_envs
    oldest = slot == (state.position - state.size) % state.slots
    ended = jnp.roll(state.last | ~state.valid, state.n_envs)  # whether the row before was the last of its episode
    begins = state.valid & jnp.where(oldest, state.size < state.slots, ended)
    return _draw(state, begins, key, n, length)


def _draw(state: SequenceState, begins: Array, key: Key, n: int, length: int) -> Batch:
    """Windows [n, length, ...] from rows where `begins` [rows] holds."""
    count = running_count(begins)
    nth = jax.random.randint(key, (n,), 0, jnp.maximum(count[-1], 1))
    start = jnp.minimum(jnp.searchsorted(count, nth, side="right"), count.shape[0] - 1)
    return _windows(state, start, count[-1] > 0, length)


def _windows(state: SequenceState, start: Array, some: Array, length: int) -> Batch:
    """The windows [n, length, ...] that begin at rows `start` [n]; some: [] whether a window may begin anywhere."""
    return jax.vmap(lambda row: _window(state, row, some, length))(start)


def _window(state: SequenceState, start: Array, some: Array, length: int) -> Batch:
    """The window [length, ...] that begins at row `start` []."""
    slot, env = start // state.n_envs, start % state.n_envs
    age, steps = (slot - state.position + state.size) % state.slots, jnp.arange(length)  # age: slots after the oldest
    index = (slot + steps) % state.slots * state.n_envs + env
    follows = jnp.concatenate([jnp.ones(1, bool), ~state.last[index][:-1]])
    valid = jnp.cumprod(some & (age + steps < state.size) & state.valid[index] & follows).astype(bool)

    def rows_of(column: Array) -> Array:
        rows = column[index]
        return jnp.where(jnp.expand_dims(valid, tuple(range(1, rows.ndim))), rows, jnp.zeros_like(rows))

    return Batch(*jax.tree.map(rows_of, state.data), valid=valid)
