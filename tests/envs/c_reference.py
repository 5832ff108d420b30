"""The same episodes through C MuJoCo: the reference for MJX, for finer time steps, and the model a renderer draws.

Impure: C MuJoCo steps in place.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.mujoco.scene import Scene
from envs.mujoco.worlds import PhysicsState
from envs.types import Array

_COMPILED: dict[int, Any] = {}  # by the identity of a scene, which is kept beside, because it has no hash


def play(
    scene: Scene,
    theta: dict[str, float],
    start: PhysicsState,
    actions: Sequence[Array] | Array,
    *,
    refine: int = 1,
    iterations: int = 0,
) -> list[PhysicsState]:
    """Plays `actions` [T, act_dim] from `start` with C MuJoCo; returns the T states after each control step.

    theta: domain parameters by name. refine: divides the time step. iterations: solver iterations, 0 = the scene's own.
    """
    spec = scene.build(theta)
    spec.option.timestep = scene.control_dt / (scene.substeps * refine)
    if iterations:
        spec.option.iterations, spec.option.ls_iterations = iterations, 50
    model = spec.compile()
    data = mujoco.MjData(model)
    params = jnp.asarray(list(theta.values()), jnp.float32)
    target, event = _compiled(scene)
    states, state = [], start
    for action in actions:
        command = np.asarray(target(params, state, action))
        after = _control_step(model, data, state, command, scene.substeps * refine, scene.ramp)
        state = event(params, after)
        states.append(state)
    return states


def _compiled(scene: Scene) -> tuple[Callable[..., Array], Callable[..., PhysicsState]]:
    """(params, state, action) -> command, and the scene's event; compiled once for a scene."""
    if id(scene) not in _COMPILED:

        def target(params: Array, state: PhysicsState, action: Array) -> Array:
            return scene.motors(params, state.ctrl, scene.target(state.qpos, action))

        _COMPILED[id(scene)] = scene, jax.jit(target), jax.jit(scene.event)
    return _COMPILED[id(scene)][1:]


def _control_step(
    model: mujoco.MjModel, data: mujoco.MjData, state: PhysicsState, command: np.ndarray, substeps: int, ramp: float
) -> PhysicsState:
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = state.qpos, state.qvel, state.warmstart
    previous = np.asarray(state.ctrl)
    for i in range(substeps):
        progress = min((i + 1) * model.opt.timestep / max(ramp, 1e-9), 1.0)
        data.ctrl[:] = previous + progress * (command - previous)
        mujoco.mj_step(model, data)
    found = data.qpos, data.qvel, data.qacc_warmstart, data.ctrl, data.sensordata
    return PhysicsState(*(jnp.asarray(x, jnp.float32) for x in found))
