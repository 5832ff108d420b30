"""MJX's own JAX code as the engine of a scene, and what both engines of MJX share."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

import envs.mujoco.engines.fences  # noqa: F401 - a repair of mjx, before its first use
from sgft_jax.types import Array, PyTree

MEAN_INERTIA = "stat.meaninertia"

# (fields of one world, its state, controls [substeps, nu]) -> the state after these steps. `fields` are those of the
# model that differ between worlds, by name; the state is a NamedTuple of qpos, qvel, warmstart and ctrl.
Advance = Callable[[dict[str, Array], PyTree, Array], PyTree]


def make_advance(host: mujoco.MjModel) -> Advance:
    """The engine of a compiled scene; for one world, vmap over worlds.

    Between substeps only the minimal state is carried: it keeps the loop's memory traffic small. Matrix products run in
    full float32: TF32 is not enough for contact dynamics.
    """
    nominal, blank = put(host)

    def advance(fields: dict[str, Array], state: Any, controls: Array) -> Any:
        model = with_fields(nominal, fields)

        def substep(state: Any, ctrl: Array) -> tuple[Any, None]:
            data = blank.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, ctrl=ctrl)
            data = mjx.step(hold_saturated(model, data), data)
            return state._replace(qpos=data.qpos, qvel=data.qvel, warmstart=data.qacc_warmstart, ctrl=ctrl), None

        with jax.default_matmul_precision("highest"):
            return jax.lax.scan(substep, state, controls)[0]

    return advance


def put(host: mujoco.MjModel) -> tuple[mjx.Model, mjx.Data]:
    """A compiled scene and its blank data for MJX's own code, on a device of this process.

    Left to itself MJX takes the first device of all, which may be another host's: programs cannot hold its arrays.
    """
    device = jax.local_devices()[0]
    return mjx.put_model(host, device=device, impl="jax"), mjx.make_data(host, device=device, impl="jax")


def with_fields(model: mjx.Model, fields: dict[str, Array]) -> mjx.Model:
    """The model of one world: the nominal one with the fields of that world, in the shapes that its engine uses."""
    fields = dict(fields)
    mean_inertia = fields.pop(MEAN_INERTIA, model.stat.meaninertia)
    fields = {name: x.reshape(getattr(model, name).shape) for name, x in fields.items()}
    return model.replace(stat=model.stat.replace(meaninertia=mean_inertia), **fields)


def hold_saturated(model: mjx.Model, data: mjx.Data) -> mjx.Model:
    """The model for one step, in which servos at their force limit are constant forces.

    The implicit integrator counts a servo's damping in the inertia. C MuJoCo leaves out servos at their limit, MJX does
    not: a saturated wrist of the hammering arm, 0.1 kg m^2, then moved as if it had 0.7. For servos on joints, gear 1.
    """
    joint = model.actuator_trnid[:, 0]
    position, velocity = data.qpos[model.jnt_qposadr[joint]], data.qvel[model.jnt_dofadr[joint]]
    gain, bias = model.actuator_gainprm, model.actuator_biasprm
    force = gain[:, 0] * data.ctrl + bias[:, 0] + bias[:, 1] * position + bias[:, 2] * velocity
    low, high = model.actuator_forcerange.T
    held = (model.actuator_forcelimited & ((force <= low) | (force >= high)))[:, None]
    constant = jnp.zeros_like(bias).at[:, 0].set(jnp.clip(force, low, high))
    return model.replace(actuator_gainprm=jnp.where(held, 0.0, gain), actuator_biasprm=jnp.where(held, constant, bias))
