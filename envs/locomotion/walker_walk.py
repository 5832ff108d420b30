"""Walker-walk of the DeepMind Control Suite, one of SGFT's sim-to-sim tasks (section 6.3): two legs walk at 1 m/s.

Facts from dm_control (suite/walker, Tassa et al. 2018): frames of 25 ms, 1,000 to an episode that begins with a fall in
any posture and never ends early. An action lasts two frames and earns the rewards of both, as in TD-MPC2 and Du et al.
The real walker has other masses, see `envs.control.suite`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Entry
from envs.control.suite import bell, runner
from envs.locomotion import planar
from envs.locomotion.planar import NV, Capsule, Link
from envs.mujoco.scene import Scene
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

TIMESTEP, FRAME, REPEAT = 0.0025, 0.025, 2  # s; s; frames per action
CONTROL_DT = FRAME * REPEAT
ALIKE = 10.3138485  # kg of every link in Du et al., the torso's in MuJoCo of their day
HEIGHT = 1.3  # m of the torso at the start
DENSITY, FRICTION = 1000.0, 0.7  # kg/m^3
DAMPING, ARMATURE = 0.1, 0.01  # N m s/rad, kg m^2
LIMIT = {"solimp_limit": [0.0, 0.99, 0.01, 0.5, 2.0]}
STANDING, LOW, SPEED = 1.2, 0.6, 1.0  # m that earn all; m below it that earn a tenth; m/s
TORSO = Capsule(0.07, 0.3, (0.0, 0.0), 0.0)
LINKED = 7  # the torso and six links


def _leg(side: str) -> tuple[Link, ...]:
    """side: what ends the names of a leg. Both legs are in one plane."""
    hip, knee, ankle = (tuple(np.radians(limits)) for limits in ((-20.0, 100.0), (-150.0, 0.0), (-45.0, 45.0)))
    thigh, leg, foot = (f"{part}{side}" for part in ("thigh", "leg", "foot"))
    joint = (0.0, DAMPING)  # no spring
    sole = Capsule(0.05, 0.1, (0.0, 0.0), np.pi / 2)
    return (
        Link(thigh, "torso", (0.0, -0.3), (0.0, 0.0), hip, *joint, 100.0, Capsule(0.05, 0.225, (0.0, -0.225), 0.0)),
        Link(leg, thigh, (0.0, -0.7), (0.0, 0.25), knee, *joint, 50.0, Capsule(0.04, 0.25, (0.0, 0.0), 0.0)),
        Link(foot, leg, (0.06, -0.25), (-0.06, 0.0), ankle, *joint, 20.0, sole),
    )


LINKS = _leg("") + _leg("_left")
LOWEST, HIGHEST = np.array([link.range for link in LINKS]).T  # rad


def draw() -> mujoco.MjSpec:
    """The suite's scene."""
    euler = mujoco.mjtIntegrator.mjINT_EULER
    spec, torso = planar.stage(timestep=TIMESTEP, integrator=euler, gravity=1.0, height=HEIGHT, ref=HEIGHT)
    geom: dict[str, Any] = {"density": DENSITY, "friction": FRICTION}
    planar.add_capsule(spec, torso, "torso", TORSO, **geom)
    for link in LINKS:
        planar.add_link(spec, link, axis=-1, armature=ARMATURE, geom=geom, limit=LIMIT)
    return spec


def initial(params: Array, key: Key) -> PhysicsState:
    """In any posture, at rest, in the air or partly in the ground, as in the suite."""
    key_pitch, key_joints = jax.random.split(key)
    pitch = jax.random.uniform(key_pitch, minval=-jnp.pi, maxval=jnp.pi)
    joints = jax.random.uniform(key_joints, (6,), minval=LOWEST, maxval=HIGHEST)
    return planar.start(jnp.array([0.0, HEIGHT, pitch, *joints]), jnp.zeros(NV))


def observe(params: Array, state: PhysicsState) -> Array:
    """[24]: cosines and sines of the pitch of every link, height, speeds along x and z, of pitch and of the joints."""
    pitches = planar.pitches(LINKS, -1, state.qpos[2:])
    turned = jnp.stack([jnp.cos(pitches), jnp.sin(pitches)], axis=1).ravel()
    return jnp.concatenate([turned, state.qpos[1:2], state.qvel])


def settled(params: Array, obs: Array) -> PhysicsState:
    """The state that is seen, at x = 0."""
    return planar.start(jnp.concatenate([jnp.zeros(1), obs[2 * LINKED :][:1], _pose(obs)]), obs[2 * LINKED + 1 :])


def _pose(obs: Array) -> Array:
    """[7] rad, pitch and joints."""
    cos, sin = obs[: 2 * LINKED].reshape(LINKED, 2).T
    return planar.joints(LINKS, -1, jnp.arctan2(sin, cos))


def frame_reward(masses: Array, obs: Array) -> Array:
    """[] from 0 to 1: the torso is high and upright, the whole moves ahead. masses: [7] kg."""
    upright, height, velocity = obs[0], obs[2 * LINKED], obs[2 * LINKED + 1 :]
    speed = planar.speed([TORSO], LINKS, -1, masses, _pose(obs), velocity)
    standing = (3 * bell(jnp.maximum(STANDING - height, 0.0) / LOW) + (1 + upright) / 2) / 4
    return standing * (5 * jnp.clip(speed / SPEED, 0.0, 1.0) + 1) / 6


def scene(name: str = "walker-walk", **masses: Any) -> Scene:
    """The task. masses: see `envs.control.suite.runner`."""
    return runner(
        draw,
        frame_reward,
        frames=REPEAT,
        observe=observe,
        alike=ALIKE,
        name=name,
        observation=(
            Entry("pitches", "", 2 * LINKED),
            Entry("height", "m", 1),
            Entry("velocity_xz", "m/s", 2),
            Entry("pitch_velocity", "rad/s", 1),
            Entry("joint_velocities", "rad/s", 6),
        ),
        episode_length=500,
        control_dt=CONTROL_DT,
        substeps=round(CONTROL_DT / TIMESTEP),
        initial=initial,
        settled=settled,
        view=planar.VIEW,
        **masses,
    )


SCENE = scene()
