"""Driving a nail in with a hammer that must be taken first: a twin of hammer-v3 of Meta-World.

An action of Meta-World moves a point that drags the hand of a Sawyer arm behind it, and closes the fingers. An
observation says nothing of joints. So there is no arm here: a hand hangs on three slides, whose servos were fitted to
how far Meta-World's hand lags behind (docs/physics.md). It does not turn. Fingers touch the handle alone, only the
hammer's face touches the nail, and nothing touches the block.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Entry, Parameter
from envs.franka import armless
from envs.franka.armless import inverse, turned
from envs.mujoco import parts
from envs.mujoco.scene import View
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

CONTROL_DT, SUBSTEPS = 0.025, 10  # s: two frames of Meta-World; physics steps in it
STEP = 0.02  # m: how far an action of 1 moves where the hand is sent
START = np.array([0.0, 0.4, 0.2])  # m: where the hand is sent at first
WORKSPACE = np.array([[-0.5, 0.4, 0.05], [0.5, 1.0, 0.5]])  # m, of where it may be sent
HAMMER_AT = np.array([[-0.1, 0.4], [0.1, 0.5]])  # m, x and y: where the middle of the handle starts
# A hand of 3 kg, which hangs through by 3.6 mm, with the arm's inertia along x, y, z and one stiff servo for all three.
HAND_MASS, ARM_INERTIA = 3.0, (6.4, 2.2, 3.7)  # kg
STIFFNESS, DAMPING = 8200.0, 490.0  # N/m, N s/m
# Fingers of Meta-World are slow: behind each there are 100 kg in 1000 N s/m, and a force of 400 N for an effort of 1.
FINGER_MASS, FINGER_INERTIA, FINGER_DAMPING, FINGER_FORCE = 0.016, 100.0, 1000.0, 400.0
SAG = 9.81 * (HAND_MASS + 2 * FINGER_MASS) / STIFFNESS  # m
FINGER_HALF = 0.015, 0.0045, 0.045  # m: along the handle, in thickness, in height; the hand's place is their middle
OPEN, INSIDE = 0.05, 0.006  # m: from the middle to a finger's own place when open; from there to its inner face
TRAVEL = 0.04, 0.03  # m, of the right and of the left finger
# The hammer lies along x. Its head is a rod across, whose ends are its two faces.
HANDLE_HALF, HANDLE_RADIUS = 0.14, 0.02  # m
HEAD_X, HEAD_RADIUS, FACE_Y = 0.16, 0.038, 0.072  # m
HAMMER_MASS, HAMMER_COM = 1.1, 0.145  # kg; m along the handle
HAMMER_INERTIA = np.array([0.0024, 0.0037, 0.0055]) / HAMMER_MASS  # m^2
TILT = (HEAD_RADIUS - HANDLE_RADIUS) / (HANDLE_HALF + HEAD_X)  # rad of the handle when the hammer lies on the table
LYING = HANDLE_RADIUS + HANDLE_HALF * TILT  # m: height of the handle's middle then
# A round face that meets a round head is here a ball that meets a square block: both radii are the block's.
NAIL = np.array([0.24, 0.631, 0.11])  # m: the middle of the front of the nail's head at the start
NAIL_HALF, NAIL_BACK, NAIL_MASS, BALL = 0.06, 0.1, 0.09, 0.01  # m, m, kg, m
BLOCK_HALF, BLOCK_Y = (0.1, 0.1, 0.11), 0.75  # m; its front
DEEP, DRIVEN = 0.1, 0.09  # m: how far the nail can go, and has to
GRIP_BELOW = 0.03  # m: a handle that is no deeper than this below the hand's place, is well between the fingers

PARAMETERS = (
    Parameter("hammer_mass", "kg", HAMMER_MASS, 0.8, 1.4, minimum=0.05),
    Parameter("table_friction", "", 1.0, 0.6, 1.4, minimum=0.0),
    Parameter("finger_friction", "", 2.0, 1.2, 2.5, minimum=0.0),
    Parameter("hand_stiffness", "", 1.0, 0.7, 1.3, minimum=0.1),
    Parameter("hand_damping", "", 1.0, 0.8, 1.25, minimum=0.1),
    Parameter("finger_force", "", 1.0, 0.7, 1.3, minimum=0.05),
    Parameter("nail_damping", "N s/m", 2.0, 1.0, 20.0, minimum=0.0),
    # Random actions from far above would hardly ever touch the hammer, let alone lift it.
    Parameter("start_above", "probability", 0.25, 0.25, 0.25, minimum=0.0, maximum=1.0),
    Parameter("start_held", "probability", 0.25, 0.25, 0.25, minimum=0.0, maximum=1.0),
)
_ABOVE, _HELD = (next(i for i, p in enumerate(PARAMETERS) if p.name == name) for name in ("start_above", "start_held"))
_RED, _METAL, _WOOD = [0.65, 0.1, 0.1, 1.0], [0.6, 0.62, 0.65, 1.0], [0.72, 0.55, 0.35, 1.0]


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The scene for one theta. Where the hammer starts is part of the state, not of the model."""
    spec = armless.table_spec(CONTROL_DT / SUBSTEPS)
    _add_hand(spec, theta)
    _add_hammer(spec, theta["hammer_mass"])
    _add_nail(spec, theta["nail_damping"])
    for part in ("handle", "head"):
        _add_pair(spec, "table", part, theta["table_friction"], 0.015, (0.945, 0.97, 0.0055))
    for finger in ("right", "left"):  # whose friction also resists a turn about the contact's normal: it holds level
        _add_pair(spec, finger, "handle", theta["finger_friction"], 0.01, (0.97, 0.99, 0.01), condim=4)
    for what in ("nail", "block"):
        # Hardly any friction, or a face that slides along the nail's side would pull it out.
        _add_pair(spec, "face", what, 0.01, 0.01, (0.99, 0.99, 0.01))
    return spec


def initial(params: Array, key: Key) -> PhysicsState:
    """The hammer anywhere in its rectangle; the open hand at its start or above the handle, or the hammer in hand."""
    key_place, key_which, key_above, key_held = jax.random.split(key, 4)
    place = jax.random.uniform(key_place, (2,), minval=HAMMER_AT[0], maxval=HAMMER_AT[1])
    which = jax.random.uniform(key_which)
    sent = jnp.asarray(START, jnp.float32)
    sent = jnp.where(which < params[_ABOVE] + params[_HELD], above(place, key_above), sent)
    start = _state(sent, jnp.zeros(2), jnp.concatenate([place, _lying()]), effort=-1.0)
    return jax.tree.map(lambda a, b: jnp.where(which < params[_HELD], a, b), held(key_held), start)


def above(place: Array, key: Key) -> Array:
    """[3] m: a random place to send the hand to, over the handle of a hammer that lies at `place` [2]."""
    low, high = jnp.array([-0.1, -0.01, WORKSPACE[0, 2]]), jnp.array([0.06, 0.01, 0.12])
    along, aside, height = jax.random.uniform(key, (3,), minval=low, maxval=high)
    return jnp.stack([place[0] + along, place[1] + aside, height])


def held(key: Key) -> PhysicsState:
    """The hand holds the hammer, level and at rest, on some way from where a hammer can be to just before the nail."""
    key_place, key_way, key_along = jax.random.split(key, 3)
    low, high = jnp.array([-0.12, 0.4, LYING + 0.01]), jnp.array([0.12, 0.5, 0.15])
    place, way = jax.random.uniform(key_place, (3,), minval=low, maxval=high), jax.random.uniform(key_way)
    before_nail = jnp.asarray(NAIL - [HEAD_X, FACE_Y + 0.004, 0.0], jnp.float32)
    place = place + way * (before_nail - place)
    along = jax.random.uniform(key_along, minval=-0.08, maxval=0.04)
    closed = jnp.full(2, OPEN - INSIDE - HANDLE_RADIUS + 0.001)  # pads give way by a millimetre
    sent = place + jnp.stack([along, 0.0, 0.02 + SAG])
    return _state(sent, closed, jnp.concatenate([place, _lying()[1:]]), effort=1.0)


def settled(params: Array, obs: Array) -> PhysicsState:
    """The state that an observation stands for.

    It does not say by how much both fingers are shifted to one side; they are placed around the handle if it lies
    between them. The last effort is unknown, too; the next command replaces it.
    """
    turn = obs[14:18] / jnp.linalg.norm(obs[14:18])
    fingers = OPEN - obs[9] / 2 + _shift(obs) * jnp.array([1.0, -1.0])
    qpos = jnp.concatenate([obs[:3], fingers, obs[11:14], turn, obs[24:25]])
    closing = jnp.full(2, -obs[10] / 2)
    spin = turned(inverse(turn), obs[21:24])  # MuJoCo tells it in the hammer's own frame
    qvel = jnp.concatenate([obs[6:9], closing, obs[18:21], spin, obs[25:26]])
    return PhysicsState(qpos, qvel, jnp.zeros(12), jnp.concatenate([obs[3:6], jnp.zeros(2)]))


def target(qpos: Array, action: Array) -> Array:
    """[5]: how far along x, y, z to move where the hand is sent, m, and the effort of both fingers."""
    action = jnp.clip(action, -1.0, 1.0)
    return jnp.concatenate([STEP * action[:3], action[3:], action[3:]])


def motors(params: Array, previous: Array, target: Array) -> Array:
    """[5]: where the hand is sent, m, a step from where it was sent before and within the workspace; both efforts."""
    low, high = jnp.asarray(WORKSPACE, jnp.float32)
    return target.at[:3].set(jnp.clip(previous[:3] + target[:3], low, high))


def observe(params: Array, state: PhysicsState) -> dict[str, Array]:
    """What the driver of Meta-World measures, in its order and units."""
    qpos, qvel = state.qpos, state.qvel
    turn = qpos[8:12]
    return {
        "hand_xyz": qpos[:3],
        "sent_xyz": state.ctrl[:3],
        "hand_velocity": qvel[:3],
        "fingers_apart": jnp.minimum(2 * OPEN - qpos[3:5].sum(keepdims=True), 2 * OPEN),
        "fingers_opening": -qvel[3:5].sum(keepdims=True),
        "hammer_xyz": qpos[5:8],
        "hammer_rotation": turn * jnp.where(turn[0] < 0, -1.0, 1.0),
        "hammer_velocity": qvel[5:8],
        "hammer_spin": turned(turn, qvel[8:11]),
        "nail_depth": qpos[12:13],
        "nail_velocity": qvel[11:12],
    }


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """[]: up to 0.2 each for a hand at the handle, fingers around it and a lifted face, up to 0.4 for a face near the
    nail, up to 1 for the nail's depth.

    Each part grows on the way and pays most where the next one begins, so waiting is never worth more than going on.
    Fingers that close before the handle is between them are worth nothing.
    """
    near = 1 - jnp.tanh(10 * jnp.linalg.norm(off_handle(next_obs)))
    closed = jnp.clip((2 * OPEN - next_obs[9]) / OPEN, 0.0, 1.0)
    face, nail = face_of(next_obs), jnp.asarray(NAIL, jnp.float32) + next_obs[24] * jnp.array([0.0, 1.0, 0.0])
    lifted = jnp.clip((face[2] - HEAD_RADIUS) / (NAIL[2] - HEAD_RADIUS), 0.0, 1.0)
    at_nail = 1 - jnp.tanh(5 * jnp.linalg.norm(nail - face))
    depth = jnp.clip(next_obs[24] / DEEP, 0.0, 1.0)
    return 0.2 * (near + near**4 * closed + lifted) + 0.4 * at_nail + depth


def success(obs: Array) -> Array:
    """[] bool: the nail is more than 9 cm deep."""
    return obs[24] > DRIVEN


def off_handle(obs: Array) -> Array:
    """[3] m: how far the hand is from where it can close around the handle, anywhere along it but at its ends."""
    axis = turned(obs[14:18], jnp.array([1.0, 0.0, 0.0]))
    off = obs[:3] - obs[11:14]
    off = off - jnp.clip(off @ axis, -0.11, 0.09) * axis
    return off.at[2].add(-jnp.clip(off[2], 0.0, GRIP_BELOW))


def face_of(obs: Array) -> Array:
    """[3] m: the middle of the face that strikes."""
    return obs[11:14] + turned(obs[14:18], jnp.array([HEAD_X, FACE_Y, 0.0]))


def dress(spec: mujoco.MjSpec) -> None:
    """A table top, the palm, and the block around the nail, which only a viewer sees."""
    world, hand = spec.worldbody, spec.body("hand")
    parts.add_box(world, (0.7, 0.4, 0.01), pos=(0, 0.6, -0.0102), rgba=[0.9, 0.9, 0.88, 1])
    parts.add_box(hand, (0.03, 0.07, 0.03), pos=(0, 0, 0.075), rgba=[0.3, 0.1, 0.1, 1])
    x, y, z = NAIL[0], BLOCK_Y + BLOCK_HALF[1], NAIL[2]
    for side in (-1, 1):
        parts.add_box(world, (0.1, 0.1, 0.048), pos=(x, y, z + 0.062 * side), rgba=_WOOD)
        parts.add_box(world, (0.042, 0.1, 0.014), pos=(x + 0.058 * side, y, z), rgba=_WOOD)
    for radius, half, back in ((0.03, 0.009, 0.009), (0.01, 0.06, 0.066)):
        turn = [0.7071, 0.7071, 0, 0]
        parts.add_cylinder(spec.body("nail"), radius, half, pos=[0, back, 0], quat=turn, rgba=_METAL, mass=0)


SCENE = armless.scene(
    name="metaworld-hammer",
    observation=(
        Entry("hand_xyz", "m", 3),
        Entry("sent_xyz", "m", 3),
        Entry("hand_velocity", "m/s", 3),
        Entry("fingers_apart", "m", 1),
        Entry("fingers_opening", "m/s", 1),
        Entry("hammer_xyz", "m", 3),
        Entry("hammer_rotation", "", 4),
        Entry("hammer_velocity", "m/s", 3),
        Entry("hammer_spin", "rad/s", 3),
        Entry("nail_depth", "m", 1),
        Entry("nail_velocity", "m/s", 1),
    ),
    action=(Entry("sent_step", "2 cm", 3), Entry("finger_effort", "", 1)),
    parameters=PARAMETERS,
    episode_length=75,
    control_dt=CONTROL_DT,
    substeps=SUBSTEPS,
    build=build,
    initial=initial,
    settled=settled,
    target=target,
    motors=motors,
    observe=observe,
    reward=reward,
    success=success,
    success_anytime=True,  # as Meta-World judges; the nail has no way back
    dress=dress,
    view=View((0.1, 0.6, 0.08), 1.0, 145.0, -25.0, -0.913),
)


def _lying() -> Array:
    """[5]: height and rotation of a hammer that lies on the table."""
    return jnp.array([LYING, np.cos(TILT / 2), 0.0, -np.sin(TILT / 2), 0.0], jnp.float32)


def _state(sent: Array, fingers: Array, hammer: Array, *, effort: float) -> PhysicsState:
    """All at rest, the hand as near as it comes to where it was sent [3]. fingers: [2] how far each has moved inwards.
    hammer: [7]. The nail is at its start.
    """
    hand = sent - jnp.array([0.0, 0.0, SAG])
    qpos = jnp.concatenate([hand, fingers, hammer, jnp.zeros(1)])
    return PhysicsState(qpos, jnp.zeros(12), jnp.zeros(12), jnp.concatenate([sent, jnp.full(2, effort)]))


def _shift(obs: Array) -> Array:
    """[] m: shift of both fingers to the left that puts the handle between them; 0 where the handle is elsewhere.

    It is the smallest shift that does so.
    """
    axis = turned(obs[14:18], jnp.array([1.0, 0.0, 0.0]))
    off = obs[11:14] - obs[:3]
    off = off - jnp.clip(off @ axis, -HANDLE_HALF, HANDLE_HALF) * axis  # from the hand to the handle
    beyond = jnp.abs(off[1]) - (obs[9] / 2 - INSIDE - HANDLE_RADIUS)
    between = (jnp.abs(off[0]) < FINGER_HALF[0]) & (jnp.abs(off[2]) < FINGER_HALF[2]) & (jnp.abs(off[1]) < 0.03)
    return jnp.where(between, jnp.sign(off[1]) * jnp.clip(beyond, 0.0, jnp.abs(off[1])), 0.0)


def _add_hand(spec: mujoco.MjSpec, theta: dict[str, float]) -> None:
    """The hand on its slides, whose zeros are those of the world, and both fingers on theirs, which close them."""
    hand = spec.worldbody.add_body(name="hand", mass=HAND_MASS, inertia=[0.01] * 3, explicitinertial=True)
    stiffness, damping = STIFFNESS * theta["hand_stiffness"], DAMPING * theta["hand_damping"]
    for name, axis, inertia in zip("xyz", np.eye(3), ARM_INERTIA, strict=True):
        parts.add_slide(hand, axis, name=name, armature=inertia)
        parts.add_servo(spec, name, stiffness, damping)
    for name, side, travel in zip(("right", "left"), (-1, 1), TRAVEL, strict=True):
        finger = hand.add_body(name=name, pos=[0, side * OPEN, 0])
        slow = {"armature": FINGER_INERTIA, "damping": FINGER_DAMPING}
        parts.add_slide(finger, [0, -side, 0], name=name, range=[0, travel], **slow)
        parts.add_servo(spec, name, FINGER_FORCE * theta["finger_force"], 0.0)  # 1 m away is an effort of 1
        middle = (0, -side * (INSIDE - FINGER_HALF[1]), 0)
        parts.add_box(finger, FINGER_HALF, name=name, pos=middle, mass=FINGER_MASS, rgba=[0.85, 0.85, 0.88, 1])


def _add_hammer(spec: mujoco.MjSpec, mass: float) -> None:
    """Handle along x and head across it. The ball in its face at +y is what meets the nail."""
    hammer = spec.worldbody.add_body(
        name="hammer", mass=mass, ipos=[HAMMER_COM, 0, 0], inertia=mass * HAMMER_INERTIA, explicitinertial=True
    )
    hammer.add_freejoint()
    end, across = HANDLE_HALF, FACE_Y - HEAD_RADIUS
    parts.add_capsule(hammer, HANDLE_RADIUS, name="handle", fromto=[-end, 0, 0, end, 0, 0], rgba=_RED)
    parts.add_capsule(hammer, HEAD_RADIUS, name="head", fromto=[HEAD_X, -across, 0, HEAD_X, across, 0], rgba=_METAL)
    parts.add_sphere(hammer, BALL, name="face", pos=[HEAD_X, FACE_Y - BALL, 0], rgba=_METAL)


def _add_nail(spec: mujoco.MjSpec, damping: float) -> None:
    """A head on a slide that ends where the nail is in. A viewer does not see the square."""
    nail = spec.worldbody.add_body(
        name="nail", pos=NAIL, mass=NAIL_MASS, inertia=[1e-4] * 3, ipos=[0, 0.05, 0], explicitinertial=True
    )
    stop = {"range": [0, DEEP], "solref_limit": [0.01, 1.0], "solimp_limit": [0.99, 0.99, 0.01, 0.5, 2]}
    parts.add_slide(nail, [0, 1, 0], name="nail", damping=damping, **stop)
    # It reaches far back, so that no ball gets behind it and pulls the nail out.
    parts.add_box(nail, [NAIL_HALF, NAIL_BACK, NAIL_HALF], name="nail", pos=[0, NAIL_BACK, 0], rgba=parts.INVISIBLE)
    wide, deep, high = BLOCK_HALF
    half, place = [wide + HEAD_RADIUS, deep, high + HEAD_RADIUS], [NAIL[0], BLOCK_Y + deep, NAIL[2]]
    parts.add_box(spec.worldbody, half, name="block", pos=place, rgba=parts.INVISIBLE)


def _add_pair(
    spec: mujoco.MjSpec, one: str, other: str, friction: float, time: float, impedance: Sequence[float], condim: int = 3
) -> None:
    """time: s, that of the contact's spring. impedance: the first three of MuJoCo's five numbers."""
    solver = {"solref": [time, 1.0], "solimp": [*impedance, 0.5, 2]}
    parts.add_pair(spec, one, other, friction, 0.05 * friction, condim, **solver)
