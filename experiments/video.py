"""Impure: one real episode of a policy before and after fine-tuning, rendered side by side."""

import importlib
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.base import Env, World
from envs.rollout import pick
from experiments import cli
from experiments.evaluation import play_episodes
from sgft_jax.types import Array, Key, PyTree

_EPISODE_SEED = 2**31 + 3  # of the one episode that is filmed: not chosen for how it looks


def before_and_after(
    env: Env, pool: World, act: Callable[[PyTree, Array, Key], Array], states: PyTree, path: Path, *, rollouts: int
) -> str:
    """Films the same start in the same real world twice and says in one line where, or why there is no video.

    act(state, obs, key) -> action. states: [2] what `act` is given, before and after `rollouts` real rollouts.
    Never raises for want of a scene, a graphics library or an encoder: a run does not fail for a picture.
    """
    scene = getattr(importlib.import_module(envs.TASKS[env.name]), "SCENE", None)
    if scene is None:
        return f"no video: {env.name} has no scene to draw"
    if reason := cli.select_renderer():
        return f"no video: {reason}"
    from envs.franka.render import render_side_by_side

    world = pick(pool, jnp.zeros(1, int))
    qpos, success = _film(env, world, act, states)
    captions = [
        f"{name}: {'success' if won else 'failure'}"
        for name, won in zip(("simulator's policy", f"after {rollouts} real rollouts"), success, strict=True)
    ]
    theta = np.asarray(world.params[0]).tolist()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        render_side_by_side(scene, [theta, theta], list(qpos), captions, path)
    except Exception as error:  # whatever a graphics driver or a video encoder raises
        said = (str(error).strip() or type(error).__name__).splitlines()[0]
        return f"no video: {said}"
    return f"video: {path}"


def _film(
    env: Env, world: World, act: Callable[[PyTree, Array, Key], Array], states: PyTree
) -> tuple[np.ndarray, np.ndarray]:
    """Qpos [2, T + 1, nq] and success [2] of one episode with the same key for both states."""

    def play(state: PyTree) -> tuple[Array, Array]:
        key = jax.random.key(_EPISODE_SEED)
        episode = play_episodes(env, world, lambda obs, key: act(state, obs, key), key, 1, gamma=1.0)
        qpos = jnp.concatenate([episode.start.physics.qpos, episode.qpos[0]])
        return qpos, episode.success[0]

    qpos, success = jax.jit(jax.vmap(play))(states)
    return np.asarray(qpos), np.asarray(success)
