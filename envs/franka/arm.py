"""A Franka Research 3 arm of primitive geoms, from public kinematic, limit and inertial facts.

Kinematics: modified Denavit-Hartenberg table of the manufacturer. Limits: the manufacturer's position limits (the
narrower box of constant velocity limits cannot point the gripper down closer than 0.3 m to the base). Link inertias
follow from capsules of the published link masses; reflected motor inertia (armature) dominates the wrist. The arm
touches nothing: only a task's tool has contacts, declared pair by pair.
"""

import mujoco
import numpy as np

from envs.mujoco.parts import add_box, add_capsule, add_hinge, add_servo

N_JOINTS = 7
# a [m], d [m], alpha [rad] of the transform from frame i-1 to frame i; the flange is a fixed eighth frame.
DH_A = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)
DH_D = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0)
DH_ALPHA = (0.0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2)
FLANGE = 0.107  # m along z of frame 7
TCP = FLANGE + 0.1034  # m along z of frame 7: between the fingertips
HAND_YAW = -np.pi / 4  # the hand is mounted at -45 degrees about the flange axis

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


def add_arm(spec: mujoco.MjSpec, *, stiffness: float = 1.0) -> mujoco.MjsBody:
    """Adds the arm and its servos at the world origin; returns the last link, whose frame carries the tool.

    stiffness: multiplies the servo stiffness (and damping) of every joint.
    Tool geoms belong on the returned body: the flange is at (0, 0, FLANGE), the tool centre point at (0, 0, TCP).
    """
    add_capsule(spec.worldbody, 0.075, fromto=[0, 0, 0, 0, 0, 0.16], mass=0, rgba=_GREY)
    body = spec.worldbody
    for i in range(N_JOINTS):
        body = _add_link(body, i)
        kp, most = float(STIFFNESS[i]) * stiffness, TORQUE_MAX[i]
        servo = add_servo(spec, f"joint{i + 1}", kp, kp * DAMPING_TIME, name=f"servo{i + 1}")
        servo.forcelimited, servo.forcerange = 1, [-most, most]
    add_capsule(body, 0.04, fromto=[0, 0, FLANGE, 0, 0, FLANGE + 0.02], mass=0, rgba=_DARK)
    place, turn = [0, 0, FLANGE + 0.045], tool_quaternion()
    add_box(body, [0.025, 0.1, 0.03], pos=place, quat=turn, mass=HAND_MASS, rgba=_DARK)
    return body


def tool_quaternion() -> np.ndarray:
    """[4] w, x, y, z: orientation of the hand in the frame of the last link."""
    return np.array([np.cos(HAND_YAW / 2), 0.0, 0.0, np.sin(HAND_YAW / 2)])


def _add_link(parent: mujoco.MjsBody, i: int) -> mujoco.MjsBody:
    alpha, a, d = DH_ALPHA[i], DH_A[i], DH_D[i]
    pos, quat = [a, -np.sin(alpha) * d, np.cos(alpha) * d], [np.cos(alpha / 2), np.sin(alpha / 2), 0, 0]
    body = parent.add_body(name=f"link{i + 1}", pos=pos, quat=quat)
    add_hinge(body, [0, 0, 1], name=f"joint{i + 1}", armature=ARMATURE[i], damping=JOINT_DAMPING)
    start, end, radius = _SHAPES[i]
    add_capsule(body, radius, fromto=[*start, *end], mass=LINK_MASS[i], rgba=_WHITE if i % 2 else _GREY)
    return body
