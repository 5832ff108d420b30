"""What tasks without an arm share: a table, in the solver that their contacts need, and quaternions [4] w, x, y, z."""

import functools

import jax.numpy as jnp
import mujoco

from envs.mujoco.parts import add_plane, stiff_spec
from envs.mujoco.scene import Scene
from envs.types import Array

# Steps of a hand; joints or objects that are faster than 500 m/s or rad/s have exploded.
scene = functools.partial(Scene, cartesian=True, training={"obs_noise": 0.002, "obs_noise_prob": 0.3}, max_speed=500.0)


def table_spec(timestep: float) -> mujoco.MjSpec:
    """A scene that holds a table without edges. timestep: of the physics, s."""
    spec = stiff_spec(timestep, iterations=6, ls_iterations=8)
    # With pyramids for friction as few iterations leave so large an error that a sliding cube trips over its edge.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    add_plane(spec, "table")
    return spec


def turned(turn: Array, vector: Array) -> Array:
    """[3] a vector of a body's frame in that of the world. turn: [4] unit quaternion of the body."""
    return vector + 2 * jnp.cross(turn[1:], jnp.cross(turn[1:], vector) + turn[0] * vector)


def inverse(turn: Array) -> Array:
    """[4] of a unit quaternion."""
    return turn * jnp.array([1.0, -1.0, -1.0, -1.0])
