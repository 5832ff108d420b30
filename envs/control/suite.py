"""What tasks of the DeepMind Control Suite share: its bell, rewards of several frames, links of other masses.

Source: dm_control (Tassa et al. 2018); of the masses Du et al. 2021, whose settings SGFT's sim-to-sim runs take.
"""

from collections.abc import Callable, Mapping

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Parameter
from envs.types import Array


def bell(distance: Array) -> Array:
    """1 at 0, a tenth at distance 1."""
    return jnp.exp(jnp.log(0.1) * distance**2)


def over_frames(frame: Callable[[Array], Array], before: Array, after: Array, frames: int) -> Array:
    """[] the sum of a frame's reward over the frames of a step, as if it went straight from one end to the other."""
    return (frames - 1) / 2 * frame(before) + (frames + 1) / 2 * frame(after)


def mass_parameters(mass: tuple[float, float, float] = (1.0, 1.0, 1.0), even: float = 0.0) -> tuple[Parameter, ...]:
    """Domain parameters of `weigh`. mass: nominal, least and greatest factor in training. even: in training."""
    return (
        Parameter("mass", "", *mass, minimum=0.05, maximum=20.0),
        Parameter("even", "", even, even, even, minimum=0.0, maximum=1.0),
    )


def masses_of(plain: mujoco.MjModel, alike: float, params: Array) -> Array:
    """[links] kg. plain: the scene with the suite's masses. params: as `mass_parameters`.

    even: share by which links weigh `alike` kg instead of what they weigh in the suite; Du et al. give all one mass.
    """
    factor, even = params
    return factor * ((1 - even) * jnp.asarray(plain.body_mass[1:]) + even * alike)


def weigh(spec: mujoco.MjSpec, plain: mujoco.MjModel, alike: float, theta: Mapping[str, float]) -> None:
    """Gives the links other masses, in place. plain, alike: see `masses_of`.

    Inertias stay as they are, as in Du et al. and in SGFT's code, whose real walker has every mass doubled.
    """
    masses = masses_of(plain, alike, jnp.array([theta["mass"], theta["even"]]))
    for i, mass in enumerate(np.asarray(masses), start=1):
        body = spec.body(plain.body(i).name)
        body.explicitinertial, body.mass, body.inertia = True, float(mass), plain.body_inertia[i]
        body.ipos, body.iquat = plain.body_ipos[i], plain.body_iquat[i]
