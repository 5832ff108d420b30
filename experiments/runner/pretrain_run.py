"""Impure: one run of pretraining: folders, logs, evaluations and checkpoints around `sgft_jax.pretrain`.

`experiments.pretrain` is its command.
"""

import functools
import importlib
import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps, mesh
from envs.base import Domain, Env, World
from envs.domains import uniform, with_actuators
from envs.doraemon import entropy
from envs.gaps import SIM, Gap
from envs.observations import all_varying, blurred, varying, with_system
from envs.rollout import Episode, heldout_worlds, load_gap, pool_size, real_env, training_worlds
from envs.types import Key, PyTree
from experiments.runner.ahead import Ahead, compiling
from experiments.runner.cli import as_typed
from experiments.runner.machines import folder_of_host, join_hosts, reserve
from experiments.runner.options import command
from experiments.runner.pictures import film_episode
from experiments.runner.progress import doing
from experiments.runner.report import Report, make_judges, make_report, numbers, value_numbers
from experiments.runner.training import Record, Training, best_of, describe, opened, play, scores
from sgft_jax import stacking
from sgft_jax.algorithms import make_policy, recipe_of
from sgft_jax.analysis import figures
from sgft_jax.files.disk import jsonable
from sgft_jax.io import checkpoint, runs
from sgft_jax.io.log import EVAL, read_jsonl, write_summary
from sgft_jax.io.priors import digest
from sgft_jax.keys import Pretraining, seed_keys
from sgft_jax.methods import DEFAULT, all_methods
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train import evidence, pretraining, value_fit
from sgft_jax.train.fleet import FleetState
from sgft_jax.train.value_fit import Held
from sgft_jax.types import Prior

if TYPE_CHECKING:
    from experiments.pretrain import PretrainArgs

_CUT = ("n_envs", "replay_capacity", "batch_size")  # sizes that devices share
_HELDOUT_SEED, _FINAL_SEED = 2**31, 2**31 + 1  # held-out worlds and episodes, the same for every run
_VALUE_SEED, _STATES = 2**31 + 2, 64  # of the worlds that V_sim is measured in; states that are played again, at most


# One program instead of one for every field.
_stacked = jax.jit(stacking.stack)
_levels = jax.jit(lambda best: (best.score, best.total))


class Shapes(NamedTuple):
    """Shapes and types of worlds [seeds, W], experience under random actions and state: what a chunk takes."""

    worlds: World
    random: PyTree
    state: FleetState


class Saved(NamedTuple):
    """What a checkpoint holds, with a leading seeds axis: the run itself and the best policy so far."""

    run: FleetState
    best: evidence.Best


def run(args: "PretrainArgs", seeds: list[int], home: Path) -> dict[str, Any]:
    """One run from (or back) to disk in `home`; returns its summary."""
    join_hosts(args.hosts)
    env = envs.make(args.task, args.impl, previous_actions=args.config.previous_actions)
    gap = load_gap(env, args.real, args.set)
    env = real_env(env, [gap] if gap else [])
    env = with_actuators(env) if args.config.actuators else env
    if args.config.sees_system:
        seeing = with_system(env, varying(env, gap.params, gap.effects) if gap else varying(env))
        env = blurred(seeing, args.config.system_noise)
    if args.config.blind_actor:
        network = replace(args.config.network, blind=len(env.system))
        args = replace(args, config=replace(args.config, network=network))
    domain = pretraining.domain_of(env, args.config)
    sizes = pretraining.memory(env, args.config)  # what does not fit is reported before anything is written
    devices = mesh.devices(args.devices, {f"--config.{n.replace('_', '-')}": getattr(args.config, n) for n in _CUT})
    with folder_of_host(home) as folder, mesh.use(devices):
        reserve(sizes, copies=args.seeds, devices=devices)
        with opened("pretrain", args, {folder: jsonable(args)}) as (folder,):
            mesh.meet()  # nobody looks for checkpoints before the first host has emptied a folder to be replaced
            record = Record(folder, {"kind": "pretrain", "task": env.name, "seeds": seeds}, home)
            return _Run(args, env, gap, domain, record).work()


class _Writer:
    """Writes one state after the other while training goes on; the end of its `with` block waits for the last one."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "checkpoints")
        self._writing: Future[object] | None = None

    def __enter__(self) -> "_Writer":
        return self

    def write(self, state: PyTree, write: Callable[[PyTree], object]) -> None:
        """Begins to write a state, which may then be donated; raises what stopped the one before."""
        self._settle()  # in memory there is one copy at most
        copies = checkpoint.copied(mesh.local(state))
        self._writing = self._pool.submit(write, copies)
        if jax.process_count() > 1:
            self._settle()  # hosts meet when they write, and nowhere else meanwhile

    def _settle(self) -> None:
        if self._writing is not None:
            writing, self._writing = self._writing, None
            writing.result()

    def __exit__(self, *failure: object) -> None:
        self._pool.shutdown()
        self._settle()


class _Run(Training):
    """Pretraining of the seeds [S] of a record."""

    unit = "env steps"

    def __init__(self, args: "PretrainArgs", env: Env, gap: Gap | None, domain: Domain, record: Record) -> None:
        self.args, self.config, self.env, self.gap = args, args.config, env, gap
        self.records, self.record, self.seeds = [record], record, record.seeds
        size = self.config.chunk_env_steps
        every = {"eval_every": self.config.eval_every * size, "checkpoint_every": self.config.checkpoint_every * size}
        super().__init__(f"pretrain {env.name}", self.config.chunks * size, len(record.seeds), **every)
        system = all_varying(env, gap.params, gap.effects) if gap else all_varying(env)
        self.fits = recipe_of(env, self.config).valued
        self.card = pretraining.prior_card(env, self.config) | (pretraining.system_card(system) if self.fits else {})
        self.policy = make_policy(self.card, env)
        self.domain, self.make = domain, pretraining.maker(env, self.config)
        self.widening = pretraining.training_pools(self.config, self.seeds, domain, self.make)
        self.whole = functools.lru_cache(maxsize=1)(self._whole)  # worlds take long to compile
        self.shapes = functools.cache(self._shapes)
        self.programs = pretraining.make_programs(env, self.config, len(self.seeds))
        measure = functools.partial(make_report, env, self.policy, gamma=self.config.gamma)
        self.measure = jax.jit(jax.vmap(functools.partial(measure, trajectories=self.config.eval_episodes)))
        self.reports = args.report and self.policy.value is not None
        self.fit = pretraining.make_value_program(env, self.config, system, self.card, len(self.seeds))
        known, n = system if self.fits else (), self.config.report_episodes
        self.judges = make_judges(env, known, self.policy, self.config.gamma, episodes=n, members=len(self.seeds))
        self.best: evidence.Best | None = None

    def work(self) -> dict[str, Any]:
        """Everything, in order."""
        with compiling() as ahead, _Writer() as self.writer:
            ahead.begin(self.env.prepare)
            state, done = None, 0
            for saved, meta in self.restore(lambda: jax.eval_shape(self._saved, self.shapes().state)):
                (state, self.best), self.clock.seconds, done = saved, meta["seconds"], meta["env_steps"]
            alone = mesh.pieces() == 1  # threads would know nothing of a mesh
            if alone:
                self._compile(ahead, begins=state is None)
            self._build()
            if alone:
                with self.announced(None):
                    self._compile_evaluations(ahead)
            data = {"pools": self.pools, "domain": self.domain, "random": self._random(ahead)}
            with self.announced(None):
                ahead.wait(self.programs.train.init, self.programs.train.chunk, self.heldout.program(self.policy))
                begun = {"state": state, "programs": self.programs}
                steps = pretraining.pretrain(self.env, self.config, self.seeds, **begun, **data)
            self.follow(steps, done)
            assert self.best is not None  # evaluated before the first chunk
            ahead.wait(self.fit, self.measure, self.judges.hold)
            summary = self._hand_over(self.best)
        self.record.log.close()
        return summary

    def _build(self) -> None:
        """The worlds."""
        n, count = self.config.eval_episodes, self.count * self.config.worlds
        with self.clock("worlds"), doing(f"building {count:,} worlds", 3 + 0.01 * count):
            self._first()
            heldout, self.final = (
                _stacked([heldout_worlds(self.env, self.gap, jax.random.key(seed), n)])
                for seed in (_HELDOUT_SEED, _FINAL_SEED)
            )
        self.heldout = Simulated(self.env, heldout, jnp.zeros(self.count, jnp.int32), gamma=self.config.gamma)

    def _compile(self, ahead: Ahead, *, begins: bool) -> None:
        """Begins to compile what trains, first what takes longest, while the worlds are still being built."""
        collect, (init, chunk, _), _ = self.programs
        random, start = (seed_keys(self.seeds, purpose) for purpose in (Pretraining.RANDOM, Pretraining.START))
        ahead.promise(chunk, self.shapes)
        if begins:
            ahead.promise(collect, lambda: (self.shapes().worlds, random))
            ahead.promise(init, lambda: (self.shapes().worlds, self.shapes().random, start))

    def _compile_evaluations(self, ahead: Ahead) -> None:
        """Begins to compile what plays and measures."""
        n, system, report = self.config.eval_episodes, self.heldout, seed_keys(self.seeds, Pretraining.REPORT)
        keys = jnp.broadcast_to(jax.random.split(jax.random.key(0), n), (self.count, n))

        def params() -> PyTree:
            return jax.eval_shape(functools.partial(pretraining.exported, self.env, self.config), self.shapes().state)

        ahead.promise(system.program(self.policy), lambda: (params(), system.pools, system.which, keys, False))

        def pools(size: int) -> World:
            """Pools of that many worlds, where anything varies."""
            shapes = jax.tree.leaves(worlds := self.shapes().worlds)
            size = size if shapes[0].shape[1] > 1 else 1
            return jax.tree.map(lambda x: jax.ShapeDtypeStruct((x.shape[0], size, *x.shape[2:]), x.dtype), worlds)

        def to_fit() -> tuple[World, PyTree, Key]:
            return pools(max(self.config.worlds, value_fit.WORLDS)), params(), seed_keys(self.seeds, Pretraining.VALUE)

        def valued() -> PyTree:
            return params()._replace(value=self.fit.eval_shape(*to_fit())) if self.fits else params()

        if self.fits:
            ahead.promise(self.fit, to_fit)
        if self.reports:
            ahead.promise(self.measure, lambda: (self.shapes().worlds, valued(), report))
            ahead.promise(self.judges.hold, lambda: (pools(value_fit.WORLDS), valued(), report))
        ahead.begin(functools.partial(importlib.import_module, "tensorboardX"))  # seconds, where PyTorch is installed

    def _shapes(self) -> Shapes:
        """What programs are compiled for and checkpoints are read into."""
        random, start = (seed_keys(self.seeds, purpose) for purpose in (Pretraining.RANDOM, Pretraining.START))
        few = self._drawn(jax.random.key(0), 2)
        n = self.config.worlds if pool_size(few) == 2 else 1  # one, where nothing varies
        worlds = jax.tree.map(lambda x: jax.ShapeDtypeStruct((self.count, n, *x.shape[1:]), x.dtype), few)
        experience = self.programs.collect.eval_shape(worlds, random)
        state = self.programs.train.init.eval_shape(worlds, experience, start)
        domain = jax.eval_shape(functools.partial(pretraining.domains, self.domain, self.count))
        return Shapes(worlds, experience, state._replace(domain=domain))

    def _drawn(self, key: Key, n: int) -> World:
        """Worlds [n] of the whole domain."""
        if self.config.doraemon:
            return self.make(uniform(self.env).sample((), key, n))
        return training_worlds(self.env, self.gap, key, n)

    def _whole(self, number: int) -> World:
        """A set of worlds [seeds, W] of the whole domain."""
        keys = pretraining.world_keys(self.seeds, number)
        return _stacked([self._drawn(key, self.config.worlds) for key in keys])

    def pools(self, number: int, domains: PyTree) -> World:
        """The worlds [seeds, W] of a set, to train in."""
        return self.widening(number, domains) if self.config.doraemon else self.whole(number)

    def _first(self) -> World:
        """Those with which training begins."""
        return self.pools(0, pretraining.domains(self.domain, self.count))

    def _value_pools(self) -> World:
        """The worlds [seeds, W] that V_sim is fitted in: those of training, or more where these are few."""
        if self.config.worlds >= value_fit.WORLDS or pool_size(self.whole(0)) == 1:
            return self.whole(0)
        keys = seed_keys(self.seeds, Pretraining.VALUE)
        return _stacked([self._drawn(key, value_fit.WORLDS) for key in keys])

    def _heldout_pools(self) -> World:
        """As many that nobody has seen, with sensors as in training, the same for all seeds."""
        pool = self._drawn(jax.random.key(_VALUE_SEED), value_fit.WORLDS)
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (self.count, *x.shape)), pool)

    def _saved(self, state: FleetState) -> Saved:
        """What a first checkpoint holds."""
        params = pretraining.exported(self.env, self.config, state)
        return Saved(state, evidence.nothing_known(params, self.count, self.config.eval_episodes))

    def _random(self, ahead: Ahead) -> PyTree:
        """Experience under random actions: collected once, then read from disk."""
        folder, expect = self.record.home / "random", self.record.expect
        if checkpoint.latest(folder) is not None:
            return checkpoint.restore(folder, self.shapes().random, expect=expect)[0]
        count = self.count * self.config.random_transitions
        with self.clock("random"), doing(f"collecting {count:,} random transitions", 15 + count / 200_000, once=True):
            ahead.wait(self.env.prepare, self.programs.collect)
            rows = self.programs.collect(self._first(), seed_keys(self.seeds, Pretraining.RANDOM))
            random = jax.block_until_ready(rows)
        self.writer.write(random, functools.partial(checkpoint.save, folder, 0, meta=expect))
        return random

    # ------------------------------------------------------------ between chunks

    def done(self, state: FleetState) -> int:
        return int(jax.device_get(state.rounds)[0]) * self.config.n_envs

    def log(self, state: FleetState, values: dict[str, np.ndarray], seconds: float) -> dict[str, float]:
        if self.config.doraemon:
            values["domain/entropy"] = np.array([entropy(stacking.member(state.domain, i)) for i in range(self.count)])
        super().log(state, values, seconds)
        ended = values["train/episodes"].all()  # episodes begin together, so in some chunks none ends
        name = "success" if self.env.score == "success" else "reward"
        return {f"{name}, exploring": float(values[f"train/{name}"].mean())} if ended else {}

    def evaluate(self, state: FleetState, done: int) -> dict[str, float]:
        """Every evaluation plays the same episodes in the same held-out worlds."""
        params = pretraining.exported(self.env, self.config, state)
        key = jax.random.fold_in(jax.random.key(_HELDOUT_SEED), 1)
        played = play(self.heldout, self.policy, params, key, self.config.eval_episodes)
        values = scores(played)
        self.record.log.eval(done, values)
        since = self.config.choose_from * self.config.chunks * self.config.chunk_steps
        self.best = best_of(self.best, params, played, state.rounds, since=since)
        return {f"{name}, evaluation": float(values[name].mean()) for name in dict.fromkeys((self.env.score, "return"))}

    def checkpoint(self, state: FleetState, done: int) -> None:
        assert self.best is not None  # evaluated before the first chunk
        step = done // self.config.chunk_env_steps
        write = self.record.checkpointer(step, env_steps=done, seconds=self.clock.seconds)
        self.writer.write(Saved(state, self.best), write)

    # ------------------------------------------------------------ what stays

    def _value(self, best: evidence.Best) -> evidence.Best:
        """The best policies with a V_sim of their own; a fit that was killed is repeated, with the same bits."""
        pools, keys = self._value_pools(), seed_keys(self.seeds, Pretraining.VALUE)
        value = jax.block_until_ready(self.fit(pools, best.params, keys))
        return best._replace(params=best.params._replace(value=value))

    def _hand_over(self, best: evidence.Best) -> dict[str, Any]:
        """V_sim, priors with their cards, report, figures, summary, closing words."""
        report = None
        if self.fits:
            with self.clock("value"), doing("fitting V_sim", 20 + 20 * len(self.seeds), once=True):
                best = self._value(best)
        with self.clock("report"):
            if self.reports:
                with doing("measuring V_sim and the models", 15 + 5 * len(self.seeds), once=True):
                    report, held, judged = self._report(best.params)
            with doing("playing fresh episodes for the cards", 5):
                played = self._final_episodes(best.params)
        (score, total), best, results = *jax.device_get((_levels(best), best)), []
        for i, seed in enumerate(self.seeds):
            chosen = stacking.member(best, i)
            name = digest(Prior(chosen.params, {}))  # by which runs of fine-tuning tell which priors they began from
            facts = {"seed": seed, "digest": name, **describe(stacking.member(played, i))}
            facts["best/env_steps"] = int(chosen.age) * self.config.n_envs
            facts |= {f"best/{self.env.score}": float(score[i]), "best/return": float(total[i])}
            if report is not None:
                facts |= judged[i] | numbers(stacking.member(report, i))
            results.append(facts)
        cards = {facts["seed"]: self._card(facts) for facts in results}
        self.record.save_policies("prior", best.params, cards.__getitem__)
        for i, seed in enumerate(self.seeds if report is not None else []):
            self._save_report(seed, stacking.member(report, i), stacking.member(held, i), i)
        summary = {
            "task": self.env.name,
            "preset": self.args.preset,
            "impl": self.env.impl,
            "gap": None if self.gap is None else self.gap.table,
            "env_steps": self.total,
            "updates": self.config.chunks * self.config.chunk_steps * self.config.updates_per_step,
            "seeds": results,
            **self.clock.record(),
        }
        write_summary(self.record.folder, summary)
        if self.args.video:
            path, episodes = self.record.folder / "videos" / f"seed-{self.seeds[0]}.mp4", stacking.member(played, 0)
            print(film_episode(self.env, self.final, 0, stacking.member(episodes, 0), path))
        self._say(results)
        return summary

    def _card(self, facts: dict[str, Any]) -> dict[str, Any]:
        """What a prior says of itself; facts: its numbers."""
        late = f"{self.config.choose_from:.0%} of training"
        return {
            **self.card,
            "gap": None if self.gap is None else self.gap.table,
            "preset": self.args.preset,
            "chosen": f"the best evaluation in held-out worlds after {late}: {self.env.score}, then return",
            "metrics": facts,
            "provenance": runs.provenance(),
        }

    def _final_episodes(self, params: PyTree) -> Episode:
        """[seeds, >= report_episodes] new episodes in worlds that neither training nor the choice has seen."""
        system, n = self.heldout.moved(self.final, self.heldout.which), self.config.eval_episodes
        rounds = math.ceil(self.config.report_episodes / n)
        keys = jax.random.split(jax.random.fold_in(jax.random.key(_FINAL_SEED), 1), rounds)
        played = [play(system, self.policy, params, key, n) for key in keys]
        return jax.tree.map(lambda *x: np.concatenate(x, axis=1), *played)

    def _report(self, params: PyTree) -> tuple[Report, Held, list[dict[str, Any]]]:
        """[seeds] measurements, as NumPy arrays, and what they say of V_sim."""
        keys = seed_keys(self.seeds, Pretraining.REPORT)
        pools = self._heldout_pools()
        measured = self.measure(self.whole(0), params, keys), self.judges.hold(pools, params, keys)
        report, held = jax.tree.map(np.asarray, mesh.local(measured))
        again = self.fits and self.gap is None and self.env.restore is not None
        states = min(_STATES, self.config.eval_episodes // 2) if again else 0
        pool, judged = stacking.member(pools, 0), []
        for i in range(len(self.seeds)):
            of_seed = stacking.member(held, i), pool, stacking.member(params, i), keys[i]
            judged.append(value_numbers(self.judges, self.env, *of_seed, states))
        return report, held, judged

    def _save_report(self, seed: int, report: Report, held: Held, i: int) -> None:
        """The arrays behind the figure, and the figure."""
        folder = self.record.folder
        curve = read_jsonl(folder / EVAL)
        some = np.flatnonzero(held.intact)[:2000]  # points that a figure can show
        (folder / "report").mkdir(exist_ok=True)
        np.savez(folder / "report" / f"seed-{seed}.npz", allow_pickle=False, **report._asdict(), **held._asdict())
        if not some.size:
            return  # every trajectory exploded: there is nothing to draw
        figures.pretraining(
            folder / "figures" / f"seed-{seed}.png",
            ([line["step"] for line in curve], *([line[x][i] for line in curve] for x in ("success", "return"))),
            (held.value[some], held.returns[some]),
            (report.model_error, report.still_error),
            title=f"pretraining {self.env.name}, preset {self.args.preset}, seed {seed}",
        )

    def _say(self, results: list[dict[str, Any]]) -> None:
        folder = self.record.folder
        for facts in results:
            low, high = facts["success/interval"]
            score = f"return {facts['return']:.3f}"
            if self.env.score == "success":
                score = f"success {facts['success']:.3f} [{low:.3f}, {high:.3f}]"
            line = f"seed {facts['seed']}: {score} in {facts['episodes']} fresh episodes"
            if "value/off_path_explained_variance" in facts:
                line += f"; V_sim explains {facts['value/off_path_explained_variance']:.2f} of the variance of returns"
                if "value/explainable_variance" in facts:
                    line += f" (explainable: {facts['value/explainable_variance']:.2f})"
                line += f", rank correlation {facts['value/off_path_rank_correlation']:.2f}"
                line += f", bias {facts['value/off_path_bias']:+.2f}"
            print(line)
        files = ", ".join(name for name in ("prior/", "summary.json", "figures/") if (folder / name).exists())
        print(f"results: {folder}  ({files})")
        wanted = self.config.algorithm, self.config.sees_system, self.config.blind_actor
        methods = [
            name for name, way in all_methods().items() if (way.prior, way.sees_system, way.blind_actor) == wanted
        ]
        if not methods:  # as for an algorithm that is new
            return
        method = None if methods[0] == DEFAULT else methods[0]
        real = gaps.usual(self.env.name) if self.gap is None else SIM
        chosen = {"method": method, "real": None if real == "default" else real, "prior": folder, "out": self.args.out}
        print(as_typed(f"next: {command('finetune', task=self.args.task, **chosen)}"))
