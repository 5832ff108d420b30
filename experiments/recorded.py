"""Impure: a real system whose every episode is on disk before anything learns from it."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.rollout import Episode
from experiments.stacking import join, part
from sgft_jax.io.real import RealStore
from sgft_jax.systems import System
from sgft_jax.types import Key, PyTree, Transition, UserError

_FACTS = tuple(name for name in Episode._fields if name != "transitions")


class Recorded:
    """A `System` that stores episodes, and replays those stored already instead of playing them again.

    A run that was killed after its last checkpoint learns from what the robot has done since, and repeats nothing.

    inner: what plays. stores: one for each real system, whose members stand one after another. done: episodes behind
    the state that the run starts from. explore: whether exploring episodes are stored, or those without exploration;
    the others are played and forgotten.
    """

    def __init__(self, inner: System, stores: Sequence[RealStore], *, done: int, explore: bool = True) -> None:
        self.inner, self.stores, self.rollout, self.explore = inner, stores, done, explore
        if short := [store for store in stores if len(store) < done]:
            raise UserError(f"{short[0].folder}: holds {len(short[0])} rollouts, the checkpoint remembers {done}")

    def play(self, policy: Any, states: PyTree, keys: Key, *, explore: bool) -> Episode:
        """Episodes [M, n], stored one after another."""
        if explore != self.explore:
            return self.inner.play(policy, states, keys, explore=explore)
        played = [self._one(policy, states, keys[:, i : i + 1]) for i in range(keys.shape[1])]
        return jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *played)

    def _one(self, policy: Any, states: PyTree, keys: Key) -> Episode:
        """The next episode of every member, [M, 1]."""
        number, self.rollout = self.rollout, self.rollout + 1
        missing = [store for store in self.stores if len(store) <= number]
        if not missing:
            return self._stored(number)
        episodes = self.inner.play(policy, states, keys, explore=self.explore)
        for i, store in enumerate(self.stores):
            if len(store) <= number:
                store.append(_arrays(part(episodes, i, keys.shape[0] // len(self.stores))))
        # What a robot has done stands, also where the others had to play this rollout again.
        return episodes if len(missing) == len(self.stores) else self._stored(number)

    def _stored(self, number: int) -> Episode:
        return join([_read(store.load(number)) for store in self.stores])


def _arrays(episodes: Episode) -> dict[str, np.ndarray]:
    """Arrays [S, ...] of one rollout of every seed, as they are stored."""
    arrays = episodes.transitions._asdict() | {name: getattr(episodes, name) for name in _FACTS}
    return {name: np.asarray(x[:, 0]) for name, x in arrays.items()}


def _read(arrays: dict[str, np.ndarray]) -> Episode:
    """The inverse."""
    stored = {name: jnp.asarray(x)[:, None] for name, x in arrays.items()}
    transitions = Transition(*(stored[name] for name in Transition._fields))
    return Episode(transitions=transitions, **{name: stored[name] for name in _FACTS})
