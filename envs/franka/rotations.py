"""Unit quaternions [4] w, x, y, z: what tasks with free bodies share."""

import jax.numpy as jnp

from envs.types import Array


def turned(turn: Array, vector: Array) -> Array:
    """[3] a vector of a body's frame in that of the world. turn: [4] unit quaternion of the body."""
    return vector + 2 * jnp.cross(turn[1:], jnp.cross(turn[1:], vector) + turn[0] * vector)


def inverse(turn: Array) -> Array:
    """[4] of a unit quaternion."""
    return turn * jnp.array([1.0, -1.0, -1.0, -1.0])
