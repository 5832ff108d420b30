"""Impure: a run of `sgft_jax.train.hybrid` with data, folders, checkpoints, logs and evaluations around it."""

import functools
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps, normalised
from envs.base import Env, World
from envs.gaps import SIM, Gap
from envs.rollout import Episode, real_env, real_worlds
from envs.types import Key
from experiments.runner.machines import reserve
from experiments.runner.pictures import film_episode
from experiments.runner.recorded import read_log
from experiments.runner.training import Record, Training, opened, play, scores
from sgft_jax.analysis import figures
from sgft_jax.analysis.hybrid import LATE, late
from sgft_jax.analysis.reading import measures, read_curve
from sgft_jax.datasets import logs
from sgft_jax.files.disk import jsonable
from sgft_jax.io import runs
from sgft_jax.io.log import EVAL, read_jsonl, write_summary
from sgft_jax.io.runs import NO_SIMULATOR
from sgft_jax.keys import FromLog, seed_keys
from sgft_jax.math.stats import bootstrap_interval, mean
from sgft_jax.stacking import join, member
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train import hybrid
from sgft_jax.train.fleet import FleetState
from sgft_jax.types import Fixed, HybridAgent, RealData

if TYPE_CHECKING:
    from experiments.runner.hybrid_args import HybridArgs


def run(
    args: "HybridArgs", method: Fixed, seeds: list[int], homes: Mapping[Path, Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """The runs with the simulators of `args`; returns their summaries. homes: of each its folder and configuration."""
    env = envs.make(args.task, args.impl, previous_actions=args.previous_actions)
    named = [config["gap"] for config in homes.values()]
    simulators = [Gap(NO_SIMULATOR, {}, {}) if name == NO_SIMULATOR else gaps.load(env, name) for name in named]
    log = None
    if method.kind != "simulator" and args.data is not None:
        log = read_log(args.data, env, gamma=args.options.gamma, successors=args.successors)
    inputs = {"data": None if log is None else {"sha256": log.facts.sha256, "successors": log.facts.successors}}
    setup = _set_up(args, method, env, simulators, seeds, log)  # refuses what it cannot play before a folder is made
    with opened("hybrid", args, homes, inputs) as folders:
        return _Run(setup, folders).work()


def intervals(scores: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """By NAME/interval, the 95 % bootstrap interval [low, high] of the mean over seeds; none where seeds are too few.

    scores: [seeds] each.
    """
    bounds = {f"{name}/interval": bootstrap_interval(values, statistic=mean) for name, values in scores.items()}
    return {name: [float(x.low), float(x.high)] for name, x in bounds.items() if np.isfinite(x.low)}


def in_words(scores: np.ndarray, bounds: list[float] | None) -> str:
    """The mean over seeds with its interval [low, high], "20.5 [18, 22]"; alone where that says nothing."""
    low, high = bounds or (0.0, 0.0)
    return f"{scores.mean():.4g}" + (f" [{low:.4g}, {high:.4g}]" if low < high else "")


class _Setup(NamedTuple):
    """What a run trains with. Members [M] are the seeds of the first simulator, then those of the next.

    env: what the simulators share. gaps: these, one for each run folder. log: the real data, None without any. system:
    the real one, [M]. pools, real, keys: as `hybrid.train` takes them.
    """

    args: "HybridArgs"
    method: Fixed
    env: Env
    gaps: list[Gap]
    seeds: list[int]
    log: logs.Log | None
    agent: HybridAgent
    system: Simulated
    pools: World
    real: RealData
    keys: Key


def _set_up(
    args: "HybridArgs", method: Fixed, task: Env, simulators: list[Gap], seeds: list[int], log: logs.Log | None
) -> _Setup:
    """Says how much memory the rows take; raises UserError where there is not as much."""
    env, gap = real_env(task, simulators), gaps.load(task, args.real)
    agent = method.build(args.options, env)
    world = real_env(env, [gap])
    members = jnp.zeros(len(simulators) * len(seeds), jnp.int32)
    system = Simulated(world, real_worlds(world, [gap], jax.random.key(0)), members, gamma=args.options.gamma)
    real = hybrid.no_data(env) if log is None else RealData(log.rows, jnp.asarray(log.last))
    # Where there is no simulator, the real system's worlds stand for it.
    played = [gaps.load(env, SIM) if gap.name == NO_SIMULATOR else gap for gap in simulators]
    pools = jax.tree.map(lambda x: jnp.repeat(x, len(seeds), axis=0), real_worlds(env, played, jax.random.key(1)))
    # A seed gives the same draws whichever simulators share the program.
    keys = jnp.concatenate([seed_keys(seeds, FromLog.TRAINING)] * len(simulators))
    kept, data = hybrid.memory(env, agent, args.schedule, real)
    reserve({"buffer": kept}, copies=len(members), shared=data, settings="schedule")
    return _Setup(args, method, env, simulators, seeds, log, agent, system, pools, real, keys)


class _Run(Training):
    """A run on all simulators of a setup. folders: of the runs, one for each simulator."""

    unit = "updates"

    def __init__(self, setup: _Setup, folders: list[Path]) -> None:
        self.setup, self.args, self.env, self.agent = setup, setup.args, setup.env, setup.agent
        names = "+".join(gap.name for gap in setup.gaps)
        expect = {"kind": "hybrid", "task": self.env.name, "method": setup.method.name, "seeds": setup.seeds}
        title = f"{setup.method.name} on {self.env.name}/{names}"
        records = [Record(folder, expect) for folder in folders]
        every = {"eval_every": self.args.eval_every, "checkpoint_every": self.args.checkpoint_every}
        super().__init__(records, title, self.args.schedule.updates_in_all, **every)

    def work(self) -> list[dict[str, Any]]:
        """Everything, in order; returns the summaries."""
        setup, schedule = self.setup, self.args.schedule
        count = self.count
        first = jax.tree.map(lambda x: x[:count], setup.pools), setup.real, setup.keys[:count]  # of one simulator
        restored = self.restore(lambda: hybrid.shape_of(self.env, self.agent, schedule, *first))
        state = join([state for state, _ in restored]) if restored else None
        data = setup.pools, setup.real, setup.keys
        steps = hybrid.train(self.env, self.agent, schedule, *data, gamma=self.args.options.gamma, state=state)
        return self._finish(self.follow(steps, 0 if state is None else self.done(state)))

    # ------------------------------------------------------------ between chunks

    def done(self, state: FleetState) -> int:
        return int(jax.device_get(state.rounds)[0]) * self.args.schedule.updates_per_round

    def evaluate(self, state: FleetState, done: int) -> dict[str, float]:
        played = self._play(state, self.args.eval_episodes)
        values = scores(played) | self._measures(played)
        for record, part in self.each(values):
            record.log.eval(done, part)
        return {f"{self.env.score}, real system": float(values["score"].mean())}

    def checkpoint(self, state: FleetState, done: int) -> None:
        for record, part in self.each(state):
            record.checkpoint(part, done)

    def _measures(self, played: Episode) -> dict[str, Any]:
        """What else the task is judged by, [M] means over episodes."""
        measured = self.env.measures(played.transitions.next_obs, played.valid)
        return {name: values.mean(-1) for name, values in measured.items()}

    def _play(self, state: FleetState, episodes: int) -> Episode:
        """Episodes [M, episodes] in the real system, always the same starts."""
        params = jax.jit(jax.vmap(self.agent.export))(state.learner)
        return play(self.setup.system, self.agent.policy, params, jax.random.key(FromLog.EVALUATION), episodes)

    # ------------------------------------------------------------ what stays

    def _finish(self, state: FleetState) -> list[dict[str, Any]]:
        """Policies, summaries, curves and closing words. The last policy is the result: nothing real chose it."""
        params = jax.jit(jax.vmap(self.agent.export))(state.learner)
        filmed = functools.cache(lambda: self._play(state, 1))
        summaries = []
        for i, (record, policies) in enumerate(self.each(params)):
            gap, folder = self.setup.gaps[i], record.folder
            record.log.close()
            record.save_policies("policy", policies, functools.partial(self._card, gap))
            lines = read_jsonl(folder / EVAL)
            summary = self._summary(lines, gap)
            write_summary(folder, summary)
            _draw(folder)
            if self.args.video:
                print(self._film(folder, member(member(filmed(), i * self.count), 0)))
            self._say(folder, gap, summary)
            summaries.append(summary)
        return summaries

    def _card(self, gap: Gap, seed: int) -> dict[str, Any]:
        env = self.env
        sizes = {"task": env.name, "obs_dim": env.obs_dim, "act_dim": env.act_dim, "control_dt": env.control_dt}
        sizes |= {"previous_actions": env.previous_actions}
        layout = {"observation": [e._asdict() for e in env.observation], "action": [e._asdict() for e in env.action]}
        facts = {"method": self.setup.method.name, "gap": gap._asdict(), "seed": seed, "data": self._facts()}
        return {**self.agent.card, **sizes, **layout, "hybrid": facts, "provenance": runs.provenance()}

    def _facts(self) -> dict[str, Any] | None:
        return (
            None
            if self.setup.log is None
            else asdict(self.setup.log.facts) | {"path": Path(self.setup.log.facts.path).name}
        )

    def _summary(self, lines: list[dict[str, Any]], gap: Gap) -> dict[str, Any]:
        """Score of each seed at the last evaluation, and the mean over the last ten. lines: the evaluations."""
        curve = np.array([line["score"] for line in lines])
        scores = {"last": curve[-1], "late": late(curve)}
        others = {name: lines[-1][name] for name in measures(lines[-1])}
        return {
            "task": self.env.name,
            "method": self.setup.method.name,
            "gap": gap._asdict(),
            "real": self.args.real,
            "impl": self.env.impl,
            "data": self._facts(),
            "schedule": jsonable(self.args.schedule),
            "updates": self.args.schedule.updates_in_all,
            "score": self.env.score,
            "seeds": self.setup.seeds,
            **{name: values.tolist() for name, values in scores.items()},
            **intervals(scores),
            "normalised": [normalised(self.env.name, x) for x in scores["last"].tolist()],
            "measures": others,
        }

    def _film(self, folder: Path, played: Episode) -> str:
        """An episode in the real system."""
        path = folder / "videos" / f"seed-{self.setup.seeds[0]}.mp4"
        return film_episode(self.setup.system.env, self.setup.system.pools, 0, played, path)

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
