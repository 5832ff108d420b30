"""What MuJoCo computes and another engine leaves out without a word. What an engine refuses itself is not listed."""

from collections.abc import Callable
from typing import NamedTuple

import mujoco

from envs.types import UserError


class Feature(NamedTuple):
    """name: as a user of MJCF knows it. used(model): whether the scene has it. lacking: the engines without it."""

    name: str
    used: Callable[[mujoco.MjModel], bool]
    lacking: tuple[str, ...] = ("jax", "warp")


def _any(*names: str) -> Callable[[mujoco.MjModel], bool]:
    return lambda host: any(getattr(host, name).any() for name in names)


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
    Feature(
        "the custom number max_contact_points, by which MJX drops contacts",
        lambda host: _has(host, "max_contact_points"),
    ),
    Feature("the custom number max_geom_pairs, by which MJX drops contacts", lambda host: _has(host, "max_geom_pairs")),
)


def check_features(engine: str, host: mujoco.MjModel) -> None:
    """Raises UserError that names a feature of the scene which that engine lacks, and the engines that have it."""
    for feature in FEATURES:
        if engine in feature.lacking and feature.used(host):
            others = " or ".join(f"--impl {name}" for name in ("c", "warp") if name not in feature.lacking)
            raise UserError(f"the engine {engine} ignores {feature.name}; use {others}")


def _has(host: mujoco.MjModel, numeric: str) -> bool:
    return mujoco.mj_name2id(host, mujoco.mjtObj.mjOBJ_NUMERIC, numeric) >= 0
