"""Whether replays tell simulated systems apart, and how fast they are (docs/rules.md, "Which system is this?").

Systems are drawn from the prior over what is unknown of a real one. A prior's policy plays a few rollouts in each; then
the true system and many others from the prior replay them. Replays are not seeded alike: every system has its own keys.
"""

import functools
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.mujoco.worlds import choose_impl
from envs.rollout import play_episode
from envs.types import Array, Key
from experiments.runner import cli
from experiments.runner.cli import Json
from experiments.runner.options import Impl, Out, at_least_one, each_once, seed_list
from experiments.runner.progress import doing
from sgft_jax.algorithms import make_policy
from sgft_jax.api import load_prior, make_env
from sgft_jax.io.log import write_summary
from sgft_jax.posterior.candidates import candidates
from sgft_jax.posterior.replay import Rollout, replay, rollout_of

_BEATEN, _SYSTEMS = 0.9, 0.8  # gate 1: the truth beats so many draws, on so many systems


@dataclass(frozen=True)
class PosteriorArgs:
    """One study of replays."""

    tasks: tuple[str, ...] = ("push", "insert", "hammer")
    """Tasks; their shipped priors play."""
    systems: int = 10
    """Systems a task that are taken for real ones."""
    rollouts: int = 2
    """Rollouts in each of them."""
    draws: int = 1000
    """Other systems that replay the same rollouts."""
    states: int = 8
    """Expert: states of the filter."""
    seed: int = 0
    """Expert: another seed draws other systems."""
    impl: Impl = "auto"
    json: Json = False
    out: Out = Path("runs")


def main(args: PosteriorArgs) -> None:
    """Measures, prints and writes the numbers to <out>/posterior/summary.json."""
    at_least_one(args, "systems", "rollouts", "draws", "states")
    each_once(args, "tasks")
    seed_list(args.seed, 1)
    lines = [_task(args, task) for task in args.tasks]
    folder = args.out / "posterior"
    folder.mkdir(parents=True, exist_ok=True)
    summary = {"tasks": lines, "passed": all(line["passed"] for line in lines)}
    path = write_summary(folder, summary)
    print(json.dumps(summary) if args.json else f"written to {path}")


def _task(args: PosteriorArgs, task: str) -> dict[str, Any]:
    """Gate 1 on one task."""
    prior = load_prior(f"shipped:{task}/seed-0")
    env, base = make_env(prior), envs.make(task, choose_impl(args.impl))
    with doing(f"compiling worlds of {task}", 10):
        systems = candidates(base)
    key_systems, key_draws, key_play, key_replay = jax.random.split(jax.random.key(args.seed), 4)
    true, others = systems.draw(key_systems, args.systems), systems.draw(key_draws, args.draws)
    policy = make_policy(prior.card, env)

    def play(point: Array, key: Key) -> Rollout:
        key_world, key_episode = jax.random.split(key)
        pool = jax.tree.map(lambda x: x[None], systems.episode(point, key_world))
        act = functools.partial(policy.act, prior.params, explore=False)
        return rollout_of(env, play_episode(env, pool, act, policy.init_carry(), key_episode, gamma=1.0))

    def explain(point: Array, rollouts: Rollout, key: Key) -> tuple[Array, Array]:
        keys = jax.random.split(key, len(rollouts.success))
        evidence = jax.vmap(functools.partial(replay, base, systems, point, states=args.states))(rollouts, keys)
        return evidence.log_likelihood.sum(), evidence.success

    with doing(f"playing {args.systems * args.rollouts} rollouts", 20):
        keys = jax.random.split(key_play, (args.systems, args.rollouts))
        rollouts = jax.jit(jax.vmap(jax.vmap(play, (None, 0))))(true, keys)
    replayed = jax.jit(jax.vmap(explain, (0, None, 0)))
    beaten, right, seconds = [], [], []
    for number in range(args.systems):
        real = jax.tree.map(lambda x: x[number], rollouts)  # noqa: B023
        points = jnp.concatenate([true[number : number + 1], others])
        keys = jax.random.split(jax.random.fold_in(key_replay, number), len(points))
        begun = time.perf_counter()
        with doing(f"replaying in {len(points)} systems", 30, once=True):
            total, success = jax.device_get(replayed(points, real, keys))
        seconds.append(time.perf_counter() - begun)
        beaten.append(float((total[0] > total[1:]).mean()))
        right.append(float(np.where(real.success, success[0], 1.0 - success[0]).mean()))
        print(f"{task} {number}: the truth beats {beaten[-1]:.1%} of {args.draws} draws", flush=True)
    passed = float(np.mean(np.array(beaten) >= _BEATEN))
    steps = (args.draws + 1) * args.rollouts * args.states * base.episode_length * envs.scene(task).substeps
    line = {
        "task": task,
        "impl": base.impl,
        "systems": passed,
        "beaten": beaten,
        "outcome_right": float(np.mean(right)),
        "success": float(np.mean(rollouts.success)),
        "first_s": seconds[0],
        "replay_s": min(seconds),
        "steps_per_s": steps / min(seconds),
        "passed": passed >= _SYSTEMS,
    }
    print(f"{task}: the truth beats {_BEATEN:.0%} of the draws on {passed:.0%} of {args.systems} systems")
    print(f"    replays of the truth end as the rollout did: {line['outcome_right']:.0%}")
    print(f"    {line['steps_per_s'] / 1e6:.2f} million physics steps per second")
    return line


if __name__ == "__main__":
    cli.run_main(main, PosteriorArgs, __doc__ or "")
