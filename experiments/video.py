"""Impure: one real episode of a policy before and after fine-tuning, rendered side by side."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import envs
from envs.base import Env, World
from envs.rollout import Episode
from experiments import cli


def before_and_after(env: Env, pool: World, play: Callable[[], Sequence[Episode]], path: Path, *, rollouts: int) -> str:
    """Films the same start in the same real world twice and says in one line where, or why there is no video.

    play() -> one episode in a world of `pool` before and the same after `rollouts` real rollouts. Never raises for want
    of a scene, a graphics library or an encoder: a run does not fail for a picture.
    """
    scene = envs.scene(env.name, env.scene)
    if scene is None:
        return f"no video: {env.name} has no scene to draw"
    if reason := cli.select_renderer():
        return f"no video: {reason}"
    from envs.mujoco.render import render_side_by_side

    episodes = play()
    qpos = [np.asarray(episode.trace) for episode in episodes]
    captions = [
        f"{name}: {'success' if episode.success else 'failure'}"
        for name, episode in zip(("before fine-tuning", f"after {rollouts} real rollouts"), episodes, strict=True)
    ]
    theta = np.asarray(pool.theta.params[episodes[0].world]).tolist()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        render_side_by_side(scene, [theta, theta], qpos, captions, path)
    except Exception as error:  # whatever a graphics driver or a video encoder raises
        said = (str(error).strip() or type(error).__name__).splitlines()[0]
        return f"no video: {said}"
    return f"video: {path}"
