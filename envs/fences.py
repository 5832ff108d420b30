"""Keeps XLA from fusing MJX's walk along the bodies into one kernel. Importing it is enough.

MJX computes a kinematic chain level by level. XLA fuses a level into every later level that reads it and so computes it
again and again, exponentially often in the length of the chain: on a CPU a 7-joint arm then spends most of its step
in `mjx.kinematics`. An optimisation barrier after each level ends that. The numbers are unchanged; `python -m
experiments.accuracy` and the parity tests run with it. For mujoco-mjx 3.17, whose internals this touches.
"""

from collections.abc import Callable

import jax
from mujoco.mjx._src import scan

from sgft_jax.types import PyTree

_map_level = scan._nvmap  # noqa: SLF001


def _fenced(function: Callable[..., PyTree], *args: PyTree) -> PyTree:
    level = _map_level(function, *args)
    return level if level is None else jax.lax.optimization_barrier(level)


scan._nvmap = _fenced  # noqa: SLF001
