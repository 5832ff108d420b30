"""Walker2d-v2 of OpenAI Gym, the system that D4RL was recorded on: two legs walk along x until they fall.

The left foot has twice the grip of the right one, a slip of Gym's model that D4RL inherited. All capsules have the
density of water, so a gap that resizes the thighs changes the mass of the whole.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.locomotion import planar
from envs.locomotion.planar import NV, Capsule, Link, multiple
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

FRAME, SUBSTEPS = 0.002, 4  # s; physics steps per action
CONTROL_DT = FRAME * SUBSTEPS
DENSITY = 1000.0  # kg/m^3
HEIGHT = 1.25  # m of the torso at the start; the coordinate z is the height itself
ALIVE, CONTROL_COST = 1.0, 0.001
LOWEST, HIGHEST, LEANING = 0.8, 2.0, 1.0  # m, m, rad: the walker has fallen outside of them
MOST_SPEED = 10.0  # m/s and rad/s: observations tell no more
START_SPREAD = 0.005  # m, rad, m/s, rad/s: half-width of a uniform draw
ARMATURE, DAMPING, GEAR = 0.01, 0.1, 100.0  # kg m^2, N m s/rad, N m
FRICTION, LEFT_FOOT_FRICTION = 0.9, 1.9  # the floor's own 0.7 never counts: of a pair the larger one does
TORSO = Capsule(0.05, 0.2, (0.0, 0.0), 0.0)


def _leg(side: str) -> tuple[Link, ...]:
    """side: what ends the names of a leg. Both legs are at the same place."""
    bent, free = (np.radians(-150.0), 0.0), (np.radians(-45.0), np.radians(45.0))
    thigh, leg, foot = (f"{part}{side}" for part in ("thigh", "leg", "foot"))
    motor = (0.0, DAMPING, GEAR)  # no spring
    return (
        Link(thigh, "torso", (0.0, -0.2), (0.0, 0.0), bent, *motor, Capsule(0.05, 0.225, (0.0, -0.225), 0.0)),
        Link(leg, thigh, (0.0, -0.7), (0.0, 0.25), bent, *motor, Capsule(0.04, 0.25, (0.0, 0.0), 0.0)),
        Link(foot, leg, (0.2, -0.35), (-0.2, 0.1), free, *motor, Capsule(0.06, 0.1, (-0.1, 0.1), np.pi / 2)),
    )


LINKS = _leg("") + _leg("_left")
THIGHS = np.array([link.name.startswith("thigh") for link in LINKS])

PARAMETERS = (
    multiple("gravity", 0.0),
    multiple("friction", 0.0),
    multiple("thigh_radius", 0.05),
    multiple("thigh_range", 0.01),
    multiple("thigh_torque", 0.0),
)
_TORQUE = [p.name for p in PARAMETERS].index("thigh_torque")


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The scene for one theta."""
    runge_kutta = mujoco.mjtIntegrator.mjINT_RK4
    gravity = theta["gravity"]
    spec, torso = planar.stage(timestep=FRAME, integrator=runge_kutta, gravity=gravity, height=HEIGHT, ref=HEIGHT)
    grip = FRICTION * theta["friction"]
    planar.add_capsule(spec, torso, "torso", TORSO, density=DENSITY, friction=grip)
    for link in LINKS:
        friction = LEFT_FOOT_FRICTION * theta["friction"] if link.name == "foot_left" else grip
        geom = {"density": DENSITY, "friction": friction}
        planar.add_link(spec, _changed(link, theta), axis=-1, armature=ARMATURE, geom=geom)
    return spec


def _changed(link: Link, theta: dict[str, float]) -> Link:
    if not link.name.startswith("thigh"):
        return link
    low, high = link.range
    k, capsule = theta["thigh_range"], link.capsule
    thicker = capsule._replace(radius=capsule.radius * theta["thigh_radius"])
    return link._replace(range=(low * k, high * k), gear=link.gear * theta["thigh_torque"], capsule=thicker)


def initial(params: Array, key: Key) -> PhysicsState:
    """Upright, almost at rest."""
    spread = jax.random.uniform(key, (2, NV), minval=-START_SPREAD, maxval=START_SPREAD)
    return planar.start(spread[0].at[1].add(HEIGHT), spread[1])


def terminated(obs: Array, action: Array, next_obs: Array) -> Array:
    """[] bool: fallen, too low or leaning too far."""
    height, pitch = next_obs[0], next_obs[1]
    return ~((height > LOWEST) & (height < HIGHEST) & (jnp.abs(pitch) < LEANING))


def torque(params: Array) -> Array:
    """[6]: stronger or weaker thighs, whose control Gym scales before it counts its cost."""
    return jnp.where(THIGHS, params[_TORQUE], 1.0)


SCENE = planar.scene(
    name="walker2d",
    parameters=PARAMETERS,
    control_dt=CONTROL_DT,
    substeps=SUBSTEPS,
    build=build,
    initial=initial,
    clip=MOST_SPEED,
    terminated=terminated,
    bonus=ALIVE,
    cost=CONTROL_COST,
    # Steps are short, and of the joints' speeds observations tell too little to follow another point than the root.
    late=0.5,
    torque=torque,
)
