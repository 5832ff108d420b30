"""From a specification per domain parameter to stacked worlds, and the engine that steps them.

Domain parameters reach MuJoCo in one place, `compile_worlds`: every theta is compiled on the host by MuJoCo's own
compiler, and the fields in which the compiled models differ are stacked. That is exact for everything (sizes, masses
and all constants derived from them), because no derived field is ever recomputed by hand.
"""

import importlib
import os
from collections.abc import Iterable, Sequence
from operator import attrgetter
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.mujoco.engines import NESTED, Engine
from sgft_jax.types import Array, UserError, unknown

# Fields that only matter to a renderer: they may differ between worlds without being simulated.
_COSMETIC = ("geom_rgba", "mat_", "light_", "cam_")
Impl = Literal["auto", "jax", "warp", "c"]  # see `choose_impl`
IMPL_VARIABLE = "SGFT_IMPL"
_STRUCTURE = (
    "body_parentid", "jnt_type", "geom_type", "geom_bodyid", "actuator_trnid", "pair_geom1", "pair_geom2", "pair_dim",
)  # fmt: skip


class PhysicsState(NamedTuple):
    """All that a MuJoCo step needs to continue exactly: everything else is recomputed from it.

    qpos: [nq], qvel: [nv], warmstart: [nv] last acceleration, where the constraint solver starts.
    ctrl: [nu] last command.
    sensordata: [nsensordata] what MuJoCo's sensors read, touch and contact sensors among them. Like MuJoCo's own it is
        that of the start of the last physics step. Engines fill it in; a scene without sensors has none.
    """

    qpos: Array
    qvel: Array
    warmstart: Array
    ctrl: Array
    sensordata: Array | np.ndarray = np.zeros(0, np.float32)


def make_engine(host: mujoco.MjModel, fields: tuple[str, ...], impl: str) -> Engine:
    """What steps a scene whose worlds differ in `fields`, by one of the engines of `choose_impl`."""
    module = importlib.import_module(f"envs.mujoco.engines.{'mjx' if impl == 'jax' else impl}")
    return module.make_engine(host, fields)


def check_supported(name: str, host: mujoco.MjModel) -> None:
    """Raises UserError for a scene whose state is more than a `PhysicsState`."""
    for count, what in ((host.na, "actuators with a state of their own (dyntype)"), (host.nmocap, "mocap bodies")):
        if count:
            raise UserError(f"scene {name} has {what}, which no engine here carries from step to step")


def choose_impl(wanted: str = "auto") -> str:
    """The physics engine: "jax" (MJX's own code), "warp" (MuJoCo Warp) or "c" (MuJoCo's own engine).

    wanted: one of them, or "auto": what $SGFT_IMPL says, or else the fastest (docs/performance.md), which is "c" where
        JAX computes on CPUs, "warp" on NVIDIA GPUs where it is installed, "jax" elsewhere. Raises UserError for
        anything else.
    """
    impl = os.environ.get(IMPL_VARIABLE) or "auto" if wanted == "auto" else wanted
    if impl not in get_args(Impl):
        raise UserError(unknown(IMPL_VARIABLE if wanted == "auto" else "impl", impl, get_args(Impl)))
    if impl != "auto":
        return impl
    match jax.default_backend():
        case "cpu":
            return "c"
        case "gpu":
            from envs.mujoco.engines import warp

            return "warp" if warp.available() else "jax"
        case _:
            return "jax"


def varying_fields(nominal: mujoco.MjModel, specs: Iterable[mujoco.MjSpec]) -> tuple[str, ...]:
    """Names of the simulated fields in which any of the specs differs from the nominal scene.

    Found once per task from perturbed specs, so that all worlds of a task are pytrees of one structure: programs
    compiled for one gap serve every other, and gaps can be vmapped over.
    """
    from envs.mujoco.engines import mjx

    model, _ = mjx.put(nominal)
    names = [k for k, v in vars(model).items() if isinstance(v, jax.Array) and not k.startswith(_COSMETIC)]
    reference = _read(nominal, names)
    others = [_read(spec.compile(), names) for spec in specs]
    return tuple(k for k in reference if any(not np.array_equal(reference[k], fields[k]) for fields in others))


def compile_worlds(
    nominal: mujoco.MjModel, specs: Iterable[mujoco.MjSpec], names: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Compiles one model per spec and stacks the fields `names` (see `varying_fields`): name -> [n, ...].

    Raises UserError when MuJoCo refuses a spec, or when one changes the structure of the scene (number or types of
    elements), which a compiled program cannot follow.
    """
    models = []
    for spec in specs:
        try:
            host = spec.compile()
        except ValueError as error:
            raise UserError(f"MuJoCo cannot build these domain parameters: {str(error).splitlines()[0]}") from None
        _check_structure(nominal, host)
        models.append(_read(host, names))
    return {k: np.stack([fields[k] for fields in models]) for k in names}


def exploded(state: PhysicsState, *, max_speed: float) -> Array:
    """[] bool: the state is not finite, or something moves faster than `max_speed` (m/s or rad/s)."""
    speed = jnp.abs(state.qvel).max()
    return ~(jnp.isfinite(state.qpos).all() & (speed < max_speed))  # NaN speeds compare false


def _read(host: mujoco.MjModel, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Fields of a compiled model in the precision MJX keeps them in, the nested ones always among them."""
    fields = {name: np.array(attrgetter(name)(host)) for name in dict.fromkeys([*names, *NESTED])}
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
