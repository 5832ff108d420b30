"""MJX's own JAX code as the engine of a scene, and what both engines of MJX share."""

import contextlib
import io
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces on stdout that the optional Warp backend is absent
    from mujoco import mjx
    from mujoco.mjx._src import scan

from envs.mujoco.engines import FLUID, POLYNOMIAL, Engine, check_features
from envs.types import Array, PyTree, UserError

_map_level = scan._nvmap


def _fenced(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    """Keeps XLA from fusing MJX's walk along the bodies into one kernel.

    MJX computes a kinematic chain level by level. XLA fuses a level into every later level that reads it and so
    computes it again and again: on a CPU a 7-joint arm then spends most of a bare `mjx.step` in `mjx.kinematics`. An
    optimisation barrier after each level ends that: 50 to 26 microseconds a bare step of the pushing scene (64 worlds,
    two cores). On a GPU the fused kernels are the better ones (0.29 against 0.35 microseconds on an H200), so the
    barriers stay away there. For mujoco-mjx 3.17, whose internals this touches.
    """
    level = _map_level(function, *args)
    fence = level is not None and jax.default_backend() == "cpu"
    return jax.lax.optimization_barrier(level) if fence else level


scan._nvmap = _fenced  # before the first use of mjx


def make_engine(host: mujoco.MjModel, fields: tuple[str, ...] = ()) -> Engine:
    """The engine of a compiled scene. fields: names that a world may set in the model.

    Between substeps only the minimal state is carried: it keeps the loop's memory traffic small. Matrix products run in
    full float32: TF32 is not enough for contact dynamics. Raises UserError for what MJX cannot step as MuJoCo does.
    """
    check_features("jax", host)
    _check_fields(host, fields)
    nominal, blank = put(host)
    if set(FLUID) & set(fields):
        option = nominal.opt
        nominal = nominal.replace(opt=option.replace(_impl=option._impl.replace(has_fluid_params=True)))
    servos = joint_servos(host)

    def enter(state: Any, ctrl: Array) -> mjx.Data:
        return blank.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, ctrl=ctrl)

    def sense(fields: dict[str, Array], state: Any) -> Any:
        with jax.default_matmul_precision("highest"):
            data = mjx.forward(with_fields(nominal, fields), enter(state, state.ctrl))
        return state._replace(sensordata=data.sensordata)

    def advance(fields: dict[str, Array], state: Any, controls: Array) -> Any:
        model = with_fields(nominal, fields)

        def substep(state: Any, ctrl: Array) -> tuple[Any, None]:
            data = enter(state, ctrl)
            data = mjx.step(hold_saturated(model, data, servos), data)
            after = data.qpos, data.qvel, data.qacc_warmstart, ctrl, data.sensordata
            return type(state)(*after), None

        with jax.default_matmul_precision("highest"):
            return jax.lax.scan(substep, state, controls)[0]

    return Engine(advance, sense)


def put(host: mujoco.MjModel) -> tuple[mjx.Model, mjx.Data]:
    """A compiled scene and its blank data for MJX's own code, on a device of this process.

    Left to itself MJX takes the first device of all, which may be another host's: programs cannot hold its arrays.
    Raises UserError for a scene with something that MJX does not have.
    """
    device = jax.local_devices()[0]
    try:
        return mjx.put_model(host, device=device, impl="jax"), mjx.make_data(host, device=device, impl="jax")
    except NotImplementedError as error:
        raise UserError(f"MJX cannot step it: {error}; the engine c can (--impl c)") from None


def with_fields(model: mjx.Model, fields: dict[str, Array]) -> mjx.Model:
    """The model of one world: the nominal one with the fields of that world, in the shapes that its engine uses.

    What only C MuJoCo reads is left out: MJX has it as a constant.
    """
    parts: dict[str, dict[str, Array]] = {"": {}}
    for name, value in fields.items():
        part, _, last = name.rpartition(".")
        nominal = getattr(getattr(model, part) if part else model, last)
        if isinstance(nominal, jax.Array):
            parts.setdefault(part, {})[last] = value.reshape(nominal.shape)
    direct = parts.pop("")
    return model.replace(**direct, **{part: getattr(model, part).replace(**changed) for part, changed in parts.items()})


def _check_fields(host: mujoco.MjModel, fields: tuple[str, ...]) -> None:
    """Raises UserError where worlds differ in what MJX's JAX code takes from the nominal model, or does not read."""
    fast = host.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for names, why in (
        (POLYNOMIAL, "MJX does not read it"),
        (FLUID if fast else (), "with the integrator implicitfast MJX has no fluids"),
        (("geom_rbound",) if host.nhfield else (), "beside a height field MJX has one size of geoms for all worlds"),
    ):
        if odd := [name for name in names if name in fields]:
            raise UserError(f"worlds that differ in '{odd[0]}' need the engine c (--impl c): {why}")


def joint_servos(host: mujoco.MjModel) -> np.ndarray:
    """[nu] bool: actuators whose force is limited and linear in the position and velocity of one joint."""
    joint = host.actuator_trnid[:, 0].clip(0)
    one_dof = np.isin(host.jnt_type[joint], (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    return (
        (host.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        & one_dof
        & (host.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)
        & (host.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)
        & (host.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        & (host.actuator_forcelimited != 0)
        & (host.actuator_ctrllimited == 0)
    )


def hold_saturated(model: mjx.Model, data: mjx.Data, servos: np.ndarray) -> mjx.Model:
    """The model for one step, in which servos at their force limit are constant forces; `servos`: see `joint_servos`.

    The implicit integrator counts a servo's damping in the inertia. C MuJoCo leaves out servos at their limit, MJX does
    not: a saturated wrist of the hammering arm, 0.1 kg m^2, then moved as if it had 0.7.
    """
    if not servos.any():
        return model
    joint, gear = model.actuator_trnid[:, 0].clip(0), model.actuator_gear[:, 0]
    position, velocity = data.qpos[model.jnt_qposadr[joint]], data.qvel[model.jnt_dofadr[joint]]
    gain, bias = model.actuator_gainprm, model.actuator_biasprm
    force = gain[:, 0] * data.ctrl + bias[:, 0] + gear * (bias[:, 1] * position + bias[:, 2] * velocity)
    low, high = model.actuator_forcerange.T
    held = (servos & ((force <= low) | (force >= high)))[:, None]
    constant = jnp.zeros_like(bias).at[:, 0].set(jnp.clip(force, low, high))
    return model.replace(actuator_gainprm=jnp.where(held, 0.0, gain), actuator_biasprm=jnp.where(held, constant, bias))
