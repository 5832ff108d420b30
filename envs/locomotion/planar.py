"""What the planar runners share: links on hinges over a floor, the observation, the reward for running along x.

Those of `scene` are the `-v2` systems of OpenAI Gym that D4RL was recorded on. A domain parameter multiplies what that
system has, so all are 1 there.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from envs.base import NOTHING, Entry, Parameter
from envs.mujoco import parts
from envs.mujoco.parts import INVISIBLE, NO_CONTACT, add_hinge, add_motor, add_slide, empty_spec
from envs.mujoco.scene import Measured, Scene, View
from envs.mujoco.worlds import PhysicsState
from envs.types import Array

N_ROOT, N_JOINTS = 3, 6  # x, z, pitch; three joints of either leg
NV = N_ROOT + N_JOINTS
GRAVITY = 9.81  # m/s^2
VIEW = View((0.0, 0.0, -0.35), 3.6, 90.0, -12.0, floor=0.0, follow="torso")
FLOOR = "floor"
ROLLING = [0.1, 0.1, 0.1]  # torsional and rolling friction, which contacts of three dimensions do not feel
LIGHT, ORANGE, BLUE = [0.85, 0.86, 0.88, 1.0], [0.87, 0.52, 0.25, 1.0], [0.30, 0.46, 0.68, 1.0]

OBSERVATION = (
    Entry("height", "m", 1),
    Entry("pitch", "rad", 1),
    Entry("joint_angles", "rad", N_JOINTS),
    Entry("velocity_xz", "m/s", 2),
    Entry("pitch_velocity", "rad/s", 1),
    Entry("joint_velocities", "rad/s", N_JOINTS),
)


class Capsule(NamedTuple):
    """A capsule in the frame of its body: radius and half length in m, centre (x, z) in m.

    turn: rad about +y, from upright.
    """

    radius: float
    half: float
    center: tuple[float, float]
    turn: float

    @property
    def volume(self) -> float:
        """m^3, with both round ends."""
        return np.pi * self.radius**2 * (2 * self.half + 4 / 3 * self.radius)


class Link(NamedTuple):
    """A link on a hinge with a motor.

    position: (x, z) m in the frame of the parent. anchor: (x, z) m of the hinge in its own frame. range: rad.
    stiffness: N m/rad. damping: N m s/rad. gear: N m at full action.
    """

    name: str
    parent: str
    position: tuple[float, float]
    anchor: tuple[float, float]
    range: tuple[float, float]
    stiffness: float
    damping: float
    gear: float
    capsule: Capsule


def stage(
    *, timestep: float, integrator: mujoco.mjtIntegrator, gravity: float, height: float, ref: float
) -> tuple[mujoco.MjSpec, mujoco.MjsBody]:
    """A scene in radians with a floor at z = 0 and the root `height` m above it, and that root.

    The root is free to slide along x and z, where z reads `ref` m at the start, and to pitch. gravity: multiplies that
    of the Earth. MuJoCo's defaults are Gym's solver settings: Newton's method, 100 iterations, pyramidal friction
    cones. Viewers see the floor of `VIEW`.
    """
    spec = empty_spec(timestep, integrator)
    spec.compiler.degree = False
    spec.option.gravity = [0.0, 0.0, -GRAVITY * gravity]
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name=FLOOR, type=plane, size=[0, 0, 1], rgba=INVISIBLE, **NO_CONTACT)
    torso = spec.worldbody.add_body(name="torso", pos=[0, 0, height])
    add_slide(torso, [1, 0, 0], name="root_x")
    add_slide(torso, [0, 0, 1], name="root_z", ref=ref)
    add_hinge(torso, [0, 1, 0], name="root_pitch")
    return spec, torso


def add_capsule(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    capsule: Capsule,
    *,
    density: float,
    friction: float,
    contact: Mapping[str, Any] = NOTHING,
) -> None:
    """The capsule as a geom of that density, kg/m^3, that touches the floor and nothing else.

    friction: of the contact, in MuJoCo the larger of both geoms. contact: its `solref` and `solimp`.
    """
    radius, half, (x, z), turn = capsule
    quat = [np.cos(turn / 2), 0, np.sin(turn / 2), 0]
    parts.add_capsule(body, radius, half, name=name, pos=[x, 0, z], quat=quat, density=density, rgba=_tint(name))
    spec.add_pair(geomname1=FLOOR, geomname2=name, condim=3, friction=[friction, friction, *ROLLING], **contact)


def add_link(
    spec: mujoco.MjSpec,
    link: Link,
    *,
    axis: float,
    armature: float,
    geom: Mapping[str, Any],
    limit: Mapping[str, Any] = NOTHING,
) -> None:
    """The link with its hinge about +y or -y (axis: 1 or -1) and its motor.

    armature: kg m^2. geom: density, friction and perhaps contact, see `add_capsule`. limit: `solref_limit` and
    `solimp_limit` of the hinge.
    """
    (x, z), (anchor_x, anchor_z) = link.position, link.anchor
    body = spec.body(link.parent).add_body(name=link.name, pos=[x, 0, z])
    spring = {"stiffness": link.stiffness, "damping": link.damping, "armature": armature, "range": link.range}
    add_hinge(body, [0, axis, 0], name=link.name, pos=[anchor_x, 0, anchor_z], **spring, **limit)
    add_capsule(spec, body, link.name, link.capsule, **geom)
    add_motor(spec, link.name, link.name, link.gear)


def pitches(links: Sequence[Link], axis: float, pose: Array) -> Array:
    """[1 + links] rad about +y, of the torso and of the links on hinges about +y or -y (axis: 1 or -1).

    pose: [1 + links] rad, the pitch and the joints.
    """
    turns = {"torso": pose[0]}
    for link, angle in zip(links, pose[1:], strict=True):
        turns[link.name] = turns[link.parent] + axis * angle
    return jnp.stack(list(turns.values()))


def joints(links: Sequence[Link], axis: float, turns: Array) -> Array:
    """The pose [1 + links] of these `pitches`, joints between -pi and pi."""
    named = _named(links, turns)
    angles = jnp.stack([axis * (named[link.name] - named[link.parent]) for link in links])
    return jnp.concatenate([turns[:1], jnp.mod(angles + jnp.pi, 2 * jnp.pi) - jnp.pi])


def lead(trunk: Sequence[Capsule], links: Sequence[Link], axis: float, masses: Array, pose: Array) -> Array:
    """How far ahead of the root the centre of mass is, [] m.

    trunk: capsules of the torso, all of one density. axis: of the hinges, see `add_link`. masses: [1 + links], in any
    unit, the torso's first. pose: see `pitches`.
    """
    turns = _named(links, pitches(links, axis, pose))
    volumes = [capsule.volume for capsule in trunk]
    middle = np.average([capsule.center for capsule in trunk], axis=0, weights=volumes)
    origins = {"torso": jnp.zeros(2)}
    centers = [_turned(middle, pose[0])[0]]
    for link in links:
        hinge = np.add(link.position, link.anchor)  # in the frame of the parent
        turn, parent = turns[link.name], link.parent
        origin = origins[parent] + _turned(hinge, turns[parent]) - _turned(link.anchor, turn)
        origins[link.name] = origin
        centers.append((origin + _turned(link.capsule.center, turn))[0])
    return jnp.sum(masses * jnp.stack(centers)) / jnp.sum(masses)


def speed(
    trunk: Sequence[Capsule], links: Sequence[Link], axis: float, masses: Array, pose: Array, velocity: Array
) -> Array:
    """[] m/s of the centre of mass along x. velocity: of the root along x and z, then of the pose. See `lead`."""
    _, drift = jax.jvp(lambda pose: lead(trunk, links, axis, masses, pose), (pose,), (velocity[2:],))
    return velocity[0] + drift


def _named(links: Sequence[Link], turns: Array) -> dict[str, Array]:
    """Turns [1 + links] by the names of torso and links."""
    return dict(zip(("torso", *(link.name for link in links)), turns, strict=True))


def _turned(point: ArrayLike, angle: Array) -> Array:
    """(x, z) [2] of a point in a frame that is turned about +y."""
    x, z = np.asarray(point)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([x * cos + z * sin, z * cos - x * sin])


def _tint(name: str) -> list[float]:
    """The colour of a geom: the leg that is in front, or the right one, is orange, the other one blue."""
    if name in ("torso", "head"):
        return LIGHT
    return BLUE if name.startswith("b") or name.endswith("_left") else ORANGE


def multiple(name: str, minimum: float) -> Parameter:
    """A domain parameter that multiplies what the real system has, fixed in training."""
    return Parameter(name, "", 1.0, 1.0, 1.0, minimum=minimum)


def start(qpos: Array, qvel: Array) -> PhysicsState:
    """A state [9], [9] before anything was commanded."""
    return PhysicsState(qpos, qvel, jnp.zeros(NV), jnp.zeros(N_JOINTS))


def settled(params: Array, obs: Array) -> PhysicsState:
    """The state that is seen, at x = 0: nothing but the place depends on x."""
    return start(jnp.concatenate([jnp.zeros(1), obs[: NV - 1]]), obs[NV - 1 :])


def scene(
    *,
    control_dt: float,
    bonus: float,
    cost: float,
    late: float,
    clip: float = np.inf,
    lead: Callable[[Array], Array] = lambda pose: jnp.zeros(()),
    torque: Callable[[Array], Array | float] = lambda params: 1.0,
    **parts: Any,
) -> Scene:
    """A runner, whose reward is speed along x, a bonus, minus the cost of the squared control. parts: see `Scene`.

    clip: m/s and rad/s, beyond which observations tell no speed. torque(params): [6] multiplies the control where a gap
    makes motors stronger, as Gym counts it.

    x is not observed, so as a function of observations the reward is an approximation, for transitions that nobody
    measures, such as imagined ones. There motors are nominal and get the action as it is. The way of some point of the
    runner is control_dt times a mean of its speeds before and after; what that point has gained on the root is seen.
    late: share of the speed after the step in that mean. lead(pose [7] of pitch and joints) -> [] m: how far ahead of
    the root the point is; default the root itself.
    """

    def observe(params: Array, state: PhysicsState) -> Array:
        """[17]: everything but x."""
        return jnp.concatenate([state.qpos[1:], jnp.clip(state.qvel, -clip, clip)])

    def measured(params: Array, before: PhysicsState, action: Array, after: PhysicsState) -> Measured:
        """The control is what the motors got, scaled, noisy and clipped.

        In float32 speeds are right to 0.001 m/s as far away as runners get in an episode: 500 m (HalfCheetah), 40 m
        (Walker2d).
        """
        control = after.ctrl * torque(params)
        progress = (after.qpos[0] - before.qpos[0]) / control_dt
        return Measured(reward=progress + bonus - cost * jnp.sum(control**2))

    def moving(obs: Array) -> tuple[Array, Array]:
        ahead, drift = jax.jvp(lead, (obs[1 : NV - 1],), (obs[NV + 1 :],))
        return ahead, obs[NV - 1] + drift

    def reward(obs: Array, action: Array, next_obs: Array) -> Array:
        (ahead, speed), (ahead_after, speed_after) = moving(obs), moving(next_obs)
        progress = (1 - late) * speed + late * speed_after - (ahead_after - ahead) / control_dt
        return progress + bonus - cost * jnp.sum(jnp.clip(action, -1.0, 1.0) ** 2)

    return Scene(
        observation=OBSERVATION,
        action=(Entry("joint_torques", "gear", N_JOINTS),),
        episode_length=1_000,
        control_dt=control_dt,
        settled=settled,
        target=lambda qpos, action: jnp.clip(action, -1.0, 1.0),
        observe=observe,
        reward=reward,
        measured=measured,
        score="return",
        view=VIEW,
        max_speed=1_000.0,  # feet of Walker2d reach 100 rad/s
        **parts,
    )
