"""Hammering: drive a nail into a board with three joints of the arm. Paper section 6.1.

Everything happens in the arm's vertical plane y = 0. The gripper points down and holds the hammer close to its head, on
the side of the base, so that the striking face is almost below joint 6: the weak wrist (12 Nm) then carries over 250 N.
"Nail z" of the paper's Table 1 is read as the height of the nail's head at the start, the board lies 2 * half height
below. Nail height means the underside of the head: it touches the board at 0. A head driven deeper sinks in until
the hammer itself meets the board.

The face meets the nail and the board. For handle and wrist the board is a plane; parts of the arm between the two need
no contact of their own, because they stay above it. The elbow may start beside a high board and below its top, so for
the elbow the board is a block with an edge.
"""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Entry, Parameter
from envs.franka import arm
from envs.franka.arm import across, at_rest
from envs.mujoco import parts
from envs.mujoco.scene import Scene, View
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

SUBSTEPS = 32
STEP = 0.2  # rad per control step at |action| = 1
JOINTS = np.array([1, 3, 5])  # joints 2, 4 and 6: parallel axes, one vertical plane
TOLERANCE = 0.005  # m above the board counts as driven home
HEAD_BACK = 0.045  # m from the gripper's centre to the hammer's axis, towards the base
FACE = 0.035  # m from the gripper's centre down to the striking face
TOOL = np.array([*across(-HEAD_BACK, 0.0), arm.TCP + FACE])  # m: the face's centre in the frame of the last link
FACE_RADIUS = 0.018  # m: the face is a sphere, so its contact does not depend on the hammer's tilt
START_LOW, START_HIGH = np.array([0.31, 0.69, -0.08]), np.array([0.37, 0.72, 0.08])  # face x, z in m, pitch in rad
Q_READY = np.array([0.0, -0.2, 0.0, -0.9, 0.0, 0.7, np.pi / 4])  # near every start, for the inverse kinematics
STEEL = 7850.0  # kg/m^3
REACTION_TIME = 0.002  # s, see `_add_nail`
SOLREF, SOLIMP = [0.0125, 1.0], [0.0, 0.95, 0.003, 0.5, 2.0]
DEPTH = 0.3  # m: the contact geoms of the nail and of the board's edge reach this far down
HANDLE, HANDLE_RADIUS = 0.13, 0.011  # m from the gripper's centre to the end of the handle, away from the base
# Two spheres on the axis of link 4, wider than its capsule: neither between them nor next to them does the board's edge
# get deeper than 1 cm into the drawn arm. The capsule itself would do as well, but costs MJX's own code far more time.
ELBOW = {"elbow": (-0.006, 0.009, 0.0), "forearm": (-0.054, 0.081, 0.0)}  # m, frame of link 4
ELBOW_RADIUS = 0.065  # m
EDGE = 0.075  # m from the nail to the board's edges: the elbow of some starts would touch a wider board
PAIRS = (
    ("face", "nail"),
    *((name, "board") for name in ("face", "handle", "wrist")),
    *((name, "block") for name in ELBOW),
)
BOARD_THICKNESS = 0.06  # m
GRIPS = (2.0, 4.0, 8.0)  # N m/rad, of real systems
DOME = 0.007  # m, of the head that is drawn
_RED = [0.8, 0.15, 0.1, 1]
NV = arm.N_JOINTS + 1

PARAMETERS = (
    Parameter("nail_x", "m", 0.35, 0.30, 0.40, minimum=0.1, maximum=0.8, real=(0.25, 0.45), place=True),
    Parameter("nail_z", "m", 0.60, 0.55, 0.65, minimum=0.1, maximum=1.0, real=(0.48, 0.69), place=True),
    Parameter("nail_damping", "N s/m", 1000.0, 250.0, 2500.0, minimum=0.0, real=(200.0, 6000.0)),
    Parameter("nail_half_height", "m", 0.04, 0.02, 0.06, minimum=0.001, real=(0.012, 0.08), place=True),
    Parameter("nail_radius", "m", 0.01, 0.005, 0.015, minimum=0.0005, real=(0.002, 0.017)),
    Parameter("head_radius", "m", 0.035, 0.03, 0.04, minimum=0.0005, real=(0.012, 0.05)),
    Parameter("head_thickness", "m", 0.005, 0.001, 0.01, minimum=0.0001, real=(0.0004, 0.017)),
    Parameter("hammer_mass", "kg", 0.05, 0.015, 0.15, minimum=0.001, real=(0.008, 0.6)),
    Parameter("nail_friction", "N", 0.1, 0.1, 0.1, minimum=0.001, real=(0.1, 200.0)),
    Parameter("servo_stiffness", "", 1.0, 1.0, 1.0, minimum=0.01, real=(0.2, 2.5)),
)
_INDEX = {p.name: i for i, p in enumerate(PARAMETERS)}


def build(theta: dict[str, float], grip: float | None = None) -> mujoco.MjSpec:
    """The scene for one theta. grip: N m/rad, of a hand in which the hammer turns; None holds it rigidly."""
    spec = arm.new_spec(substeps=SUBSTEPS, iterations=2, ls_iterations=4)
    link = arm.add_arm(spec, stiffness=theta["servo_stiffness"])
    _add_hammer(link if grip is None else arm.add_loose(link, grip, (0.0, 1.0)), theta["hammer_mass"])
    spec.body("link6").geoms[0].name = "wrist"  # the link's capsule, as drawn
    for name, center in ELBOW.items():
        parts.add_sphere(spec.body("link4"), ELBOW_RADIUS, name=name, pos=center, mass=0, rgba=parts.INVISIBLE)
    board = theta["nail_z"] - 2 * theta["nail_half_height"]
    _add_board(spec, theta["nail_x"], board)
    _add_nail(spec, theta, board)
    for moving, still in PAIRS:
        # Frictionless: one constraint row instead of four, and the face cannot drag the nail.
        spec.add_pair(geomname1=moving, geomname2=still, condim=1, solref=SOLREF, solimp=SOLIMP)
    return spec


def observe(params: Array, state: PhysicsState) -> Array:
    """[12]: face xyz (m), q of joints 2, 4, 6 (rad), their velocities (rad/s), nail z (m), goal xz (m)."""
    joints, velocities = state.qpos[JOINTS], state.qvel[JOINTS]
    goal = jnp.stack([params[_INDEX["nail_x"]], _board(params)])
    nail = goal[1:] + state.qpos[-1:]
    face = arm.forward(state.qpos[: arm.N_JOINTS], jnp.asarray(TOOL, jnp.float32)).position
    return jnp.concatenate([face, joints, velocities, nail, goal])


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """[]: minus ten times the height (m) by which the nail still stands out of the board."""
    return -10.0 * jnp.maximum(0.0, _exposed(next_obs))


def success(obs: Array) -> Array:
    """[] bool: the nail stands out by at most 5 mm."""
    return _exposed(obs) <= TOLERANCE


def initial(params: Array, key: Key) -> PhysicsState:
    """The hammer somewhere above every nail, slightly tilted; the nail standing."""
    x, z, pitch = jax.random.uniform(key, (3,), minval=jnp.array(START_LOW), maxval=jnp.array(START_HIGH))
    c, s = jnp.cos(pitch), jnp.sin(pitch)
    turn = jnp.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ jnp.asarray(arm.DOWN, jnp.float32)
    grip = jnp.stack([x, jnp.zeros(()), z]) - turn @ jnp.array([-HEAD_BACK, 0.0, FACE])
    joints = arm.solve(Q_READY, arm.Pose(grip, turn), iterations=8)
    nail = 2 * params[_INDEX["nail_half_height"]]
    return at_rest(_hold(joints), nail[None], NV)


def settled(params: Array, obs: Array) -> PhysicsState:
    """Joints 2, 4, 6 as they are seen, moving as fast as they are seen to; the nail at its height, at rest."""
    joints = jnp.asarray(Q_READY, jnp.float32).at[JOINTS].set(obs[3:6])
    still = at_rest(joints, obs[9:10] - _board(params), NV)
    return still._replace(qvel=still.qvel.at[JOINTS].set(obs[6:9]))


def target(qpos: Array, action: Array) -> Array:
    """[7] joint targets: joints 2, 4, 6 move by `action` * 0.2 rad from where they are, the others hold still.

    Nothing keeps the hammer above the board but the board itself.
    """
    joints = qpos[: arm.N_JOINTS]
    return arm.clip_joints(_hold(joints.at[JOINTS].add(STEP * action)))


def check(theta: dict[str, float]) -> str | None:
    """The board has to lie above its stand."""
    board = theta["nail_z"] - 2 * theta["nail_half_height"]
    if board > BOARD_THICKNESS:
        return None
    return f"nail_z less twice nail_half_height is the board's height, {board:g} m: more than {BOARD_THICKNESS:g} m"


def dress(spec: mujoco.MjSpec) -> None:
    """The robot, and a red nail with a round head: that one is seen when the flat one has sunk into the board."""
    arm.dress(spec)
    nail = spec.body("nail")
    stem, head, _ = nail.geoms
    stem.rgba = head.rgba = _RED
    size, place = [head.size[0], head.size[0], DOME], [0, 0, 2 * head.size[1]]
    nail.add_geom(type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=size, pos=place, rgba=_RED, mass=0, **parts.NO_CONTACT)


SCENE = arm.scene(
    name="hammer",
    observation=(
        Entry("face_xyz", "m", 3),
        Entry("joint_angles", "rad", 3),
        Entry("joint_velocities", "rad/s", 3),
        Entry("nail_z", "m", 1),
        Entry("goal_xz", "m", 2, error=0.015),
    ),
    action=(Entry("joint_steps", "0.2 rad", 3),),
    parameters=PARAMETERS,
    episode_length=50,
    substeps=SUBSTEPS,
    workspace=((0.28, 0.5), (0.0, 0.0), (0.44, 0.72)),
    # Joints sag under a tool more than Cartesian commands drift.
    actuators={**arm.NOISE, "action_scale": [[0.6] * 3, [1.4] * 3], "action_bias": [[-0.3] * 3, [0.3] * 3]},
    build=build,
    initial=initial,
    settled=settled,
    target=target,
    observe=observe,
    reward=reward,
    success=success,
    check=check,
    dress=dress,
    view=View((0.36, 0.0, 0.58), 0.52, 65.0, -16.0, 0.0),
)


def loose(grip: float) -> Scene:
    """Hammering where the hammer turns in the hand, which nothing measures. Coordinates: arm, that angle, nail."""

    def begun(params: Array, key: Key) -> PhysicsState:
        state = initial(params, key)
        return at_rest(state.ctrl, jnp.insert(state.qpos[arm.N_JOINTS :], 0, 0.0), NV + 1)

    name = f"grip-{grip:g}"
    return SCENE._replace(variant=name, build=functools.partial(build, grip=grip), initial=begun, settled=None)


REAL = {scene.variant: scene for scene in map(loose, GRIPS)}


def _exposed(obs: Array) -> Array:
    return obs[9] - obs[11]


def _board(params: Array) -> Array:
    return params[_INDEX["nail_z"]] - 2 * params[_INDEX["nail_half_height"]]


def _hold(joints: Array) -> Array:
    """Joints 2, 4, 6 as they are, the others at rest."""
    moving = np.isin(np.arange(arm.N_JOINTS), JOINTS)
    return jnp.where(moving, joints, jnp.asarray(Q_READY, jnp.float32))


def _add_hammer(link: mujoco.MjsBody, mass: float) -> None:
    wood, steel, dark = [0.72, 0.52, 0.3, 1], [0.45, 0.47, 0.5, 1], [0.1, 0.1, 0.12, 1]
    axis, (*head, tip) = arm.TCP, TOOL
    parts.add_sphere(link, FACE_RADIUS, name="face", pos=[*head, tip - FACE_RADIUS], mass=mass, rgba=steel)
    end = (*across(HANDLE, 0.0), axis)
    parts.add_sphere(link, HANDLE_RADIUS, name="handle", pos=end, mass=0, rgba=wood)
    parts.add_cylinder(link, 0.0165, fromto=[*head, axis - 0.045, *head, tip - FACE_RADIUS], mass=0, rgba=steel)
    parts.add_cylinder(link, HANDLE_RADIUS, fromto=[*head, axis, *end], mass=0, rgba=wood)
    for side in (-1, 1):
        xy = across(0, side * 0.019)
        parts.add_cylinder(link, 0.008, fromto=[*xy, arm.FLANGE + 0.07, *xy, axis], mass=0, rgba=dark)


def _add_nail(spec: mujoco.MjSpec, theta: dict[str, float], board: float) -> None:
    """A nail on a vertical slide; its coordinate is the height of the head's underside above the board.

    MuJoCo's contact solver does not see implicit damping. It expects almost no resistance from a nail of 0.05 kg in
    2500 N s/m, and the hammer would sink through the head. Inertia of damping * 2 ms repairs that. It changes the first
    few milliseconds of a blow, not its travel, which is momentum / damping.
    """
    half, radius, head = theta["nail_half_height"], theta["nail_radius"], theta["head_radius"]
    thickness, damping = theta["head_thickness"], theta["nail_damping"]
    steel = [0.7, 0.72, 0.75, 1]
    body = spec.worldbody.add_body(name="nail", pos=[theta["nail_x"], 0, board])
    nail = parts.add_slide(body, [0, 0, 1], name="nail", damping=damping, frictionloss=theta["nail_friction"])
    nail.armature = damping * REACTION_TIME
    parts.add_cylinder(body, radius, half, pos=[0, 0, -half], density=STEEL, rgba=steel)
    parts.add_cylinder(body, head, thickness / 2, pos=[0, 0, thickness / 2], density=STEEL, rgba=steel)
    # What the hammer feels: a block as wide as the head that reaches far down, so a fast hammer cannot pass a thin head
    # or lift it from below.
    place = [0, 0, thickness - DEPTH / 2]
    parts.add_box(body, [head, head, DEPTH / 2], name="nail", pos=place, mass=0, rgba=parts.INVISIBLE)


def _add_board(spec: mujoco.MjSpec, x: float, height: float) -> None:
    """The board stops hammer and wrist at its height everywhere (a plane), and the elbow from its edge on (a block).

    What is drawn is a board on a stand.
    """
    world, half, stand = spec.worldbody, BOARD_THICKNESS / 2, (height - BOARD_THICKNESS) / 2
    parts.add_plane(spec, "board", pos=[0, 0, height])
    center = [x - EDGE + 1, 0, height - DEPTH / 2]
    parts.add_box(world, [1, 1, DEPTH / 2], name="block", pos=center, rgba=parts.INVISIBLE)
    parts.add_box(world, [EDGE, 0.16, half - 1e-4], pos=[x, 0, height - half], rgba=[0.78, 0.62, 0.42, 1])
    parts.add_box(world, [0.05, 0.09, stand], pos=[x, 0, stand], rgba=[0.35, 0.37, 0.4, 1])
