"""Training as iterators. They yield (state, metrics), print nothing and touch no files; the caller does both.

A yielded state is valid until the iterator's next step, which donates its arrays: copy it to keep it longer.
"""

import functools
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.mesh import split_vmap
from envs.rollout import Episode
from envs.types import Array, Key, PyTree, Transition, UserError
from sgft_jax.keys import Finetuning
from sgft_jax.systems.simulated import System, drifted
from sgft_jax.train import evidence
from sgft_jax.train.evidence import Best
from sgft_jax.train.simulation import SimulatedRows
from sgft_jax.types import Finetuner, Metrics

if TYPE_CHECKING:
    from sgft_jax.train.learner_process import LearnerProcess

__all__ = ["FinetuneProgress", "evaluate", "finetune"]

Phase = Literal["offline", "logged", "online"]  # of learning, see `Updates`
OFFLINE_PART = 5_000  # updates of the offline phase between two yields


class FinetuneProgress(NamedTuple):
    """What a fine-tuning run needs to go on.

    agent: [M, ...]. rollouts: int32 [], real ones behind it. offline: int32 [], updates before the first of them, on
    simulated transitions, then on logs. transitions: [M] int32, the real ones in the rollouts.
    """

    agent: PyTree
    best: Best
    rollouts: Array
    offline: Array
    transitions: Array


class Logged(NamedTuple):
    """Episodes of the real system that something else has played, the same for all members.

    transitions: [N, T, ...]. valid: [N, T] bool, the first steps of each episode. updates: gradient updates on them
    before the first rollout.
    """

    transitions: Transition
    valid: Array
    updates: int


# --- fine-tuning ------------------------------------------------------------------------------------------------------


def finetune(
    finetuner: Finetuner,
    system: System,
    priors: PyTree,
    seeds: Array,
    simulated: Callable[[], SimulatedRows] | None = None,
    *,
    rollouts: int,
    progress: FinetuneProgress | None = None,
    learner: "LearnerProcess | None" = None,
    waits: bool = True,
    logged: Logged | None = None,
    programs: "Programs | None" = None,
) -> Iterator[tuple[FinetuneProgress, Metrics]]:
    """Fine-tunes M members, each a seed on a real system, until each has made `rollouts` real rollouts.

    priors: params [P, ...] of P priors, or None; the member with seed s starts from prior s modulo P.
    seeds: [M] uint32. simulated() -> what `simulate` returns, for methods that ask for it; called when something first
    learns from it, which is after the first rollout where nothing is learned before.
    progress: where an earlier run stopped, or None. logged: logs to begin with: all members keep their episodes and
    make `logged.updates` updates, as they learn from real rollouts, before they play.
    learner: a process that learns while the system is reset, for systems that are stepped (`Gymnasium.play`); None:
    this process learns between rollouts. waits: True holds the first step of a rollout until learning has finished, so
    results are those without a `learner`. False plays with the old policy until the new one has been learned; such a
    rollout is evidence for the one that made more of its steps. programs: compiled already; None makes them.

    A rollout of full length is followed by `finetuner.updates_per_rollout` updates, a shorter one by its share, one at
    least, and one without a valid step by none.

    Yields the fresh state with no metrics (unless `progress` is given), then once per part of the offline phase, then
    once per real rollout, all initial ones together; with a `learner` after the next rollout has been played. Metrics
    are arrays [M]. Every random draw follows from (seed, purpose, rollout), so a resumed run draws what an
    uninterrupted one would have drawn, and all methods meet the same real starts.
    """
    step = _Steps(finetuner, system, priors, seeds, simulated, programs)
    if progress is None:
        progress = step.begin()
        yield progress, {}
    simulated_updates = simulated_updates_of(finetuner)
    progress = yield from step.offline(progress, simulated_updates, learner, "offline")
    if logged is not None:
        if int(progress.offline) == simulated_updates and not int(progress.rollouts):  # else they are kept already
            progress = step.keep(progress, logged)
        progress = yield from step.offline(progress, simulated_updates + logged.updates, learner, "logged")
    if learner is not None:
        if not waits and finetuner.guarded:
            raise UserError("waits=False: a guard judges rollouts by one policy; leave one of the two out")
        yield from step.beside(progress, learner, rollouts, waits=waits)
        return
    while (done := int(progress.rollouts)) < rollouts:
        progress, metrics = step.rollouts(progress, done, 1 if done else finetuner.initial_rollouts)
        yield progress, metrics


def simulated_updates_of(finetuner: Finetuner) -> int:
    """Updates on simulated transitions alone, before anything else."""
    return finetuner.simulation.offline_updates if finetuner.simulation else 0


def offline_parts(finetuner: Finetuner, offline: int) -> int:
    """In how many parts so many updates before the first rollout have been yielded."""
    simulated = min(offline, simulated_updates_of(finetuner))
    return -(-simulated // OFFLINE_PART) - (simulated - offline) // OFFLINE_PART


def evaluate(policy: Any, system: System, states: PyTree, seeds: Array, episodes: int) -> Episode:
    """Episodes [M, episodes] without exploration, the same ones at every call: a fixed series for each seed.

    policy, states: see `System.play`; for a `Finetuner` the states are `FinetuneProgress.agent`, of which what they
    export plays: one program for agents and the best policies.
    """
    if isinstance(policy, Finetuner):
        policy, states = policy.policy, exported(policy.export, states)
    return system.play(policy, states, _episode_keys(seeds, Finetuning.EVALUATE, 0, episodes), explore=False)


@functools.partial(jax.jit, static_argnums=0)
def exported(export: Callable[[PyTree], PyTree], states: PyTree) -> PyTree:
    """Params [M, ...] of the agents [M, ...] as they act now."""
    return jax.vmap(export)(states)


def begin(finetuner: Finetuner, priors: PyTree, seeds: Array) -> FinetuneProgress:
    """The state that `finetune` starts from. `jax.eval_shape` of it says what a checkpoint is read into."""

    def one(params: PyTree, seed: Array) -> PyTree:
        return finetuner.init(params, _key(seed, Finetuning.INIT, 0))

    agent = split_vmap(one)(priors_of_members(priors, seeds), seeds)
    m = seeds.shape[0]
    best = evidence.nothing_known(jax.tree.map(jnp.copy, jax.vmap(finetuner.export)(agent)), m)
    return FinetuneProgress(agent, best, jnp.int32(0), jnp.int32(0), jnp.zeros(m, jnp.int32))


class Programs(NamedTuple):
    """What `finetune` calls, jitted, of members [M]; those that take a state use it up.

    begin(priors, seeds) -> `FinetuneProgress`. prepare(agent, which, rows) -> agent; which: [M] the prior of each.
    judge(best, agent, episodes [M, 1], age) -> best and witness(best, episodes) -> best: see `evidence.judged` and
    `witnessed`. store(agent, episodes [M, 1]) -> agent.
    keep(agent, transitions [T], valid, None) -> agent. learn(agent, keys, which, updates, rows, offline, limits) ->
    (agent, metrics).
    """

    begin: Callable[..., FinetuneProgress]
    prepare: Callable[..., PyTree]
    judge: Callable[..., Best]
    witness: Callable[..., Best]
    store: Callable[..., PyTree]
    keep: Callable[..., PyTree]
    learn: Callable[..., tuple[PyTree, Metrics]]


def make_programs(finetuner: Finetuner) -> Programs:
    """The programs of a method; each compiles when it is first called, if it has not been compiled before."""

    def prepare(state: PyTree, which: Array, rows: SimulatedRows) -> PyTree:
        return finetuner.prepare(state, rows.of(which))

    def judge(best: Best, agent: PyTree, played: Episode, age: Array) -> Best:
        outcome = played.score[:, 0], played.total_reward[:, 0], played.exploded[:, 0]
        return evidence.judged(finetuner, best, agent, *outcome, age)

    def witness(best: Best, played: Episode) -> Best:
        return evidence.witnessed(best, played.score[:, 0], played.total_reward[:, 0])

    def store(state: PyTree, played: Episode) -> PyTree:
        episode = jax.tree.map(lambda x: x[0], played)
        score = jnp.where(episode.exploded, -jnp.inf, episode.score)
        return finetuner.observe(state, episode.transitions, episode.valid, score)

    return Programs(
        begin=jax.jit(functools.partial(begin, finetuner)),
        prepare=jax.jit(split_vmap(prepare, (0, 0, None)), donate_argnums=0),
        judge=jax.jit(judge),
        witness=jax.jit(witness),
        store=jax.jit(split_vmap(store), donate_argnums=0),
        keep=jax.jit(split_vmap(finetuner.observe, (0, None, None, None)), donate_argnums=0),
        learn=jax.jit(functools.partial(_update, finetuner), static_argnums=(3, 5), donate_argnums=0),
    )


class Updates:
    """Learning phases of M members, compiled.

    seeds: [M] uint32. which: [M] the prior of each. simulated: see `finetune`. learn: of `Programs`.
    """

    def __init__(
        self,
        finetuner: Finetuner,
        seeds: Array,
        which: Array,
        simulated: Callable[[], SimulatedRows] | None,
        learn: Callable[..., tuple[PyTree, Metrics]] | None = None,
    ) -> None:
        self.finetuner, self.seeds, self.which = finetuner, seeds, which
        self.rows = simulated or (lambda: None)
        self._learn = learn or make_programs(finetuner).learn

    def __call__(
        self, agent: PyTree, parts: Sequence[int], updates: int | Array, phase: Phase = "online"
    ) -> tuple[PyTree, Metrics]:
        """So many updates in each part, a number from which their random draws follow; returns the mean metrics.

        updates: or [parts, M], of each part and member, up to `updates_per_rollout`. phase: "offline", on simulated
        transitions alone; "logged", before the first rollout; "online", after one.
        """
        purpose, learned, rows = Finetuning.LEARN if phase == "online" else Finetuning.OFFLINE, [], self.rows()
        most, limits = (updates, None) if isinstance(updates, int) else (self.finetuner.updates_per_rollout, updates)
        for i, part in enumerate(parts):  # equal parts, so that one compiled program serves any number
            keys = _learning_keys(self.seeds, purpose, part)
            limit = None if limits is None else limits[i]
            agent, metrics = self._learn(agent, keys, self.which, most, rows, phase == "offline", limit)
            learned.append(metrics)
        return agent, jax.tree.map(_mean, *learned) if limits is None else _mean_of_parts(learned)


def _update(
    finetuner: Finetuner,
    states: PyTree,
    keys: Key,
    which: Array,
    updates: int,
    source: SimulatedRows | None,
    offline: bool,
    limits: Array | None,
) -> tuple[PyTree, Metrics]:
    def one(state: PyTree, key: Key, which: Array, rows: SimulatedRows | None, limit: Array | None) -> Any:
        data = None if rows is None else rows.of(which)
        # Where no episode ends early the number is static: the program, and its bits, of a fixed length.
        some = {} if limit is None else {"limit": limit}
        return finetuner.learn(state, key, updates, data, offline=offline, **some)

    axes = (0, 0, 0, None, None if limits is None else 0)
    return split_vmap(one, axes)(states, keys, which, source, limits)


class _Steps:
    """The steps of one run."""

    def __init__(
        self,
        finetuner: Finetuner,
        system: System,
        priors: PyTree,
        seeds: Array,
        simulated: Callable[[], SimulatedRows] | None,
        programs: Programs | None,
    ) -> None:
        self.finetuner, self.system, self.priors, self.seeds = finetuner, system, priors, seeds
        self.programs = programs or make_programs(finetuner)
        if finetuner.simulation is not None and simulated is None:
            raise UserError("this method also learns from simulated transitions: pass `simulated` (see `simulate`)")
        self._learn = Updates(finetuner, seeds, prior_of(priors, seeds), simulated, self.programs.learn)

    def begin(self) -> FinetuneProgress:
        """The fresh state, which has seen no simulated row."""
        return self.programs.begin(self.priors, self.seeds)

    def prepare(self, agent: PyTree) -> PyTree:
        """The agent before it observes or learns anything. From here on there are simulated rows."""
        if self.finetuner.simulation is None:
            return agent
        return self.programs.prepare(agent, self._learn.which, self._learn.rows())

    def keep(self, progress: FinetuneProgress, logged: Logged) -> FinetuneProgress:
        """The episodes of a log, one after another, as if they had been played."""
        agent = progress.agent if int(progress.offline) else self.prepare(progress.agent)
        for i in range(len(logged.valid)):
            rows = jax.tree.map(lambda x, i=i: x[i], logged.transitions)
            agent = self.programs.keep(agent, rows, logged.valid[i], None)
        return progress._replace(agent=agent)

    def offline(
        self, progress: FinetuneProgress, until: int, learner: "LearnerProcess | None", phase: Phase
    ) -> Generator[tuple[FinetuneProgress, Metrics], None, FinetuneProgress]:
        """Updates before the first rollout, part by part, until there are so many of them."""
        while (done := int(progress.offline)) < until:
            updates = min(OFFLINE_PART, until - done)
            if not done:
                progress = progress._replace(agent=self.prepare(progress.agent))
            if learner is None:
                agent, metrics = self._learn(progress.agent, [done], updates, phase)
            else:
                learner.submit(progress.agent, [done], updates, phase)
                agent, metrics = learner.result()
            progress = progress._replace(agent=agent, offline=progress.offline + updates)
            yield progress, metrics
        return progress

    def rollouts(self, progress: FinetuneProgress, done: int, n: int) -> tuple[FinetuneProgress, Metrics]:
        """N real rollouts, one after another as on a robot, then the updates that they allow."""
        played = self._play(progress.agent, done, n)
        agent, best = self._take(progress.agent, progress.best, played, done, (progress.agent, done))
        agent, metrics = self._learn(agent, range(done, done + n), self._updates(played))
        made = progress.transitions + _transitions(played).sum(0)
        progress = FinetuneProgress(agent, best, progress.rollouts + n, progress.offline, made)
        return progress, _real(best, played) | metrics

    def beside(
        self, progress: FinetuneProgress, learner: "LearnerProcess", rollouts: int, *, waits: bool
    ) -> Iterator[tuple[FinetuneProgress, Metrics]]:
        """The same with a learner that works on one rollout while the next one is played."""
        agent, best, done = progress.agent, progress.best, int(progress.rollouts)
        offline, transitions = progress.offline, progress.transitions
        acting = _Acting(agent, done, None, waits=waits)  # before anything has been submitted
        before: list[Episode] = []
        while before or done < rollouts:
            n = 1 if done else self.finetuner.initial_rollouts
            played = self._play(acting, done, n) if done < rollouts else []
            if before:
                agent, metrics = learner.result()
                real = _real(best, before)
                yield FinetuneProgress(agent, best, jnp.int32(done), offline, transitions), real | metrics
            if played:
                agent, best = self._take(agent, best, played, done, acting.player(agent, done))
                learner.submit(agent, range(done, done + n), self._updates(played), "online")
                acting = _Acting(agent, done, learner, waits=waits)
                done, transitions = done + n, transitions + _transitions(played).sum(0)
            before = played

    def _play(self, agent: PyTree, done: int, n: int) -> list[Episode]:
        """The next n rollouts [M, 1]. agent: or a function that returns it."""
        who, states = self.finetuner, agent
        if done == 0 and who.initial_policy is not None:
            who, states = who.initial_policy, priors_of_members(self.priors, self.seeds)

        def rollout(number: int) -> Episode:
            keys = _episode_keys(self.seeds, Finetuning.COLLECT, number, 1)
            return drifted(self.system, number).play(who, states, keys, explore=True)

        return [rollout(number) for number in range(done, done + n)]

    def _updates(self, played: Sequence[Episode]) -> int | Array:
        """Gradient updates [n, M] after each of these rollouts; one number where all of them have their full length."""
        full, length = self.finetuner.updates_per_rollout, played[0].valid.shape[-1]
        made = np.asarray(_transitions(played))
        if (made == length).all():
            return full
        return jnp.asarray(np.where(made, np.maximum(np.rint(full * made / length), 1), 0), jnp.int32)

    def _take(
        self, agent: PyTree, best: Best, played: Sequence[Episode], done: int, player: tuple[PyTree, int]
    ) -> tuple[PyTree, Best]:
        """The agent with these rollouts, and what they say of the one who played them.

        player: that agent, or None, and the rollouts it had learned from.
        """
        for episodes in played:
            if done or self.finetuner.initial_policy is None:
                best = self.programs.judge(best, player[0], episodes, jnp.int32(player[1]))
            else:
                best = self.programs.witness(best, episodes)
        if not done:
            agent = self.prepare(agent)
        for episodes in played:
            agent = self.programs.store(agent, episodes)
        return agent, best


class _Acting:
    """The agent that acts now, asked at every step: what has been learned or, if not `waits`, what there is until then.

    before: the agent that has learned from `rollouts` rollouts. learner: None where nobody learns meanwhile.
    """

    def __init__(self, before: PyTree, rollouts: int, learner: "LearnerProcess | None", *, waits: bool) -> None:
        self.before, self.rollouts, self.learner, self.waits = before, rollouts, learner, waits
        self.steps = {False: 0, True: 0}  # with the agent before and with what has been learned

    def __call__(self) -> PyTree:
        learner = self.learner if self.learner and (self.waits or self.learner.ready()) else None
        self.steps[learner is not None] += 1
        return learner.result()[0] if learner else self.before

    def player(self, learned: PyTree, done: int) -> tuple[PyTree, int]:
        """The agent that made more of the steps, and the rollouts it had learned from.

        learned: the agent after `done` rollouts. None and no matter where that is not known: a rollout that a resumed
        run reads from disk asks nobody.
        """
        if self.waits or self.steps[True] > self.steps[False]:
            return learned, done
        return (self.before, self.rollouts) if self.steps[False] else (None, done)


@jax.jit
def _real(best: Best, played: Sequence[Episode]) -> Metrics:
    """[M] how rollouts [M, 1] went, on average; one that exploded as `best` knows it."""
    facts = [(x.score[:, 0], x.total_reward[:, 0], x.exploded[:, 0]) for x in played]
    counted = [evidence.as_known(best, *outcome) for outcome in facts]
    return {
        "real/return": _mean(*[total for _, total in counted]),
        "real/score": _mean(*[score for score, _ in counted]),
        "real/exploded": _mean(*[exploded.astype(jnp.float32) for *_, exploded in facts]),
    }


@jax.jit
def _transitions(played: Sequence[Episode]) -> Array:
    """[n, M] valid steps of rollouts [M, 1]."""
    return jnp.stack([x.valid[:, 0].sum(-1) for x in played]).astype(jnp.int32)


def _mean(*x: Array) -> Array:
    return jnp.mean(jnp.stack(x), axis=0)


def _mean_of_parts(parts: Sequence[Metrics]) -> Metrics:
    """The mean [M] over the parts in which a member has made updates, nan without any; of `updates` over all."""
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *parts)
    means = {name: jnp.mean(x, axis=0, where=stacked["updates"] > 0) for name, x in stacked.items()}
    return means | {"updates": stacked["updates"].mean(0)}


def priors_of_members(priors: PyTree, seeds: Array) -> PyTree:
    """The params [M, ...] that each member starts from, of priors [P, ...]; None without priors. seeds: [M]."""
    which = prior_of(priors, seeds)
    return jax.tree.map(lambda x: x[which], priors)


def prior_of(priors: PyTree, seeds: Array) -> Array:
    """[M] which of the priors [P, ...] each member starts from. seeds: [M]."""
    return seeds % (1 if priors is None else jax.tree.leaves(priors)[0].shape[0])


def _key(seed: Array, purpose: int | Array, part: int | Array) -> Key:
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), purpose), part)


@jax.jit
def _learning_keys(seeds: Array, purpose: Array, part: Array) -> Key:
    return jax.vmap(lambda seed: _key(seed, purpose, part))(seeds)


@functools.partial(jax.jit, static_argnums=3)
def _episode_keys(seeds: Array, purpose: Array, rollout: Array, n: int) -> Key:
    """Keys [M, n]; the first ones are the same for every n."""

    def keys(seed: Array) -> Key:
        return jax.vmap(lambda i: jax.random.fold_in(_key(seed, purpose, rollout), i))(jnp.arange(n))

    return jax.vmap(keys)(seeds)
