"""From a specification per domain parameter to stacked MJX worlds, and from control targets to the next state.

Domain parameters reach MuJoCo in one place, `compile_worlds`: every theta is compiled on the host by MuJoCo's own
compiler, and the fields in which the compiled models differ are stacked. That is exact for everything (sizes, masses
and all constants derived from them), because no derived field is ever recomputed by hand.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

import envs.fences  # noqa: F401 - a repair of mjx, before its first use
from envs.native import Advance, make_advance
from sgft_jax.types import Array, UserError

# Fields that only matter to a renderer: they may differ between worlds without being simulated.
_COSMETIC = ("geom_rgba", "mat_", "light_", "cam_")
_MEAN_INERTIA = "stat.meaninertia"
IMPL_VARIABLE, IMPLS = "SGFT_IMPL", ("auto", "jax", "c")
_STRUCTURE = (
    "body_parentid",
    "jnt_type",
    "geom_type",
    "geom_bodyid",
    "actuator_trnid",
    "pair_geom1",
    "pair_geom2",
    "pair_dim",
)


class PhysicsState(NamedTuple):
    """All that a MuJoCo step needs to continue exactly: everything else is recomputed from it.

    qpos: [nq], qvel: [nv], warmstart: [nv] last acceleration, where the constraint solver starts.
    ctrl: [nu] last command.
    """

    qpos: Array
    qvel: Array
    warmstart: Array
    ctrl: Array


class Simulator(NamedTuple):
    """A compiled scene. model: the nominal MJX model; blank: the data a step starts from; host: MuJoCo's model.

    native: MuJoCo's C engine for the worlds of this scene, or None where MJX steps them.
    """

    model: mjx.Model
    blank: mjx.Data
    host: mujoco.MjModel
    native: Advance | None = None


def make_simulator(spec: mujoco.MjSpec) -> Simulator:
    """Compiles the nominal scene, to be stepped by MJX."""
    host = spec.compile()
    return Simulator(mjx.put_model(host, impl="jax"), mjx.make_data(host, impl="jax"), host)


def with_impl(simulator: Simulator, fields: tuple[str, ...], impl: str) -> Simulator:
    """The simulator stepped by "jax" (MJX) or by "c" (MuJoCo itself), for worlds that differ in `fields`."""
    return simulator._replace(native=make_advance(simulator.host, fields, _MEAN_INERTIA) if impl == "c" else None)


def choose_impl(wanted: str | None = None) -> str:
    """Who steps the physics: "jax" (MJX) or "c" (MuJoCo's own engine).

    wanted: one of them, or "auto", which is "c" where JAX computes on CPUs; default $SGFT_IMPL, or "auto". Raises
    UserError for anything else.
    """
    impl = wanted or os.environ.get(IMPL_VARIABLE) or "auto"
    if impl not in IMPLS:
        raise UserError(f"{IMPL_VARIABLE}: there is no {impl!r}. Choose from: {', '.join(IMPLS)}")
    if impl == "auto":
        return "c" if jax.default_backend() == "cpu" else "jax"
    return impl


def varying_fields(simulator: Simulator, specs: Iterable[mujoco.MjSpec]) -> tuple[str, ...]:
    """Names of the simulated fields in which any of the specs differs from the nominal scene.

    Found once per task from perturbed specs, so that all worlds of a task are pytrees of one structure: programs
    compiled for one gap serve every other, and gaps can be vmapped over.
    """
    names = [k for k, v in vars(simulator.model).items() if isinstance(v, jax.Array) and not k.startswith(_COSMETIC)]
    reference = _read(simulator.host, names)
    others = [_read(spec.compile(), names) for spec in specs]
    return tuple(k for k in reference if any(not np.array_equal(reference[k], fields[k]) for fields in others))


def compile_worlds(
    simulator: Simulator, specs: Iterable[mujoco.MjSpec], names: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Compiles one model per spec and stacks the fields `names` (see `varying_fields`): name -> [n, ...].

    Raises UserError when a spec changes the structure of the scene (number or types of elements), which a compiled
    program cannot follow.
    """
    models = []
    for spec in specs:
        host = spec.compile()
        _check_structure(simulator.host, host)
        models.append(_read(host, names))
    return {k: np.stack([fields[k] for fields in models]) for k in names}


def with_fields(model: mjx.Model, fields: dict[str, Array]) -> mjx.Model:
    """The model of one world: the nominal one with the fields of that world."""
    fields = dict(fields)
    mean_inertia = fields.pop(_MEAN_INERTIA, model.stat.meaninertia)
    return model.replace(stat=model.stat.replace(meaninertia=mean_inertia), **fields)


def advance(
    simulator: Simulator,
    fields: dict[str, Array],
    state: PhysicsState,
    control: Callable[[Array], Array],
    *,
    substeps: int,
) -> PhysicsState:
    """Runs `substeps` steps; `control(i)` gives the command [nu] of substep i.

    MJX: between substeps only the minimal state is carried: it keeps the loop's memory traffic small.
    Matrix products run in full float32: TF32 is not enough for contact dynamics.
    """
    if simulator.native is not None:
        return simulator.native(fields, state, jax.vmap(control)(jnp.arange(substeps)))
    model = with_fields(simulator.model, fields)

    def substep(state: PhysicsState, i: Array) -> tuple[PhysicsState, None]:
        ctrl = control(i)
        data = simulator.blank.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, ctrl=ctrl)
        data = mjx.step(_hold_saturated(model, data), data)
        return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart, ctrl), None

    with jax.default_matmul_precision("highest"):
        return jax.lax.scan(substep, state, jnp.arange(substeps))[0]


def _hold_saturated(model: mjx.Model, data: mjx.Data) -> mjx.Model:
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


def exploded(state: PhysicsState, *, max_speed: float) -> Array:
    """[] bool: the state is not finite, or something moves faster than `max_speed` (m/s or rad/s)."""
    speed = jnp.abs(state.qvel).max()
    return ~(jnp.isfinite(state.qpos).all() & (speed < max_speed))  # NaN speeds compare false


def _read(host: mujoco.MjModel, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Fields of a compiled model in the precision MJX keeps them in, and the mean inertia that scales its solver."""
    fields = {name: np.array(getattr(host, name)) for name in names if name != _MEAN_INERTIA}
    fields[_MEAN_INERTIA] = np.array(host.stat.meaninertia)
    return {k: v.astype(np.float32) if v.dtype == np.float64 else v for k, v in fields.items()}


def _check_structure(nominal: mujoco.MjModel, host: mujoco.MjModel) -> None:
    for name in _STRUCTURE:
        if not np.array_equal(getattr(nominal, name), getattr(host, name)):
            raise UserError(
                f"domain parameters change '{name}' of the scene; they may change values, not its structure"
            )
    for name in ("dof_frictionloss", "tendon_frictionloss"):  # MJX allocates constraint rows for non-zero ones only
        if not np.array_equal(getattr(nominal, name) > 0, getattr(host, name) > 0):
            raise UserError(f"'{name}' must be positive for the same elements in the nominal and in every other model")
