"""Insertion: put a table leg into its hole in a table top. Paper section 6.2.

Everything is measured in the robot's base frame. The table top lies in the bench with its upper face level with the
bench, z = 0, so there is one surface with one hole. The leg is held rigidly, so it is part of the last link, and it
points down: its tip translates by steps while the hand keeps its orientation.

Contacts live in configuration space: a round peg of radius r that stays upright inside a square opening of half-width
R moves exactly as a small ball in an opening of half-width R - r + ball. So two balls on the peg's axis collide with
four boxes around the narrowed opening, and the drawn leg and hole have their true sizes. The balls' radius is the
rounding of the leg's tip: it decides how far off the hole the leg may be and still slide in. Each ball costs 16
constraint rows; a leg of its own shape against a ring of 12 to 16 boxes would cost over a hundred.
"""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Entry, Parameter
from envs.franka import arm
from envs.franka.arm import at_rest, new_spec, solve_down
from envs.mujoco.parts import INVISIBLE, add_box, add_cylinder, add_pair, add_sphere
from envs.mujoco.scene import Scene, View
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

SUBSTEPS = 40
STEP = 0.02  # m per control step at |action| = 1
TOLERANCE = 0.01  # m per axis
PART_HALF = 0.08775  # m, half the side of the table top, scaled by 1.08
HOLE_OFFSET = np.array([0.06075, 0.06075])  # m, hole in the frame of the table top
HOLE_NOMINAL = np.array([0.50, 0.0])  # m, base frame, of an unmoved table top
TOP = 0.0  # m, base frame: the upper face of the table top and the bench
DEPTH = 0.025  # m: how deep the tip is when the leg is assembled
LEG_LENGTH, LEG_HALF_WIDTH, LEG_MASS = 0.0875, 0.015, 0.023  # m, m, kg
LEG_COLOUR = [0.93, 0.80, 0.60, 1]
FINGER_HALF = np.array([0.009, 0.006, 0.025])  # m
WALL_HALF = np.array([0.2, 0.2, 0.05])  # m: large enough for the workspace
GRASP = 0.06  # m from the tool centre point down to the leg's tip
TIP_ROUNDING = 0.003  # m
GRIPS = (1.0, 1.4, 2.0)  # N m/rad, of real systems
UPPER_BALL = 0.018  # m above the tip's ball: it enters the hole's mouth when the leg is nearly assembled
WORKSPACE = np.array([[0.30, -0.30, TOP - DEPTH], [0.70, 0.30, 0.25]])  # m, of the leg's tip, base frame
START_LOW, START_HIGH = np.array([-0.05, -0.05, 0.05]), np.array([0.05, 0.05, 0.10])  # m, from the nominal hole's mouth
# s, servo damping over stiffness, more than the other tasks': the joints of a soft servo lag unequally, and a straight
# descent of 2 cm then bends sideways by 2 mm (1/20 s), 1.3 mm (1/16 s) or 1 mm (1/12 s, which reaches only 17 mm).
DAMPING_TIME = 1 / 16
# The contact stiffens over 0.5 mm behind the surface, so the opening keeps its size for a leg that does not press, and
# 100 N sink in by 0.4 mm. Newton's method then converges in 4 iterations; over 0.2 mm it needs 20, and with 4 the leg
# sinks in by 3 mm.
WOOD = (0.0, 0.9, 0.0005, 0.5, 2.0)
# Joint angles with the hand over the table top: where the inverse kinematics of a reset begins.
Q_READY = np.array([0.0, 0.2, 0.0, -2.39, 0.0, 2.6, np.pi / 4])
NV = arm.N_JOINTS

PARAMETERS = (
    Parameter("part_x", "m", 0.0, -0.05, 0.05, minimum=-0.15, maximum=0.15, real=(-0.06, 0.06), place=True),
    Parameter("part_y", "m", 0.0, -0.05, 0.05, minimum=-0.15, maximum=0.15, real=(-0.06, 0.06), place=True),
    Parameter("part_rotation", "rad", 0.0, -np.pi / 12, np.pi / 12, minimum=-np.pi, maximum=np.pi, real=(-0.6, 0.6)),
    Parameter("part_friction", "", 0.15, 0.14, 0.16, minimum=0.0, real=(0.04, 0.5)),
    Parameter("hole_radius", "m", 0.012, 0.012, 0.012, minimum=0.001, maximum=0.05, real=(0.0116, 0.0126)),
    Parameter("peg_radius", "m", 0.0115, 0.0115, 0.0115, minimum=0.001, maximum=LEG_HALF_WIDTH, real=(0.011, 0.0119)),
    Parameter("servo_stiffness", "", 0.5, 0.5, 0.5, minimum=0.01, real=(0.2, 2.0)),
)


def build(theta: dict[str, float], grip: float | None = None) -> mujoco.MjSpec:
    """The scene for one theta. The table top is fixed to the table. grip: N m/rad, of a hand in which the leg tilts;
    None holds it rigidly.
    """
    spec = new_spec(substeps=SUBSTEPS, iterations=4, ls_iterations=6)
    link = arm.add_arm(spec, stiffness=theta["servo_stiffness"])
    for servo in spec.actuators:
        servo.biasprm[2] = servo.biasprm[1] * DAMPING_TIME
    leg = link if grip is None else arm.add_loose(link, grip, (1.0, 0.0), (0.0, 1.0))
    _add_leg(leg, theta["peg_radius"])
    _add_fingers(link)
    _add_part(spec, theta)
    for ball in ("tip", "shaft"):
        for wall in range(4):
            add_pair(spec, ball, f"wall{wall}", theta["part_friction"], solimp=WOOD)
    return spec


def observe(params: Array, state: PhysicsState) -> Array:
    """[9] m, base frame: tool centre point, the leg's tip, where the tip is when the leg is assembled."""
    joints = state.qpos[: arm.N_JOINTS]
    return jnp.concatenate([arm.forward(joints).position, _tip(joints), assembled(params)])


def assembled(params: Array) -> Array:
    """[3] m, base frame: the place of the leg's tip when it is fully in the hole."""
    c, s = jnp.cos(params[2]), jnp.sin(params[2])
    offset = jnp.asarray(HOLE_OFFSET, jnp.float32)
    turned = jnp.stack([c * offset[0] - s * offset[1], s * offset[0] + c * offset[1]])
    xy = jnp.asarray(HOLE_NOMINAL, jnp.float32) - offset + params[:2] + turned
    return jnp.concatenate([xy, jnp.array([TOP - DEPTH])])


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """[]: 1 when the leg is within 1 cm of its place on each axis, minus 100 times its squared distance, which counts
    up to 10 cm per axis. The paper swaps its y and z distances, harmless because the sum is symmetric.
    """
    distance = jnp.clip(jnp.abs(next_obs[3:6] - next_obs[6:9]), 0.0, 0.1)
    return success(next_obs) - 100.0 * (distance**2).sum()


def success(obs: Array) -> Array:
    """[] bool: the leg is within 1 cm of its place on each axis."""
    return (jnp.abs(obs[3:6] - obs[6:9]) < TOLERANCE).all()


def initial(params: Array, key: Key) -> PhysicsState:
    """The leg above the table top, at a random place around the nominal hole."""
    offset = jax.random.uniform(key, (3,), minval=jnp.asarray(START_LOW), maxval=jnp.asarray(START_HIGH))
    tip = jnp.concatenate([jnp.asarray(HOLE_NOMINAL, jnp.float32), jnp.array([TOP])]) + offset
    joints = solve_down(Q_READY, _hand(tip), iterations=6)
    return at_rest(joints, jnp.zeros(0), NV)


def settled(params: Array, obs: Array) -> PhysicsState:
    """The leg where its tip is seen, upright and at rest."""
    joints = solve_down(Q_READY, _hand(obs[3:6]), iterations=12)
    return at_rest(joints, jnp.zeros(0), NV)


def target(qpos: Array, action: Array) -> Array:
    """[7] joint targets that move the tip by `action` * 2 cm, inside the workspace, and set the leg upright.

    Steps relative to the tip, not the hand: with a caught tip the hand would walk away and the leg would topple.
    """
    joints = qpos[: arm.N_JOINTS]
    goal = jnp.clip(_tip(joints) + STEP * action, jnp.asarray(WORKSPACE[0]), jnp.asarray(WORKSPACE[1]))
    return solve_down(joints, _hand(goal), iterations=3)


def check(theta: dict[str, float]) -> str | None:
    """The leg's peg has to fit: contacts are between balls of no peg's size, which would pass through the wood."""
    hole, peg = theta["hole_radius"], theta["peg_radius"]
    return f"hole_radius {hole:g} m is narrower than peg_radius {peg:g} m" if hole < peg else None


SCENE = arm.scene(
    name="insert",
    observation=(Entry("hand_xyz", "m", 3), Entry("leg_xyz", "m", 3), Entry("hole_xyz", "m", 3, error=0.006)),
    action=(Entry("hand_xyz_step", "2 cm", 3),),
    parameters=PARAMETERS,
    episode_length=40,
    substeps=SUBSTEPS,
    success_anytime=True,
    cartesian=True,
    workspace=((0.44, 0.56), (-0.06, 0.06), (GRASP - DEPTH, GRASP + 0.1)),  # of starts and holes
    actuators={**arm.NOISE, "action_scale": [[0.5] * 3, [1.4] * 3]},
    build=build,
    initial=initial,
    settled=settled,
    target=target,
    observe=observe,
    reward=reward,
    success=success,
    check=check,
    dress=functools.partial(arm.dress, table=(-0.15, 0.75, 0.4)),
    view=View((0.49, 0.0, 0.05), 0.38, 135.0, -22.0, arm.FLOOR),
)


def loose(grip: float) -> Scene:
    """Insertion where the leg tilts in the hand; what is seen is where it is. Coordinates: arm, the two angles."""

    def begun(params: Array, key: Key) -> PhysicsState:
        return at_rest(initial(params, key).ctrl, jnp.zeros(2), NV + 2)

    def seen(params: Array, state: PhysicsState) -> Array:
        pose = arm.forward(state.qpos[: arm.N_JOINTS])
        (sx, sy), (cx, cy) = jnp.sin(state.qpos[arm.N_JOINTS :]), jnp.cos(state.qpos[arm.N_JOINTS :])
        tip = pose.position + pose.rotation @ jnp.stack([sy, -sx * cy, cx * cy]) * GRASP
        return jnp.concatenate([pose.position, tip, assembled(params)])

    scene = SCENE._replace(variant=f"grip-{grip:g}", build=functools.partial(build, grip=grip), settled=None)
    return scene._replace(initial=begun, observe=seen)


REAL = {scene.variant: scene for scene in map(loose, GRIPS)}


def _tip(joints: Array) -> Array:
    """[3] m, base frame: the leg's tip."""
    return arm.forward(joints, jnp.array([0.0, 0.0, arm.TCP + GRASP])).position


def _hand(tip: Array) -> Array:
    """[3] m: where the hand is that holds the leg upright with its tip at `tip` [3]."""
    return tip + jnp.array([0.0, 0.0, GRASP])


def _add_leg(link: mujoco.MjsBody, peg_radius: float) -> None:
    """A square leg that ends in a round peg, and the two balls that feel the hole."""
    tip = arm.TCP + GRASP
    look = {"rgba": LEG_COLOUR, "quat": arm.HAND_TURN}
    half = (LEG_LENGTH - DEPTH) / 2
    place = [0, 0, tip - DEPTH - half]
    add_box(link, [LEG_HALF_WIDTH, LEG_HALF_WIDTH, half], pos=place, mass=LEG_MASS, **look)
    add_cylinder(link, peg_radius, DEPTH / 2, pos=[0, 0, tip - DEPTH / 2], mass=0, **look)
    for name, height in (("tip", 0.0), ("shaft", UPPER_BALL)):
        place = [0, 0, tip - TIP_ROUNDING - height]
        add_sphere(link, TIP_ROUNDING, name=name, pos=place, mass=0, rgba=INVISIBLE)


def _add_fingers(link: mujoco.MjsBody) -> None:
    look = {"quat": arm.HAND_TURN, "rgba": [0.1, 0.1, 0.12, 1]}
    for side in (-1, 1):
        place = [*arm.across(0.0, side * (LEG_HALF_WIDTH + FINGER_HALF[1])), arm.TCP - 0.015]
        add_box(link, FINGER_HALF, pos=place, mass=0.015, **look)


def _add_part(spec: mujoco.MjSpec, theta: dict[str, float]) -> None:
    """The table top: a body at the hole, turned with the part, whose four walls leave a square opening."""
    angle = theta["part_rotation"]
    c, s = np.cos(angle), np.sin(angle)
    xy = HOLE_NOMINAL - HOLE_OFFSET + [theta["part_x"], theta["part_y"]] + np.array([[c, -s], [s, c]]) @ HOLE_OFFSET
    hole = spec.worldbody.add_body(name="hole", pos=[*xy, TOP], quat=[np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    opening = theta["hole_radius"] - theta["peg_radius"] + TIP_ROUNDING
    x, y = WALL_HALF[0] + opening, WALL_HALF[1] - opening
    for i in range(4):  # each wall covers one side and one corner of the opening, like the blades of a pinwheel
        c, s = np.cos(i * np.pi / 2), np.sin(i * np.pi / 2)
        place = [c * x - s * y, s * x + c * y, -WALL_HALF[2]]
        turn = [np.cos(i * np.pi / 4), 0, 0, np.sin(i * np.pi / 4)]
        add_box(hole, WALL_HALF, name=f"wall{i}", pos=place, quat=turn, rgba=INVISIBLE, mass=0)
    _add_scenery(spec, hole, theta["hole_radius"])


def _add_scenery(spec: mujoco.MjSpec, hole: mujoco.MjsBody, hole_radius: float) -> None:
    """What a viewer sees: the bench 4 mm below the surface of contact, the table top and its hole just below it."""
    bench, part, dark = [0.62, 0.64, 0.66, 1], [0.80, 0.62, 0.42, 1], [0.05, 0.04, 0.04, 1]
    add_box(spec.worldbody, [0.5, 0.45, 0.02], pos=[0.3, 0, -0.024], rgba=bench)
    add_box(hole, [PART_HALF, PART_HALF, 0.01], pos=[*-HOLE_OFFSET, -0.0105], mass=0, rgba=part)
    add_cylinder(hole, hole_radius, 0.005, pos=[0, 0, -0.0052], mass=0, rgba=dark)
