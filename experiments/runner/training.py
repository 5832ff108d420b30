"""Impure: run folders, the one loop around everything that trains (log, evaluate, checkpoint, resume), evaluations."""

import abc
import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import mesh
from envs.rollout import Episode, counted
from envs.types import Array, Key, Policy, PyTree, UserError
from experiments.runner.progress import RunProgress, doing
from sgft_jax.files.disk import jsonable
from sgft_jax.io import checkpoint, runs
from sgft_jax.io.log import Clock, MetricsLog, check_finite
from sgft_jax.io.priors import save_prior
from sgft_jax.math import stats
from sgft_jax.stacking import member, part
from sgft_jax.systems.simulated import System
from sgft_jax.train import evidence
from sgft_jax.train.evidence import Best
from sgft_jax.types import Metrics, Prior


def opened(
    kind: str, args: Any, configs: Mapping[Path, Mapping[str, Any]], inputs: Mapping[str, Any] | None = None
) -> contextlib.AbstractContextManager[list[Path]]:
    """`runs.opened` as a command with these `args` wants it."""
    how = {"resume": args.resume, "overwrite": args.overwrite, "volatile": args.volatile}
    return runs.opened(configs, kind=kind, inputs=inputs, **how)


class Record:
    """The files of one run folder (docs/formats.md). Arrays and states have a leading axis of the seeds [S].

    expect: facts that its checkpoints share. home: of checkpoints, where another host than this one writes them.
    """

    def __init__(self, folder: Path, expect: Mapping[str, Any], home: Path | None = None) -> None:
        self.folder, self.home, self.expect, self.seeds = folder, home or folder, expect, expect["seeds"]
        self.log = MetricsLog(folder)
        self.last_good: Path | None = None  # the checkpoint to go back to when training diverges

    def restore(self, like: PyTree, step: int) -> tuple[Any, dict[str, Any]]:
        """State and facts of a whole checkpoint, to which the logs are cut back."""
        state, meta = checkpoint.restore(self.home, like, step=step, checked=True, expect=self.expect)
        self.log.truncate(meta["position"])
        self.last_good = checkpoint.path(self.home, step)
        return state, meta

    def checkpoint(self, state: PyTree, step: int, **facts: Any) -> None:
        """The state, what else is known at this step, and how long the logs are."""
        self.checkpointer(step, **facts)(mesh.local(state))

    def checkpointer(self, step: int, **facts: Any) -> Callable[[PyTree], None]:
        """What writes a state with the facts and logs of this moment, though it be called later."""
        meta = jsonable({**self.expect, **facts, "position": self.log.position()})

        def write(state: PyTree) -> None:
            self.last_good = checkpoint.save(self.home, step, state, meta=meta)

        return write

    def save_policies(self, kind: str, params: PyTree, card: Callable[[int], Mapping[str, Any]]) -> None:
        """Policies [S] in the form of priors: <kind>/seed-<k>. card(seed) -> what the card of one says."""
        for i, seed in enumerate(self.seeds):
            save_prior(self.home / kind / f"seed-{seed}", Prior(member(params, i), dict(card(seed))))


class Training(abc.ABC):
    """What happens between compiled calls; what is on disk comes before what is in memory.

    Members [M = G * S] are the seeds of the first record, then those of the next. A kind of run says how far a state is
    (`done`, in `unit`), what is logged, how its policies are evaluated, and what a checkpoint holds.

    total: units of the whole run. count: seeds of a record. eval_every, checkpoint_every: units from one evaluation or
    checkpoint to the next. records: of the run folders, set before the work begins.
    """

    unit = ""
    records: Sequence[Any]

    def __init__(self, title: str, total: int, count: int, *, eval_every: int, checkpoint_every: int) -> None:
        self.title, self.total, self.count, self.clock = title, total, count, Clock()
        self.eval_every, self.checkpoint_every = eval_every, checkpoint_every

    def by_record(self, members: PyTree) -> Iterator[tuple[Any, PyTree]]:
        """Every record and, [S], what belongs to it in a pytree over all members."""
        return ((record, part(members, i, self.count)) for i, record in enumerate(self.records))

    def restore(self, like: Callable[[], PyTree]) -> list[tuple[Any, dict[str, Any]]]:
        """States and facts after the last checkpoints, none for a fresh start; raises UserError where these differ.

        like() -> shapes and types of the state of one record.
        """
        steps = [checkpoint.latest(record.home, whole=True) for record in self.records]
        if len(set(steps)) > 1:
            places = [f"{r.folder} is at step {step or 0}" for r, step in zip(self.records, steps, strict=True)]
            raise UserError(f"{', '.join(places)}: they cannot go on together, resume them one at a time")
        if steps[0] is None:
            for record in self.records:
                record.log.truncate({})
            return []
        shapes = like()
        return [record.restore(shapes, steps[0]) for record in self.records]

    def follow(self, steps: Iterator[tuple[Any, Metrics]], done: int) -> Any:
        """Logs, evaluates and checkpoints what an iterator yields; returns its last state. done: where it starts."""
        state = None
        with RunProgress(self.title, total=self.total, unit=self.unit, done=done) as progress:
            for state, metrics, seconds in self._timed(steps):
                before, done = done, self.done(state)
                values = {name: np.asarray(x) for name, x in metrics.items()}
                shown = self.log(state, values, seconds) if values else {}
                if self.evaluates(before, done, learned=bool(values)):
                    with self.clock("evaluate"), doing("evaluating", 15, once=True):
                        shown |= self.evaluate(state, done)
                if self.checkpoints(before, done, learned=bool(values)):
                    with self.clock("checkpoint"), doing("writing a checkpoint"):
                        self.checkpoint(state, done)
                progress.advance(done - before, shown)
        return state

    def announced(self, before: Any) -> contextlib.AbstractContextManager[None]:
        """Says what the next step is, see `doing`. before: the state of the one before, None at the start."""
        return doing("compiling the training", 30, once=True) if before is None else doing("training")

    def _timed(self, steps: Iterator[tuple[Any, Metrics]]) -> Iterator[tuple[Any, Metrics, float]]:
        """The same with the seconds that each took."""
        phase, before = "compile", None
        while True:
            started = time.perf_counter()
            with self.clock(phase), self.announced(before):
                step = jax.block_until_ready(next(steps, None))
            if step is None:
                return
            phase, before = "train", step[0]
            yield *step, time.perf_counter() - started

    def due(self, every: int, before: int, done: int) -> bool:
        """Whether something that happens every so many units happens after this chunk: also after the last."""
        return done != before and (before // every != done // every or done >= self.total)

    def log(self, state: Any, values: dict[str, np.ndarray], seconds: float) -> dict[str, float]:
        """Writes the metrics [M] of a chunk; returns what the progress bar shows."""
        done = self.done(state)
        for record, metrics in self.by_record(values):
            record.log.metrics(done, metrics)
            check_finite(metrics, done, unit=self.unit, last_good=record.last_good)
        return {}

    def evaluates(self, before: int, done: int, *, learned: bool) -> bool:
        """Whether there is an evaluation now. learned: whether there have been updates since the last time."""
        return done == 0 or self.due(self.eval_every, before, done)

    def checkpoints(self, before: int, done: int, *, learned: bool) -> bool:
        """Whether there is a checkpoint now."""
        return self.due(self.checkpoint_every, before, done)

    # what a kind of run says

    @abc.abstractmethod
    def done(self, state: Any) -> int:
        """Units behind a state."""

    @abc.abstractmethod
    def evaluate(self, state: Any, done: int) -> dict[str, float]:
        """Plays and logs an evaluation; returns what the progress bar shows."""

    def checkpoint(self, state: Any, done: int) -> None:
        """Writes the checkpoints of all records."""
        for record, states in self.by_record(state):
            record.checkpoint(states, done)


# --- evaluations -----------------------------------------------------------------------------------------------------


def play(system: System, policy: Policy, params: PyTree, key: Key, episodes: int, *, explore: bool = False) -> Episode:
    """Episodes [M, episodes] of each of M policies, as NumPy arrays on every host.

    All policies play the same episodes, so that differences between them are paired.
    """
    members = jax.tree.leaves(params)[0].shape[0]
    keys = jnp.broadcast_to(jax.random.split(key, episodes), (members, episodes))
    played = mesh.local(system.play(policy, params, keys, explore=explore))
    return jax.tree.map(np.asarray, played)


def scores(played: Episode, worst: Array | None = None) -> Metrics:
    """Mean score, success, return and share of exploded episodes [M] of episodes [M, n].

    worst: [M, 2] the lowest score and return of earlier episodes: one that exploded counts as the worst known.
    """
    score, total = counted(played, worst)
    return {
        "score": score.mean(-1),
        "success": played.success.mean(-1),
        "return": total.mean(-1),
        "exploded": played.exploded.mean(-1),
    }


def describe(played: Episode) -> dict[str, Any]:
    """The numbers of one policy's episodes [n] as JSON data, success with its 95 % Wilson interval."""
    interval = stats.success_interval(int(played.success.sum()), len(played.success))
    return {
        "episodes": len(played.success),
        "success": float(interval.estimate),
        "success/interval": [float(interval.low), float(interval.high)],
        "return": float(counted(played)[1].mean()),
        "exploded": float(played.exploded.mean()),
    }


def best_of(best: Best | None, params: PyTree, played: Episode, age: Array, *, since: float = 0) -> Best:
    """The best [M] of an earlier evaluation, if there was one, and of this one of `params` [M, ...]; see `Best`.

    params may be donated afterwards. age: [M]. since: see `evidence.evaluated`.
    """
    best = evidence.nothing_known(params, *played.exploded.shape) if best is None else best
    return _evaluated(best, params, played.score, played.total_reward, played.exploded, age, since)


_evaluated: Callable[..., Best] = jax.jit(evidence.evaluated)
