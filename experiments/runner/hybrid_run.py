"""Impure: a run of `sgft_jax.hybrid.trainer` with data, folders, checkpoints, logs and evaluations around it."""

import functools
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, World
from envs.gaps import SIM, Gap
from envs.pools import real_env, real_worlds
from envs.rollout import Episode
from envs.types import PyTree, UserError
from experiments.runner import logged
from experiments.runner.evaluation import play, scores
from experiments.runner.hybrid_args import VOLATILE, HybridArgs, gaps_of, run_folder
from experiments.runner.memory import reserve
from experiments.runner.video import film_episode
from sgft_jax.analysis import figures
from sgft_jax.analysis.reading import read_curve
from sgft_jax.datasets import logs
from sgft_jax.files.jsonfile import jsonable
from sgft_jax.hybrid import trainer
from sgft_jax.hybrid.robot import MEASURES
from sgft_jax.hybrid.scores import LATE, late, measures, normalised
from sgft_jax.hybrid.trainer import HybridState
from sgft_jax.io import checkpoint, runs
from sgft_jax.io.log import EVAL, MetricsLog, check_finite, read_jsonl, write_summary
from sgft_jax.io.priors import save_prior
from sgft_jax.io.progress import RunProgress
from sgft_jax.io.runs import NO_SIMULATOR
from sgft_jax.math.stats import bootstrap_interval, mean
from sgft_jax.stacking import join, member, part
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train.pretraining import seed_keys
from sgft_jax.types import Fixed, Metrics, Prior, RealData

_TRAINING, _EVALUATION = 11, 12  # purposes, folded into a seed's key


def run(args: HybridArgs, method: Fixed, seeds: list[int]) -> list[dict[str, Any]]:
    """The runs with the simulators of `args`; returns their summaries."""
    env = envs.make(args.task, args.impl, previous_actions=args.previous_actions)
    named = gaps_of(args, method)
    found = [Gap(NO_SIMULATOR, {}, {}) if name == NO_SIMULATOR else gaps.load(env, name) for name in named]
    log = None
    if method.kind != "simulator" and args.data is not None:
        log = logged.read(args.data, env, gamma=args.options.gamma, successors=args.successors)
    homes = {run_folder(args, name): jsonable(args) | {"gap": name} for name in named}
    inputs = {"data": None if log is None else {"sha256": log.facts.sha256, "successors": log.facts.successors}}
    ready = _Run(args, method, env, found, seeds, log)  # refuses what it cannot play before a folder is made
    opened = runs.open_runs(
        homes, kind="hybrid", resume=args.resume, overwrite=args.overwrite, volatile=VOLATILE, inputs=inputs
    )
    try:
        return ready.work([own.folder for own in opened])
    finally:
        for own in opened:
            own.close()


def intervals(scores: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """By NAME/interval, the 95 % bootstrap interval [low, high] of the mean over seeds; none where seeds are too few.

    scores: [seeds] each.
    """
    found = {f"{name}/interval": bootstrap_interval(own, statistic=mean) for name, own in scores.items()}
    return {name: [float(own.low), float(own.high)] for name, own in found.items() if np.isfinite(own.low)}


def in_words(scores: np.ndarray, bounds: list[float] | None) -> str:
    """The mean over seeds with its interval [low, high], "20.5 [18, 22]"; alone where that says nothing."""
    low, high = bounds or (0.0, 0.0)
    return f"{scores.mean():.4g}" + (f" [{low:.4g}, {high:.4g}]" if low < high else "")


class _Run:
    """What happens between chunks. Members [M = G * S] are the seeds of the first simulator, then those of the next."""

    def __init__(
        self, args: HybridArgs, method: Fixed, env: Env, found: list[Gap], seeds: list[int],
        log: logs.Log | None,
    ) -> None:  # fmt: skip
        self.args, self.method, self.gaps, self.seeds = args, method, found, seeds
        self.env = real_env(env, found)  # what the simulators share
        self.data = log
        self.agent = method.build(args.options, env)
        self.last_good: Path | None = None
        self.expect = {"kind": "hybrid", "task": env.name, "method": method.name, "seeds": seeds}
        members = jnp.zeros(len(found) * len(seeds), jnp.int32)
        gap = gaps.load(env, args.real)
        real = real_env(env, [gap])
        pools = real_worlds(real, [gap], jax.random.key(0))
        self.system = Simulated(real, pools, members, gamma=args.options.gamma)
        self.chunk = args.schedule.updates_per_chunk
        self.inputs = (self._pools(), self._real(), self._keys())
        self._reserve(self.inputs[1])

    def work(self, folders: list[Path]) -> list[dict[str, Any]]:
        """Everything, in order; returns the summaries. folders: of the runs, one for each simulator."""
        self.folders, self.logs = folders, [MetricsLog(folder) for folder in folders]
        state = self._restore(*self.inputs)
        steps = trainer.train(
            self.env, self.agent, self.args.schedule, *self.inputs, gamma=self.args.options.gamma, state=state
        )
        return self._finish(self._follow(steps))

    def _reserve(self, real: RealData) -> None:
        """Says how much memory the rows take; raises UserError where there is not as much."""
        kept = trainer.memory(self.env, self.agent, self.args.schedule, real)
        members = len(self.gaps) * len(self.seeds)
        reserve({"buffer": kept.buffer}, copies=members, shared=kept.data, settings="schedule")

    def _pools(self) -> World:
        """The worlds [M, W] of each member's simulator; those of the real system where there is none."""
        found = [gaps.load(self.env, SIM) if gap.name == NO_SIMULATOR else gap for gap in self.gaps]
        pools = real_worlds(self.env, found, jax.random.key(1))
        return jax.tree.map(lambda x: jnp.repeat(x, len(self.seeds), axis=0), pools)

    def _real(self) -> RealData:
        """The real data, or what stands for it."""
        if self.data is None:
            return trainer.no_data(self.env)
        return RealData(self.data.rows, jnp.asarray(self.data.last))

    def _keys(self) -> Any:
        """[M]: a seed gives the same draws whichever simulators share the program."""
        return jnp.concatenate([seed_keys(self.seeds, _TRAINING)] * len(self.gaps))

    def _restore(self, pools: World, real: RealData, keys: Any) -> HybridState | None:
        """The state after the last checkpoint, None for a fresh start; raises UserError where simulators differ."""
        steps = [checkpoint.latest(folder, whole=True) for folder in self.folders]
        if len(set(steps)) > 1:
            listed = ", ".join(f"{own} is at {n or 0} updates" for own, n in zip(self.folders, steps, strict=True))
            raise UserError(f"{listed}: they cannot go on together, resume them one at a time")
        if steps[0] is None:
            for log in self.logs:
                log.truncate({})
            return None
        first = len(self.seeds)  # of the members: those of one simulator
        own = jax.tree.map(lambda x: x[:first], pools)
        like = trainer.shape_of(self.env, self.agent, self.args.schedule, own, real, keys[:first])
        restored = functools.partial(checkpoint.restore, like=like, step=steps[0], checked=True, expect=self.expect)
        found = [restored(folder) for folder in self.folders]
        for log, (_, meta) in zip(self.logs, found, strict=True):
            log.truncate(meta["position"])
        return join([state for state, _ in found])

    def _follow(self, steps: Iterator[tuple[HybridState, Metrics]]) -> HybridState:
        """Logs, evaluates and checkpoints what the iterator yields; returns its last state."""
        schedule, names = self.args.schedule, "+".join(gap.name for gap in self.gaps)
        state, _ = next(steps)
        done = trainer.chunks_done(state, schedule)
        if done == 0:
            self._evaluate(state, 0)
        title = f"{self.method.name} on {self.env.name}/{names}"
        with RunProgress(title, total=schedule.updates_in_all, unit="updates", done=done * self.chunk) as progress:
            for state, metrics in steps:
                before, done = done * self.chunk, done + 1
                values = {name: np.asarray(x) for name, x in metrics.items()}
                check_finite(values, done * self.chunk, unit="updates", last_good=self.last_good)
                for log, own in zip(self.logs, self._each(values), strict=True):
                    log.metrics(done * self.chunk, own)
                shown = {}
                if self._due(self.args.eval_every, before, done):
                    shown = {f"{self.env.score}, real system": self._evaluate(state, done)}
                if self._due(self.args.checkpoint_every, before, done):
                    self._checkpoint(state, done)
                progress.advance(self.chunk, shown)
        return state

    def _due(self, every: int, before: int, done: int) -> bool:
        """Whether something that happens every so many updates happens after this chunk: also after the last."""
        return before // every != done * self.chunk // every or done == self.args.schedule.chunks

    def _evaluate(self, state: HybridState, done: int) -> float:
        played = self._play(state, self.args.eval_episodes)
        found = scores(played) | self._measures(played)
        for log, own in zip(self.logs, self._each(found), strict=True):
            log.eval(done * self.chunk, own)
        return float(found["score"].mean())

    def _measures(self, played: Episode) -> dict[str, Any]:
        """What else the task is judged by, [M] means over episodes."""
        measure = MEASURES.get(self.env.name)
        if measure is None:
            return {}
        found = measure(played.transitions.next_obs, played.valid, dt=self.env.control_dt)
        return {name: values.mean(-1) for name, values in found.items()}

    def _play(self, state: HybridState, episodes: int) -> Episode:
        """Episodes [M, episodes] in the real system, always the same starts."""
        params = jax.jit(jax.vmap(self.agent.export))(state.learner)
        return play(self.system, self.agent.policy, params, jax.random.key(_EVALUATION), episodes)

    def _checkpoint(self, state: HybridState, done: int) -> None:
        for folder, log, own in zip(self.folders, self.logs, self._each(state), strict=True):
            meta = {**self.expect, "position": log.position()}
            self.last_good = checkpoint.save(folder, done * self.chunk, own, meta=meta)

    def _each(self, members: PyTree) -> Iterator[PyTree]:
        """Of each simulator, [S], what belongs to it in a pytree over all members."""
        return (part(members, i, len(self.seeds)) for i in range(len(self.gaps)))

    # ------------------------------------------------------------ what stays

    def _finish(self, state: HybridState) -> list[dict[str, Any]]:
        """Policies, summaries, curves and closing words. The last policy is the result: nothing real chose it."""
        params = jax.jit(jax.vmap(self.agent.export))(state.learner)
        filmed = functools.cache(lambda: self._play(state, 1))
        found = []
        for i, (folder, gap, own) in enumerate(zip(self.folders, self.gaps, self._each(params), strict=True)):
            self.logs[i].close()
            for k, seed in enumerate(self.seeds):
                save_prior(folder / "policy" / f"seed-{seed}", Prior(member(own, k), self._card(gap, seed)))
            lines = read_jsonl(folder / EVAL)
            summary = self._summary(lines, gap)
            write_summary(folder, summary)
            _draw(folder)
            if self.args.video:
                print(self._film(folder, member(member(filmed(), i * len(self.seeds)), 0)))
            self._say(folder, gap, summary)
            found.append(summary)
        return found

    def _card(self, gap: Gap, seed: int) -> dict[str, Any]:
        env = self.env
        sizes = {"task": env.name, "obs_dim": env.obs_dim, "act_dim": env.act_dim, "control_dt": env.control_dt}
        sizes |= {"previous_actions": env.previous_actions}
        layout = {"observation": [e._asdict() for e in env.observation], "action": [e._asdict() for e in env.action]}
        facts = {"method": self.method.name, "gap": gap._asdict(), "seed": seed, "data": self._facts()}
        return {**self.agent.card, **sizes, **layout, "hybrid": facts, "provenance": runs.provenance()}

    def _facts(self) -> dict[str, Any] | None:
        return None if self.data is None else asdict(self.data.facts) | {"path": Path(self.data.facts.path).name}

    def _summary(self, lines: list[dict[str, Any]], gap: Gap) -> dict[str, Any]:
        """Score of each seed at the last evaluation, and the mean over the last ten. lines: the evaluations."""
        curve = np.array([line["score"] for line in lines])
        scores = {"last": curve[-1], "late": late(curve)}
        others = {name: lines[-1][name] for name in measures(lines[-1])}
        return {
            "task": self.env.name,
            "method": self.method.name,
            "gap": gap._asdict(),
            "real": self.args.real,
            "impl": self.env.impl,
            "data": self._facts(),
            "schedule": jsonable(self.args.schedule),
            "updates": self.args.schedule.updates_in_all,
            "score": self.env.score,
            "seeds": self.seeds,
            **{name: own.tolist() for name, own in scores.items()},
            **intervals(scores),
            "normalised": [normalised(self.env.name, x) for x in scores["last"].tolist()],
            "measures": others,
        }

    def _film(self, folder: Path, played: Episode) -> str:
        """An episode in the real system."""
        path = folder / "videos" / f"seed-{self.seeds[0]}.mp4"
        return film_episode(self.system.env, self.system.pools, 0, played, path)

    def _say(self, folder: Path, gap: Gap, summary: dict[str, Any]) -> None:
        last, average = np.array(summary["last"]), np.array(summary["late"])
        rescaled = [x for x in summary["normalised"] if x is not None]
        scale = f", {np.mean(rescaled):.1f} on D4RL's scale" if rescaled else ""
        print(
            f"{gap.name}: {self.env.score} in the real system {in_words(last, summary.get('last/interval'))} "
            f"(std over seeds {last.std():.3g}) after {summary['updates']:,} updates{scale}; "
            f"mean of the last {LATE} evaluations {in_words(average, summary.get('late/interval'))}"
        )
        for name, values in summary["measures"].items():
            print(f"  {name}: {np.mean(values):.3g} (std over seeds {np.std(values):.2g})")
        print(f"results: {folder}  (policy/, summary.json, eval.jsonl, figures/)")


def _draw(folder: Path) -> None:
    """The learning curve of a finished run."""
    curve = read_curve(folder)
    title = " on ".join(filter(None, [curve.task, curve.data]))
    figures.learning_curves(folder / "figures/score.png", {f"simulator: {curve.gap or 'none'}": [curve]}, title=title)
