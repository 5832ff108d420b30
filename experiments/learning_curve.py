"""Train TD-MPC2 from nothing on a public task, the way its authors do, and draw the curve next to theirs.

The task is cartpole swing-up of the DeepMind Control Suite. Random episodes come first, then an update for each of
their steps; from then on the planner plays an episode and as many updates follow. The authors update between the steps,
but from finished episodes alone, as here.
"""

import functools
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from sgft_jax.finetune_planner import make_planner

import envs
from envs.base import Env, World
from envs.control import cartpole
from envs.mujoco.worlds import Impl
from envs.rollout import Episode
from experiments import cli, stacking
from experiments.evaluation import play_episodes, score
from experiments.finetuning import Reals, make_program
from experiments.options import seed_list, seeds_name
from sgft_jax.analysis import plot
from sgft_jax.io import checkpoint, runs
from sgft_jax.io.log import EVAL, MetricsLog, RunProgress, read_jsonl, write_summary
from sgft_jax.learners import tdmpc2
from sgft_jax.methods import finetune_config, get_method
from sgft_jax.models import normalizer
from sgft_jax.types import Array, Key, PyTree, UserError

RETURN_MAX = 1000.0  # of an episode of the DeepMind Control Suite
HORIZON, REPLAY_CAPACITY = 3, 250_000
# Returns of TD-MPC2's authors, seeds 1 to 3, by control steps; their file counts frames, two to a step (issue #45).
# Source: github.com/nicklashansen/tdmpc2, results/cartpole-swingup.csv, commit b67b21c.
PUBLISHED_STEPS = (0, 50_000, 100_000, 150_000, 200_000, 250_000)
PUBLISHED = (
    (1.5, 860.5, 859.1, 864.4, 864.2, 866.0),
    (2.0, 789.8, 877.6, 879.1, 880.4, 882.0),
    (4.8, 867.9, 879.0, 877.4, 867.4, 880.2),
)
_RANDOM = 100  # a purpose of keys beside those of `finetuning`


@dataclass(frozen=True)
class LearningCurveArgs:
    """TD-MPC2 from nothing; the defaults are its authors'."""

    seed: int = 0
    """First seed."""
    seeds: int = 3
    """Seeds, all in one program."""
    steps: int = 50_000
    """Control steps per seed, each two frames; may grow later."""
    random_steps: int | None = None
    """Steps of random actions at the start; default: 1,000 or 5 episodes, whichever is more."""
    size: str = "5M"
    """TD-MPC2's networks by their published number of parameters: 1M, 5M, 19M, 48M or 317M."""
    plan_samples: int = 512
    """Sequences that a plan tries in each of its iterations."""
    batch_size: int = 256
    """Windows per update."""
    eval_every: int = 10
    """Episodes between evaluations, and checkpoints."""
    eval_episodes: int = 10
    """Episodes per evaluation and seed."""
    minutes: float | None = None
    """Stop after the first episode that ends later than this, with an evaluation; --resume goes on from there."""
    impl: Impl = "jax"
    """Who steps the physics: jax (the cart's motion in closed form), MuJoCo's C engine, or MuJoCo Warp."""
    resume: bool = False
    """Continue from the last checkpoint."""
    overwrite: bool = False
    """Replace what is there."""
    out: Path = Path("runs")
    """Parent of all run folders."""


def main(args: LearningCurveArgs) -> None:
    """Trains all seeds and draws their curve."""
    _check(args)
    seeds = seed_list(args.seed, args.seeds)
    env = cartpole.make(args.impl)
    run = runs.open_run(
        args.out / "learning_curve" / env.name / args.size / seeds_name(seeds),
        kind="learning_curve",
        config=args,
        resume=args.resume,
        overwrite=args.overwrite,
        volatile=("resume", "overwrite", "steps", "minutes", "out"),
    )
    try:
        _Run(args, env, seeds, run.folder).work()
    finally:
        run.close()


def discount(episode_length: int) -> float:
    """The authors' discount factor per step for episodes of that many steps."""
    return float(np.clip(1 - 5 / episode_length, 0.95, 0.995))


class _Run:
    """The impure part: what happens between compiled calls."""

    def __init__(self, args: LearningCurveArgs, env: Env, seeds: list[int], folder: Path) -> None:
        self.args, self.env, self.seeds, self.folder = args, env, seeds, folder
        length, gamma = env.episode_length, discount(env.episode_length)
        random = max(1000, 5 * length) if args.random_steps is None else args.random_steps
        self.random_episodes, self.episodes = max(random // length, 1), max(args.steps // length, 1)
        method = get_method("tdmpc2")._replace(fresh=True)
        config = finetune_config(
            method, horizon=HORIZON, size=args.size, plan_samples=args.plan_samples, batch_size=args.batch_size,
            gamma=gamma, replay_capacity=REPLAY_CAPACITY,
        )  # fmt: skip
        tuner = make_planner(method, config, obs_dim=env.obs_dim, act_dim=env.act_dim)
        self.program = make_program(env, tuner, gamma=gamma)
        self.collect_random = jax.jit(functools.partial(random_episodes, env, gamma=gamma, n=self.random_episodes))
        nominal = {p.name: p.nominal for p in env.parameters}
        self.pool = envs.sample_worlds(env, jax.random.key(0), 1, params=nominal, effects={"obs_noise": 0.0})
        self.reals = Reals(jax.tree.map(lambda x: x[None], self.pool), jnp.zeros(len(seeds), int))
        self.numbers = jnp.array(seeds, jnp.uint32)
        self.log, self.started = MetricsLog(folder, tensorboard=False), time.monotonic()
        self.late = False
        self.expect = {"kind": "learning_curve", "task": env.name, "seeds": seeds}

    def work(self) -> None:
        """Everything, in order."""
        state, done = self._start()
        length = self.env.episode_length
        total, title = self.episodes * length, f"TD-MPC2 {self.args.size} on {self.env.name}"
        with RunProgress(title, total=total, unit="steps", done=done * length) as progress:
            while done < self.episodes and not self.late:
                n = 1 if done else self.random_episodes
                state, shown = self._advance(state, done, n)
                done += n
                progress.advance(n * length, shown)
        if done < self.episodes:
            print(f"stopped after {self.args.minutes:g} minutes; the same command with --resume goes on")
        self.log.close()
        print(report(self.folder))

    def _start(self) -> tuple[PyTree, int]:
        """The state to continue from and the episodes behind it: a checkpoint's, or a fresh one."""
        still = normalizer.identity(self.env.obs_dim)  # observations as they are
        fresh = tdmpc2.TDMPC2Prior(None, None, None, None, None, still, jnp.float32(1))
        make = lambda: self.program.init(stacking.stack([fresh] * len(self.seeds)), self.numbers)  # noqa: E731
        if checkpoint.latest(self.folder) is None:
            self.log.truncate({})
            state = make()
            self._evaluate(state, 0)
            return state, 0
        state, meta = checkpoint.restore(self.folder, jax.eval_shape(make), expect=self.expect)
        self.log.truncate(meta["position"])
        return state, meta["episodes"]

    def _advance(self, state: PyTree, done: int, n: int) -> tuple[PyTree, dict[str, float]]:
        """The first N episodes, which are random, or one more, and as many updates as they have steps."""
        length, started = self.env.episode_length, time.perf_counter()
        if done:
            episodes = self.program.collect(state, self.reals, self.numbers, done, 1)
        else:
            episodes = self.collect_random(self.pool, stacking.seed_keys(self.seeds, _RANDOM))
        returns = np.asarray(episodes.total_reward).mean(1)
        collected = time.perf_counter()
        state, metrics = self.program.store(state, episodes), {}
        for part in range(done, done + n):  # one compiled program serves the first episodes and all later ones
            state, metrics = self.program.learn(state, self.numbers, part, length, None)
        done += n
        self.log.metrics(done * length, {"return": returns, **{name: np.asarray(x) for name, x in metrics.items()}})
        seconds = {"collect s": collected - started, "learn s": time.perf_counter() - collected}
        shown = {"return": float(returns.mean()), **seconds}
        minutes = self.args.minutes
        self.late = minutes is not None and time.monotonic() - self.started > 60 * minutes
        if done % self.args.eval_every == 0 or done >= self.episodes or self.late:
            shown["evaluation"] = self._evaluate(state, done)
            meta = {**self.expect, "episodes": done, "position": self.log.position()}
            checkpoint.save(self.folder, done, state, meta=meta)
        return state, shown

    def _evaluate(self, state: PyTree, done: int) -> float:
        played = self.program.evaluate(state, self.reals, self.numbers, self.args.eval_episodes)
        scores = jax.vmap(score)(played)
        self.log.eval(done * self.env.episode_length, scores)
        return float(scores["return"].mean())


def random_episodes(env: Env, pool: World, keys: Key, *, gamma: float, n: int) -> Episode:
    """Episodes [S, n] of uniformly random actions; keys: [S]."""

    def policy(carry: PyTree, obs: Array, key: Key) -> tuple[Array, PyTree]:
        return jax.random.uniform(key, (env.act_dim,), minval=-1.0, maxval=1.0), carry

    play = lambda key: play_episodes(env, pool, policy, (), jax.random.split(key, n), gamma=gamma)  # noqa: E731
    return jax.vmap(play)(keys)


def report(folder: Path) -> str:
    """Draws a run's curve with the published one, writes summary.json, and says in one line how they compare."""
    records = read_jsonl(folder / EVAL)
    steps, returns = np.array([r["step"] for r in records]), np.array([r["return"] for r in records]).T
    upto = int(np.searchsorted(PUBLISHED_STEPS, steps[-1], side="right"))  # points that the run has reached
    ours, theirs = returns[:, -1], np.array(PUBLISHED)[:, upto - 1]
    sides = {"ours": (steps[-1], ours), "published": (PUBLISHED_STEPS[upto - 1], theirs)}
    write_summary(folder, {k: {"steps": at, "mean": x.mean(), "seeds": x} for k, (at, x) in sides.items()})
    drawn = slice(upto + 1)
    path = plot.learning_curves(
        folder / "figures" / "return.png",
        {
            "sgft_jax": (steps, returns / RETURN_MAX),
            "published": (PUBLISHED_STEPS[drawn], np.array(PUBLISHED)[:, drawn] / RETURN_MAX),
        },
        title="TD-MPC2 from nothing on cartpole swing-up",
        quantity="return / 1,000",
        over="control steps",
    )
    words = (f"{k} {x.mean():.0f} ({x.min():.0f} to {x.max():.0f}) after {at:,}" for k, (at, x) in sides.items())
    return f"return: {', '.join(words)} control steps; {path}"


def _check(args: LearningCurveArgs) -> None:
    """Raises UserError for what is wrong in the arguments alone."""
    for name in ("steps", "batch_size", "eval_every", "eval_episodes"):
        if getattr(args, name) < 1:
            raise UserError(f"--{name.replace('_', '-')} is {getattr(args, name)}: must be at least 1")


if __name__ == "__main__":
    cli.run_main(main, LearningCurveArgs, __doc__ or "")
