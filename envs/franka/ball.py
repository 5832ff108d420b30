"""Pushing a soft ball: a rigid puck in simulation, in reality a ball that rolls, gives way and flattens.

The ball is a core from which pads stick out in all directions, each on a radial slide with a spring and a damper: the
skin gives way where it is pressed and comes back slowly, and rolling costs energy. The core touches fingers and table
too, once the pads have given way by a third of the radius.
"""

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.franka import arm, push, soft
from envs.franka.arm import at_rest
from envs.mujoco.parts import INVISIBLE, add_slide, add_sphere
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

RADIUS = 0.035  # m
PAD = 0.0095  # m, radius of the pads: their neighbours are 0.014 m away
CORE = 0.65  # of the radius
SHELL = 0.5  # of the mass: the pads
# N/m of one pad. Pads swing out up to 1,100 N/m at 5 ms, their armature included, but a ball on the table comes to rest
# only up to 130.
STIFFNESS = 40.0
DAMPING = 2.0  # N s/m of one pad: it comes back in 0.1 s, so the ball stops soon after the hand
ROLLING = 0.003  # m, of the pads on the table: resistance to rolling
# kg of one pad. The solver of contacts does not know of dampers: a pad that is lighter than damping times time step
# chatters on the table for ever.
ARMATURE = 0.01
HEIGHT = 0.075  # m: the hand passes over the ball
SINKS = 0.0055  # m: how far the ball flattens under its weight
ITERATIONS = 12  # rolling resistance takes more than friction; with 8, Warp is not done


def _sphere(splits: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors [v, 3] and faces [f, 3]: an icosahedron whose faces are split in four so many times."""
    golden = (1 + 5**0.5) / 2
    corners = [(a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    points = np.array([np.roll([0.0, a, b], k) for k in range(3) for a, b in corners])
    near = np.linalg.norm(points[:, None] - points, axis=-1) < 2.1
    apart = [
        (i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]
    ]
    faces = np.array([f if np.linalg.det(points[list(f)]) > 0 else f[::-1] for f in apart])
    for _ in range(splits):
        middles = [(points[faces[:, i]] + points[faces[:, (i + 1) % 3]]) / 2 for i in range(3)]
        every, index = np.unique(np.concatenate(middles).round(6), axis=0, return_inverse=True)
        x, y, z = index.reshape(3, -1) + len(points)
        a, b, c = faces.T
        faces = np.concatenate([np.stack(f, 1) for f in ((a, x, z), (b, y, x), (c, z, y), (x, y, z))])
        points = np.concatenate([points, every])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points / np.linalg.norm(points, axis=1, keepdims=True), faces


DIRECTIONS = _sphere(1)[0]  # [42, 3]
NV = arm.N_JOINTS + 6 + len(DIRECTIONS)


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The real scene for one theta. Coordinates: the core's pose, then of every pad how far it sticks out, m."""
    spec = soft.stage(theta, height=HEIGHT, iterations=ITERATIONS)
    core = spec.worldbody.add_body(name="ball", pos=[0, 0, RADIUS])
    core.add_freejoint()
    mass, yellow = theta["object_mass"], [0.95, 0.75, 0.2, 1]
    add_sphere(core, CORE * RADIUS, name="core", mass=(1 - SHELL) * mass, rgba=yellow)
    soft.touch(spec, "core", theta)
    for i, direction in enumerate(DIRECTIONS):
        pad = core.add_body(name=f"pad{i}", pos=direction * (RADIUS - PAD))
        add_slide(pad, direction, stiffness=STIFFNESS, damping=DAMPING, armature=ARMATURE)
        add_sphere(pad, PAD, name=f"pad{i}", mass=SHELL * mass / len(DIRECTIONS), rgba=yellow)
        soft.touch(spec, f"pad{i}", theta, rolling=ROLLING)
    return spec


def initial(params: Array, key: Key) -> PhysicsState:
    """The hand near the base, the ball where theta says."""
    return at_rest(push.ready(key, HEIGHT), _lie(params[:2] + jnp.array([push.TABLE_ORIGIN, 0.0])), NV)


def dress(spec: mujoco.MjSpec) -> None:
    """A smooth skin in the colours of a beach ball."""
    points, faces = _sphere(3)
    weights = np.exp(14.0 * (points @ DIRECTIONS.T - 1.0))
    weights[weights < 0.01 * weights.sum(1, keepdims=True)] = 0.0
    weights /= weights.sum(1, keepdims=True)
    longitude = np.arctan2(points[:, 1], points[:, 0]) / np.pi
    texture = np.stack([np.abs(longitude), (points[:, 2] + 1) / 2], axis=1)  # mirrored, so it has no seam
    bones = [(f"pad{i}", direction * (RADIUS - PAD)) for i, direction in enumerate(DIRECTIONS)]
    look = {"name": "ball", "texture": texture, "repeat": (3.0, 1.0)}
    soft.add_skin(spec, points * RADIUS, faces, weights, bones, colours=((0.95, 0.75, 0.2), (0.25, 0.5, 0.8)), **look)
    spec.geom("core").rgba = INVISIBLE


def _place(qpos: Array) -> Array:
    return qpos[arm.N_JOINTS : arm.N_JOINTS + 2]


def _lie(xy: Array) -> Array:
    return jnp.concatenate([xy, jnp.array([RADIUS - SINKS, 1.0, 0.0, 0.0, 0.0]), jnp.zeros(len(DIRECTIONS))])


SCENE = soft.simulated("push-ball", mass=0.1)
REAL = soft.real_scenes(SCENE, "ball", height=HEIGHT, build=build, initial=initial, place=_place, lie=_lie, dress=dress)
