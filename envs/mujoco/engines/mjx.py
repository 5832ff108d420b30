"""MJX's own JAX code as the engine of a scene, and what both engines of MJX share."""

import contextlib
import io
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces on stdout that the optional Warp backend is absent
    from mujoco import mjx

import envs.mujoco.engines.fences  # noqa: F401 - a repair of mjx, before its first use
from envs.mujoco.engines import NESTED, Engine
from sgft_jax.types import Array


def make_engine(host: mujoco.MjModel, fields: tuple[str, ...] = ()) -> Engine:
    """The engine of a compiled scene. fields: not needed here, every field may be set.

    Between substeps only the minimal state is carried: it keeps the loop's memory traffic small. Matrix products run in
    full float32: TF32 is not enough for contact dynamics.
    """
    nominal, blank = put(host)
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
    """
    device = jax.local_devices()[0]
    return mjx.put_model(host, device=device, impl="jax"), mjx.make_data(host, device=device, impl="jax")


def with_fields(model: mjx.Model, fields: dict[str, Array]) -> mjx.Model:
    """The model of one world: the nominal one with the fields of that world, in the shapes that its engine uses."""
    fields = dict(fields)
    for part, own in (name.split(".") for name in NESTED if name in fields):
        changed = getattr(model, part).replace(**{own: fields.pop(f"{part}.{own}")})
        model = model.replace(**{part: changed})
    fields = {name: x.reshape(getattr(model, name).shape) for name, x in fields.items()}
    return model.replace(**fields)


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
