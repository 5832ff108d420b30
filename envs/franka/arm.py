"""A Franka Research 3 arm of primitive geoms, from public kinematic, limit and inertial facts; what its tasks share.

Kinematics: modified Denavit-Hartenberg table of the manufacturer. Limits: the manufacturer's position limits (the
narrower box of constant velocity limits cannot point the gripper down closer than 0.3 m to the base). Link inertias
follow from capsules of the published link masses; reflected motor inertia (armature) dominates the wrist. The arm
touches nothing: only a task's tool has contacts, declared pair by pair.

After the arm itself: its kinematics, as pure functions of joint angles; then control period, empty scene, states at
rest, and how a viewer sees the arm.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.mujoco.parts import add_box, add_capsule, add_cylinder, add_hinge, add_servo, stiff_spec
from envs.mujoco.scene import Scene
from envs.mujoco.worlds import PhysicsState
from envs.types import Array

N_JOINTS = 7
# a [m], d [m], alpha [rad] of the transform from frame i-1 to frame i; the flange is a fixed eighth frame.
DH_A = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)
DH_D = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0)
DH_ALPHA = (0.0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2)
FLANGE = 0.107  # m along z of frame 7
TCP = FLANGE + 0.1034  # m along z of frame 7: between the fingertips
HAND_YAW = -np.pi / 4  # the hand is mounted at -45 degrees about the flange axis
HAND_TURN = np.array([np.cos(HAND_YAW / 2), 0.0, 0.0, np.sin(HAND_YAW / 2)])  # w, x, y, z in the frame of the last link

Q_MIN = np.array([-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159])
Q_MAX = np.array([2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159])
TORQUE_MAX = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
LINK_MASS = (2.927, 2.936, 2.245, 2.616, 2.327, 1.817, 0.627)
HAND_MASS = 0.73
ARMATURE = (0.195, 0.195, 0.195, 0.195, 0.074, 0.074, 0.074)
JOINT_DAMPING = 1.0
# Servo stiffness per joint; damping is stiffness / 20, close to critical for the whole chain: a 0.1 s ramp has settled
# at the end of a 0.2 s control period, so observations at 5 Hz need no memory of the command.
STIFFNESS = np.array([4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0])
DAMPING_TIME = 1 / 20  # s
GRIP_TIME = 0.04  # s: what a grip that gives way needs to come back
# Gripper down, elbow up, in front of the base.
Q_HOME = np.array([0.0, 0.0, 0.0, -np.pi / 2, 0.0, np.pi / 2, np.pi / 4])

# Capsules that stand for the links: (from, to, radius), in the link's own frame.
_SHAPES = (
    ((0, 0, -0.16), (0, 0, 0.0), 0.06),
    ((0, 0, 0.0), (0, -0.16, 0.0), 0.06),
    ((0, 0, -0.13), (0.06, 0, 0.0), 0.055),
    ((0, 0, 0.0), (-0.06, 0.09, 0.0), 0.055),
    ((0, 0.04, -0.24), (0, 0.06, -0.02), 0.048),
    ((0, 0, 0.0), (0.07, 0.0, 0.0), 0.047),
    ((0, 0, 0.03), (0, 0, 0.09), 0.042),
)
_WHITE, _GREY, _DARK = (0.93, 0.94, 0.95, 1), (0.55, 0.58, 0.62, 1), (0.16, 0.17, 0.2, 1)
_RING, _STAND = [0.60, 0.62, 0.65, 1.0], [0.20, 0.21, 0.24, 1.0]

CONTROL_DT = 0.2  # s, 5 Hz as in the paper
RAMP = 0.1  # s: the servo's target moves linearly to its new value, then rests, so the arm has settled at the next step
# Exact commands, occasional sensor noise in raw units (paper, Appendix C).
TRAINING = {"obs_noise": 0.004, "obs_noise_prob": 0.3}
NOISE = {"obs_noise": [0.0, 0.004]}  # of the domain in which actuators and sensors differ
scene = functools.partial(Scene, control_dt=CONTROL_DT, ramp=RAMP, training=TRAINING, actuators=NOISE)
FLOOR = -0.75  # m: the arm stands on a table
# Gripper pointing down, fingers opening along y of the base.
DOWN = np.diag([1.0, -1.0, -1.0])


def new_spec(*, substeps: int, iterations: int, ls_iterations: int) -> mujoco.MjSpec:
    """An empty scene with the solver settings all tasks share; contacts only where a task declares a pair."""
    spec = stiff_spec(CONTROL_DT / substeps, iterations=iterations, ls_iterations=ls_iterations)
    # The robot compensates its own weight, which is the same as none, and MuJoCo's per-body compensation costs a
    # quarter of the simulation speed. A task gives weight to the objects that need it, see `push`.
    spec.option.gravity = np.zeros(3)
    return spec


def add_arm(spec: mujoco.MjSpec, *, stiffness: float = 1.0) -> mujoco.MjsBody:
    """Adds the arm and its servos at the world origin; returns the last link, whose frame carries the tool.

    stiffness: multiplies the servo stiffness (and damping) of every joint.
    Tool geoms belong on the returned body: the flange is at (0, 0, FLANGE), the tool centre point at (0, 0, TCP).
    """
    add_capsule(spec.worldbody, 0.075, fromto=[0, 0, 0, 0, 0, 0.16], mass=0, rgba=_GREY)
    body = spec.worldbody
    for i in range(N_JOINTS):
        body = _add_link(body, i)
        kp = float(STIFFNESS[i]) * stiffness
        add_servo(spec, f"joint{i + 1}", kp, kp * DAMPING_TIME, TORQUE_MAX[i], name=f"servo{i + 1}")
    add_capsule(body, 0.04, fromto=[0, 0, FLANGE, 0, 0, FLANGE + 0.02], mass=0, rgba=_DARK)
    add_box(body, [0.025, 0.1, 0.03], pos=[0, 0, FLANGE + 0.045], quat=HAND_TURN, mass=HAND_MASS, rgba=_DARK)
    return body


def add_loose(link: mujoco.MjsBody, stiffness: float, *axes: tuple[float, float]) -> mujoco.MjsBody:
    """What the hand holds, as a body in the frame of the last link that gives way about the tool centre point.

    stiffness: N m/rad, about each of these axes, xy in the frame of the hand.
    """
    body = link.add_body()
    damping = stiffness * GRIP_TIME  # MuJoCo's solver of contacts does not see it: the inertia stands for it
    for axis in axes:
        spring = {"stiffness": stiffness, "damping": damping, "armature": damping * GRIP_TIME / 4}
        add_hinge(body, [*across(*axis), 0.0], pos=[0, 0, TCP], **spring)
    # Between the fingers; a sphere alone, the hammer's face, has no axes of inertia.
    add_box(body, [0.004, 0.008, 0.016], pos=[0, 0, TCP], mass=0.01, rgba=_DARK)
    return body


def across(x: float, y: float) -> tuple[float, float]:
    """Xy in the frame of the hand -> xy in the frame of the last link."""
    c, s = np.cos(HAND_YAW), np.sin(HAND_YAW)
    return c * x - s * y, s * x + c * y


def _add_link(parent: mujoco.MjsBody, i: int) -> mujoco.MjsBody:
    alpha, a, d = DH_ALPHA[i], DH_A[i], DH_D[i]
    pos, quat = [a, -np.sin(alpha) * d, np.cos(alpha) * d], [np.cos(alpha / 2), np.sin(alpha / 2), 0, 0]
    body = parent.add_body(name=f"link{i + 1}", pos=pos, quat=quat)
    add_hinge(body, [0, 0, 1], name=f"joint{i + 1}", armature=ARMATURE[i], damping=JOINT_DAMPING)
    start, end, radius = _SHAPES[i]
    add_capsule(body, radius, fromto=[*start, *end], mass=LINK_MASS[i], rgba=_WHITE if i % 2 else _GREY)
    return body


class Pose(NamedTuple):
    """Position [3] in m and rotation matrix [3, 3], both in the base frame."""

    position: Array
    rotation: Array


def _joint_bases() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[7, 4, 4] each: the transform of joint i is the first + cos(q_i) * the second + sin(q_i) * the third."""
    fixed, cosine, sine = np.zeros((3, N_JOINTS, 4, 4), np.float32)
    for i, (a, d, alpha) in enumerate(zip(DH_A, DH_D, DH_ALPHA, strict=True)):
        ca, sa = np.cos(alpha), np.sin(alpha)
        fixed[i] = [[0, 0, 0, a], [0, 0, -sa, -sa * d], [0, 0, ca, ca * d], [0, 0, 0, 1]]
        cosine[i, :3, :2] = [[1, 0], [0, ca], [0, sa]]
        sine[i, :3, :2] = [[0, -1], [ca, 0], [sa, 0]]
    return fixed, cosine, sine


_FIXED, _COSINE, _SINE = _joint_bases()


def _chain(q: Array, tool: Array | None) -> tuple[Pose, Array]:
    """Pose of the tool, see `forward`, and its Jacobian.

    Products of 4 x 4 matrices as sums, which XLA fuses into one kernel, where it would call a library for each `@`.
    """
    turn = q[:, None, None]
    joints = _FIXED + jnp.cos(turn) * _COSINE + jnp.sin(turn) * _SINE
    frames = [joints[0]]
    for i in range(1, N_JOINTS):
        frames.append((frames[-1][:, :, None] * joints[i][None]).sum(1))
    chain = jnp.stack(frames)
    rotation, position = chain[-1, :3, :3], chain[-1, :3, 3]
    hand = np.array([[*across(1.0, 0.0), 0.0], [*across(0.0, 1.0), 0.0], [0.0, 0.0, 1.0]]).T
    tool = jnp.array([0.0, 0.0, TCP]) if tool is None else tool
    pose = Pose(position + rotation @ tool, rotation @ jnp.asarray(hand, jnp.float32))
    axes, origins = chain[:, :3, 2], chain[:, :3, 3]
    return pose, jnp.concatenate([jnp.cross(axes, pose.position[None] - origins).T, axes.T])


def forward(q: Array, tool: Array | None = None) -> Pose:
    """Pose of the tool point for joint angles q: [7] rad.

    tool: [3] m, a point in the frame of the last link; default the tool centre point between the fingertips.
    """
    return _chain(q, tool)[0]


def jacobian(q: Array, tool: Array | None = None) -> Array:
    """[6, 7] geometric Jacobian in the base frame: rows are m/s and rad/s of the tool per rad/s of each joint."""
    return _chain(q, tool)[1]


def solve(
    q: Array | np.ndarray, target: Pose, *, iterations: int, damping: float = 0.02, posture: float = 0.0
) -> Array:
    """[7] joint angles near q that bring the tool to `target`, by damped least squares, inside the joint limits.

    iterations: Newton steps; 2 are exact to 0.1 mm for moves of 5 cm.
    damping: regularisation of the least-squares step, in units of the Jacobian (m/rad).
    posture: per-iteration pull of the redundant degree of freedom towards `Q_HOME` (0 = none).
    Unreachable targets end at a nearby reachable pose.
    """

    def improve(q: Array, _: None) -> tuple[Array, None]:
        pose, jac = _chain(q, None)
        error = jnp.concatenate([target.position - pose.position, rotation_error(pose.rotation, target.rotation)])
        rest = posture * (jnp.asarray(Q_HOME, jnp.float32) - q)
        gram = jac @ jac.T + damping**2 * jnp.eye(6)
        step = rest + jac.T @ jax.scipy.linalg.solve(gram, error - jac @ rest, assume_a="pos")
        return clip_joints(q + jnp.clip(step, -0.5, 0.5)), None

    return jax.lax.scan(improve, jnp.asarray(q, jnp.float32), None, length=iterations)[0]


def solve_down(q: Array | np.ndarray, position: Array, *, iterations: int) -> Array:
    """`solve` for a gripper at `position` [3] that points down."""
    return solve(q, Pose(position, jnp.asarray(DOWN, jnp.float32)), iterations=iterations, posture=0.05)


def rotation_error(current: Array, target: Array) -> Array:
    """[3] rad, small-angle rotation vector (base frame) that turns `current` into `target`."""
    return 0.5 * jnp.cross(current.T, target.T).sum(0)


def at_rest(joints: Array, others: Array, nv: int) -> PhysicsState:
    """A motionless state: arm at `joints` [7], the other coordinates at `others`, servo target where the arm is."""
    return PhysicsState(jnp.concatenate([joints, others]), jnp.zeros(nv), jnp.zeros(nv), joints)


def clip_joints(q: Array) -> Array:
    """Joint targets inside the position limits."""
    return jnp.clip(q, jnp.asarray(Q_MIN, jnp.float32), jnp.asarray(Q_MAX, jnp.float32))


def dress(spec: mujoco.MjSpec, *, table: tuple[float, float, float] | None = None) -> None:
    """The robot's pedestal and livery, and the legs of the table it stands on: x of the back and the front ones and
    how far they stand to the sides, m.
    """
    for link in (body for body in spec.bodies if body.name.startswith("link")):
        capsule = link.geoms[0]  # white, with a grey ring at each joint
        capsule.rgba = _WHITE
        radius = 1.06 * capsule.size[0]
        add_cylinder(link, radius, 0.35 * radius, rgba=_RING, mass=0)
    add_cylinder(spec.worldbody, 0.11, 0.015, pos=[0, 0, 0.015], rgba=_STAND)
    add_cylinder(spec.worldbody, 0.09, 0.09, pos=[0, 0, 0.09], rgba=_WHITE)
    half = -(FLOOR + 0.04) / 2
    for x in table[:2] if table else ():
        for y in (-table[2], table[2]) if table else ():
            add_box(spec.worldbody, [0.02, 0.02, half], pos=[x, y, -0.04 - half], rgba=_STAND)
    spec.stat.extent, spec.stat.center = 1.5, [0.3, 0, 0.3]
