"""Impure: pictures and videos of stored rollouts. `experiments.replay` is their command."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

import envs
from envs import gaps
from envs.base import Entry, Env
from envs.pools import real_env, real_worlds
from experiments.runner.rollouts import check_sizes
from experiments.runner.video import film
from sgft_jax.analysis import figures
from sgft_jax.analysis.figures import Panel
from sgft_jax.io.real import Played
from sgft_jax.io.runs import read_config

_WORDY = 5  # rollouts that have room for more than their numbers


def draw(home: Path, task: str, episodes: Sequence[Played], out: Path, *, video: bool) -> list[str]:
    """A plot of all these rollouts, and a video of each; says in a line for each where it is, or why there is none."""
    env = envs.make(task)
    check_sizes(home, episodes, env)
    seed, numbers = episodes[0].seed, [own.number for own in episodes]
    path = out / f"seed-{seed}-rollout-{'-'.join(map(str, numbers))}.png"
    ends = np.cumsum([len(own.rows["reward"]) for own in episodes]) * env.control_dt
    words = [f"rollout {own.number}: {'success' if own.success else 'failure'}" for own in episodes]
    if len(episodes) > _WORDY:
        words = [str(own.number) for own in episodes]
    title = f"{env.name}: real rollouts of seed {seed}"
    figures.rollouts(path, panels(env, episodes), dict(zip(words, ends.tolist(), strict=True)), title=title)
    return [f"picture: {path}", *([_video(home, task, own, out) for own in episodes] if video else [])]


def panels(env: Env, episodes: Sequence[Played]) -> list[Panel]:
    """What sensors said, what was commanded and sent, and the reward, over the time of all episodes."""
    rows = [own.rows for own in episodes]
    states = _joined([np.concatenate([own["obs"], own["next_obs"][-1:]])[:, : env.measured_dim] for own in rows])
    sent, reward = (_joined([_held(own[name]) for own in rows]) for name in ("action", "reward"))
    commands = [own.command for own in episodes if own.command is not None]
    command = _joined([_held(own) for own in commands]) if len(commands) == len(episodes) else None
    time = _joined([np.arange(len(own["reward"]) + 1.0) for own in rows])[:, 0]
    begun = np.concatenate([[0], np.cumsum([len(own["reward"]) for own in rows])[:-1]])
    time = (time + np.repeat(begun, [len(own["reward"]) + 2 for own in rows])) * env.control_dt
    sensors = [Panel(e.name, e.unit, time, _lines(e, own)) for e, own in _of_entries(env.measured, states)]
    actions = [
        Panel(f"{e.name}, sent", e.unit, time, _lines(e, own), held=True) for e, own in _of_entries(env.action, sent)
    ]
    if command is not None:
        asked = [_lines(e, own) for e, own in _of_entries(env.action, command)]
        actions = [
            replace(panel, name=f"{panel.name}; dotted: commanded", dotted=own)
            for panel, own in zip(actions, asked, strict=True)
        ]
    return [*sensors, *actions, Panel("reward", "", time, {"reward": reward[:, 0]}, held=True)]


def _of_entries(entries: Sequence[Entry], values: np.ndarray) -> list[tuple[Entry, np.ndarray]]:
    """Every entry with its columns of values [N, dim]."""
    borders = np.cumsum([e.size for e in entries])[:-1]
    return list(zip(entries, np.split(values, borders, axis=1), strict=True))


def _lines(entry: Entry, values: np.ndarray) -> dict[str, np.ndarray]:
    """A line for each number of an entry, by its place. values: [N, size]."""
    return {f"[{i}]": values[:, i] for i in range(entry.size)}


def _held(values: np.ndarray) -> np.ndarray:
    """[T + 1, k] of what is in force during T steps, [T] or [T, k]: the last one stays to the end."""
    values = values.reshape(len(values), -1)
    return np.concatenate([values, values[-1:]])


def _joined(each: Sequence[np.ndarray]) -> np.ndarray:
    """[N, k] of episodes [T + 1, k], or [T + 1], with a row of nan behind each, where a line has its gap."""
    rows = [own.reshape(len(own), -1) for own in each]
    return np.concatenate([x for own in rows for x in (own, np.full((1, own.shape[1]), np.nan))])


def _video(home: Path, task: str, own: Played, out: Path) -> str:
    """Films a rollout in the world in which it took place."""
    config = read_config(home)
    if own.trace.size == 0:
        return f"no video of rollout {own.number}: its states were not stored; a simulated real system leaves them"
    if any(config.get(name) is None for name in ("impl", "real", "set")):
        return f"no video of rollout {own.number}: {home} does not say in which gap it was played"
    env = envs.make(task, config["impl"])
    gap = gaps.load(env, config["real"], config["set"])
    env = real_env(env, [gap])
    worlds = real_worlds(env, [gap], jax.random.key(0)).theta.params[0]
    # A gap that was played beside others shares their size of a pool: what does not vary is repeated in it.
    theta = worlds[own.world % len(worlds)]
    states = own.trace[: len(own.rows["reward"]) + 1]
    return film(env, theta, states, out / "videos" / f"seed-{own.seed}-rollout-{own.number}.mp4")
