"""Which system is this? What replays of real rollouts tell, on systems that are known (docs/rules.md).

Systems are drawn from the prior over what is unknown of a real one, and a prior's policy plays a few rollouts in each.
gate: the true system and many others from the prior replay them. calibrate: particles of the posterior, at one exponent
of the likelihood after the other: how often they cover the truth, how far they narrow it, and what the policy that is
chosen under them promises and does; beside it, what is chosen without data.
"""

import functools
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.base import Env, World
from envs.mujoco.worlds import choose_impl
from envs.rollout import Episode, play_episode
from envs.types import Array, Key, PyTree
from experiments.runner import cli
from experiments.runner.cli import Json
from experiments.runner.options import Impl, Out, at_least_one, each_once, seed_list
from experiments.runner.progress import doing
from sgft_jax.algorithms import make_policy
from sgft_jax.analysis import tables
from sgft_jax.io.log import write_summary
from sgft_jax.io.priors import load_prior, observed
from sgft_jax.models.distortion import none
from sgft_jax.posterior.candidates import Candidates, candidates
from sgft_jax.posterior.decision import Decision, correction, decide
from sgft_jax.posterior.replay import Rollout, likelihood, replays, rollout_of
from sgft_jax.posterior.smc import Likelihood, Particles, begin, sample
from sgft_jax.stacking import join, member, stack

_BEATEN, _SYSTEMS = 0.9, 0.8  # gate 1: the truth beats so many draws, on so many systems
EXPONENTS = (0.01, 0.02, 0.05, 0.1, 0.2)
_CANDIDATES, _JUDGES = 24, 32  # particles whose corrections are tried, and particles that they are tried in
_EPISODES, _PLAYED = 4, 50  # of a candidate in a particle, and of the chosen one in the true system


@dataclass(frozen=True)
class PosteriorArgs:
    """One study of replays."""

    parts: tuple[Literal["gate", "calibrate"], ...] = ("gate",)
    """What to measure; the head of this help explains it."""
    tasks: tuple[str, ...] = ("push", "insert", "hammer")
    """Tasks; their shipped priors play."""
    systems: int = 10
    """Systems a task that are taken for real ones."""
    rollouts: tuple[int, ...] = (2,)
    """Rollouts in each of them, one study for each number."""
    draws: int = 1000
    """Other systems that replay the same rollouts, for gate."""
    particles: int = 128
    """Particles of the posterior, for calibrate."""
    states: int = 8
    """Expert: states of the filter."""
    seed: int = 0
    """Expert: another seed draws other systems."""
    impl: Impl = "auto"
    json: Json = False
    out: Out = Path("runs")


class Setup(NamedTuple):
    """A task whose systems are known. true: [G, d] systems. rollouts: [G, K] in each.

    env: with the observations of the prior's policy. simulator: without what they hold beside measurements.
    play(distortion, world, key) -> an episode of the prior's policy behind a correction.
    """

    env: Env
    simulator: Env
    systems: Candidates
    play: Callable[[PyTree, World, Key], Episode]
    true: Array
    rollouts: Rollout


def main(args: PosteriorArgs) -> None:
    """Measures, prints and writes the numbers to <out>/posterior/summary.json."""
    at_least_one(args, "systems", "rollouts", "draws", "particles", "states")
    each_once(args, "parts", "tasks", "rollouts")
    seed_list(args.seed, 1)
    folder = args.out / "posterior"
    summary: dict[str, Any] = {part: [] for part in args.parts}
    for task in args.tasks:
        for count in args.rollouts:
            setup = _set_up(args, task, count)
            for part in args.parts:
                lines = {"gate": _gate, "calibrate": _calibrate}[part](args, setup)
                summary[part] += [{"task": task, "rollouts": count} | line for line in lines]
                folder.mkdir(parents=True, exist_ok=True)
                write_summary(folder, summary)
    if args.json:
        print(json.dumps(summary))
        return
    for lines in summary.values():
        print(_table(lines))
    print(f"numbers: {folder / 'summary.json'}")


def _set_up(args: PosteriorArgs, task: str, count: int) -> Setup:
    """The task, its systems and what is played in them."""
    prior = load_prior(f"shipped:{task}/seed-0")
    impl = choose_impl(args.impl)
    env, simulator = envs.make(task, impl, **observed(prior.card)), envs.make(task, impl)
    policy = make_policy(prior.card, env)
    with doing(f"compiling the simulator and worlds of {task}", 40, once=True):
        simulator.prepare()
        systems = candidates(simulator)
    key_systems, key_play = jax.random.split(jax.random.key(args.seed))
    true = systems.draw(key_systems, args.systems)

    def play(distortion: PyTree, world: World, key: Key) -> Episode:
        act = functools.partial(policy.act, prior.params._replace(distortion=distortion), explore=False)
        return play_episode(env, jax.tree.map(lambda x: x[None], world), act, policy.init_carry(), key, gamma=1.0)

    def record(point: Array, key: Key) -> Rollout:
        key_world, key_episode = jax.random.split(key)
        return rollout_of(env, play(None, systems.episode(point, key_world), key_episode))

    with doing(f"playing {args.systems * count} rollouts", 20):
        keys = jax.random.split(key_play, (args.systems, count))
        rollouts = jax.jit(jax.vmap(jax.vmap(record, (None, 0))))(true, keys)
    return Setup(env, simulator, systems, play, true, rollouts)


def _gate(args: PosteriorArgs, setup: Setup) -> list[dict[str, Any]]:
    """Gate 1 on one task."""
    key_draws, key_replay = jax.random.split(jax.random.key(args.seed + 1))
    others = setup.systems.draw(key_draws, args.draws)

    def explain(point: Array, rollouts: Rollout, key: Key) -> tuple[Array, Array]:
        evidence = replays(setup.simulator, setup.systems, point, rollouts, key, states=args.states)
        return evidence.log_likelihood.sum(), evidence.success

    replayed = jax.jit(jax.vmap(explain, (0, None, 0)))
    beaten, right, seconds = [], [], []
    for number in range(args.systems):
        real = member(setup.rollouts, number)
        points = jnp.concatenate([setup.true[number : number + 1], others])
        keys = jax.random.split(jax.random.fold_in(key_replay, number), len(points))
        begun = time.perf_counter()
        with doing(f"replaying in {len(points)} systems", 30, once=True):
            total, success = jax.device_get(replayed(points, real, keys))
        seconds.append(time.perf_counter() - begun)
        beaten.append(float((total[0] > total[1:]).mean()))
        right.append(float(np.where(real.success, success[0], 1.0 - success[0]).mean()))
    simulator, passed = setup.simulator, float(np.mean(np.array(beaten) >= _BEATEN))
    count = (args.draws + 1) * setup.rollouts.success.shape[1] * args.states
    steps = count * simulator.episode_length * envs.scene(simulator.name).substeps
    return [
        {
            "systems passed": passed,
            "least beaten": min(beaten),
            "outcome right": float(np.mean(right)),
            "success": float(np.mean(setup.rollouts.success)),
            "first s": seconds[0],
            "replay s": min(seconds),
            "steps per s": steps / min(seconds),
            "passed": passed >= _SYSTEMS,
        }
    ]


def _calibrate(args: PosteriorArgs, setup: Setup) -> list[dict[str, Any]]:
    """A line for the prior and for each exponent."""
    keys = jax.random.split(jax.random.key(args.seed + 2), args.systems)
    points = jax.vmap(lambda key: setup.systems.draw(key, args.particles))(keys)

    def explain(rollouts: Rollout) -> Likelihood:
        return likelihood(setup.simulator, setup.systems, rollouts, states=args.states)

    first = jax.jit(jax.vmap(lambda rollouts, points, key: begin(explain(rollouts), points, key)))
    further = jax.jit(
        jax.vmap(lambda rollouts, *rest: sample(explain(rollouts), *rest[:2], exponent=rest[2]), (0, 0, 0, None))
    )
    judged = jax.jit(jax.vmap(functools.partial(_decide, setup)))
    lines, begun = [], time.perf_counter()
    with doing("replaying in the systems of the prior", 30, once=True):
        particles = jax.block_until_ready(first(setup.rollouts, points, keys))
    for exponent in (0.0, *EXPONENTS):
        if exponent:
            with doing(f"sampling the posterior with exponent {exponent}", 60):
                particles = further(setup.rollouts, particles, keys, jnp.float32(exponent))
                particles = jax.block_until_ready(particles)
        seconds = time.perf_counter() - begun
        with doing("playing in particles what may be deployed", 30, once=True):
            decision, played = jax.device_get(judged(particles.points, setup.true, keys))
        lines.append(_line(setup, particles, decision, played, exponent, seconds))
        print(_table(lines[-1:]), file=sys.stderr, flush=True)
        begun = time.perf_counter()
    return lines


def _decide(setup: Setup, points: Array, true: Array, key: Key) -> tuple[Decision, Array]:
    """What is chosen under particles [n, d], and the success [2] of the prior and of that in the true system."""
    key_decide, key_played = jax.random.split(key)
    undo = jax.vmap(lambda point: correction(setup.env, setup.systems.unknowns, point))
    tried = undo(points[:_CANDIDATES])
    acting = join([stack([none(setup.env.act_dim, setup.env.measured_dim)]), tried])

    def success(distortion: PyTree, world: World, key: Key) -> Array:
        return setup.play(distortion, world, key).success

    judges = points[-_JUDGES:]
    decision = decide(success, acting, setup.systems, judges, key_decide, episodes=_EPISODES)

    def play(number: Array, key: Key) -> Array:
        key_world, key_play = jax.random.split(key)
        return success(member(acting, number), setup.systems.episode(true, key_world), key_play)

    keys = jax.random.split(key_played, _PLAYED)
    of_both = jax.vmap(jax.vmap(play, (None, 0)), (0, None))(
        jnp.stack([jnp.zeros_like(decision.chosen), decision.chosen]), keys
    )
    return decision, of_both.mean(axis=1)


def _line(
    setup: Setup, particles: Particles, decision: Decision, played: np.ndarray, exponent: float, seconds: float
) -> dict[str, Any]:
    """What particles [G, n] say of the true systems [G]."""
    points, true = np.asarray(particles.points), np.asarray(setup.true)
    below = (points < true[:, None]).mean(axis=1)
    inside = (below > 0.1) & (below < 0.9)
    mean, std = points.mean(axis=1), np.maximum(points.std(axis=1), 1e-3)
    score = -0.5 * ((true - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)
    gain = decision.promised - played[:, 1]
    return {
        "exponent": exponent,
        "inside 80": float(inside.mean()),
        "least inside": float(inside.mean(axis=0).min()),
        "log score": float(np.clip(score, -20.0, None).mean()),
        "std": float(std.mean() * 12**0.5),
        "ancestors": float(np.mean([len(np.unique(x)) for x in np.asarray(particles.ancestor)])),
        "acceptance": float(np.mean(particles.acceptance)),
        "stages": int(np.max(particles.stages)),
        "zero-shot": float(played[:, 0].mean()),
        "played": float(played[:, 1].mean()),
        "promised": float(np.mean(decision.promised)),
        "overestimate": float(gain.mean()),
        "worst fall": float((played[:, 0] - played[:, 1]).max()),
        "seconds": seconds,
        "by unknown": {
            f"{u.name}[{u.index}]": [float(inside[:, i].mean()), float(std[:, i].mean() * 12**0.5)]
            for i, u in enumerate(setup.systems.unknowns)
        },
    }


def _table(lines: list[dict[str, Any]]) -> str:
    """The numbers of lines, which all have the same."""
    rows = [{name: x for name, x in line.items() if not isinstance(x, dict)} for line in lines]
    cells = [[f"{x:.3g}" if isinstance(x, float) else str(x) for x in row.values()] for row in rows]
    return tables.markdown(list(rows[0]), cells)


if __name__ == "__main__":
    cli.run_main(main, PosteriorArgs, __doc__ or "")
