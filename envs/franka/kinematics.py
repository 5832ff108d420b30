"""Forward kinematics, Jacobian and differential inverse kinematics of the arm: pure functions of joint angles."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.franka import arm
from envs.types import Array

# Gripper pointing down, fingers opening along y of the base.
DOWN = np.diag([1.0, -1.0, -1.0])


class Pose(NamedTuple):
    """Position [3] in m and rotation matrix [3, 3], both in the base frame."""

    position: Array
    rotation: Array


def _joint_bases() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[7, 4, 4] each: the transform of joint i is the first + cos(q_i) * the second + sin(q_i) * the third."""
    fixed, cosine, sine = np.zeros((3, arm.N_JOINTS, 4, 4), np.float32)
    for i, (a, d, alpha) in enumerate(zip(arm.DH_A, arm.DH_D, arm.DH_ALPHA, strict=True)):
        ca, sa = np.cos(alpha), np.sin(alpha)
        fixed[i] = [[0, 0, 0, a], [0, 0, -sa, -sa * d], [0, 0, ca, ca * d], [0, 0, 0, 1]]
        cosine[i, :3, :2] = [[1, 0], [0, ca], [0, sa]]
        sine[i, :3, :2] = [[0, -1], [ca, 0], [sa, 0]]
    return fixed, cosine, sine


_FIXED, _COSINE, _SINE = _joint_bases()


def _hand_frame() -> np.ndarray:
    c, s = np.cos(arm.HAND_YAW), np.sin(arm.HAND_YAW)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _chain(q: Array, tool: Array) -> tuple[Pose, Array, Array]:
    """Pose of the tool and, per joint, its axis and a point on it: [7, 3], [7, 3].

    Products of 4 x 4 matrices as sums, which XLA fuses into one kernel, where it would call a library for each `@`.
    """
    turn = q[:, None, None]
    joints = _FIXED + jnp.cos(turn) * _COSINE + jnp.sin(turn) * _SINE
    frames = [joints[0]]
    for i in range(1, arm.N_JOINTS):
        frames.append((frames[-1][:, :, None] * joints[i][None]).sum(1))
    chain = jnp.stack(frames)
    rotation, position = chain[-1, :3, :3], chain[-1, :3, 3]
    pose = Pose(position + rotation @ tool, rotation @ jnp.asarray(_hand_frame(), jnp.float32))
    return pose, chain[:, :3, 2], chain[:, :3, 3]


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
        step = rest + jac.T @ jax.scipy.linalg.solve(gram, error - jac @ rest, assume_a="pos")
        limits = jnp.asarray(arm.Q_MIN, jnp.float32), jnp.asarray(arm.Q_MAX, jnp.float32)
        return jnp.clip(q + jnp.clip(step, -0.5, 0.5), *limits), None

    return jax.lax.scan(improve, q, None, length=iterations)[0]


def rotation_error(current: Array, target: Array) -> Array:
    """[3] rad, small-angle rotation vector (base frame) that turns `current` into `target`."""
    return 0.5 * jnp.cross(current.T, target.T).sum(0)


def _tool(tool: Array | None) -> Array:
    return jnp.array([0.0, 0.0, arm.TCP]) if tool is None else tool
