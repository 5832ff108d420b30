"""Impure: a fine-tuning run, `finetuning.finetune` with folders, checkpoints, logs, evaluations and videos."""

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import envs
from envs import mesh
from envs.base import Env
from envs.rollout import Episode
from envs.types import PyTree, UserError
from experiments.runner import cli, logged, real_systems
from experiments.runner.evaluation import scores
from experiments.runner.finetune_args import VOLATILE, FinetuneArgs, run_folder
from experiments.runner.finetune_record import Record, evaluation_store
from experiments.runner.memory import reserve
from experiments.runner.recorded import RecordedSystem
from sgft_jax import api
from sgft_jax.api import Setup
from sgft_jax.datasets.logs import Log
from sgft_jax.files.jsonfile import jsonable
from sgft_jax.io import runs
from sgft_jax.io.priors import digest, load_priors, observed_by
from sgft_jax.io.progress import RunProgress
from sgft_jax.methods import get_method
from sgft_jax.stacking import join, part
from sgft_jax.systems import KnownSystem, System
from sgft_jax.train import finetuning
from sgft_jax.train.finetuning import FinetuneProgress, Logged
from sgft_jax.train.learner_process import LearnerProcess
from sgft_jax.train.options import card_of
from sgft_jax.types import Finetuner, Metrics, Online, Prior


def run(args: FinetuneArgs, method: Online, seeds: list[int], folders: list[Path]) -> list[dict[str, Any]]:
    """The runs on the real systems of `args`; returns their summaries. folders: of the priors."""
    sizes = {"--seeds" if len(args.real) == 1 else "the number of --real times --seeds": len(args.real) * args.seeds}
    devices = mesh.devices(args.devices, sizes)
    env = envs.make(args.task, args.impl, **observed_by(folders))
    _reserve(args, env, len(folders), devices)
    found = [real_systems.described(env, name, args.set) for name in args.real]
    priors = load_priors(folders, env)
    for prior in priors:
        api.check_prior(prior, method, env)
    card = card_of(priors[0] if priors else None)
    logs = [logged.read(path, env, gamma=card["gamma"], successors=args.successors) for path in args.real_data]
    # Every folder is that of a run on its real system alone: either kind of run continues the other.
    # A robot may come back at another address.
    named = [real_systems.REMOTE if real_systems.is_robot(name) else name for name in args.real]
    homes = {run_folder(args, name): jsonable(args) | {"real": name} for name in named}
    with contextlib.ExitStack() as last:
        last.enter_context(mesh.use(devices))
        playing, members, stepped = found, seeds, real_systems.is_stepped(args.real[0])
        if stepped:
            playing = real_systems.connect(
                env, args.real, args.set, members=len(seeds), gamma=card["gamma"], home=args.out
            )
            last.push(lambda error, *_: playing.close(over=error is None))
            members = seeds * len(args.real)
        setup = api.setup(env, playing, priors, method=args.method, seeds=members, config=args.options)
        assert isinstance(setup.system, KnownSystem)
        # Last: what is wrong with a robot or with a method of the user's own leaves no folder behind.
        opened = runs.open_runs(
            homes, kind="finetune", resume=args.resume, overwrite=args.overwrite, volatile=VOLATILE,
            inputs={
                "priors": [digest(prior) for prior in priors],
                "real_data": [log.facts.sha256[:12] for log in logs],
                "successors": [log.facts.successors for log in logs],
            },
        )  # fmt: skip
        for own in opened:
            last.callback(own.close)
        records = [
            Record(
                own.folder, setup.system.env, gap, method.name, seeds, real_evaluations=stepped,
                logged=logged.transitions(logs),
            )
            for own, gap in zip(opened, found, strict=True)
        ]  # fmt: skip
        learner = None
        if real_systems.is_robot(args.real[0]):
            which = finetuning.prior_of(setup.priors, setup.seeds)
            learner = LearnerProcess(_build(args, folders, priors), setup.seeds, which, setup.simulated)
            last.callback(learner.close)
            learner.wait()
        return _Run(args, setup, setup.system, card, records, logs, learner).work()


def _reserve(args: FinetuneArgs, env: Env, priors: int, devices: int) -> None:
    """Raises UserError where the devices have no room for the transitions of all members."""
    row, members = 4 * (2 * env.obs_dim + env.act_dim + 2), args.seeds * len(args.real)
    kept = {name: row * members * getattr(args.options, name) for name in ("replay_capacity", "batch_size")}
    kept["simulated_transitions"] = row * priors * getattr(args.options, "simulated_transitions", 0)
    reserve(kept, copies=1, devices=devices, settings="options")


def _build(args: FinetuneArgs, folders: list[Path], priors: list[Prior]) -> Callable[[], Finetuner]:
    """Makes the finetuner of the run again, in another process."""
    options = {field.name: getattr(args.options, field.name) for field in dataclasses.fields(args.options)}
    prior = jax.device_get(priors[0]) if priors else None
    return functools.partial(build, args.task, args.impl, args.method, options, observed_by(folders), prior)


def build(
    task: str, impl: str, method: str, options: dict[str, Any], observed: dict[str, Any], prior: Prior | None
) -> Finetuner:
    """The finetuner of a run. Method and options are names and numbers, because a user's own file is no module."""
    cli.set_up()
    chosen = get_method(method)
    return chosen.build(chosen.config(**options), prior, envs.make(task, impl, **observed))


def evaluates(args: FinetuneArgs, before: int, done: int) -> bool:
    """Whether there is an evaluation after `done` rollouts; `before`: after how many the run was here last."""
    if args.eval_at:
        return any(before < n <= done for n in args.eval_at) or (done == 0 and 0 in args.eval_at)
    return due(args, args.eval_every, before, done)


def due(args: FinetuneArgs, every: int, before: int, done: int) -> bool:
    """Whether something that happens every so many rollouts happens now: also at the start, the first and last."""
    return before == 0 or done >= args.rollouts or done % every == 0


class _Run:
    """What happens between compiled calls, on disk before in memory.

    The real systems are played together, because physics takes as long as its longest chain of steps and hardly longer
    for more worlds. Members [M = G * S] are the seeds of the first real system, then those of the next.
    """

    def __init__(
        self,
        args: FinetuneArgs,
        setup: Setup,
        system: KnownSystem,
        card: dict[str, Any],
        records: list[Record],
        logs: list[Log],
        learner: LearnerProcess | None,
    ) -> None:
        self.logs, self.learner, self.sync_every = logs, learner, args.sync_every if learner else None
        self.args, self.setup, self.card, self.records = args, setup, card, records
        self.finetuner, self.system, self.seeds = setup.finetuner, system, setup.seeds
        self.count, self.episodes = len(setup.seeds) // len(records), args.eval_episodes or 0
        self.begin = functools.partial(finetuning.begin, setup.finetuner, setup.priors, setup.seeds, setup.simulated)

    def work(self) -> list[dict[str, Any]]:
        """Everything, in order; returns the summaries."""
        progress = self._restore()
        done = int(progress.rollouts) if progress else 0
        stores = [record.real for record in self.records]
        recorded = RecordedSystem(self.system, stores, done=done, sync_every=self.sync_every)
        steps = finetuning.finetune(
            *self.setup._replace(system=recorded), rollouts=self.args.rollouts, progress=progress, learner=self.learner,
            waits=self.args.hand_over == "rollouts", logged=self._logged(),
        )  # fmt: skip
        return self._finish(self._follow(steps, progress))

    def _logged(self) -> Logged | None:
        """What the logs are for the members, None without logs."""
        if not self.logs:
            return None
        capacity, updates = self.args.options.replay_capacity, self.args.real_updates
        return logged.begin_with(self.logs, self.finetuner, self.system.env, capacity=capacity, updates=updates)

    def _restore(self) -> FinetuneProgress | None:
        """The state after the last checkpoint, None for a fresh start; raises UserError where real systems differ."""
        steps = [record.latest() for record in self.records]
        if len(set(steps)) > 1:
            listed = ", ".join(f"{own.folder} is at step {n or 0}" for own, n in zip(self.records, steps, strict=True))
            raise UserError(f"{listed}: they cannot go on together, resume them one at a time")
        if steps[0] is None:
            for record in self.records:
                record.log.truncate({})
            return None
        like = jax.eval_shape(lambda: _part(self.begin(), 0, self.count))
        return _join([record.restore(like, step) for record, step in zip(self.records, steps, strict=True) if step])

    def _follow(self, steps: Iterator[tuple[FinetuneProgress, Metrics]], progress: Any) -> FinetuneProgress:
        """Logs, evaluates and checkpoints what the iterator yields; returns its last state."""
        done, started = int(progress.rollouts) if progress else 0, time.perf_counter()
        systems = "+".join(record.gap.name for record in self.records)
        title = f"{self.records[0].method} on {self.system.env.name}/{systems}"
        bar = RunProgress(title, total=self.args.rollouts, unit="rollouts", done=done)
        with bar:
            for progress, metrics in steps:
                before, done = done, int(progress.rollouts)
                for record, transitions in self._each(np.asarray(progress.transitions)):
                    record.played = transitions
                values = {name: np.asarray(x) for name, x in metrics.items()}
                shown = self._log(done, values, time.perf_counter() - started)
                if done == before and values:  # a part of the offline phase
                    self._checkpoint(progress)
                elif self.episodes and evaluates(self.args, before, done):
                    shown[f"{self.system.env.score}, evaluation"] = self._evaluate(progress, done)
                if done and due(self.args, self.args.checkpoint_every, before, done):
                    self._checkpoint(progress)
                bar.advance(done - before, shown)
                started = time.perf_counter()
        return progress

    def _log(self, done: int, values: Mapping[str, np.ndarray], seconds: float) -> dict[str, float]:
        """Writes a line of metrics for each real system; returns what the progress bar shows."""
        if not values:
            return {}
        for record, own in self._each(values):
            record.metrics(done, own)
            record.time(done, seconds)
        real = values.get("real/score")
        return {} if real is None else {f"{self.system.env.score}, exploring": float(real.mean())}

    def _evaluate(self, progress: FinetuneProgress, done: int) -> float:
        system: System = self.system
        if self.system.pools is None:  # its episodes are real ones, and as dear as those of training
            stores = [evaluation_store(record.folder, done) for record in self.records]
            system = RecordedSystem(system, stores, done=0, explore=False, sync_every=self.sync_every)
        played = finetuning.evaluate(self.finetuner, system, progress.agent, self.seeds, self.episodes)
        found = scores(played, progress.best.worst)
        for record, (own, cost) in self._each((found, np.asarray(played.valid.sum((1, 2))))):
            record.evaluation(done, own, cost)
        return float(found["score"].mean())

    def _checkpoint(self, progress: FinetuneProgress) -> None:
        step = int(progress.rollouts) + finetuning.offline_parts(self.finetuner, int(progress.offline))
        for i, record in enumerate(self.records):
            record.checkpoint(_part(progress, i, self.count), step)

    def _each(self, members: PyTree) -> Iterator[tuple[Record, PyTree]]:
        """Every real system's record and, [S], what belongs to it in a pytree over all members."""
        return ((record, part(members, i, self.count)) for i, record in enumerate(self.records))

    # ------------------------------------------------------------ what stays

    def _finish(self, progress: FinetuneProgress) -> list[dict[str, Any]]:
        """Policies, summaries, figures and films."""
        best = progress.best
        card = {**self.card, "plan": None, **self.finetuner.card}  # the prior may be one that plans
        last = jax.jit(jax.vmap(self.finetuner.export))(progress.agent)
        facts = {"evidence": best.score, "rollouts": best.rollouts}
        n = self.episodes
        if n and self.system.pools is not None:
            played = finetuning.evaluate(self.finetuner.policy, self.system, best.params, self.seeds, n)
            facts["score"] = scores(played, best.worst)["score"]
        films = functools.cache(lambda: self._before_and_after(progress))
        summaries = []
        for i, record in enumerate(self.records):
            own = lambda tree, i=i: part(tree, i, self.count)  # noqa: E731
            record.save_policies("policy", own(last), card)
            record.save_policies("best", own(best.params), card)
            rollouts, chosen = int(progress.rollouts), {name: np.asarray(own(x)) for name, x in facts.items()}
            summaries.append(record.summarise(rollouts, chosen))
            if self.args.video and n and self.system.pools is not None:
                pool = jax.tree.map(lambda x, i=i: x[i], self.system.pools)
                print(record.film(pool, lambda own=own: [own(x) for x in films()], rollouts))
            print(f"results: {record.folder}  (policy/, best/, real/, summary.json, figures/)")
        print(f"next: python -m experiments.figures --out {self.args.out}")
        return summaries

    def _before_and_after(self, progress: FinetuneProgress) -> list[Episode]:
        """The evaluation episodes [M, n] of the policy before the first real rollout and of the agent as it is now."""
        evaluate = functools.partial(finetuning.evaluate, system=self.system, seeds=self.seeds)
        n, initial = self.episodes, self.finetuner.initial_policy
        if initial is None:
            before = evaluate(self.finetuner, states=jax.jit(self.begin)().agent, episodes=n)
        else:
            own = finetuning.priors_of_members(self.setup.priors, self.seeds)
            before = evaluate(initial, states=own, episodes=n)
        return [before, evaluate(self.finetuner, states=progress.agent, episodes=n)]


_OF_MEMBERS = ("agent", "best", "transitions")  # of a state, what has an axis of members


@functools.partial(jax.jit, static_argnums=(1, 2))
def _part(progress: FinetuneProgress, i: int, n: int) -> FinetuneProgress:
    """The members of the i-th real system."""
    own = functools.partial(part, i=i, n=n)
    members = {name: own(getattr(progress, name)) for name in _OF_MEMBERS}
    return progress._replace(**members)


@jax.jit
def _join(states: list[FinetuneProgress]) -> FinetuneProgress:
    """The states of all members from those of each real system."""
    return states[0]._replace(**{name: join([getattr(state, name) for state in states]) for name in _OF_MEMBERS})
