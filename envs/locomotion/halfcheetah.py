"""HalfCheetah-v2 of OpenAI Gym, which D4RL recorded: a planar torso with head and two legs runs along x.

Two legs of three joints on a torso of one metre. It cannot fall over sideways, and an episode never ends early. All
capsules have one density, that which makes the whole weigh 14 kg: a gap that resizes one link changes the mass of all.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.locomotion import planar
from envs.locomotion.planar import NV, Capsule, Link, multiple
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

FRAME, SUBSTEPS = 0.01, 5  # s; physics steps per action
CONTROL_DT = FRAME * SUBSTEPS
MASS = 14.0  # kg
RADIUS = 0.046  # m of every capsule
HEIGHT = 0.7  # m of the torso at z = 0
CONTROL_COST = 0.1
START_POSITION, START_SPEED = 0.1, 0.1  # m and rad, half-width of a uniform draw; m/s and rad/s, std
ARMATURE = 0.1  # kg m^2
FRICTION = 0.4
CONTACT = {"solref": [0.02, 1.0], "solimp": [0.0, 0.8, 0.01, 0.5, 2.0]}
LIMIT = {"solref_limit": [0.02, 1.0], "solimp_limit": [0.0, 0.8, 0.03, 0.5, 2.0]}
TORSO = Capsule(RADIUS, 0.5, (0.0, 0.0), np.pi / 2)
HEAD = Capsule(RADIUS, 0.15, (0.6, 0.1), 0.87)
# name, parent, position, range, stiffness, damping, gear; half length, centre and turn of its capsule: see `Link`
_ROWS = (
    ("bthigh", "torso", (-0.5, 0.0), (-0.52, 1.05), 240.0, 6.0, 120.0, 0.145, (0.1, -0.13), -3.8),
    ("bshin", "bthigh", (0.16, -0.25), (-0.785, 0.785), 180.0, 4.5, 90.0, 0.15, (-0.14, -0.07), -2.03),
    ("bfoot", "bshin", (-0.28, -0.14), (-0.4, 0.785), 120.0, 3.0, 60.0, 0.094, (0.03, -0.097), -0.27),
    ("fthigh", "torso", (0.5, 0.0), (-1.0, 0.7), 180.0, 4.5, 120.0, 0.133, (-0.07, -0.12), 0.52),
    ("fshin", "fthigh", (-0.14, -0.24), (-1.2, 0.87), 120.0, 3.0, 60.0, 0.106, (0.065, -0.09), -0.6),
    ("ffoot", "fshin", (0.13, -0.18), (-0.5, 0.5), 60.0, 1.5, 30.0, 0.07, (0.045, -0.07), -0.6),
)
LINKS = tuple(
    Link(name, parent, position, (0.0, 0.0), limits, stiffness, damping, gear, Capsule(RADIUS, half, center, turn))
    for name, parent, position, limits, stiffness, damping, gear, half, center, turn in _ROWS
)

PARAMETERS = (
    multiple("gravity", 0.0),
    multiple("friction", 0.0),
    multiple("thigh_size", 0.05),
    multiple("thigh_range", 0.01),
    multiple("torso_length", 0.05),
    multiple("foot_stiffness", 0.0),
)


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The scene for one theta. Legs and head stay where they are on a longer torso."""
    euler = mujoco.mjtIntegrator.mjINT_EULER
    gravity = theta["gravity"]
    spec, torso = planar.stage(timestep=FRAME, integrator=euler, gravity=gravity, height=HEIGHT, ref=0.0)
    trunk = {"torso": TORSO._replace(half=TORSO.half * theta["torso_length"]), "head": HEAD}
    links = [_changed(link, theta) for link in LINKS]
    volume = sum(capsule.volume for capsule in (*trunk.values(), *(link.capsule for link in links)))
    geom = {"density": MASS / volume, "friction": FRICTION * theta["friction"], "contact": CONTACT}
    for name, capsule in trunk.items():
        planar.add_capsule(spec, torso, name, capsule, **geom)
    for link in links:
        planar.add_link(spec, link, axis=1, armature=ARMATURE, geom=geom, limit=LIMIT)
    return spec


def _changed(link: Link, theta: dict[str, float]) -> Link:
    """A thigh grows in radius and length, about its centre; a foot keeps its motor and its damping."""
    if link.name.endswith("foot"):
        return link._replace(stiffness=link.stiffness * theta["foot_stiffness"])
    if not link.name.endswith("thigh"):
        return link
    low, high = link.range
    size, k, capsule = theta["thigh_size"], theta["thigh_range"], link.capsule
    larger = capsule._replace(radius=capsule.radius * size, half=capsule.half * size)
    return link._replace(range=(low * k, high * k), capsule=larger)


def initial(params: Array, key: Key) -> PhysicsState:
    """Near the posture with all coordinates 0, in slow motion."""
    key_position, key_speed = jax.random.split(key)
    qpos = jax.random.uniform(key_position, (NV,), minval=-START_POSITION, maxval=START_POSITION)
    return planar.start(qpos, START_SPEED * jax.random.normal(key_speed, (NV,)))


def lead(pose: Array) -> Array:
    """How far ahead of the root the nominal centre of mass is, [] m. pose: [7] rad, pitch and joints.

    Only the floor moves that point between two steps, while the root swings with the legs: its way can be told from
    speeds.
    """
    volumes = jnp.array([TORSO.volume + HEAD.volume, *(link.capsule.volume for link in LINKS)])
    return planar.lead((TORSO, HEAD), LINKS, 1, volumes, pose)


SCENE = planar.scene(
    name="halfcheetah",
    parameters=PARAMETERS,
    control_dt=CONTROL_DT,
    substeps=SUBSTEPS,
    build=build,
    initial=initial,
    bonus=0.0,
    cost=CONTROL_COST,
    late=(SUBSTEPS + 1) / (2 * SUBSTEPS),  # each of Euler's steps moves by the speed that it ends with
    lead=lead,
)
