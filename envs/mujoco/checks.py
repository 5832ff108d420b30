"""Whether the parts of a scene fit each other and what MuJoCo compiled, by the shapes of what they return."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco

from envs.base import pack
from envs.checks import check_array, check_outcomes, is_count, is_number
from envs.mujoco.worlds import PhysicsState
from envs.types import UserError

if TYPE_CHECKING:
    from envs.mujoco.scene import Scene

_TOLERANCE = 1e-6  # of a control period: what sums of rounded time steps may miss it by


def check_scene(scene: Scene, host: mujoco.MjModel) -> None:
    """Raises UserError, which names scene and field, for parts that no step can be made of. host: compiled."""
    _check_times(scene, host)
    sizes = {"qpos": host.nq, "qvel": host.nv, "warmstart": host.nv, "ctrl": host.nu}
    full = PhysicsState(**{name: _float(n) for name, n in sizes.items()}, sensordata=_float(host.nsensordata))
    params, action, obs = (
        _float(n)
        for n in (len(scene.parameters), sum(e.size for e in scene.action), sum(e.size for e in scene.observation))
    )
    key = jax.eval_shape(lambda: jax.random.key(0))

    def check_state(field: str, state: Any) -> None:
        if not isinstance(state, PhysicsState):
            raise UserError(f"task {scene.name}: '{field}' must return a PhysicsState, got {type(state).__name__}")
        for name, size in sizes.items():
            check_array(scene, f"{field}: {name}", getattr(state, name), (size,))

    check_state("initial", jax.eval_shape(scene.initial, params, key))
    target = jax.eval_shape(scene.target, full.qpos, action)
    check_array(scene, "target", target, (host.nu,))
    check_array(scene, "motors", jax.eval_shape(scene.motors, params, full.ctrl, target), (host.nu,))
    check_state("event", jax.eval_shape(scene.event, params, full))
    check_array(scene, "observe", _observed(scene, params, full), obs.shape)
    if scene.settled is not None:
        check_state("settled", jax.eval_shape(scene.settled, params, obs))
    _check_outcomes(scene, params, full, action, obs)


def _check_times(scene: Scene, host: mujoco.MjModel) -> None:
    for field, possible, need in (
        ("substeps", is_count(scene.substeps), "a whole number of at least 1"),
        ("ramp", is_number(scene.ramp) and scene.ramp >= 0, "a number of seconds, not negative"),
        ("max_speed", is_number(scene.max_speed) and scene.max_speed > 0, "a number above 0"),
    ):
        if not possible:
            raise UserError(f"task {scene.name}: '{field}' must be {need}, got {getattr(scene, field)}")
    steps = scene.substeps * host.opt.timestep
    if abs(steps - scene.control_dt) > _TOLERANCE * scene.control_dt:
        raise UserError(
            f"task {scene.name}: 'control_dt' is {scene.control_dt:g} s, but {scene.substeps} substeps of MuJoCo's "
            f"timestep take {steps:g} s"
        )


def _observed(scene: Scene, params: Any, state: PhysicsState) -> Any:
    try:
        return jax.eval_shape(lambda *args: pack(scene.observation, scene.observe(*args)), params, state)
    except UserError as error:
        raise UserError(f"task {scene.name}: 'observe': {error}") from None


def _check_outcomes(scene: Scene, params: Any, state: PhysicsState, action: Any, obs: Any) -> None:
    """Reward, end and success: functions of observations, or measured."""
    functions = {name: getattr(scene, name) for name in ("reward", "terminated", "success")}
    check_outcomes(scene, functions, obs, action)
    measured = jax.eval_shape(scene.measured, params, state, action, state)
    for name, value in measured._asdict().items():
        if value is not None:
            check_array(scene, f"measured: {name}", value, (), "float32" if name == "reward" else "bool")
        if value is not None and name != "reward" and functions[name] is not None:
            raise UserError(f"task {scene.name} measures '{name}': then its function of observations must be None")
    name = {"success": "success", "return": "reward"}[scene.score]
    if functions[name] is None and getattr(measured, name) is None:
        raise UserError(f"task {scene.name}: 'score' is {scene.score!r}, but nothing tells its {name}")


def _float(size: int) -> Any:
    """Stands for a vector of float32."""
    return jax.ShapeDtypeStruct((size,), jnp.float32)
