"""Impure: films of episodes, and one line that says where they are or why there is none."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import envs
from envs.base import Env, World
from envs.rollout import Episode
from envs.types import Array
from experiments.runner import cli


def before_and_after(env: Env, pool: World, play: Callable[[], Sequence[Episode]], path: Path, *, rollouts: int) -> str:
    """Films the same start in the same real world twice and says in one line where, or why there is no video.

    play() -> one episode in a world of `pool` before and the same after `rollouts` real rollouts. Never raises for want
    of a scene, a graphics library or an encoder: a run does not fail for a picture.
    """

    def render(scene: Any) -> None:
        from envs.mujoco.render import render_side_by_side

        episodes = play()
        qpos = [np.asarray(episode.trace) for episode in episodes]
        captions = [
            f"{name}: {'success' if episode.success else 'failure'}"
            for name, episode in zip(("before fine-tuning", f"after {rollouts} real rollouts"), episodes, strict=True)
        ]
        theta = np.asarray(pool.theta.params[episodes[0].world]).tolist()
        render_side_by_side(scene, [theta, theta], qpos, captions, path)

    return _draw(env, path, render)


def film(env: Env, theta: Array, qpos: np.ndarray, path: Path) -> str:
    """Renders an episode, qpos [T + 1, nq], in a world with domain parameters theta; says in one line how it went."""

    def render(scene: Any) -> None:
        from envs.mujoco.render import render_episode

        render_episode(scene, np.asarray(theta).tolist(), qpos, path)

    return _draw(env, path, render)


def film_episode(env: Env, pools: World, i: int, played: Episode, path: Path) -> str:
    """Renders one episode in a world of the i-th of stacked pools; see `film`."""
    return film(env, pools.theta.params[i, played.world], np.asarray(played.trace), path)


def _draw(env: Env, path: Path, render: Callable[[Any], None]) -> str:
    """Calls `render` with the scene of the task, and says in one line where the video is, or why there is none."""
    scene = envs.scene(env.name, env.scene)
    if scene is None:
        return f"no video: {env.name} has no scene to draw"
    if reason := cli.select_renderer():
        return f"no video: {reason}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        render(scene)
    except Exception as error:  # whatever a graphics driver or a video encoder raises
        return f"no video: {(str(error).strip() or type(error).__name__).splitlines()[0]}"
    return f"video: {path}"
