"""Impure: plots and videos of stored rollouts, films of episodes, and one line that says where they are, or why not."""

import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

import envs
from envs import gaps
from envs.base import Entry, Env, World
from envs.rollout import Episode, real_env, real_worlds
from envs.types import Array
from experiments.runner.options import check_sizes
from experiments.runner.progress import doing
from sgft_jax.analysis import figures
from sgft_jax.analysis.figures import Panel
from sgft_jax.io.real import Played
from sgft_jax.io.runs import read_config

_WORDY = 5  # rollouts that have room for more than their numbers


# --- films of episodes ------------------------------------------------------------------------------------------------


def before_and_after(env: Env, pool: World, play: Callable[[], Sequence[Episode]], path: Path, *, rollouts: int) -> str:
    """Films the same start in the same real world twice and says in one line where, or why there is no video.

    play() -> episodes [n] in worlds of `pool` of the policy before and of that after `rollouts` real rollouts. The
    first one that only the latter solves is filmed: what fine-tuning is about. Without one, the first. Never raises for
    want of a scene, a graphics library or an encoder: a run does not fail for a picture.
    """

    def render(scene: Any) -> None:
        from envs.mujoco.render import render_side_by_side

        both = play()
        first = telling(*(np.asarray(episodes.success) for episodes in both))
        both = [jax.tree.map(lambda x: np.asarray(x[first]), episodes) for episodes in both]
        captions = [
            f"{name}: {outcome(env, episode.success, episode.total_reward)}"
            for name, episode in zip(("before fine-tuning", f"after {rollouts} real rollouts"), both, strict=True)
        ]
        theta = np.asarray(pool.theta.params[both[0].world]).tolist()
        render_side_by_side(scene, [theta, theta], [episode.trace for episode in both], captions, path)

    return _draw(env, path, render)


def outcome(env: Env, success: Any, earned: Any) -> str:
    """How an episode ended, in words of what the task is judged by. earned: the sum of its rewards."""
    if env.score == "return":
        return f"return {float(earned):.3g}"
    return "success" if success else "failure"


def telling(before: np.ndarray, after: np.ndarray) -> int:
    """Which episode to show, of successes before and after, [n] bool: the first that was mended, else the first."""
    return int(np.argmax(~before & after))


def film_episode(env: Env, pools: World, i: int, played: Episode, path: Path) -> str:
    """Renders one episode in a world of the i-th of stacked pools; says in one line how it went."""
    return _film(env, pools.theta.params[i, played.world], np.asarray(played.trace), path)


def _film(env: Env, theta: Array, qpos: np.ndarray, path: Path) -> str:
    """Renders an episode, qpos [T + 1, nq], in a world with domain parameters theta."""

    def render(scene: Any) -> None:
        from envs.mujoco.render import render_episode

        render_episode(scene, np.asarray(theta).tolist(), qpos, path)

    return _draw(env, path, render)


def _draw(env: Env, path: Path, render: Callable[[Any], None]) -> str:
    """Calls `render` with the scene of the task, and says in one line where the video is, or why there is none."""
    scene = envs.scene(env.name, env.scene)
    if scene is None:
        return f"no video: {env.name} has no scene to draw"
    if reason := select_renderer():
        return f"no video: {reason}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with doing("rendering a video", 15):
            render(scene)
    except Exception as error:  # whatever a graphics driver or a video encoder raises
        return f"no video: {(str(error).strip() or type(error).__name__).splitlines()[0]}"
    return f"video: {path}"


def select_renderer() -> str | None:
    """Make MuJoCo able to render without a screen by setting MUJOCO_GL; None on success, else one line why not.

    Call it only if pictures are wanted: it tries egl and osmesa, each in a process of its own, because a failed attempt
    cannot be undone. A value that the user has set is tried alone.
    """
    chosen = os.environ.get("MUJOCO_GL")
    reasons = []
    for backend in [chosen] if chosen else ["egl", "osmesa"]:
        reason = _probe(backend)
        if reason is None:
            os.environ["MUJOCO_GL"] = backend
            if module := sys.modules.get("mujoco.rendering.classic.gl_context"):
                importlib.reload(module)  # MuJoCo was imported already and has read the old value
            return None
        reasons.append(f"{backend}: {reason}")
    return f"MuJoCo cannot render here ({'; '.join(reasons)}); install libegl1 or libosmesa6"


def _probe(backend: str) -> str | None:
    """None if MuJoCo makes an off-screen context with this backend, else the last line it said."""
    code = "import mujoco; c = mujoco.GLContext(16, 16); c.make_current(); c.free()"
    command, environment = [sys.executable, "-c", code], {**os.environ, "MUJOCO_GL": backend}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        return "no answer within 60 s"
    if done.returncode == 0:
        return None
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    return lines[-1].strip()[:120] if lines else f"exit code {done.returncode}"


# --- stored rollouts --------------------------------------------------------------------------------------------------


def draw(home: Path, task: str, episodes: Sequence[Played], out: Path, *, video: bool) -> list[str]:
    """A plot of all these rollouts, and a video of each; says in a line for each where it is, or why there is none."""
    env = envs.make(task)
    check_sizes(home, episodes, env)
    seed, numbers = episodes[0].seed, [str(episode.number) for episode in episodes]
    path = out / f"seed-{seed}-rollout-{'-'.join(numbers)}.png"
    ends = np.cumsum([len(episode.rows.reward) for episode in episodes]) * env.control_dt
    words = [f"rollout {e.number}: {outcome(env, e.success, np.sum(e.rows.reward))}" for e in episodes]
    words, title = numbers if len(episodes) > _WORDY else words, f"{env.name}: real rollouts of seed {seed}"
    figures.rollouts(path, panels(env, episodes), dict(zip(words, ends.tolist(), strict=True)), title=title)
    return [f"picture: {path}", *(_video(home, task, episode, out) for episode in episodes if video)]


def panels(env: Env, episodes: Sequence[Played]) -> list[Panel]:
    """What sensors said, what was commanded and sent, and the reward, over the time of all episodes."""
    rows = [episode.rows for episode in episodes]
    states = _joined([np.concatenate([x.obs, x.next_obs[-1:]])[:, : env.measured_dim] for x in rows])
    sent, reward = (_joined([_held(getattr(x, name)) for x in rows]) for name in ("action", "reward"))
    commands = [_held(episode.command) for episode in episodes if episode.command is not None]
    begun = np.cumsum([0, *(len(x.reward) for x in rows)])
    time = _joined([start + np.arange(len(x.reward) + 1.0) for start, x in zip(begun[:-1], rows, strict=True)])
    time = time[:, 0] * env.control_dt
    sensors = [Panel(e.name, e.unit, time, lines) for e, lines in _of_entries(env.measured, states)]
    actions = [Panel(f"{e.name}, sent", e.unit, time, x, held=True) for e, x in _of_entries(env.action, sent)]
    if len(commands) == len(episodes):
        actions = [
            replace(panel, name=f"{panel.name}; dotted: commanded", dotted=lines)
            for panel, (_, lines) in zip(actions, _of_entries(env.action, _joined(commands)), strict=True)
        ]
    return [*sensors, *actions, Panel("reward", "", time, {"reward": reward[:, 0]}, held=True)]


def _of_entries(entries: Sequence[Entry], values: np.ndarray) -> list[tuple[Entry, dict[str, np.ndarray]]]:
    """Every entry with a line for each of its numbers, by its place. values: [N, dim]."""
    parts = np.split(values, np.cumsum([e.size for e in entries])[:-1], axis=1)
    return [(e, {f"[{i}]": x for i, x in enumerate(part.T)}) for e, part in zip(entries, parts, strict=True)]


def _held(values: np.ndarray) -> np.ndarray:
    """[T + 1, k] of what is in force during T steps, [T] or [T, k]: the last one stays to the end."""
    values = values.reshape(len(values), -1)
    return np.concatenate([values, values[-1:]])


def _joined(episodes: Sequence[np.ndarray]) -> np.ndarray:
    """[N, k] of episodes [T + 1, k], or [T + 1], with a row of nan behind each, where a line has its gap."""
    rows = [values.reshape(len(values), -1) for values in episodes]
    return np.concatenate([np.pad(values, ((0, 1), (0, 0)), constant_values=np.nan) for values in rows])


def _video(home: Path, task: str, episode: Played, out: Path) -> str:
    """Films a rollout in the world in which it took place."""
    config = read_config(home)
    if episode.trace.size == 0:
        return f"no video of rollout {episode.number}: its states were not stored; a simulated real system leaves them"
    if any(config.get(name) is None for name in ("impl", "real", "set")):
        return f"no video of rollout {episode.number}: {home} does not say in which gap it was played"
    env = envs.make(task, config["impl"])
    gap = gaps.load(env, config["real"], config["set"])
    env = real_env(env, [gap])
    worlds = real_worlds(env, [gap], jax.random.key(0)).theta.params[0]
    # A gap that was played beside others shares their size of a pool: what does not vary is repeated in it.
    theta = worlds[episode.world % len(worlds)]
    states = episode.trace[: len(episode.rows.reward) + 1]
    return _film(env, theta, states, out / "videos" / f"seed-{episode.seed}-rollout-{episode.number}.mp4")
