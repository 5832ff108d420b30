"""From a specification per domain parameter to stacked worlds, and the engine that steps them.

Domain parameters reach MuJoCo in one place, `compile_worlds`: every theta is compiled on the host by MuJoCo's own
compiler, and the fields in which the compiled models differ are stacked. That is exact for everything (sizes, masses
and all constants derived from them), because no derived field is ever recomputed by hand.
"""

import importlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.mujoco.engines import CARRIED, Engine, carried, comparison
from envs.mujoco.processes import WORTH, cores, in_parallel, running
from envs.types import Array, UserError, brief, unknown

Impl = Literal["auto", "jax", "warp", "c"]  # see `choose_impl`
IMPL_VARIABLE = "SGFT_IMPL"
_FEW = 16  # worlds for which a process that runs is worth asking
# MuJoCo's kinds of state that a step continues with a `PhysicsState`, or that no step of ours ever changes.
_KEPT = ("TIME", "QPOS", "QVEL", "WARMSTART", "CTRL", "QFRC_APPLIED", "XFRC_APPLIED", "EQ_ACTIVE")
_STATES = {
    "ACT": "actuators with a state of their own (dyntype)",
    "HISTORY": "delays of actuators or sensors (nsample)",
    "MOCAP_POS": "mocap bodies",
    "USERDATA": "user data (nuserdata)",
    "PLUGIN": "plugins with a state",
}


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
    """Raises UserError for a scene whose state is more than a `PhysicsState`, by MuJoCo's own list of states."""
    states = mujoco.mjtState.__members__.items()
    kinds = {k.removeprefix("mjSTATE_"): v for k, v in states if k.startswith("mjSTATE_") and int(v).bit_count() == 1}
    odd = [kind for kind, bit in kinds.items() if kind not in _KEPT and mujoco.mj_stateSize(host, int(bit))]
    more = [_STATES.get(kind, f"a state {kind}") for kind in odd]
    if host.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        more.append("bodies that sleep (flag sleep)")
    # Time begins anew in every control step.
    if (host.sensor_interval[:, 0] > 0).any() or int(mujoco.mjtSensor.mjSENS_CLOCK) in host.sensor_type:
        more.append("sensors that read the time (clock, interval)")
    if more:
        raise UserError(f"scene {name} has {more[0]}, which no engine here carries from step to step")


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
    if jax.default_backend() == "gpu":
        from envs.mujoco.engines import warp

        return "warp" if warp.available() else "jax"
    return "c" if jax.default_backend() == "cpu" else "jax"


def varying_fields(nominal: mujoco.MjModel, specs: Iterable[mujoco.MjSpec]) -> tuple[str, ...]:
    """Names of the simulated fields in which any of the specs differs from the nominal scene.

    Found once per task from perturbed specs, so that all worlds of a task are pytrees of one structure: programs
    compiled for one gap serve every other, and gaps can be vmapped over. Raises UserError as `compile_worlds` does.
    """
    names = carried(nominal)
    reference = _read(nominal, names)
    others = list(_compiled(nominal, specs, names))
    return tuple(k for k in names if any(not np.array_equal(reference[k], fields[k]) for fields in others))


def compile_worlds(
    nominal: mujoco.MjModel,
    build: Callable[[dict[str, float]], mujoco.MjSpec],
    theta: dict[str, float],
    thetas: Sequence[dict[str, float]],
    names: tuple[str, ...],
) -> dict[str, np.ndarray]:
    """Compiles the spec of every theta and stacks the fields `names` (see `varying_fields`): name -> [n, ...].

    nominal: the scene, compiled from build(theta). Many worlds are compiled in several processes.

    Raises UserError when MuJoCo refuses a spec, or when one differs from the nominal scene in anything else that a step
    reads: in its structure, which a compiled program cannot follow, or in what was the same in `varying_fields`.
    """
    count, parts = min(cores(), max(len(thetas) // WORTH, min(len(thetas) // _FEW, running()))), None
    if count > 1:
        shares = [thetas[len(thetas) * i // count : len(thetas) * (i + 1) // count] for i in range(count)]
        parts = in_parallel(_share, [(build, theta, share, names) for share in shares], keep=True)
        here = _stacked(nominal, (build(share[0]) for share in shares), names)
        if parts and any(not np.array_equal(here[k], [part[k][0] for part in parts]) for k in names):
            parts = None  # they import code anew, as from a file that has changed, and know no global that was set here
    if parts is None:
        parts = [_stacked(nominal, map(build, thetas), names)]
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


def _share(
    build: Callable[[dict[str, float]], mujoco.MjSpec],
    theta: dict[str, float],
    thetas: Sequence[dict[str, float]],
    names: tuple[str, ...],
) -> dict[str, np.ndarray]:
    """What a process does of `compile_worlds`."""
    return _stacked(build(theta).compile(), map(build, thetas), names)


def _stacked(nominal: mujoco.MjModel, specs: Iterable[mujoco.MjSpec], names: tuple[str, ...]) -> dict[str, np.ndarray]:
    models = list(_compiled(nominal, specs, names))
    return {name: np.stack([fields[name] for fields in models]) for name in names}


def exploded(state: PhysicsState, *, max_speed: float) -> Array:
    """[] bool: the state is not finite, or something moves faster than `max_speed` (m/s or rad/s)."""
    speed = jnp.abs(state.qvel).max()
    return ~(jnp.isfinite(state.qpos).all() & (speed < max_speed))  # NaN speeds compare false


def _compiled(
    nominal: mujoco.MjModel, specs: Iterable[mujoco.MjSpec], names: tuple[str, ...]
) -> Iterator[dict[str, np.ndarray]]:
    """The fields `names` of each spec's model; see `compile_worlds`."""
    differing = comparison(nominal, names)
    for spec in specs:
        try:
            host = spec.compile()
        except ValueError as error:
            raise UserError(f"MuJoCo cannot build these domain parameters: {brief(error)}") from None
        if odd := differing(host):
            raise _uncarried(odd)
        _check_kinds(nominal, host)
        yield _read(host, names)


def _uncarried(names: Sequence[str]) -> UserError:
    """What to tell someone whose domain parameters change what worlds do not carry."""
    fixed = [name for name in names if name not in CARRIED]
    changed = f"domain parameters change {', '.join(map(repr, (fixed or names)[:3]))} of the scene"
    if fixed:
        return UserError(f"{changed}; they may change values that worlds carry, not its structure (docs/extending.md)")
    return UserError(f"{changed}, but not near their nominal values: choose nominal values at which they do")


def _read(host: mujoco.MjModel, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Fields of a compiled model in the precision MJX keeps them in."""
    fields = {name: np.array(attrgetter(name)(host)) for name in names}
    return {k: v.astype(np.float32) if v.dtype == np.float64 else v for k, v in fields.items()}


def _check_kinds(nominal: mujoco.MjModel, host: mujoco.MjModel) -> None:
    """What MJX decides by values of the nominal model must be decided alike by those of every other."""
    for name in ("dof_frictionloss", "tendon_frictionloss"):  # it allocates constraint rows for non-zero ones only
        if not np.array_equal(getattr(nominal, name) > 0, getattr(host, name) > 0):
            raise UserError(f"'{name}' must be positive for the same elements in the nominal and in every other model")
    if not np.array_equal(_wraps_inside(nominal), _wraps_inside(host)):
        raise UserError(
            "the side of a geom on which a tendon wraps must be the same in the nominal and in every other model"
        )


def _wraps_inside(host: mujoco.MjModel) -> np.ndarray:
    """[n] bool, of the geoms that tendons wrap around: whether they do so inside."""
    round_geoms = np.isin(host.wrap_type, (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER))
    geoms, sites = host.wrap_objid[round_geoms], host.wrap_prm[round_geoms].round().astype(int)
    if not geoms.size or not host.nsite:
        return np.zeros(0, bool)
    distance = np.linalg.norm(host.site_pos[sites] - host.geom_pos[geoms], axis=1)
    return (sites >= 0) & (distance < host.geom_size[geoms, 0])
