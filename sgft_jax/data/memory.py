"""What a fleet of simulators keeps of its experience: single transitions, or a ring of time slots. Pure."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

from envs.types import Array, Key, PyTree, Transition
from sgft_jax.data import replay, sequences
from sgft_jax.types import Batch, Task


class Memory(NamedTuple):
    """Experience of a fleet.

    empty(transitions) -> experience with room for that many; one that keeps time slots takes the slots that fit.
    add(experience, rows [n], valid [n], last [n]) -> the same with one step more. valid: not exploded; last: of its
        episode.
    cut(experience): no episode goes on after its newest step. held(experience) -> [capacity] bool.
    sample(experience, key, n) -> Batch [n, ...].
    any_fleet: whether steps may come from a fleet of any size, not of that size alone which the experience is for.
    """

    empty: Callable[[int], PyTree]
    add: Callable[[PyTree, Transition, Array, Array], PyTree]
    cut: Callable[[PyTree], PyTree]
    held: Callable[[PyTree], Array]
    sample: Callable[[PyTree, Key, int], Batch]
    any_fleet: bool


def transitions(task: Task) -> Memory:
    """Single transitions in a `ReplayState`."""
    return Memory(
        empty=lambda capacity: replay.init(replay.blank(task.obs_dim, task.act_dim), capacity),
        add=lambda experience, rows, valid, last: replay.add_batch(experience, rows, valid),
        cut=lambda experience: experience,
        held=lambda experience: jnp.arange(experience.data.reward.shape[0]) < experience.size,
        sample=replay.sample,
        any_fleet=True,
    )


def windows(task: Task, n_envs: int, sample: Callable[[PyTree, Key, int], Batch], *, spare: int = 0) -> Memory:
    """A ring of time slots of all environments, which `sample` draws from.

    spare: slots more than the transitions fill.
    """
    blank = replay.blank(task.obs_dim, task.act_dim)
    return Memory(
        empty=lambda transitions: sequences.init(blank, transitions // n_envs + spare, n_envs),
        add=sequences.add,
        cut=sequences.end_episodes,
        held=lambda experience: experience.valid,
        sample=sample,
        any_fleet=False,
    )
