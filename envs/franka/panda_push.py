"""Pushing a cube to a mark: a twin in MuJoCo of PandaPush of panda-gym, which Bullet simulates.

An action of panda-gym moves the end effector, and an observation says nothing of joints. So there is no arm here:
closed fingers hang on three slides, whose servos were fitted to how Bullet's arm moves (docs/physics.md). The table has
no edges. The mark has two slides of its own that nothing moves, so that every episode may draw its place.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Entry, Parameter
from envs.franka import armless
from envs.franka.armless import inverse, turned
from envs.mujoco.parts import add_box, add_pair, add_servo, add_slide
from envs.mujoco.scene import View
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

CONTROL_DT, SUBSTEPS = 0.04, 10  # s; physics steps in it
CUBE_HALF = 0.02  # m
CUBE = CUBE_HALF, CUBE_HALF, CUBE_HALF
SPREAD = 0.15  # m: half of the side of the square in which cube and mark start
REACHED = 0.05  # m between the centres of cube and mark
BEHIND = 0.02  # m behind the cube's centre, where the reward wants the fingertip: it gets there by pushing
START = np.array([0.0384, 0.0, 0.1974])  # m, of the fingertip
WORKSPACE = np.array([[-0.35, -0.45, 0.0], [0.2, 0.45, 0.5]])  # m, of where the fingertip may be sent
FINGER_HALF = (0.0098, 0.0151, 0.025)  # m, of both closed fingers, with the 1 mm that Bullet keeps around them
FINGER_LOW = 0.0072  # m that they reach below the fingertip
TABLE_AT = 0.005  # m: the lowest place of the fingertip; Bullet's fingers are soft by some millimetres
# Bullet's inverse kinematics ends short of where an action of 1 sends the fingertip, 5 cm away.
STEP = 0.05 * np.array([0.6, 0.85, 0.9])  # m along x, y, z
# A servo of Bullet takes a tenth of its way in 2 ms, as far as its force allows. The arm is stiff along x.
RATE, DAMPING = 50.0, 200.0  # 1/s: speed for each m of way; how soon that speed is reached
MASS = 5.0  # kg
STRENGTH = np.array([60.0, 28.0, 20.0])  # m/s^2 of that mass along x, y, z; gravity is added

PARAMETERS = (
    Parameter("cube_mass", "kg", 1.0, 0.7, 1.4, minimum=0.01),
    Parameter("table_friction", "", 0.25, 0.15, 0.4, minimum=0.0),
    Parameter("finger_friction", "", 0.5, 0.3, 0.8, minimum=0.0),
    Parameter("servo_rate", "", 1.0, 0.7, 1.3, minimum=0.05),
    Parameter("servo_strength", "", 1.0, 0.7, 1.3, minimum=0.6),
    # Random actions from far above would hardly ever touch the cube, whose motion then had no statistics.
    Parameter("start_beside", "probability", 0.5, 0.5, 0.5, minimum=0.0, maximum=1.0),
)
_BESIDE = [p.name for p in PARAMETERS].index("start_beside")
_CUBE, _MARK = [0.1, 0.7, 0.25, 1.0], [0.1, 0.7, 0.25, 0.3]


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The scene for one theta. Where cube and mark start is part of the state, not of the model."""
    spec = armless.table_spec(CONTROL_DT / SUBSTEPS)
    _add_fingers(spec, rate=RATE * theta["servo_rate"], strength=theta["servo_strength"])
    cube = spec.worldbody.add_body(name="cube")
    cube.add_freejoint()
    add_box(cube, CUBE, name="cube", mass=theta["cube_mass"], rgba=_CUBE)
    _add_mark(spec)
    add_pair(spec, "table", "cube", theta["table_friction"], 0.005)
    add_pair(spec, "fingers", "cube", theta["finger_friction"], 0.005)
    return spec


def initial(params: Array, key: Key) -> PhysicsState:
    """Cube and mark anywhere in their square; the fingers above the middle of the table, or beside the cube."""
    key_places, key_beside, key_which = jax.random.split(key, 3)
    cube, mark = jax.random.uniform(key_places, (2, 2), minval=-SPREAD, maxval=SPREAD)
    tip = jnp.asarray(START, jnp.float32)
    tip = jnp.where(jax.random.uniform(key_which) < params[_BESIDE], beside(cube, key_beside), tip)
    lying = jnp.concatenate([cube, jnp.array([CUBE_HALF, 1.0, 0.0, 0.0, 0.0])])
    return _state(tip, jnp.zeros(3), lying, jnp.zeros(6), mark)


def beside(cube: Array, key: Key) -> Array:
    """[3] m: a random place of the fingertip next to a cube at `cube` [2], not touching it."""
    turn, away, height = jax.random.uniform(
        key, (3,), minval=jnp.array([-jnp.pi, 0.05, 0.01]), maxval=jnp.array([jnp.pi, 0.09, 0.05])
    )
    return jnp.stack([cube[0] + away * jnp.cos(turn), cube[1] + away * jnp.sin(turn), height])


def settled(params: Array, obs: Array) -> PhysicsState:
    """The state that is seen, as if the servos had arrived. An observation tells all the rest."""
    turn = _quaternion(obs[9:12])
    spin = turned(inverse(turn), obs[15:18])  # MuJoCo tells it in the cube's own frame
    cube, moving = jnp.concatenate([obs[6:9], turn]), jnp.concatenate([obs[12:15], spin])
    return _state(obs[:3], obs[3:6], cube, moving, obs[18:20])


def target(qpos: Array, action: Array) -> Array:
    """[3] m: where the servos shall bring the fingertip, a step from where it is, within the workspace."""
    goal = qpos[:3] + jnp.asarray(STEP, jnp.float32) * jnp.clip(action, -1.0, 1.0)
    return jnp.clip(goal, jnp.asarray(WORKSPACE[0], jnp.float32), jnp.asarray(WORKSPACE[1], jnp.float32))


def observe(params: Array, state: PhysicsState) -> dict[str, Array]:
    """What panda-gym observes, in its order and units."""
    turn = state.qpos[6:10]
    return {
        "tip_xyz": state.qpos[:3],
        "tip_velocity": state.qvel[:3],
        "cube_xyz": state.qpos[3:6],
        "cube_rotation": euler(turn),
        "cube_velocity": state.qvel[3:6],
        "cube_spin": turned(turn, state.qvel[6:9]),
        "mark_xyz": jnp.append(state.qpos[10:12], CUBE_HALF),
    }


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """[]: 1 - tanh(5 d) - tanh(10 e) / 2, for a cube d m from the mark and a fingertip e m from its place.

    That place lies `BEHIND` m behind the cube's centre, seen from the mark. Within 5 cm of the mark it moves to the
    cube's centre, because no side is then behind the cube. With a bonus near the mark instead of tanh, the gain on the
    way there was smaller than the critic's error, and policies stayed away from the cube.
    """
    tip, cube, mark = next_obs[:3], next_obs[6:9], next_obs[18:21]
    way = mark - cube
    away = jnp.linalg.norm(way)
    place = cube - BEHIND * way / jnp.maximum(away, REACHED)
    return 1 - jnp.tanh(5 * away) - 0.5 * jnp.tanh(10 * jnp.linalg.norm(tip - place))


def success(obs: Array) -> Array:
    """[] bool: the cube's centre is less than 5 cm from the mark's."""
    return jnp.linalg.norm(obs[6:9] - obs[18:21]) < REACHED


def euler(turn: Array) -> Array:
    """[3] rad, roll, pitch and yaw of a unit quaternion [4] w, x, y, z: turns about the fixed axes x, y, z in turn."""
    w, x, y, z = turn
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))
    return jnp.stack([roll, pitch, jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))])


def dress(spec: mujoco.MjSpec) -> None:
    """A table top and the hand above the fingers, which only a viewer sees."""
    add_box(spec.worldbody, (0.55, 0.35, 0.01), pos=(-0.3, 0.0, -0.0102), rgba=[0.9, 0.9, 0.88, 1])
    add_box(spec.body("fingers"), (0.03, 0.1, 0.03), pos=(0, 0, 0.072), rgba=[0.93, 0.94, 0.95, 1])


SCENE = armless.scene(
    name="panda-push",
    observation=(
        Entry("tip_xyz", "m", 3),
        Entry("tip_velocity", "m/s", 3),
        Entry("cube_xyz", "m", 3),
        Entry("cube_rotation", "rad", 3),
        Entry("cube_velocity", "m/s", 3),
        Entry("cube_spin", "rad/s", 3),
        Entry("mark_xyz", "m", 3),
    ),
    action=(Entry("tip_step", "5 cm", 3),),
    parameters=PARAMETERS,
    episode_length=50,
    control_dt=CONTROL_DT,
    substeps=SUBSTEPS,
    build=build,
    initial=initial,
    settled=settled,
    target=target,
    observe=observe,
    reward=reward,
    success=success,
    dress=dress,
    view=View((-0.05, 0.0, 0.04), 0.7, 145.0, -32.0, -0.4),
)


def _state(tip: Array, speed: Array, cube: Array, moving: Array, mark: Array) -> PhysicsState:
    """Servos that have arrived. tip, speed: [3] of the fingertip. cube: [7], moving: [6], as MuJoCo has them."""
    qvel = jnp.concatenate([speed, moving, jnp.zeros(2)])
    return PhysicsState(jnp.concatenate([tip, cube, mark]), qvel, jnp.zeros(11), tip)


def _add_fingers(spec: mujoco.MjSpec, *, rate: float, strength: float) -> None:
    """The closed fingers on their slides. rate: 1/s. strength: share of `STRENGTH`."""
    body = spec.worldbody.add_body(name="fingers")
    for name, axis, limit in zip("xyz", np.eye(3), STRENGTH, strict=True):
        joint = add_slide(body, axis, name=name)
        if name == "z":
            joint.range, joint.solref_limit = [TABLE_AT, 1.0], [2 * spec.option.timestep, 1.0]  # as hard as steps allow
        add_servo(spec, name, MASS * DAMPING * rate, MASS * DAMPING, MASS * limit * strength)
    middle = (0, 0, FINGER_HALF[2] - FINGER_LOW)
    add_box(body, FINGER_HALF, name="fingers", pos=middle, mass=MASS, rgba=[0.3, 0.32, 0.35, 1])


def _add_mark(spec: mujoco.MjSpec) -> None:
    body = spec.worldbody.add_body(name="mark", pos=[0, 0, CUBE_HALF])
    for axis in np.eye(3)[:2]:
        add_slide(body, axis)
    add_box(body, CUBE, mass=1.0, rgba=_MARK)


def _quaternion(angles: Array) -> Array:
    """[4] w, x, y, z of roll, pitch and yaw [3] rad, see `euler`."""
    (cr, cp, cy), (sr, sp, sy) = jnp.cos(angles / 2), jnp.sin(angles / 2)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return jnp.stack([w, x, y, z])
