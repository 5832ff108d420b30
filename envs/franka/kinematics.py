"""Forward kinematics, Jacobian and differential inverse kinematics of the arm: pure functions of joint angles."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.franka import arm
from sgft_jax.types import Array

# Gripper pointing down, fingers opening along y of the base.
DOWN = np.diag([1.0, -1.0, -1.0])


class Pose(NamedTuple):
    """Position [3] in m and rotation matrix [3, 3], both in the base frame."""

    position: Array
    rotation: Array


def _joint_transform(i: int, q: Array) -> tuple[Array, Array]:
    ca, sa = float(np.cos(arm.DH_ALPHA[i])), float(np.sin(arm.DH_ALPHA[i]))
    c, s = jnp.cos(q), jnp.sin(q)
    rotation = jnp.stack(
        [
            jnp.stack([c, -s, jnp.zeros_like(c)]),
            jnp.stack([ca * s, ca * c, jnp.full_like(c, -sa)]),
            jnp.stack([sa * s, sa * c, jnp.full_like(c, ca)]),
        ]
    )
    return jnp.array([arm.DH_A[i], -sa * arm.DH_D[i], ca * arm.DH_D[i]]), rotation


def _hand_frame() -> np.ndarray:
    c, s = np.cos(arm.HAND_YAW), np.sin(arm.HAND_YAW)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _chain(q: Array, tool: Array) -> tuple[Pose, Array, Array]:
    """Pose of the tool and, per joint, its axis and a point on it: [7, 3], [7, 3]."""
    position, rotation = jnp.zeros(3), jnp.eye(3)
    axes, origins = [], []
    for i in range(arm.N_JOINTS):
        offset, turn = _joint_transform(i, q[i])
        position, rotation = position + rotation @ offset, rotation @ turn
        axes.append(rotation[:, 2])
        origins.append(position)
    pose = Pose(position + rotation @ tool, rotation @ jnp.asarray(_hand_frame(), jnp.float32))
    return pose, jnp.stack(axes), jnp.stack(origins)


def forward(q: Array, tool: Array | None = None) -> Pose:
    """Pose of the tool point for joint angles q: [7] rad.

    tool: [3] m, a point in the frame of the last link; default the tool centre point between the fingertips.
    """
    return _chain(q, _tool(tool))[0]


def jacobian(q: Array, tool: Array | None = None) -> Array:
    """[6, 7] geometric Jacobian in the base frame: rows are m/s and rad/s of the tool per rad/s of each joint."""
    pose, axes, origins = _chain(q, _tool(tool))
    return jnp.concatenate([jnp.cross(axes, pose.position[None] - origins).T, axes.T])


def solve(q: Array, target: Pose, *, iterations: int, damping: float = 0.02, posture: float = 0.0) -> Array:
    """[7] joint angles near q that bring the tool to `target`, by damped least squares, inside the joint limits.

    iterations: Newton steps; 2 are exact to 0.1 mm for moves of 5 cm.
    damping: regularisation of the least-squares step, in units of the Jacobian (m/rad).
    posture: per-iteration pull of the redundant degree of freedom towards `arm.Q_HOME` (0 = none).
    Unreachable targets end at a nearby reachable pose.
    """

    def improve(q: Array, _: None) -> tuple[Array, None]:
        pose, axes, origins = _chain(q, _tool(None))
        jac = jnp.concatenate([jnp.cross(axes, pose.position[None] - origins).T, axes.T])
        error = jnp.concatenate([target.position - pose.position, rotation_error(pose.rotation, target.rotation)])
        rest = posture * (jnp.asarray(arm.Q_HOME, jnp.float32) - q)
        gram = jac @ jac.T + damping**2 * jnp.eye(6)
        step = rest + jac.T @ jnp.linalg.solve(gram, error - jac @ rest)
        limits = jnp.asarray(arm.Q_MIN, jnp.float32), jnp.asarray(arm.Q_MAX, jnp.float32)
        return jnp.clip(q + jnp.clip(step, -0.5, 0.5), *limits), None

    return jax.lax.scan(improve, q, None, length=iterations)[0]


def rotation_error(current: Array, target: Array) -> Array:
    """[3] rad, small-angle rotation vector (base frame) that turns `current` into `target`."""
    return 0.5 * jnp.cross(current.T, target.T).sum(0)


def _tool(tool: Array | None) -> Array:
    return jnp.array([0.0, 0.0, arm.TCP]) if tool is None else tool
