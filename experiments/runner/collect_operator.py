"""Impure: logs of someone who keeps a wheel-legged robot up by hand. `experiments.collect --operator` writes them."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env
from envs.locomotion import wheel_forward, wheel_legged
from envs.locomotion.wheel_operator import nominal_gain, operator
from envs.pools import real_env, real_worlds
from envs.rollout import play_episode
from experiments.runner.collect_args import ROBOTS, CollectArgs, targets, transitions_of
from experiments.runner.options import seed_list
from sgft_jax.datasets import logs
from sgft_jax.datasets.recording import Recorded, cut, of_episodes, write_table
from sgft_jax.files.disk import write_json
from sgft_jax.io import runs
from sgft_jax.stacking import member

_NAMES = ("v", "pitch", "pitch velocity", "torque")  # columns 1 to 4


def operate(args: CollectArgs) -> list[dict[str, Any]]:
    """The log of each seed; returns what the files hold."""
    env = envs.make("wheel-legged", args.impl)  # an operator sees where the robot is, whatever the task tells
    gap = gaps.load(env, args.real)
    env = real_env(env, [gap])
    pool = member(real_worlds(env, [gap], jax.random.key(0)), 0)
    policy, gain = operator(ROBOTS[args.task]), jnp.asarray(nominal_gain(), jnp.float32)
    act, length = functools.partial(policy.act, gain, explore=True), transitions_of(args)
    play = jax.jit(
        jax.vmap(lambda key: play_episode(env, pool, act, policy.init_carry(), key, gamma=1.0, length=length))
    )
    return [
        _write(args, env, path, _enough(play, length, seed))
        for path, seed in zip(targets(args), seed_list(args.seed, args.seeds), strict=True)
    ]


def _enough(play: Any, transitions: int, seed: int) -> list[Recorded]:
    """Episodes until there are transitions enough: a robot that has fallen is put up again."""
    key, episodes = jax.random.key(seed), []
    while sum(len(episode.reward) for episode in episodes) < transitions:
        key, key_now = jax.random.split(key)
        episodes += of_episodes(play(key_now[None]))
    return cut(episodes, transitions)


def _write(args: CollectArgs, env: Env, path: Path, episodes: list[Recorded]) -> dict[str, Any]:
    """The log and its card; says how it compares with what is published of the real one."""
    write_table(path, episodes, scale=wheel_legged.TORQUE)
    assert env.reward is not None
    log = logs.load_table(path, gamma=1.0, obs_dim=env.obs_dim, reward=jax.vmap(env.reward))
    rows, obs = log.rows, np.asarray(log.rows.obs)
    spread = [*obs[:, 1:].std(0), wheel_legged.TORQUE * np.asarray(rows.action).std()]
    rewards = {"moving": jax.vmap(wheel_forward.reward)(rows.obs[:, 1:], rows.action, rows.next_obs[:, 1:])}
    if not ROBOTS[args.task]:  # a robot that moves on has left its place
        rewards = {"standing": rows.reward, **rewards}
    facts = {
        **dataclasses.asdict(log.facts),
        "path": path.name,
        "std": dict(zip(_NAMES, map(float, spread), strict=True)),
        "reward": {name: float(np.mean(values)) for name, values in rewards.items()},
    }
    spreads = ", ".join(f"{name} {value:.3g}" for name, value in facts["std"].items())
    earned = ", ".join(f"{value:.2f} {name}" for name, value in facts["reward"].items())
    rows = f"{log.facts.transitions:,} transitions, {log.facts.terminal} falls"
    print(f"{path}: {rows}; std of {spreads}; reward of a step {earned}")
    write_json(path.with_suffix(".json"), {**facts, "real": args.real, "provenance": runs.provenance()})
    return facts
