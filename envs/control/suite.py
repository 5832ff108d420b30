"""What tasks of the DeepMind Control Suite share: its bell, rewards of several frames, links of other masses.

Source: dm_control (Tassa et al. 2018); of the masses Du et al. 2021, whose settings SGFT's sim-to-sim runs take.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Entry, Parameter
from envs.mujoco.scene import Measured, Scene
from envs.mujoco.worlds import PhysicsState
from envs.types import Array


def bell(distance: Array) -> Array:
    """1 at 0, a tenth at distance 1."""
    return jnp.exp(jnp.log(0.1) * distance**2)


def runner(
    draw: Callable[[], mujoco.MjSpec],
    frame_reward: Callable[[Array, Array], Array],
    *,
    frames: int,
    observe: Callable[[Array, PhysicsState], Array],
    alike: float,
    mass: tuple[float, float, float] = (1.0, 1.0, 1.0),
    even: float = 0.0,
    **parts: Any,
) -> Scene:
    """A scene of links on six motors whose masses vary, paid for every frame of a step.

    draw() -> the suite's own. frame_reward(masses [links], obs) -> []. frames: of a step. alike, even: see `masses_of`;
    even is fixed. mass: nominal, least and greatest factor in training. parts: see `Scene`.
    """

    @functools.cache
    def plain() -> mujoco.MjModel:
        return draw().compile()

    def build(theta: dict[str, float]) -> mujoco.MjSpec:
        spec = draw()
        weigh(spec, plain(), masses_of(plain(), alike, np.array([theta["mass"], theta["even"]])))
        return spec

    def paid(masses: Array, obs: Array, next_obs: Array) -> Array:
        """As if the step went straight from one end to the other."""
        before, after = (frame_reward(masses, x) for x in (obs, next_obs))
        return (frames - 1) / 2 * before + (frames + 1) / 2 * after

    def measured(params: Array, before: PhysicsState, action: Array, after: PhysicsState) -> Measured:
        masses = masses_of(plain(), alike, params)
        return Measured(reward=paid(masses, observe(params, before), observe(params, after)))

    return Scene(
        action=(Entry("joint_torques", "gear", 6),),
        parameters=(
            Parameter("mass", "", *mass, minimum=0.05, maximum=20.0),
            Parameter("even", "", even, even, even, minimum=0.0, maximum=1.0),
        ),
        build=build,
        target=lambda qpos, action: jnp.clip(action, -1.0, 1.0),
        observe=observe,
        reward=lambda obs, action, next_obs: paid(jnp.asarray(plain().body_mass[1:]), obs, next_obs),
        measured=measured,
        score="return",
        max_speed=1_000.0,
        **parts,
    )


def masses_of(plain: mujoco.MjModel, alike: float, params: Any) -> Any:
    """[links] kg. plain: the scene with the suite's masses. params: factor of all, and share `even`.

    even: share by which links weigh `alike` kg instead of what they weigh in the suite; Du et al. give all one mass.
    """
    factor, even = params
    return factor * ((1 - even) * plain.body_mass[1:] + even * alike)


def weigh(spec: mujoco.MjSpec, plain: mujoco.MjModel, masses: np.ndarray) -> None:
    """Gives the links other masses, in place.

    Inertias stay as they are, as in Du et al. and in SGFT's code, whose real walker has every mass doubled.
    """
    for i, mass in enumerate(masses, start=1):
        body = spec.body(plain.body(i).name)
        body.explicitinertial, body.mass, body.inertia = True, float(mass), plain.body_inertia[i]
        body.ipos, body.iquat = plain.body_ipos[i], plain.body_iquat[i]
