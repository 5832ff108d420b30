"""Impure: a fine-tuning run, `finetuning.finetune` with folders, checkpoints, logs, evaluations and videos."""

import contextlib
import dataclasses
import functools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import extend, mesh
from envs.base import Env
from envs.gaps import Gap
from envs.rollout import Episode
from envs.types import Key, PyTree
from experiments.runner import cli, options, real_systems
from experiments.runner.ahead import Ahead, compiling
from experiments.runner.kept import kept_in, simulated_rows
from experiments.runner.machines import reserve
from experiments.runner.pictures import before_and_after
from experiments.runner.progress import doing
from experiments.runner.recorded import RecordedSystem, begin_with, read_log
from experiments.runner.training import Record, Training, opened, scores
from sgft_jax import api
from sgft_jax.analysis import figures, tables
from sgft_jax.analysis.curves import Curve, deepest_fall, describe
from sgft_jax.analysis.reading import read_curve
from sgft_jax.api import Setup
from sgft_jax.datasets.logs import Log
from sgft_jax.io.log import EVAL, check_finite, read_jsonl, write_summary
from sgft_jax.io.priors import digest, load_priors, variant_of
from sgft_jax.io.real import RealStore
from sgft_jax.methods import get_method
from sgft_jax.stacking import join, member, part
from sgft_jax.systems.simulated import KnownSystem, Simulated, System, drifted
from sgft_jax.train import finetuning, simulation
from sgft_jax.train.finetuning import FinetuneProgress, Programs
from sgft_jax.train.learner_process import LearnerProcess
from sgft_jax.train.options import card_of, loop_of
from sgft_jax.types import Finetuner, Metrics, Online, Prior

if TYPE_CHECKING:
    from experiments.runner.finetune_args import FinetuneArgs

EVALUATION = "evaluation"  # the folder of episodes that evaluations on a real system have cost


def run(
    args: "FinetuneArgs", method: Online, seeds: list[int], folders: list[Path], homes: Mapping[Path, Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """The runs on the real systems of `args`; returns their summaries.

    folders: of the priors. homes: the configuration of each run, by its folder.
    """
    sizes = {"--seeds" if len(args.real) == 1 else "the number of --real times --seeds": len(args.real) * args.seeds}
    devices = mesh.devices(args.devices, sizes)
    env = envs.make(args.task, args.impl, **variant_of(folders))
    _reserve(args, env, len(folders), devices)
    systems = [real_systems.described(env, name, args.set) for name in args.real]
    priors = load_priors(folders, env, estimators=True)
    for prior in priors:
        api.check_prior(prior, method, env)
    card = card_of(priors[0] if priors else None)
    logs = [read_log(path, env, gamma=card["gamma"], successors=args.successors) for path in args.real_data]
    with contextlib.ExitStack() as last:
        last.enter_context(mesh.use(devices))
        playing, members, stepped = systems, seeds, real_systems.is_stepped(args.real[0])
        if stepped:
            one_each = {"members": len(seeds), "gamma": card["gamma"], "home": args.out}
            playing = real_systems.connect(env, args.real, args.set, **one_each)
            last.push(lambda error, *_: playing.close(over=error is None))
            members = seeds * len(args.real)
        rows = functools.partial(simulated_rows, kept_in(args.task), env, priors)
        with doing("making the real systems", 5):
            how = {"method": args.method, "seeds": members, "config": args.options, "rows": rows}
            setup = api.setup(env, playing, priors, **how)
        # Last: what is wrong with a robot or with a method of the user's own leaves no folder behind.
        inputs = {
            "priors": [digest(prior) for prior in priors],
            "real_data": [log.facts.sha256[:12] for log in logs],
            "successors": [log.facts.successors for log in logs],
        }
        begun = last.enter_context(opened("finetune", args, homes, inputs))
        record = functools.partial(FinetuneRecord, costly=stepped, logged=sum(log.facts.transitions for log in logs))
        assert isinstance(setup.system, KnownSystem)
        world = setup.system.env
        records = [record(x, world, gap, method.name, seeds) for x, gap in zip(begun, systems, strict=True)]
        learner = None
        if real_systems.is_robot(args.real[0]):
            prior = jax.device_get(priors[0]) if priors else None
            options = {field.name: getattr(args.options, field.name) for field in dataclasses.fields(args.options)}
            again = functools.partial(build, args.task, args.impl, args.method, options, variant_of(folders), prior)
            which = finetuning.prior_of(setup.priors, setup.seeds)
            learner = LearnerProcess(again, setup.seeds, which, setup.simulated)
            last.callback(learner.close)
            with doing("starting the process that learns", 20):
                learner.wait()
        return _Run(args, setup, card, records, logs).work(learner)


def _reserve(args: "FinetuneArgs", env: Env, priors: int, devices: int) -> None:
    """Raises UserError where the devices have no room for the transitions of all members."""
    row, members = 4 * (2 * env.obs_dim + env.act_dim + 2), args.seeds * len(args.real)
    loop = loop_of(args.options)
    kept = {name: row * members * getattr(loop, name) for name in ("replay_capacity", "batch_size")}
    kept["simulated_transitions"] = row * priors * getattr(args.options, "simulated_transitions", 0)
    reserve(kept, copies=1, devices=devices, settings="options")


def build(
    task: str, impl: str, method: str, options: dict[str, Any], observed: dict[str, Any], prior: Prior | None
) -> Finetuner:
    """The finetuner of a run, made again in another process.

    Method and options are names and numbers, because a user's own file is no module.
    """
    cli.set_up()
    chosen = get_method(method)
    return chosen.build(chosen.config(**options), prior, envs.make(task, impl, **observed))


def evaluation_store(folder: Path, done: int) -> RealStore:
    """The episodes of a run's evaluation after so many rollouts, where they are real ones."""
    return RealStore(folder / EVALUATION / f"rollouts-{done:06d}")


class FinetuneRecord(Record):
    """The files of a run on one real system.

    costly: whether evaluations are played on the real system and cost transitions; simulated ones are free.
    logged: real transitions that every seed began with and nobody has played here.
    """

    def __init__(
        self, folder: Path, env: Env, gap: Gap, method: str, seeds: list[int], *, costly: bool = False, logged: int = 0
    ) -> None:
        super().__init__(folder, {"kind": "finetune", "task": env.name, "method": method, "seeds": seeds})
        self.logged, self.costly = logged, costly
        self.played = self.evaluated = np.zeros(len(seeds), int)  # [S] real transitions of rollouts, of evaluations
        self.env, self.gap, self.method, self.real = env, gap, method, RealStore(folder)

    def restore(self, like: FinetuneProgress, step: int) -> tuple[FinetuneProgress, dict[str, Any]]:
        """The state of a checkpoint, to which the logs are cut back. What the robot did stays."""
        progress, meta = super().restore(like, step)
        self.played, self.evaluated = np.asarray(progress.transitions), np.asarray(meta["evaluated"])
        return progress, meta

    def metrics(self, done: int, values: Mapping[str, np.ndarray]) -> None:
        """A line of one learning phase; raises DivergedError where a number is not finite though something learned."""
        idle = values.get("updates", np.ones(len(self.seeds))) == 0
        known = {name: np.where(idle, 0.0, x) for name, x in values.items()}
        check_finite(known, done, unit="rollouts", last_good=self.last_good)
        self.log.metrics(self._transitions(), {"rollouts": done, **values})

    def evaluation(self, done: int, scores: Metrics, cost: np.ndarray) -> None:
        """A line of the learning curve. Its step is what lies behind it; what it costs itself counts from then on.

        cost: [S] steps of its episodes.
        """
        self.log.eval(self._transitions(), {"rollouts": done, "robot_minutes": self._minutes(), **scores})
        if self.costly:
            self.evaluated = self.evaluated + cost

    def save(self, kind: str, params: PyTree, card: Mapping[str, Any]) -> None:
        """Policies [S], `policy` (the last ones) or `best`, whose cards add to `card`."""
        env = {"task": self.env.name, "obs_dim": self.env.obs_dim, "act_dim": self.env.act_dim}
        facts = {"method": self.method, "gap": self.gap.table, "which": kind}
        self.save_policies(kind, params, lambda seed: {**card, **env, "finetuned": {**facts, "seed": seed}})

    def summarise(self, done: int, best: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """summary.json, the learning curve and the closing words; the log ends here.

        done: rollouts. best: of the best policies by real evidence, [S] each: `evidence`, `rollouts`, and `score` in
        an evaluation of their own, where there was one.
        """
        self.log.close()
        env, evaluated = self.env, read_jsonl(self.folder / EVAL) if (self.folder / EVAL).exists() else []
        curve = read_curve(self.folder).of(env.score) if evaluated else None
        far = {"rollouts": done, "transitions": self._transitions(), "robot_minutes": self._minutes()}
        numbers = {"final": far, "seeds": len(self.seeds)} if curve is None else describe(curve)
        about = {"task": env.name, "method": self.method, "impl": env.impl, "gap": self.gap.table}
        summary = about | {"score": env.score} | numbers | {"best": {k: x.tolist() for k, x in best.items()}}
        if self.logged:
            summary["logged"] = self.logged
        if self.costly:  # all steps of the real system that are on disk, those of evaluations included
            stores = [self.real, *(RealStore(folder) for folder in sorted((self.folder / EVALUATION).glob("*")))]
            steps = [store.rollout(i)["valid"].sum(1) for store in stores for i in range(len(store))]
            summary["real_steps"] = np.sum(steps, axis=0).tolist()
        write_summary(self.folder, summary)
        if curve is not None:
            self._show(curve, best.get("score"))
        elif env.score == "success":
            succeeded = np.concatenate([self.real.rollout(i)["success"] for i in range(len(self.real))])
            print(f"{self.gap.name}: {succeeded.sum()} of {len(succeeded)} training rollouts have succeeded")
        return summary

    def _show(self, curve: Curve, best: np.ndarray | None) -> None:
        """The learning curve as a figure and in words. best: [S] scores of the best policies."""
        score, title = self.env.score, f"{self.env.name} on the {self.gap.name} real system"
        figures.learning_curves(self.folder / "figures" / "score.png", {self.method: [curve]}, title=title)
        before, after = (tables.middle(curve, curve.values[:, i]) for i in (0, -1))
        chosen = "" if best is None else f"; best policy by the training rollouts {tables.plain(best.mean(), score)}"
        fall = f"deepest fall below the start {tables.plain(deepest_fall(curve), score)}"
        change = f"{before} before -> {after} after {curve.x[-1]} rollouts"
        print(f"{self.gap.name}: {tables.words(score)} on the real system {change}; {fall}{chosen}")

    def _transitions(self) -> int:
        """Real transitions of a seed so far, those that evaluations have cost included; the mean where seeds differ."""
        return round(float(np.mean(self.played + self.evaluated)))

    def _minutes(self) -> float:
        return self._transitions() * self.env.control_dt / 60


def evaluates(args: "FinetuneArgs", before: int, done: int) -> bool:
    """Whether there is an evaluation after `done` rollouts; `before`: after how many the run was here last."""
    if args.eval_at:
        return any(before < n <= done for n in args.eval_at) or (done == 0 and 0 in args.eval_at)
    return due(args, args.eval_every, before, done)


def due(args: "FinetuneArgs", every: int, before: int, done: int) -> bool:
    """Whether something that happens every so many rollouts happens now: also at the start, the first and last."""
    return before == 0 or done >= args.rollouts or done % every == 0


class _Run(Training):
    """A run on all its real systems.

    They are played together, because physics takes as long as its longest chain of steps and hardly longer for more
    worlds. Members [M = G * S] are the seeds of the first real system, then those of the next.
    """

    unit = "rollouts"

    def __init__(
        self,
        args: "FinetuneArgs",
        setup: Setup,
        card: dict[str, Any],
        records: list[FinetuneRecord],
        logs: list[Log],
    ) -> None:
        assert isinstance(setup.system, KnownSystem)
        self.args, self.setup, self.card, self.records, self.logs = args, setup, card, records, logs
        self.finetuner, self.system, self.seeds = setup.finetuner, setup.system, setup.seeds
        self.episodes = args.eval_episodes or 0
        self.played: dict[int, Episode] = {}  # evaluations after so many rollouts, the first and the last one
        self.sync_every = args.sync_every if real_systems.is_robot(args.real[0]) else None
        self.programs = finetuning.make_programs(setup.finetuner)
        self.shapes = functools.cache(lambda: self.programs.begin.eval_shape(setup.priors, setup.seeds))
        title = f"{records[0].method} on {self.system.env.name}/{'+'.join(record.gap.name for record in records)}"
        every = {"eval_every": args.eval_every, "checkpoint_every": args.checkpoint_every}
        super().__init__(title, args.rollouts, len(records[0].seeds), **every)

    def work(self, learner: LearnerProcess | None) -> list[dict[str, Any]]:
        """Everything, in order; returns the summaries. learner: of a run with a robot."""
        restored = self.restore(lambda: jax.eval_shape(lambda state: _part(state, 0, self.count), self.shapes()))
        progress = _join([progress for progress, _ in restored]) if restored else None
        done, args = self.done(progress) if progress else 0, self.args
        stores = [record.real for record in self.records]
        logged = None
        if self.logs:
            sizes = {"capacity": loop_of(args.options).replay_capacity, "updates": args.real_updates}
            logged = begin_with(self.logs, self.finetuner, self.system.env, **sizes)
        how: dict[str, Any] = {"waits": args.hand_over == "rollouts", "logged": logged}
        with compiling() as ahead:
            system = self.system
            if isinstance(system, Simulated) and mesh.pieces() == 1:  # threads would know nothing of a mesh
                how["programs"] = self._compile(ahead, system, begins=progress is None)
                self.system = _Awaited(system, ahead)
            recorded = RecordedSystem(self.system, stores, done=done, sync_every=self.sync_every)
            setup = self.setup._replace(system=recorded)
            steps = finetuning.finetune(*setup, rollouts=args.rollouts, learner=learner, progress=progress, **how)
            last = self.follow(steps, done)
        return self._finish(last)

    def _compile(self, ahead: Ahead, system: Simulated, *, begins: bool) -> Programs:
        """Begins to compile what a run calls until it has learned once, in that order; returns what waits for it."""
        fine, programs, (_, _, priors, seeds, _) = self.finetuner, self.programs, self.setup
        who, which, needs = fine.initial_policy or fine, finetuning.prior_of(priors, seeds), fine.simulation

        agent, best = self.shapes().agent, self.shapes().best

        def keys(*shape: int) -> Any:
            return jax.eval_shape(lambda: jax.random.split(jax.random.key(0), (len(seeds), *shape)))

        def evaluated() -> tuple[Any, ...]:
            states = jax.eval_shape(jax.vmap(fine.export), agent)
            return states, system.pools, system.which, keys(self.episodes), False

        def playing() -> tuple[Any, ...]:
            states = agent if fine.initial_policy is None else finetuning.priors_of_members(priors, seeds)
            return states, system.pools, system.which, keys(1), True

        @functools.cache
        def played() -> Episode:
            return system.program(who).eval_shape(*playing())

        rows = None if needs is None else simulation.shapes(system.env, needs, len(jax.tree.leaves(priors)[0]))
        if begins:
            ahead.promise(programs.begin, lambda: (priors, seeds))
        if self.episodes:
            ahead.promise(system.program(fine.policy), evaluated)
        ahead.promise(system.program(who), playing)
        if fine.initial_policy is None:
            ahead.promise(programs.judge, lambda: (best, agent, played(), jnp.int32(0)))
        ahead.promise(programs.store, lambda: (agent, played()))
        updates = fine.updates_per_rollout
        ahead.promise(programs.learn, lambda: (agent, keys(), which, updates, rows, False, None))
        if begins and needs is not None:
            ahead.promise(programs.prepare, lambda: (agent, which, rows))

        def compiles() -> contextlib.AbstractContextManager[None]:
            return doing("compiling what learns", 40, once=True)

        waits = Programs(*[ahead.awaited(program, compiles) for program in programs])
        soon = {x: ahead.awaited(getattr(programs, x), contextlib.nullcontext) for x in ("begin", "judge")}
        return waits._replace(learn=_learning(waits.learn), **soon)

    def done(self, state: FinetuneProgress) -> int:
        return int(state.rollouts)

    def announced(self, before: FinetuneProgress | None) -> contextlib.AbstractContextManager[None]:
        if before is None:
            return doing("preparing the agents", 10, once=True)
        if int(before.offline) < finetuning.simulated_updates_of(self.finetuner):
            return doing("learning from simulated transitions")
        if not self.done(before) and isinstance(self.system, _Awaited):
            return doing("playing the first rollout", 10, once=True)
        if not self.done(before):
            usual = {} if self.sync_every else {"about": 60, "once": True}  # of a robot nobody knows
            return doing("playing the first rollout and compiling what learns from it", **usual)
        return doing("playing and learning")

    def log(self, state: FinetuneProgress, values: dict[str, np.ndarray], seconds: float) -> dict[str, float]:
        done = self.done(state)
        for record, (metrics, transitions) in self.by_record((values, np.asarray(state.transitions))):
            record.played = transitions
            record.metrics(done, metrics)
            with open(record.folder / "timing.jsonl", "a") as file:  # apart: metrics must not depend on the clock
                file.write(json.dumps({"rollouts": done, "time/rollout_s": round(seconds, 3)}) + "\n")
        real = values.get("real/score")
        return {} if real is None else {f"{self.system.env.score}, exploring": float(real.mean())}

    def evaluates(self, before: int, done: int, *, learned: bool) -> bool:
        offline = learned and done == before  # a part of the offline phase
        return bool(self.episodes) and not offline and evaluates(self.args, before, done)

    def evaluate(self, state: FinetuneProgress, done: int) -> dict[str, float]:
        system: System = self.system
        if self.system.pools is None:  # its episodes are real ones, and as dear as those of training
            stores = [evaluation_store(record.folder, done) for record in self.records]
            system = RecordedSystem(system, stores, done=0, explore=False, sync_every=self.sync_every)
        played = finetuning.evaluate(self.finetuner, drifted(system, done), state.agent, self.seeds, self.episodes)
        self.played = {n: x for n, x in [*self.played.items(), (done, played)] if n in (0, done)}
        values = _scores(played, state.best.worst)
        for record, (score, cost) in self.by_record((values, np.asarray(played.valid.sum((1, 2))))):
            record.evaluation(done, score, cost)
        return {f"{self.system.env.score}, evaluation": float(values["score"].mean())}

    def checkpoints(self, before: int, done: int, *, learned: bool) -> bool:
        offline = learned and done == before
        return offline or (done > 0 and due(self.args, self.args.checkpoint_every, before, done))

    def checkpoint(self, state: FinetuneProgress, done: int) -> None:
        step = done + finetuning.offline_parts(self.finetuner, int(state.offline))
        for i, record in enumerate(self.records):
            record.checkpoint(_part(state, i, self.count), step, rollouts=done, evaluated=record.evaluated.tolist())

    def _finish(self, progress: FinetuneProgress) -> list[dict[str, Any]]:
        """Policies, summaries, figures and films."""
        best = progress.best
        card = {**self.card, "plan": None, "estimator": None, **self.finetuner.card}  # those were the prior's
        last = finetuning.exported(self.finetuner.export, progress.agent)
        facts = {"evidence": best.score, "rollouts": best.age}
        n = self.episodes
        if n and self.system.pools is not None:
            with doing("evaluating the best policies", 15, once=True):
                system = drifted(self.system, self.done(progress))
                played = finetuning.evaluate(self.finetuner.policy, system, best.params, self.seeds, n)
            facts["score"] = _scores(played, best.worst)["score"]
        films = functools.cache(lambda: self._before_and_after(progress))
        summaries = []
        for i, record in enumerate(self.records):
            members = functools.partial(part, i=i, n=self.count)
            record.save("policy", members(last), card)
            record.save("best", members(best.params), card)
            rollouts, chosen = int(progress.rollouts), {name: np.asarray(members(x)) for name, x in facts.items()}
            summaries.append(record.summarise(rollouts, chosen))
            if self.args.video and n and self.system.pools is not None:
                pool = jax.tree.map(lambda x, i=i: x[i], self.system.pools)
                path = record.folder / "videos" / f"seed-{record.seeds[0]}.mp4"
                play = functools.partial(lambda first: [member(x, first) for x in films()], i * self.count)
                print(before_and_after(record.env, pool, play, path, rollouts=rollouts))
            files = ("policy/", "best/", "real/", "summary.json", "figures/")
            print(f"results: {record.folder}  ({', '.join(x for x in files if (record.folder / x).exists())})")
        print(cli.as_typed(f"next: {self._next()}"))
        return summaries

    def _next(self) -> str:
        """The command that shows what has come of the run."""
        args = self.args
        if self.episodes:
            return options.command("figures", out=args.out)
        run = {"run": self.records[0].folder, "best": True, "task": args.task if extend.is_source(args.task) else None}
        return options.command("evaluate", **run, real=args.real[0], set=args.set, episodes=10, out=args.out)

    def _before_and_after(self, progress: FinetuneProgress) -> list[Episode]:
        """The evaluation episodes [M, n] of the policy before the first real rollout and of the agent as it is now."""
        evaluate = functools.partial(finetuning.evaluate, system=self.system, seeds=self.seeds)
        n, initial, done = self.episodes, self.finetuner.initial_policy, self.done(progress)
        after = self.played.get(done) or evaluate(self.finetuner, states=progress.agent, episodes=n)
        if initial is not None:
            priors = finetuning.priors_of_members(self.setup.priors, self.seeds)
            return [evaluate(initial, states=priors, episodes=n), after]
        fresh = functools.partial(self.programs.begin, self.setup.priors, self.seeds)
        return [self.played.get(0) or evaluate(self.finetuner, states=fresh().agent, episodes=n), after]


class _Awaited:
    """Simulated systems whose programs may still compile in threads: whoever plays waits for them."""

    def __init__(self, inner: Simulated, ahead: Ahead) -> None:
        self.inner, self.ahead, self.env, self.pools = inner, ahead, inner.env, inner.pools

    def after(self, rollouts: int) -> "_Awaited":
        """See `Simulated`."""
        return _Awaited(self.inner.after(rollouts), self.ahead)

    def play(self, policy: Any, states: PyTree, keys: Key, *, explore: bool) -> Episode:
        """See `System`."""
        self.ahead.wait(self.inner.program(policy))
        return self.inner.play(policy, states, keys, explore=explore)


def _learning(learn: Callable[..., Any]) -> Callable[..., Any]:
    """The same, which says so and is done when it returns."""

    def call(*args: Any) -> Any:
        with doing("learning"):
            return jax.block_until_ready(learn(*args))

    return call


_scores: Callable[..., Metrics] = jax.jit(scores)  # one program for a dozen small ones
_OF_MEMBERS = ("agent", "best", "transitions")  # of a state, what has an axis of members


@functools.partial(jax.jit, static_argnums=(1, 2))
def _part(progress: FinetuneProgress, i: int, n: int) -> FinetuneProgress:
    """The members of the i-th real system."""
    return progress._replace(**{name: part(getattr(progress, name), i, n) for name in _OF_MEMBERS})


@jax.jit
def _join(states: list[FinetuneProgress]) -> FinetuneProgress:
    """The states of all members from those of each real system."""
    return states[0]._replace(**{name: join([getattr(state, name) for state in states]) for name in _OF_MEMBERS})
