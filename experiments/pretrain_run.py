"""Impure: one run of pretraining, what happens between compiled calls. `experiments.pretrain` is its command."""

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.base import Env, World
from envs.gaps import Gap
from envs.rollout import pick, pool_size
from experiments import hosts, stacking
from experiments.algorithms import describe_use, make_player
from experiments.evaluation import Best, Outcome, describe, grade, keep_better, score
from experiments.memory import reserve
from experiments.options import seed_list, seeds_name
from experiments.presets import PretrainConfig
from experiments.pretrain import PretrainArgs
from experiments.pretraining import PretrainState, make_pretrainer, memory, spread, spread_replay
from experiments.report import Report, make_report, numbers
from experiments.video import film
from experiments.worlds import heldout_worlds, load_gap, real_env, training_worlds
from sgft_jax import mesh
from sgft_jax.analysis import plot
from sgft_jax.io import checkpoint, runs
from sgft_jax.io.log import EVAL, MetricsLog, read_jsonl, write_summary
from sgft_jax.io.progress import Clock, RunProgress
from sgft_jax.types import Key, PyTree

_WORLDS, _RANDOM, _START, _REPORT = range(4)  # purposes, folded into a seed's key
_CUT = ("n_envs", "replay_capacity", "batch_size")  # sizes that devices share
_EXAM_SEED, _REPORT_SEED = 2**31, 2**31 + 1  # held-out worlds and episodes, the same for every run


class Saved(NamedTuple):
    """What a checkpoint holds, with a leading seeds axis: the run itself and the best policy so far."""

    run: PretrainState
    best: Best


class Program(NamedTuple):
    """Jitted functions over a leading seeds axis; `chunk` consumes the state it is given, the `spread` ones do, too.

    collect(pools, keys) -> random-action data. begin(pools, random, keys) -> Saved.
    spread_random(random), spread(saved): what was read from disk, laid out over the devices.
    chunk(pools, random, run) -> (run, metrics). grade(pool, key, priors) -> Outcome [seeds, eval_episodes].
    better(old, new, since) -> Best. report(pools, priors, keys) -> Report. extract(agents) -> priors.
    """

    collect: Callable[..., PyTree]
    begin: Callable[..., Saved]
    spread_random: Callable[[PyTree], PyTree]
    spread: Callable[[Saved], Saved]
    chunk: Any
    grade: Callable[..., Outcome]
    better: Callable[[Best, Best, float], Best]
    report: Callable[..., Report]
    extract: Callable[[PyTree], PyTree]


def run(args: PretrainArgs, seeds: list[int]) -> dict[str, Any]:
    """One run from (or back) to disk; returns its summary."""
    hosts.join(args.hosts)
    env = envs.make(args.task, args.impl)
    gap = load_gap(env, args.real, args.set)
    env = real_env(env, [gap] if gap else [])
    make_pretrainer(env, args.config)  # what does not fit is reported before anything is written
    devices = mesh.devices(args.devices, {f"--config.{n.replace('_', '-')}": getattr(args.config, n) for n in _CUT})
    home = run_folder(args, gap)
    with hosts.own(home) as folder, mesh.use(devices):
        reserve(memory(env, args.config), copies=args.seeds, devices=devices)
        opened = runs.open_run(
            folder,
            kind="pretrain",
            config=args,
            resume=args.resume,
            overwrite=args.overwrite,
            volatile=("resume", "overwrite", "devices", "hosts", "report", "video", "out"),
        )
        mesh.meet()  # nobody looks for checkpoints before the first host has emptied a folder that is to be replaced
        try:
            return _Run(args, env, gap, seeds, opened.folder, home).work()
        finally:
            opened.close()


def run_folder(args: PretrainArgs, gap: Gap | None) -> Path:
    """Where the run of these arguments lives; the seeds of one call share a folder."""
    where = args.preset if gap is None else f"{args.preset}-on-{gap.name}"
    seeds = seeds_name(seed_list(args.seed, args.seeds))
    return args.out / "pretrain" / envs.name_of(args.task) / where / seeds


def make_program(env: Env, config: PretrainConfig, *, seeds: int) -> Program:
    """The functions of a run of that many seeds."""
    trainer, player, gamma = make_pretrainer(env, config), make_player(describe_use(env, config), env), config.gamma
    extract = trainer.algorithm.extract

    def begin(pool: World, random: PyTree, key: Key) -> Saved:
        run = trainer.init(pool, random, key)
        return Saved(run, Best(extract(run.learner), jnp.float32(-1.0), jnp.float32(-jnp.inf), jnp.int32(0)))

    graded = functools.partial(grade, env, player, gamma=gamma, episodes=config.eval_episodes)
    report = functools.partial(make_report, env, player, gamma=gamma, trajectories=config.eval_episodes)
    return Program(
        collect=jax.jit(stacking.over_seeds(trainer.collect_random, seeds)),
        begin=jax.jit(stacking.over_seeds(begin, seeds)),
        spread_random=jax.jit(stacking.over_seeds(spread_replay, seeds), donate_argnums=0),
        spread=jax.jit(stacking.over_seeds(lambda x: x._replace(run=spread(x.run)), seeds), donate_argnums=0),
        chunk=jax.jit(stacking.over_seeds(trainer.chunk, seeds), donate_argnums=2),
        grade=jax.jit(stacking.over_seeds(graded, seeds, shared=2)),
        better=jax.jit(jax.vmap(keep_better, (0, 0, None))),
        report=jax.jit(stacking.over_seeds(report, seeds)),
        extract=extract,
    )


def prior_card(args: PretrainArgs, env: Env, gap: Gap | None, found: dict[str, Any]) -> dict[str, Any]:
    """What a prior says of itself; `found` are its numbers."""
    return {
        "task": env.name,
        **describe_use(env, args.config),
        "observation": [e._asdict() for e in env.observation],
        "action": [e._asdict() for e in env.action],
        "control_dt": env.control_dt,
        "episode_length": env.episode_length,
        "domain": [p._asdict() for p in env.parameters],
        "gap": None if gap is None else gap._asdict(),
        "preset": args.preset,
        "impl": env.impl,
        "chosen": f"the best evaluation on held-out worlds after {args.config.choose_from:.0%} of training: success, "
        "then return",
        "metrics": found,
        "provenance": runs.provenance(),
    }


class _Run:
    """The impure part: what happens between compiled calls.

    folder, home: for logs, and for checkpoints and priors; they differ on all but the first of several hosts.
    """

    def __init__(
        self, args: PretrainArgs, env: Env, gap: Gap | None, seeds: list[int], folder: Path, home: Path
    ) -> None:
        self.args, self.env, self.gap, self.seeds, self.folder = args, env, gap, seeds, folder
        self.home, self.config = home, args.config
        self.clock, self.log = Clock(), MetricsLog(folder)
        self.expect = {"kind": "pretrain", "task": env.name, "seeds": seeds}
        self.chunk_env_steps = self.config.n_envs * self.config.chunk_steps
        self.chunks = math.ceil(self.config.env_steps / self.chunk_env_steps)

    def work(self) -> dict[str, Any]:
        """Everything, in order."""
        with self.clock("worlds"):
            keys = stacking.seed_keys(self.seeds, _WORLDS)
            pools = [training_worlds(self.env, self.gap, key, self.config.worlds) for key in keys]
            self.pools = stacking.stack(pools)
            self.exam, self.final = (self._exam_worlds(seed) for seed in (_EXAM_SEED, _REPORT_SEED))
        self.program = make_program(self.env, self.config, seeds=len(self.seeds))
        self.random = self._random()
        saved, done = self._start()
        saved = self._train(saved, done)
        summary = self._hand_over(saved)
        self.log.close()
        return summary

    def _random(self) -> PyTree:
        """The random-action data: collected once, then read from disk."""
        collect = lambda: self.program.collect(self.pools, stacking.seed_keys(self.seeds, _RANDOM))  # noqa: E731
        folder = self.home / "random"
        if checkpoint.latest(folder) is not None:
            return self.program.spread_random(
                checkpoint.restore(folder, jax.eval_shape(collect), expect=self.expect)[0]
            )
        with self.clock("random"):
            random = jax.block_until_ready(collect())
        checkpoint.save(folder, 0, mesh.local(random), meta=self.expect)
        return random

    def _start(self) -> tuple[Saved, int]:
        """The state to continue from and the chunks behind it: a checkpoint's, or a fresh one."""
        begin = lambda: self.program.begin(self.pools, self.random, stacking.seed_keys(self.seeds, _START))  # noqa: E731
        if checkpoint.latest(self.home) is None:
            self.log.truncate({})
            with self.clock("start"):
                return jax.block_until_ready(begin()), 0
        saved, meta = checkpoint.restore(self.home, jax.eval_shape(begin), expect=self.expect)
        self.log.truncate(meta["position"])
        self.clock.seconds = meta["seconds"]
        return self.program.spread(saved), meta["chunks"]

    def _train(self, saved: Saved, done: int) -> Saved:
        """Chunk after chunk, with evaluations and checkpoints between them."""
        if done == 0:
            saved, _ = self._examine(saved, 0)
        if done == self.chunks:
            return saved
        with self.clock("compile"):
            chunk = self.program.chunk.lower(self.pools, self.random, saved.run).compile()
        title, total = f"pretrain {self.env.name}", self.chunks * self.chunk_env_steps
        with RunProgress(title, total=total, unit="env steps", done=done * self.chunk_env_steps) as progress:
            while done < self.chunks:
                with self.clock("train"):
                    run, metrics = chunk(self.pools, self.random, saved.run)
                    metrics = {name: np.asarray(x) for name, x in metrics.items()}
                saved, done = saved._replace(run=run), done + 1
                self.log.metrics(done * self.chunk_env_steps, metrics)
                shown = {name: float(metrics[name].mean()) for name in ("train/success", "train/reward")}
                if done % self.config.eval_every == 0 or done == self.chunks:
                    saved, scores = self._examine(saved, done)
                    shown |= {"success": float(scores["success"].mean()), "return": float(scores["return"].mean())}
                if done % self.config.checkpoint_every == 0 or done == self.chunks:
                    self._checkpoint(saved, done)
                progress.advance(self.chunk_env_steps, shown)
        return saved

    def _examine(self, saved: Saved, done: int) -> tuple[Saved, dict[str, np.ndarray]]:
        """Every evaluation plays the same episodes in the same held-out worlds."""
        prior = self.program.extract(saved.run.learner)
        with self.clock("evaluate"):
            outcome = self.program.grade(self.exam, jax.random.fold_in(jax.random.key(_EXAM_SEED), 1), prior)
            scores = {name: np.asarray(x) for name, x in jax.vmap(score)(outcome).items()}
        self.log.eval(done * self.chunk_env_steps, scores)
        now = Best(prior, jnp.asarray(scores["success"]), jnp.asarray(scores["return"]), saved.run.steps)
        since = self.config.choose_from * self.chunks * self.config.chunk_steps
        return saved._replace(best=self.program.better(saved.best, now, since)), scores

    def _final_exam(self, prior: PyTree) -> Outcome:
        """[seeds, >= report_episodes] new episodes in worlds that neither training nor the choice has seen."""
        rounds = math.ceil(self.config.report_episodes / self.config.eval_episodes)
        keys = jax.random.split(jax.random.fold_in(jax.random.key(_REPORT_SEED), 1), rounds)
        outcomes = [self.program.grade(self.final, key, prior) for key in keys]
        return jax.tree.map(lambda *x: np.concatenate(x, axis=1), *outcomes)

    def _exam_worlds(self, seed: int) -> World:
        return heldout_worlds(self.env, self.gap, jax.random.key(seed), self.config.eval_episodes)

    def _checkpoint(self, saved: Saved, done: int) -> None:
        meta = {**self.expect, "chunks": done, "position": self.log.position(), "seconds": self.clock.seconds}
        with self.clock("checkpoint"):
            checkpoint.save(self.home, done, mesh.local(saved), meta=meta)

    # ------------------------------------------------------------ what stays

    def _hand_over(self, saved: Saved) -> dict[str, Any]:
        """Priors with their cards, report, figures, summary, closing words."""
        with self.clock("report"):
            report = self._report(saved.best.prior) if self.args.report else None
            outcome = self._final_exam(saved.best.prior)
        results = []
        for i, seed in enumerate(self.seeds):
            best = stacking.member(saved.best, i)
            found = {"seed": seed, **describe(stacking.member(outcome, i)), **self._chosen(best)}
            if report is not None:
                found |= numbers(stacking.member(report, i))
                self._save_report(seed, stacking.member(report, i), i)
            checkpoint.save_prior(
                self.home / "prior" / f"seed-{seed}", best.prior, prior_card(self.args, self.env, self.gap, found)
            )
            results.append(found)
        summary = {
            "task": self.env.name,
            "preset": self.args.preset,
            "impl": self.env.impl,
            "gap": None if self.gap is None else self.gap._asdict(),
            "env_steps": self.chunks * self.chunk_env_steps,
            "updates": self.chunks * self.config.chunk_steps * self.config.updates_per_step,
            "seeds": results,
            **self.clock.record(),
        }
        write_summary(self.folder, summary)
        if self.args.video:
            print(self._film(saved.best.prior))
        self._say(results)
        return summary

    def _report(self, priors: PyTree) -> Report:
        """[seeds] measurements, as NumPy arrays."""
        keys = stacking.seed_keys(self.seeds, _REPORT)
        return jax.tree.map(np.asarray, self.program.report(self.pools, priors, keys))

    def _film(self, prior: PyTree) -> str:
        """The first seed's prior in one of the worlds of the final exam; the program is that of the exam."""
        one = pick(self.final, jnp.zeros(pool_size(self.final), int))
        qpos = np.asarray(self.program.grade(one, jax.random.key(_REPORT_SEED), prior).qpos[0, 0])
        return film(self.env, one.params[0], qpos, self.folder / "videos" / f"seed-{self.seeds[0]}.mp4")

    def _chosen(self, best: Best) -> dict[str, float]:
        """Which evaluation the prior is from, and what that evaluation said."""
        steps = int(best.steps) * self.config.n_envs
        return {"best/env_steps": steps, "best/success": float(best.success), "best/return": float(best.total)}

    def _save_report(self, seed: int, report: Report, i: int) -> None:
        """The arrays behind the figure, and the figure."""
        curve = read_jsonl(self.folder / EVAL)
        some = np.flatnonzero(report.counts)[:: max(1, report.counts.sum() // 2000)]  # points that a figure can show
        (self.folder / "report").mkdir(exist_ok=True)
        np.savez(self.folder / "report" / f"seed-{seed}.npz", allow_pickle=False, **report._asdict())
        if not some.size:
            return  # every trajectory exploded: there is nothing to draw
        plot.pretraining(
            self.folder / "figures" / f"seed-{seed}.png",
            title=f"pretraining {self.env.name}, preset {self.args.preset}, seed {seed}",
            steps=[line["step"] for line in curve],
            success=[line["success"][i] for line in curve],
            returns=[line["return"][i] for line in curve],
            value=report.values[some],
            monte_carlo=report.returns[some],
            dynamics_error=report.model_error,
            baseline_error=report.still_error,
        )

    def _say(self, results: list[dict[str, Any]]) -> None:
        for found in results:
            low, high = found["success/interval"]
            success = f"{found['success']:.3f} [{low:.3f}, {high:.3f}]"
            line = f"seed {found['seed']}: success {success} in {found['episodes']} fresh episodes"
            if "value/explained_variance" in found:
                line += f"; V_sim explains {found['value/explained_variance']:.2f} of the variance of returns, "
                line += f"rank correlation {found['value/rank_correlation']:.2f}, bias {found['value/bias']:+.2f}"
            print(line)
        print(f"results: {self.folder}  (prior/, summary.json, figures/)")
        method = " --method sgft-tdmpc2" if self.config.algorithm == "tdmpc2" else ""
        print(f"next: python -m experiments.finetune --task {self.args.task}{method} --prior {self.folder}")
