"""Impure: what is on disk of real systems: logs to learn from, and every episode before anything learns from it."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Env
from envs.rollout import Episode
from envs.types import Key, PyTree, Transition, UserError
from experiments.runner.progress import amid
from sgft_jax.datasets import logs as datasets
from sgft_jax.datasets.logs import Log
from sgft_jax.io.real import RealStore
from sgft_jax.stacking import join, part
from sgft_jax.systems.gymnasium import Step
from sgft_jax.systems.simulated import SteppedSystem, System, drifted
from sgft_jax.train.finetuning import Logged
from sgft_jax.types import Finetuner, Successors

_FACTS = tuple(name for name in Episode._fields if name != "transitions")
_BESIDE = ("late", "time")  # what is kept of a robot's steps beside transitions, see `Step`


class RecordedSystem:
    """A `System` that stores episodes, and replays those stored already instead of playing them again.

    A run that was killed after its last checkpoint learns from what the robot has done since, and repeats nothing.

    inner: what plays. stores: one for each real system, whose members stand one after another. done: episodes behind
    the state that the run starts from. explore: whether exploring episodes are stored, or those without exploration;
    the others are played and forgotten. sync_every: for a robot: every step is on disk before the next one, and
    flushed after so many. What a kill leaves of a rollout is kept as one that ended there. Its next step is in doubt,
    because the robot may have made it: the rollout counts as broken off, and that step is not learned from. The first
    step is on disk before it is asked for; a rollout that was killed before that is begun again.
    """

    def __init__(
        self,
        inner: System,
        stores: Sequence[RealStore],
        *,
        done: int,
        explore: bool = True,
        sync_every: int | None = None,
    ) -> None:
        self.inner, self.stores, self.rollout, self.explore = inner, stores, done, explore
        self.sync_every = sync_every
        if short := [store for store in stores if len(store) < done]:
            raise UserError(f"{short[0].folder}: holds {len(short[0])} rollouts, the checkpoint remembers {done}")

    def play(self, policy: Any, states: PyTree, keys: Key, *, explore: bool) -> Episode:
        """Episodes [M, n], stored one after another."""
        if explore != self.explore:
            return self.inner.play(policy, states, keys, explore=explore)
        played, n = [], keys.shape[1]
        for i in range(n):
            which = f"episode {i + 1} of {n}" if n > 1 else f"rollout {self.rollout + 1}"
            with amid(f"playing {which} on the robot") if self.sync_every else contextlib.nullcontext():
                played.append(self._one(policy, states, keys[:, i : i + 1]))
        return jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *played)

    def _one(self, policy: Any, states: PyTree, keys: Key) -> Episode:
        """The next episode of every member, [M, 1]."""
        number, self.rollout = self.rollout, self.rollout + 1
        missing = [store for store in self.stores if len(store) <= number]
        if missing and self.sync_every is not None:
            self._play_robot(number, policy, states, keys[:, 0])
        elif missing:
            episodes = drifted(self.inner, number).play(policy, states, keys, explore=self.explore)
            for i, store in enumerate(self.stores):
                if len(store) <= number:
                    store.append(_arrays(part(episodes, i, keys.shape[0] // len(self.stores))))
            if len(missing) == len(self.stores):
                return episodes
        # What a robot has done stands, also where the others had to play this rollout again.
        return join([_read(store, number) for store in self.stores])

    def _play_robot(self, number: int, policy: Any, states: PyTree, keys: Key) -> None:
        """Stores the rollout of a robot, played now or as far as a kill has let it come. keys: [1]."""
        (store,), inner = self.stores, self.inner
        assert isinstance(inner, SteppedSystem)
        journal = store.journal(number, sync_every=self.sync_every or 1)
        made = [_step(journal.path, step, inner.env) for step in journal.read()]
        if made and not made[-1].over and len(made) < inner.env.episode_length:
            made.append(made[-1].in_doubt())
        elif not made:
            steps = inner.steps(
                policy, states, keys, explore=self.explore, asked=lambda step: journal.begin(step._asdict())
            )
            with journal, contextlib.closing(steps):  # whatever happens, the robot rests
                for step in steps:
                    journal.append(step._asdict())
                    made.append(step)
        beside = {name: np.stack([getattr(step, name) for step in made], axis=1) for name in _BESIDE}
        store.append({**_arrays(jax.tree.map(lambda x: x[:, None], inner.episode(made))), **beside})
        journal.remove()


def _step(path: Path, stored: Mapping[str, np.ndarray], env: Env) -> Step:
    """A step of one member from a journal, which may be one of another task, or of a version before."""
    widths = {"obs": env.obs_dim, "next_obs": env.obs_dim, "action": env.act_dim, "command": env.act_dim}
    shapes = {name: (1, widths[name]) if name in widths else (1,) for name in Step._fields}
    if {name: x.shape for name, x in stored.items()} != shapes:
        raise UserError(f"{path}: holds no steps of {env.name}; move it away to go on without them")
    return Step(**stored)


def _arrays(episodes: Episode) -> dict[str, np.ndarray]:
    """Arrays [S, ...] of one rollout of every seed, as they are stored."""
    arrays = episodes.transitions._asdict() | {name: getattr(episodes, name) for name in _FACTS}
    return {name: np.asarray(x[:, 0]) for name, x in arrays.items() if x is not None}


def _read(store: RealStore, number: int) -> Episode:
    """The inverse."""
    arrays = store.rollout(number)
    if missing := {name for name in _FACTS if name != "command"} - set(arrays):
        raise UserError(f"{store.folder}: rollout {number} lacks {min(missing)}; docs/formats.md lists what it holds")
    stored = {name: jnp.asarray(x)[:, None] for name, x in arrays.items()}
    transitions = Transition(*(stored[name] for name in Transition._fields))
    return Episode(transitions=transitions, **{name: stored[name] for name in _FACTS if name in stored})


# --- logs -------------------------------------------------------------------------------------------------------------


def read_log(path: Path, env: Env, *, gamma: float, successors: Successors = "stored") -> Log:
    """The real rows of a file or folder; says what they are. Raises UserError if they are not of this task."""
    log = datasets.load(path, gamma=gamma, successors=successors, env=env)
    facts = log.facts
    clipped = f"; {facts.clipped:,} actions beyond [-1, 1] were clipped" if facts.clipped else ""
    rows = f"{facts.transitions:,} transitions of {facts.episodes:,} episodes"
    spread = f"std {facts.return_std:.3g}, {facts.return_min:.4g} to {facts.return_max:.4g}"
    returns = f"return {facts.return_mean:.4g} ({spread})"
    print(f"data: {facts.path}, {facts.size:,} bytes, sha256 {facts.sha256[:12]}; {rows}, {returns}{clipped}")
    if facts.assumed:
        print(f"{facts.path}: {facts.assumed}")
    return log


def begin_with(logs: Sequence[Log], finetuner: Finetuner, env: Env, *, capacity: int, updates: int | None) -> Logged:
    """What fine-tuning begins with. capacity: transitions that an agent keeps.

    updates: on the logs; None makes as many as rollouts of so many transitions would allow. Raises UserError where the
    logs are more than an agent keeps.
    """
    count = sum(log.facts.transitions for log in logs)
    if count > capacity:
        room = f"an agent keeps {capacity:,}; raise --options.replay-capacity"
        raise UserError(f"--real-data: {count:,} transitions, but {room}")
    rows, valid = jax.tree.map(jnp.asarray, datasets.episodes(logs))
    made = round(finetuner.updates_per_rollout * count / env.episode_length) if updates is None else updates
    return Logged(rows, valid, made)
