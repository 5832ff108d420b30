"""A wheel-legged robot stands still: a planar inverted pendulum on wheels, the robot task of H2O+.

Facts of the real robot (arXiv 2309.12716 and its code): about 12 kg on two wheels of 6.5 cm, commanded at 200 Hz by a
torque of up to 3 N m, on a furry carpet; the rewards. Everything else was not published and is ours: how the mass is
split, where its centre is, how hard the wheels roll, the starts, the length of an episode.

Wheels do not slip, so the robot has two coordinates, x of the axle and pitch (positive forwards). The wheels turn by
x / radius - pitch against the body; a tendon has that length, and the motor pulls at it.

Also a noisy controller that keeps it upright; its logs resemble those that H2O+ learned from. A linear-quadratic
controller of the nominal robot aims at a place that wanders, and a correlated torque disturbs it. In the gap `robot`
its log has about the statistics of the published one (H2O+, arXiv 2309.12716, 83 s of a standing robot), see
docs/hybrid.md: the numbers were chosen for that.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Entry, Parameter
from envs.locomotion.planar import BLUE, GRAVITY, LIGHT, ORANGE
from envs.mujoco import parts
from envs.mujoco.scene import Scene, View
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key, Policy

CONTROL_DT, SUBSTEPS = 0.005, 2  # s; physics steps in it
EPISODE_LENGTH = 2_000  # 10 s
TORQUE = 3.0  # N m of both wheels together, at full action
WHEEL_RADIUS, WHEEL_MASS = 0.065, 1.5  # m; kg of both wheels
WHEEL_INERTIA = WHEEL_MASS * WHEEL_RADIUS**2 / 2  # kg m^2, of solid discs
BODY_HALF = (0.1, 0.12, 0.15)  # m, of a homogeneous box around the centre of mass
FALLEN = np.radians(30.0)  # rad
PLACE = 0.2  # m from x = 0: farther away it does not stand in its place
ALIVE = 30.0  # reward of a step in which nothing moves
START = np.array([0.05, 0.05, 0.05, 0.1])  # m, rad, m/s, rad/s: half-widths of a uniform draw

PARAMETERS = (
    Parameter("mass", "kg", 12.0, 12.0, 12.0, minimum=WHEEL_MASS + 0.5),
    Parameter("com_height", "m", 0.2, 0.2, 0.2, minimum=0.05, maximum=1.0),
    Parameter("com_x", "m", 0.0, 0.0, 0.0, minimum=-0.2, maximum=0.2),
    Parameter("wheel_friction", "N m", 0.02, 0.02, 0.02, minimum=0.001),
    Parameter("motor_lag", "s", 0.0, 0.0, 0.0, minimum=0.0, maximum=1.0),
)
_LAG = [p.name for p in PARAMETERS].index("motor_lag")
# Of the operator.
COST = np.diag([4.0, 1.0, 1.0, 1.0])  # of x (m), v (m/s), pitch (rad), its speed (rad/s), squared
TORQUE_COST = 1.0  # of N m, squared
WANDER, WANDER_TIME = 0.2, 15.0  # m, std of the place that is aimed at; s, how long it takes to forget
SHAKE, SHAKE_TIME = 0.65, 0.08  # N m, s: of the torque that disturbs


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The scene for one theta. The lag of the motors is no part of it, see `follow`."""
    spec = parts.empty_spec(CONTROL_DT / SUBSTEPS, mujoco.mjtIntegrator.mjINT_EULER)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    axle = spec.worldbody.add_body(name="axle", pos=[0, 0, WHEEL_RADIUS])
    rolling = parts.add_slide(axle, [1, 0, 0], name="x", frictionloss=theta["wheel_friction"] / WHEEL_RADIUS)
    rolling.armature = WHEEL_INERTIA / WHEEL_RADIUS**2  # wheels turn with x: their inertia adds to what x moves
    dark, sideways = [0.20, 0.21, 0.24, 1], [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    for y in (-0.15, 0.15):
        parts.add_cylinder(axle, WHEEL_RADIUS, 0.02, pos=[0, y, 0], quat=sideways, mass=WHEEL_MASS / 2, rgba=dark)
    body = axle.add_body(name="body")
    parts.add_hinge(body, [0, 1, 0], name="pitch")
    com, mass = [theta["com_x"], 0, theta["com_height"]], theta["mass"] - WHEEL_MASS
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=com, size=BODY_HALF, mass=mass, rgba=LIGHT)
    for y in (-0.12, 0.12):  # legs, which only a viewer sees
        parts.add_capsule(body, 0.015, fromto=[0, y, 0, 0, y, theta["com_height"]], mass=0, rgba=BLUE)
    wheel = spec.add_tendon(name="wheel")
    wheel.wrap_joint("x", 1 / WHEEL_RADIUS)
    wheel.wrap_joint("pitch", -1.0)
    parts.add_motor(spec, "motor", "wheel", TORQUE, mujoco.mjtTrn.mjTRN_TENDON)
    return spec


def follow(params: Array, previous: Array, target: Array) -> Array:
    """[1] the control of a period, which follows the command `target` [1] from `previous` [1] on, a first-order lag."""
    return target + jnp.exp(-CONTROL_DT / jnp.maximum(params[_LAG], 1e-6)) * (previous - target)


def initial(params: Array, key: Key) -> PhysicsState:
    """Nearly upright, nearly at rest, nearly at x = 0."""
    spread = jnp.asarray(START) * jax.random.uniform(key, (4,), minval=-1.0, maxval=1.0)
    return state_of(spread[:2], spread[2:])


def state_of(qpos: Array, qvel: Array) -> PhysicsState:
    """A state [2], [2] whose motors rest."""
    return PhysicsState(qpos, qvel, jnp.zeros(2), jnp.zeros(1))


def observe(params: Array, state: PhysicsState) -> Array:
    """[4]: x and v of the axle, pitch and its speed."""
    return jnp.stack([state.qpos[0], state.qvel[0], state.qpos[1], state.qvel[1]])


def settled(params: Array, obs: Array) -> PhysicsState:
    """The state that is seen, as if the motors had rested."""
    return state_of(obs[jnp.array([0, 2])], obs[jnp.array([1, 3])])


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """[]: 30 less the squares of x, v, pitch, its speed, and the commanded torque, in SI units. Source: H2O+."""
    return ALIVE - jnp.sum(next_obs**2) - jnp.sum(torque(action) ** 2)


def torque(action: Array) -> Array:
    """[1] N m that an action commands."""
    return TORQUE * jnp.clip(action, -1.0, 1.0)


def terminated(obs: Array, action: Array, next_obs: Array) -> Array:
    """[] bool: fallen, pitched by more than 30 degrees."""
    return fallen(next_obs[2])


def fallen(pitch: Array) -> Array:
    """[] bool."""
    return jnp.abs(pitch) > FALLEN


def measures(next_obs: np.ndarray, valid: np.ndarray) -> dict[str, np.ndarray]:
    """What H2O+ reports of episodes, next_obs [..., T, 4] and valid [..., T]; they last longer than ours, whose end
    bounds all times here.

    upright_s: [...] s until it pitches by more than 30 degrees. in_place_s: [...] s until it does or is more than 0.2 m
    from x = 0, whichever is first. Source: H2O+, real-world experiments.
    """
    upright = valid & (np.abs(next_obs[..., 2]) <= FALLEN)
    in_place = upright & (np.abs(next_obs[..., 0]) <= PLACE)
    return {"upright_s": seconds_until(upright), "in_place_s": seconds_until(in_place)}


def seconds_until(holds: np.ndarray) -> np.ndarray:
    """[...] s until `holds` [..., T] is false for the first time."""
    return np.cumprod(holds, axis=-1).sum(-1) * CONTROL_DT


def mark(spec: mujoco.MjSpec) -> None:
    """A line on the floor at x = 0, the place to stand at."""
    parts.add_box(spec.worldbody, [0.008, 0.3, 0.002], pos=[0, 0, 0], rgba=ORANGE)


SCENE = Scene(
    name="wheel-legged",
    observation=(
        Entry("position", "m", 1),
        Entry("velocity", "m/s", 1),
        Entry("pitch", "rad", 1),
        Entry("pitch_velocity", "rad/s", 1),
    ),
    action=(Entry("wheel_torque", "3 N m", 1),),
    parameters=PARAMETERS,
    episode_length=EPISODE_LENGTH,
    control_dt=CONTROL_DT,
    substeps=SUBSTEPS,
    build=build,
    initial=initial,
    settled=settled,
    target=lambda qpos, action: jnp.clip(action, -1.0, 1.0),
    motors=follow,
    observe=observe,
    reward=reward,
    terminated=terminated,
    score="return",
    measures=measures,
    table=True,
    max_speed=500.0,
    dress=mark,
    view=View((0.0, 0.0, 0.12), 1.25, 118.0, -14.0, floor=0.0, follow="axle"),
)


class Hand(NamedTuple):
    """aim: [] m, where the robot should be, were it not for wander [] m. shake: [] N m."""

    aim: Array
    wander: Array
    shake: Array


def operator(speed: float) -> Policy:
    """One who wants the robot of `wheel-legged` to roll at that speed, m/s; its parameters are a `gain` [4]."""

    def act(gain: Array, carry: Hand, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, Hand]:
        noise = jax.random.normal(key, (2,))
        wander = _wandered(carry.wander, noise[0], std=WANDER, time=WANDER_TIME)
        shake = _wandered(carry.shake, noise[1], std=SHAKE, time=SHAKE_TIME)
        error = obs - jnp.array([0.0, speed, 0.0, 0.0]).at[0].set(carry.aim + wander)
        torque = -gain @ error + shake
        hand = Hand(carry.aim + speed * CONTROL_DT, wander, shake)
        return jnp.clip(torque / TORQUE, -1.0, 1.0)[None], hand

    return Policy(lambda: Hand(jnp.zeros(()), jnp.zeros(()), jnp.zeros(())), act)


def _wandered(value: Array, noise: Array, *, std: float, time: float) -> Array:
    """The next value of a process with that stationary std that forgets in `time` s (Ornstein and Uhlenbeck)."""
    kept = np.exp(-CONTROL_DT / time)
    return kept * value + std * np.sqrt(1 - kept**2) * noise


def nominal_gain() -> np.ndarray:
    """[4] N m for each m, m/s, rad, rad/s: torque = -gain . (x, v, pitch, its speed) of the nominal robot."""
    import scipy.linalg

    theta = {p.name: p.nominal for p in PARAMETERS}
    mass, arm = theta["mass"] - WHEEL_MASS, theta["com_height"]
    inertia = mass * ((2 * BODY_HALF[0]) ** 2 + (2 * BODY_HALF[2]) ** 2) / 12
    # Mass matrix of x and pitch when upright; wheels that roll add their inertia.
    across = mass * arm
    matrix = [[theta["mass"] + WHEEL_INERTIA / WHEEL_RADIUS**2, across], [across, inertia + mass * arm**2]]
    inverse = np.linalg.inv(matrix)
    drift, push = np.zeros((4, 4)), np.zeros((4, 1))  # of x, pitch, and their speeds
    drift[:2, 2:] = np.eye(2)
    drift[2:, 1] = inverse @ [0.0, mass * GRAVITY * arm]
    push[2:, 0] = inverse @ [1 / WHEEL_RADIUS, -1.0]
    order = [0, 2, 1, 3]  # from x, v, pitch, its speed
    cost = COST[np.ix_(order, order)]
    solved = scipy.linalg.solve_continuous_are(drift, push, cost, np.array([[TORQUE_COST]]))
    return (push.T @ solved / TORQUE_COST)[0][order]
