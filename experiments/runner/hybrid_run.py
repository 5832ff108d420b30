"""Impure: a run of `sgft_jax.train.hybrid` with data, folders, checkpoints, logs and evaluations around it."""

import functools
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps, normalised
from envs.base import Env
from envs.gaps import SIM, Gap
from envs.rollout import Episode, real_env, real_worlds
from experiments.runner.machines import reserve
from experiments.runner.pictures import film_episode
from experiments.runner.progress import doing
from experiments.runner.recorded import read_log
from experiments.runner.training import Record, Training, opened, play, scores
from sgft_jax.analysis import figures
from sgft_jax.analysis.hybrid import LATE, late
from sgft_jax.analysis.reading import measures, read_curve
from sgft_jax.datasets.logs import Log
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
from sgft_jax.types import Fixed, RealData

if TYPE_CHECKING:
    from experiments.hybrid import HybridArgs


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
    with doing("building the worlds", 5):
        training = _Run(args, method, env, simulators, seeds, log)  # what it cannot play it refuses before any folder
    with opened("hybrid", args, homes, inputs) as folders:
        return training.work(folders)


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


class _Run(Training):
    """A run on all simulators. Members [M] are the seeds of the first one, then those of the next.

    Says how much memory the rows take; raises UserError where there is not as much. data: the real data, None without
    any.
    """

    unit = "updates"

    def __init__(
        self, args: "HybridArgs", method: Fixed, task: Env, simulators: list[Gap], seeds: list[int], data: Log | None
    ) -> None:
        title, gamma = f"{method.name} on {task.name}/{'+'.join(gap.name for gap in simulators)}", args.options.gamma
        every = {"eval_every": args.eval_every, "checkpoint_every": args.checkpoint_every}
        super().__init__(title, args.schedule.updates_in_all, len(seeds), **every)
        self.args, self.method, self.gaps, self.seeds, self.data = args, method, simulators, seeds, data
        self.env, gap = real_env(task, simulators), gaps.load(task, args.real)
        self.agent, world = method.build(args.options, self.env), real_env(self.env, [gap])
        members = jnp.zeros(len(simulators) * len(seeds), jnp.int32)
        self.system = Simulated(world, real_worlds(world, [gap], jax.random.key(0)), members, gamma=gamma)
        self.real = hybrid.no_data(self.env) if data is None else RealData(data.rows, jnp.asarray(data.last))
        # Where there is no simulator, the real system's worlds stand for it.
        played = [gaps.load(self.env, SIM) if gap.name == NO_SIMULATOR else gap for gap in simulators]
        worlds = real_worlds(self.env, played, jax.random.key(1))
        self.pools = jax.tree.map(lambda x: jnp.repeat(x, len(seeds), axis=0), worlds)
        # A seed gives the same draws whichever simulators share the program.
        self.keys = jnp.concatenate([seed_keys(seeds, FromLog.TRAINING)] * len(simulators))
        kept, shared = hybrid.memory(self.env, self.agent, args.schedule, self.real)
        reserve({"buffer": kept}, copies=len(members), shared=shared, settings="schedule")

    def work(self, folders: list[Path]) -> list[dict[str, Any]]:
        """Everything, in order; returns the summaries. folders: of the runs, one for each simulator."""
        expect = {"kind": "hybrid", "task": self.env.name, "method": self.method.name, "seeds": self.seeds}
        self.records = [Record(folder, expect) for folder in folders]
        env, agent, schedule = self.env, self.agent, self.args.schedule
        pools, keys = jax.tree.map(lambda x: x[: self.count], (self.pools, self.keys))  # of one simulator
        restored = self.restore(lambda: hybrid.shape_of(env, agent, schedule, pools, self.real, keys))
        state = join([state for state, _ in restored]) if restored else None
        data, gamma = (self.pools, self.real, self.keys), self.args.options.gamma
        with self.announced(None):
            steps = hybrid.train(env, agent, schedule, *data, gamma=gamma, state=state)
        return self._finish(self.follow(steps, 0 if state is None else self.done(state)))

    # ------------------------------------------------------------ between chunks

    def done(self, state: FleetState) -> int:
        return int(jax.device_get(state.rounds)[0]) * self.args.schedule.updates_per_round

    def evaluate(self, state: FleetState, done: int) -> dict[str, float]:
        played = self._play(state, self.args.eval_episodes)
        measured = self.env.measures(played.transitions.next_obs, played.valid)  # what else the task is judged by
        values = scores(played) | {name: x.mean(-1) for name, x in measured.items()}
        for record, part in self.by_record(values):
            record.log.eval(done, part)
        return {f"{self.env.score}, real system": float(values["score"].mean())}

    def _play(self, state: FleetState, episodes: int) -> Episode:
        """Episodes [M, episodes] in the real system, always the same starts."""
        params = jax.jit(jax.vmap(self.agent.export))(state.learner)
        return play(self.system, self.agent.policy, params, jax.random.key(FromLog.EVALUATION), episodes)

    # ------------------------------------------------------------ what stays

    def _finish(self, state: FleetState) -> list[dict[str, Any]]:
        """Policies, summaries, curves and closing words. The last policy is the result: nothing real chose it."""
        params = jax.jit(jax.vmap(self.agent.export))(state.learner)
        filmed = functools.cache(lambda: self._play(state, 1))
        summaries = []
        for i, (record, policies) in enumerate(self.by_record(params)):
            gap, folder = self.gaps[i], record.folder
            record.log.close()
            record.save_policies("policy", policies, functools.partial(self._card, gap))
            summary = self._summary(read_jsonl(folder / EVAL), gap)
            write_summary(folder, summary)
            curve = read_curve(folder)
            title, name = " on ".join(filter(None, [curve.task, curve.data])), f"simulator: {curve.gap or 'none'}"
            figures.learning_curves(folder / "figures/score.png", {name: [curve]}, title=title)
            if self.args.video:
                path, episodes = folder / "videos" / f"seed-{self.seeds[0]}.mp4", member(filmed(), i * self.count)
                print(film_episode(self.system.env, self.system.pools, 0, member(episodes, 0), path))
            self._say(folder, gap, summary)
            summaries.append(summary)
        return summaries

    def _card(self, gap: Gap, seed: int) -> dict[str, Any]:
        env = self.env
        sizes = {"task": env.name, "obs_dim": env.obs_dim, "act_dim": env.act_dim, "control_dt": env.control_dt}
        sizes |= {"previous_actions": env.previous_actions}
        layout = {"observation": [e._asdict() for e in env.observation], "action": [e._asdict() for e in env.action]}
        facts = {"method": self.method.name, "gap": gap.table, "seed": seed, "data": self._facts()}
        return {**self.agent.card, **sizes, **layout, "hybrid": facts, "provenance": runs.provenance()}

    def _facts(self) -> dict[str, Any] | None:
        """What the real data are."""
        if self.data is None:
            return None
        return asdict(self.data.facts) | {"path": Path(self.data.facts.path).name}

    def _summary(self, lines: list[dict[str, Any]], gap: Gap) -> dict[str, Any]:
        """Score of each seed at the last evaluation, and the mean over the last ten. lines: the evaluations."""
        curve = np.array([line["score"] for line in lines])
        scores = {"last": curve[-1], "late": late(curve)}
        others = {name: lines[-1][name] for name in measures(lines[-1])}
        return {
            "task": self.env.name,
            "method": self.method.name,
            "gap": gap.table,
            "real": self.args.real,
            "impl": self.env.impl,
            "data": self._facts(),
            "schedule": jsonable(self.args.schedule),
            "updates": self.args.schedule.updates_in_all,
            "score": self.env.score,
            "seeds": self.seeds,
            **{name: values.tolist() for name, values in scores.items()},
            **intervals(scores),
            "normalised": [normalised(self.env.name, x) for x in scores["last"].tolist()],
            "measures": others,
        }

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
