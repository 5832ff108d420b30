"""What engines of physics are, the fields of models that they set, and what some leave out; MJX imports in seconds."""

import functools
from collections.abc import Callable, Iterator
from operator import attrgetter
from typing import Any, NamedTuple

import mujoco
import numpy as np

from envs.types import Array, PyTree, UserError


class Engine(NamedTuple):
    """What steps a scene, for one world; vmap over worlds.

    fields: of the model that differ between worlds, by name. state: a `PhysicsState`.
    advance(fields, state, controls [substeps, nu]) -> the state after these steps.
    sense(fields, state) -> the same state with what its sensors read.
    prepare(): compiles what JAX does not compile, which the first steps would do otherwise. It may go on in a thread.
    """

    advance: Callable[[dict[str, Array], PyTree, Array], PyTree]
    sense: Callable[[dict[str, Array], PyTree], PyTree] = lambda fields, state: state
    prepare: Callable[[], None] = lambda: None


class Feature(NamedTuple):
    """What MuJoCo computes and another engine leaves out without a word. What an engine refuses itself is not listed.

    name: as a user of MJCF knows it. used(model): whether the scene has it. lacking: the engines without it.
    """

    name: str
    used: Callable[[mujoco.MjModel], bool]
    lacking: tuple[str, ...] = ("jax", "warp")


def _any(*names: str) -> Callable[[mujoco.MjModel], bool]:
    return lambda host: any(getattr(host, name).any() for name in names)


def _has(host: mujoco.MjModel, numeric: str) -> bool:
    return mujoco.mj_name2id(host, mujoco.mjtObj.mjOBJ_NUMERIC, numeric) >= 0


FEATURES = (
    Feature("surfaces that move (surfacevel)", lambda host: bool(host.flg_surfacevel), ("jax",)),
    Feature("geoms that stick (adhesion)", lambda host: bool(host.flg_adhesion), ("jax",)),
    Feature(
        "stiffness or damping of higher order",
        _any("jnt_stiffnesspoly", "dof_dampingpoly", "tendon_stiffnesspoly", "tendon_dampingpoly"),
        ("jax",),
    ),
    Feature("fluids around ellipsoids (fluidshape)", lambda host: host.geom_fluid[:, 0].any(), ("jax",)),
    Feature("noslip iterations", lambda host: host.opt.noslip_iterations > 0, ("jax",)),
    Feature("damping or armature of actuators", _any("actuator_damping", "actuator_dampingpoly", "actuator_armature")),
    Feature("disabled groups of actuators (actuatorgroupdisable)", lambda host: host.opt.disableactuator != 0),
    Feature("plugins", lambda host: host.nplugin > 0),
    *(
        Feature(f"the custom number {name}, by which MJX drops contacts", functools.partial(_has, numeric=name))
        for name in ("max_contact_points", "max_geom_pairs")
    ),
)


def check_features(engine: str, host: mujoco.MjModel) -> None:
    """Raises UserError that names a feature of the scene which that engine lacks, and the engines that have it."""
    for feature in FEATURES:
        if engine in feature.lacking and feature.used(host):
            others = " or ".join(f"--impl {name}" for name in ("c", "warp") if name not in feature.lacking)
            raise UserError(f"the engine {engine} ignores {feature.name}; use {others}")


# What the compiled models of one scene may differ in: what every engine sets for each world, and what no step reads.
# Everything else that MuJoCo keeps must be the same in all worlds, so a field that is new to MuJoCo is refused until it
# stands in one of the two lists (`tests/envs/mujoco/test_fields.py` walks over all of them).
FLUID = ("opt.wind", "opt.density", "opt.viscosity")
POLYNOMIAL = ("jnt_stiffnesspoly", "dof_dampingpoly", "tendon_stiffnesspoly", "tendon_dampingpoly")
_PARTS = {
    "qpos": "0 _spring",
    "body": "_pos _quat _ipos _iquat _mass _subtreemass _inertia _gravcomp _invweight0 _margin",
    "jnt": "_solref _solimp _pos _axis _stiffness _stiffnesspoly _range _actfrcrange _margin",
    "dof": "_solref _solimp _frictionloss _armature _damping _dampingpoly _invweight0 _M0",
    "geom": "_solmix _solref _solimp _size _aabb _rbound _pos _quat _friction _margin _gap _rgba",
    "site": "_pos _quat",
    "hfield": "_data",
    "pair": "_solref _solreffriction _solimp _margin _gap _friction",
    "eq": "_solref _solimp _data",
    "tendon": "_solref_lim _solimp_lim _solref_fri _solimp_fri _range _actfrcrange _margin _stiffness _stiffnesspoly "
    "_damping _dampingpoly _armature _frictionloss _lengthspring _length0 _invweight0",
    "actuator": "_dynprm _gainprm _biasprm _ctrlrange _forcerange _actrange _gear _cranklength _acc0 _lengthrange",
    "cam": "_pos _quat _poscom0 _pos0 _mat0 _fovy _intrinsic",
    "mat": "_rgba",
    "opt": ".gravity .wind .magnetic .density .viscosity .impratio",
    "stat": ".meaninertia",
}
CARRIED = tuple(part + name for part, names in _PARTS.items() for name in names.split())
# Beginnings of names. What cameras see and rays hit is a picture, unless a sensor looks.
_CAMERAS, _RAYS = ("cam_", "ncam"), ("geom_rgba", "geom_matid", "mat_")
_WORDS = (
    "vis light_ nlight tex_ ntex nmat skin_ nskin flex_rgba flex_texcoord nflextexcoord flex_elemtexcoord flex_matid",
    "flex_group flex_flatskin site_matid site_rgba tendon_matid tendon_rgba tendon_width geom_group site_group",
    "jnt_group tendon_group mesh_texcoord mesh_facetexcoord nmeshtexcoord",
    "stat.meanmass stat.meansize stat.extent stat.center",
    "name nnames path npaths text_ ntext tuple_ ntuple key_ nkey signature nbuffer",
    "body_user jnt_user geom_user site_user cam_user tendon_user actuator_user sensor_user nuser_",
    "body_sameframe geom_sameframe site_sameframe bvh_ body_bvh",  # shortcuts of C MuJoCo, see `with_shortcuts`
    "actuator_length0 dof_length",  # for the compiler, and for bodies that sleep
)
_UNREAD = (*_CAMERAS, *_RAYS, *" ".join(_WORDS).split())


def all_fields() -> Iterator[str]:
    """Names of everything that a compiled model holds, as "opt.wind" where its options or statistics do."""
    for owner, start in ((mujoco.MjModel, ""), (mujoco.MjOption, "opt."), (mujoco.MjStatistic, "stat.")):
        names = [k for k, v in vars(owner).items() if isinstance(v, property) and not k.startswith("_")]
        yield from (start + name for name in names if name not in ("opt", "stat"))


def unread(host: mujoco.MjModel) -> tuple[str, ...]:
    """Beginnings of the names of fields that no step of that scene reads: cameras and colours, where no sensor does."""
    objects = {*host.sensor_objtype.tolist(), *host.sensor_reftype.tolist()}
    cameras = int(mujoco.mjtObj.mjOBJ_CAMERA) in objects
    rays = int(mujoco.mjtSensor.mjSENS_RANGEFINDER) in host.sensor_type
    seen = (*(_CAMERAS if cameras else ()), *(_RAYS if rays else ()))
    return tuple(name for name in _UNREAD if name not in seen)


def carried(host: mujoco.MjModel) -> tuple[str, ...]:
    """Names of the fields in which the worlds of that scene may differ."""
    return tuple(name for name in CARRIED if not name.startswith(unread(host)))


def with_shortcuts(host: mujoco.MjModel, names: tuple[str, ...]) -> tuple[str, ...]:
    """The names, and with those of poses the frames that C MuJoCo takes to coincide: they may part in some worlds only.

    Its trees of bounding boxes, the other shortcut, `engines.c` does without where they would differ.
    """
    inertia = {"body_ipos", "body_iquat"}
    sources = {
        "body": inertia,
        "geom": inertia | {"geom_pos", "geom_quat"},
        "site": inertia | {"site_pos", "site_quat"},
    }
    frames = {f"{kind}_sameframe" for kind, poses in sources.items() if poses.intersection(names)}
    return (*names, *(name for name in sorted(frames) if getattr(host, name).any()))


def comparison(nominal: mujoco.MjModel, names: tuple[str, ...]) -> Callable[[mujoco.MjModel], list[str]]:
    """(model) -> names of the fields, but for `names`, in which it differs from `nominal` and which a step may read.

    Numbers are the same up to the rounding of float32. Where sizes differ, only these are named.
    """
    ignored = unread(nominal)
    kept = [name for name in all_fields() if not name.startswith(ignored) and name not in names]
    arrays = [name for name in kept if np.size(attrgetter(name)(nominal))]
    sizes = [name for name in kept if name.startswith("n") and isinstance(getattr(nominal, name), int)]
    get_sizes, get_arrays = attrgetter(*sizes), attrgetter(*arrays)
    wanted_sizes, wanted = get_sizes(nominal), [np.array(x) for x in get_arrays(nominal)]
    keys = [_key(x) for x in get_arrays(nominal)]

    def differing(host: mujoco.MjModel) -> list[str]:
        if (counts := get_sizes(host)) != wanted_sizes:
            return [name for name, a, b in zip(sizes, counts, wanted_sizes, strict=True) if a != b]
        rows = zip(arrays, get_arrays(host), wanted, keys, strict=True)
        different = [(name, x, y) for name, x, y, key in rows if _key(x) != key]
        return [name for name, x, y in different if not np.allclose(x, y, rtol=1e-6, atol=1e-12, equal_nan=True)]

    return differing


def _key(value: Any) -> Any:
    """What is quickly compared: the bytes of an array."""
    return value.tobytes() if isinstance(value, np.ndarray) else value
