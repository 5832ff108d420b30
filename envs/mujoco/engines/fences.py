"""Keeps XLA from fusing MJX's walk along the bodies into one kernel: `build()`.

MJX computes a kinematic chain level by level. XLA fuses a level into every later level that reads it and so computes it
again and again: on a CPU a 7-joint arm then spends most of a bare `mjx.step` in `mjx.kinematics`. An optimisation
barrier after each level ends that: 50 to 26 microseconds a bare step of the pushing scene (64 worlds, two cores). On a
GPU the fused kernels are the better ones (0.29 against 0.35 microseconds on an H200), so the barriers stay away there.
For mujoco-mjx 3.17, whose internals this touches.
"""

from collections.abc import Callable

import jax
from mujoco.mjx._src import scan

from envs.types import PyTree

_map_level = scan._nvmap


def _fenced(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    level = _map_level(function, *args)
    fence = level is not None and jax.default_backend() == "cpu"
    return jax.lax.optimization_barrier(level) if fence else level


def build() -> None:
    """Puts a barrier behind every level of every program that is traced from now on."""
    scan._nvmap = _fenced
