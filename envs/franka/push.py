"""Pushing: slide a puck to the edge of the table, not over it. Paper section 6.2.

The table frame has its origin 0.2 m in front of the robot's base; observations and rewards live in it. The
object's range of the paper's Table 2, [0, 0.3] m, starts at 0.15 m here: nearer to the base the gripper cannot point
down behind it. Two fingertips, 4 cm apart, cradle the puck; they move in a plane just above the table. A flat puck tips
over the edge when its centre passes it, so falling is an event on the centre's position: from then on the puck lies out
of reach and the camera reports it 3 cm past the edge, where it fell. Reward and success thus are functions of the
observation alone.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Entry, Parameter
from envs.franka import arm
from envs.franka.arm import at_rest, new_spec, solve_down
from envs.mujoco import parts
from envs.mujoco.scene import Scene, View
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

SUBSTEPS = 40
STEP = 0.05  # m per control step at |action| = 1
TABLE_ORIGIN = 0.20  # m, x of the table frame in the base frame
EDGE = 0.55  # m, table frame
TABLE_HALF_WIDTH = 0.6  # m
TOLERANCE = 0.025  # m short of the edge counts as reached
BEHIND = 0.035  # m: where the reward wants the hand, behind the puck
HEIGHT = 0.02  # m above the table: the plane in which the fingertips move
FINGER_RADIUS, FINGER_GAP = 0.008, 0.04  # m
FINGERS = {-1: "finger_left", 1: "finger_right"}
PUCK_RADIUS, PUCK_HALF_HEIGHT = 0.032, 0.015  # m
WORKSPACE = np.array([[0.08, -0.35], [0.56, 0.35]])  # m, xy of the hand, table frame
FALLEN_AT, SEEN_AT = 1.5, EDGE + 0.03  # m, table frame: where a fallen puck lies, where the camera saw it last
GRAVITY = 9.81  # m/s^2
SOFT = 0.01  # N/m
TILTS = (-18, -15, -12, 12, 15, 18)  # degrees, of real systems
PATCHES, PATCH, _WAVES = 16.0, 0.05, 32  # factor of friction; m over which it changes
# Rubber fingertips: the contact stiffens over 3 mm instead of at once. Newton's method then converges in 4 iterations
# on every contact we have seen; hard fingertips need more than 6 and throw the puck with fewer.
RUBBER = (0.0, 0.95, 0.003, 0.5, 2.0)
TABLE_LEGS = (-0.2, 0.7, 0.55)  # m, see `arm.dress`
# Joint angles with the hand in the start area: where the inverse kinematics of a reset begins.
Q_FOLDED = np.array([0.0, 0.247, 0.0, -2.966, 0.0, 3.213, np.pi / 4])
NV = arm.N_JOINTS + 4  # puck: x, y, z, yaw

PARAMETERS = (
    Parameter("object_x", "m", 0.22, 0.15, 0.30, minimum=0.0, maximum=EDGE, place=True),
    Parameter("object_y", "m", 0.0, -0.25, 0.25, minimum=-TABLE_HALF_WIDTH, maximum=TABLE_HALF_WIDTH, place=True),
    Parameter("object_mass", "kg", 0.15, 0.15, 0.15, minimum=0.001, real=(0.04, 0.6)),
    Parameter("table_friction", "", 0.35, 0.35, 0.35, minimum=0.0, real=(0.08, 0.7)),
    Parameter("finger_friction", "", 0.5, 0.5, 0.5, minimum=0.0, real=(0.08, 1.2)),
    Parameter("servo_stiffness", "", 1.0, 1.0, 1.0, minimum=0.01, real=(0.25, 2.5)),
)


def build(theta: dict[str, float], tilt: float = 0.0) -> mujoco.MjSpec:
    """The scene for one theta. The puck's start is part of the state, not of the model.

    tilt: rad, of the table about the x axis, as the puck feels it: it slides to +y.
    """
    spec = new_spec(substeps=SUBSTEPS, iterations=4, ls_iterations=6)
    link = arm.add_arm(spec, stiffness=theta["servo_stiffness"])
    for side in FINGERS:
        _add_finger(link, side)
    parts.add_plane(spec, "table")
    add_scenery(spec)
    _add_puck(spec, theta["object_mass"], tilt)
    friction = theta["table_friction"]
    spin = friction * PUCK_RADIUS * 2 / 3  # of a disc under uniform pressure
    kind: dict[str, Any] = {"condim": 4} if friction else {"solimp": RUBBER}
    parts.add_pair(spec, "table", "puck_base", friction, spin, **kind)
    for finger in FINGERS.values():
        parts.add_pair(spec, finger, "puck_side", theta["finger_friction"], solimp=RUBBER)
    return spec


def observe(params: Array, state: PhysicsState) -> Array:
    """[4] m, table frame: hand xy, puck xy."""
    return seen(state.qpos, _puck(state.qpos))


def seen(qpos: Array, place: Array) -> Array:
    """[4] m, table frame: hand xy and the xy of an object that lies at `place` [2] of the base frame."""
    origin = jnp.array([TABLE_ORIGIN, 0.0])
    hand = arm.forward(qpos[: arm.N_JOINTS]).position[:2]
    return jnp.concatenate([hand - origin, (place - origin).at[0].min(SEEN_AT)])


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """[]: minus the hand's distance from its place behind the puck, minus the puck's from the edge, plus 1 when it is
    within 2.5 cm of it, minus 1 when it fell. The paper prints the bonus with the wrong sign of inequality.
    """
    hand, puck = next_obs[:2], next_obs[2:4]
    hand_distance = jnp.linalg.norm(hand - puck + jnp.array([BEHIND, 0.0]))
    edge_distance = jnp.abs(puck[0] - EDGE)
    return -hand_distance - edge_distance + (edge_distance <= TOLERANCE) - fallen(next_obs)


def fallen(obs: Array) -> Array:
    """[] 1.0 if the puck's centre has passed the edge of the table, else 0.0."""
    return (obs[2] > EDGE).astype(jnp.float32)


def success(obs: Array) -> Array:
    """[] bool: the puck is within 2.5 cm of the edge and still on the table."""
    return (obs[2] >= EDGE - TOLERANCE) & (obs[2] <= EDGE)


def initial(params: Array, key: Key) -> PhysicsState:
    """The hand at a random place near the base, the puck where theta says."""
    return at_rest(ready(key), _lie(params[:2] + jnp.array([TABLE_ORIGIN, 0.0])), NV)


def settled(params: Array, obs: Array) -> PhysicsState:
    """The hand and the puck where they are seen, at rest: within a control period both come to rest."""
    joints = solve_down(Q_FOLDED, _place(obs[:2], HEIGHT), iterations=12)
    return at_rest(joints, _lie(obs[2:4] + jnp.array([TABLE_ORIGIN, 0.0])), NV)


def ready(key: Key, height: float = HEIGHT) -> Array:
    """[7] joint angles with the hand at a random place near the base, `height` m above the table."""
    start = jax.random.uniform(key, (2,), minval=jnp.array([0.09, -0.15]), maxval=jnp.array([0.11, 0.15]))
    return solve_down(Q_FOLDED, _place(start, height), iterations=6)


def target(qpos: Array, action: Array, height: float = HEIGHT) -> Array:
    """[7] joint targets that move the hand by `action` * 5 cm from where it is, in its plane and workspace."""
    joints = qpos[: arm.N_JOINTS]
    hand = arm.forward(joints).position[:2] - jnp.array([TABLE_ORIGIN, 0.0])
    goal = jnp.clip(hand + STEP * action, jnp.asarray(WORKSPACE[0]), jnp.asarray(WORKSPACE[1]))
    return solve_down(joints, _place(goal, height), iterations=3)


def falling(
    place: Callable[[Array], Array], lie: Callable[[Array], Array]
) -> Callable[[Array, PhysicsState], PhysicsState]:
    """The event of an object whose centre passed the edge: it falls and comes to rest out of reach, for good.

    place(qpos) -> [2] m, xy of the object in the base frame. lie(xy) -> [nq - 7] its coordinates there.
    """

    def event(params: Array, state: PhysicsState) -> PhysicsState:
        x, y = place(state.qpos)
        gone = x - TABLE_ORIGIN > EDGE
        lying = lie(jnp.stack([jnp.asarray(TABLE_ORIGIN + FALLEN_AT), y]))
        qpos = jnp.where(gone, state.qpos.at[arm.N_JOINTS :].set(lying), state.qpos)
        return state._replace(qpos=qpos, qvel=jnp.where(gone, state.qvel.at[arm.N_JOINTS :].set(0.0), state.qvel))

    return event


def _puck(qpos: Array) -> Array:
    return qpos[arm.N_JOINTS : arm.N_JOINTS + 2]


def _lie(xy: Array) -> Array:
    return jnp.append(xy, jnp.zeros(2))


SCENE = arm.scene(
    name="push",
    observation=(Entry("hand_xy", "m", 2), Entry("puck_xy", "m", 2, error=0.01)),
    action=(Entry("hand_xy_step", "5 cm", 2),),
    parameters=PARAMETERS,
    episode_length=40,
    substeps=SUBSTEPS,
    cartesian=True,
    workspace=tuple(zip(*WORKSPACE.tolist(), strict=True)),
    build=build,
    initial=initial,
    settled=settled,
    target=target,
    observe=observe,
    reward=reward,
    success=success,
    event=falling(_puck, _lie),
    dress=functools.partial(arm.dress, table=TABLE_LEGS),
    view=View((0.57, 0.0, 0.04), 0.8, 155.0, -33.0, arm.FLOOR),
)


def tilted(degrees: float) -> Scene:
    """Pushing on a table that slopes sideways."""
    return SCENE._replace(variant=f"tilt{degrees:+g}", build=functools.partial(build, tilt=np.radians(degrees)))


def patchy(seed: int) -> Scene:
    """Pushing on a table whose friction changes smoothly from place to place, by a factor of 1/16 to 4."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(size=(_WAVES, 2)) / PATCH, rng.uniform(0, 2 * np.pi, _WAVES)

    def adjust(params: Array, state: PhysicsState, fields: dict[str, Array]) -> dict[str, Array]:
        wave = np.sqrt(2 / _WAVES) * jnp.cos(jnp.asarray(waves, jnp.float32) @ _puck(state.qpos) + phases).sum()
        friction = fields["pair_friction"]  # the first pair: table and puck
        return {**fields, "pair_friction": friction.at[0].multiply(PATCHES ** jnp.clip(wave, -1.0, 0.5))}

    return SCENE._replace(variant=f"patches-{seed}", adjust=adjust)


REAL = {scene.variant: scene for scene in (*map(tilted, TILTS), *map(patchy, range(4)))}


def _place(xy: Array, height: float) -> Array:
    """[3] m, base frame, of a point of the table frame."""
    return jnp.concatenate([xy + jnp.array([TABLE_ORIGIN, 0.0]), jnp.array([height])])


def _add_finger(link: mujoco.MjsBody, side: int) -> None:
    (x, y), dark = arm.across(0.0, side * FINGER_GAP / 2), [0.1, 0.1, 0.12, 1]
    parts.add_sphere(link, FINGER_RADIUS, name=FINGERS[side], pos=[x, y, arm.TCP], mass=0.015, rgba=dark)
    parts.add_capsule(link, FINGER_RADIUS, fromto=[x, y, arm.FLANGE + 0.07, x, y, arm.TCP], mass=0, rgba=dark)


def _add_puck(spec: mujoco.MjSpec, mass: float, tilt: float) -> None:
    """A disc that slides and spins but does not tilt: one contact with torsional friction stands for its whole face."""
    body = spec.worldbody.add_body(name="puck", pos=[0, 0, PUCK_HALF_HEIGHT])
    parts.add_slide(body, [1, 0, 0])
    # Weight, in a scene without gravity: springs whose rest lengths are weight / stiffness away.
    side = {"stiffness": SOFT, "springref": mass * GRAVITY * np.sin(tilt) / SOFT} if tilt else {}
    parts.add_slide(body, [0, 1, 0], **side)
    parts.add_slide(body, [0, 0, 1], stiffness=1.0, springref=-mass * GRAVITY * np.cos(tilt))
    parts.add_hinge(body, [0, 0, 1])
    parts.add_cylinder(body, PUCK_RADIUS, PUCK_HALF_HEIGHT, mass=mass, rgba=[0.85, 0.25, 0.2, 1])
    hidden, foot = {"mass": 0, "rgba": parts.INVISIBLE}, PUCK_HALF_HEIGHT / 2
    parts.add_sphere(body, foot, name="puck_base", pos=[0, 0, foot - PUCK_HALF_HEIGHT], **hidden)
    # The side as the fingers feel it: a sphere against a vertical capsule is exact in every backend, a sphere against a
    # cylinder is not.
    parts.add_capsule(body, PUCK_RADIUS, PUCK_HALF_HEIGHT, name="puck_side", **hidden)


def add_scenery(spec: mujoco.MjSpec) -> None:
    """What only a viewer sees of the table: its top, which ends at the edge, and the line of the goal."""
    half = (TABLE_ORIGIN + EDGE + 0.25) / 2
    wood, line = [0.78, 0.66, 0.5, 1], [0.95, 0.85, 0.2, 1]
    parts.add_box(spec.worldbody, [half, TABLE_HALF_WIDTH, 0.0199], pos=[half - 0.25, 0, -0.02], rgba=wood)
    x = TABLE_ORIGIN + EDGE - TOLERANCE / 2
    parts.add_box(spec.worldbody, [TOLERANCE / 2, TABLE_HALF_WIDTH, 0.0005], pos=[x, 0, 0], rgba=line)
