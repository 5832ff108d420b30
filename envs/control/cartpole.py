"""Cartpole swing-up of the DeepMind Control Suite: a public task with published learning curves.

A cart on a rail swings a pole up and holds it there, in the middle. Facts from dm_control (suite/cartpole, Tassa et al.
2018): frames of 10 ms by Runge-Kutta, 1,000 to an episode. As TD-MPC2 plays it, an action lasts two frames and earns
the rewards of both, so that an episode has 500 steps and returns at most 1,000.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Entry, Env, Parameter
from envs.control.suite import bell
from envs.mujoco.engines import Engine
from envs.mujoco.parts import add_hinge, add_motor, add_slide, empty_spec
from envs.mujoco.scene import Scene, View, make_env
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

FRAME, REPEAT = 0.01, 2  # s; frames per action
CONTROL_DT = FRAME * REPEAT
RAIL = 1.8  # m to either side
STOP_TIME = 0.08  # s: time constant of the soft stop at either end
DAMPING = (5e-4, 2e-6)  # N s/m of the cart, N m s of the pole
CART_MARGIN, SPIN_MARGIN = 2.0, 5.0  # m and rad/s at which these factors of the reward have lost nine tenths of a half
UPRIGHT, CENTRED = 0.995, 0.25  # cosine and m: the bounds of dm_control's sparse variant
START_STD = 0.01  # m, rad, m/s, rad/s

PARAMETERS = (
    Parameter("cart_mass", "kg", 1.0, 0.8, 1.25, minimum=0.01),
    Parameter("pole_mass", "kg", 0.1, 0.07, 0.14, minimum=0.001),
    Parameter("pole_length", "m", 1.0, 0.9, 1.1, minimum=0.05),
    Parameter("force", "N", 10.0, 8.0, 12.5, minimum=0.0),
)


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The scene for one theta."""
    spec = empty_spec(FRAME, mujoco.mjtIntegrator.mjINT_RK4)
    spec.option.iterations, spec.option.ls_iterations = 2, 4  # one constraint, the end of the rail: two are exact
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    cart = spec.worldbody.add_body(name="cart", pos=[0, 0, 1])
    stop = {"range": [-RAIL, RAIL], "solref_limit": [STOP_TIME, 1.0]}
    add_slide(cart, [1, 0, 0], name="slider", damping=DAMPING[0], **stop)
    cart.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.15, 0.1], mass=theta["cart_mass"])
    pole = cart.add_body(name="pole")
    add_hinge(pole, [0, 1, 0], name="hinge", damping=DAMPING[1])
    ends, capsule = [0, 0, 0, 0, 0, theta["pole_length"]], mujoco.mjtGeom.mjGEOM_CAPSULE
    pole.add_geom(type=capsule, fromto=ends, size=[0.045, 0, 0], mass=theta["pole_mass"])
    add_motor(spec, "motor", "slider", theta["force"])
    return spec


def initial(params: Array, key: Key) -> PhysicsState:
    """Almost at rest in the middle, the pole hanging down."""
    spread = START_STD * jax.random.normal(key, (4,))
    return PhysicsState(spread[:2] + jnp.array([0.0, np.pi]), spread[2:], jnp.zeros(2), jnp.zeros(1))


def advance(fields: dict[str, Array], state: PhysicsState, controls: Array) -> PhysicsState:
    """The same motion as MuJoCo's in closed form, in place of MJX's general code.

    An episode of one cart takes 1 ms on a CPU instead of 100, and 3 s to compile instead of 20. fields: of one world's
    MuJoCo model. controls: [frames, 1].
    """

    def frame(state: PhysicsState, control: Array) -> tuple[PhysicsState, None]:
        force = fields["actuator_gear"].reshape(-1)[0] * jnp.clip(control[0], -1.0, 1.0)
        qpos, qvel, total = state.qpos, state.qvel, (jnp.zeros(2), jnp.zeros(2))
        for ahead, weight in ((0.5, 1), (0.5, 2), (1.0, 2), (0.0, 1)):  # Runge-Kutta
            slope = qvel, acceleration(fields, qpos, qvel, force)
            total = (total[0] + weight / 6 * slope[0], total[1] + weight / 6 * slope[1])
            qpos, qvel = state.qpos + ahead * FRAME * slope[0], state.qvel + ahead * FRAME * slope[1]
        moved = state._replace(qpos=state.qpos + FRAME * total[0], qvel=state.qvel + FRAME * total[1])
        return moved._replace(warmstart=total[1], ctrl=control), None

    return jax.lax.scan(frame, state, controls, unroll=True)[0]


def acceleration(fields: dict[str, Array], qpos: Array, qvel: Array, force: Array) -> Array:
    """[2] m/s^2 and rad/s^2 under a force [] on the cart in N, that of the stops included."""
    (_, cart, pole), gravity = fields["body_mass"], 9.81
    arm, inertia = pole * fields["body_ipos"][2, 2], fields["body_inertia"][2, 1]
    sin, cos = jnp.sin(qpos[1]), jnp.cos(qpos[1])
    a, b, c = cart + pole, arm * cos, inertia + arm**2 / pole  # the mass matrix [[a, b], [b, c]]
    push = force - DAMPING[0] * qvel[0] + arm * sin * qvel[1] ** 2
    turn = arm * gravity * sin - DAMPING[1] * qvel[1]
    free = (c * push - b * turn) / (a * c - b**2)
    push += _stop(qpos[0], qvel[0], free, c / (a * c - b**2), fields["dof_invweight0"][0])
    return jnp.stack([c * push - b * turn, a * turn - b * push]) / (a * c - b**2)


def _stop(x: Array, v: Array, free: Array, compliance: Array, weight: Array) -> Array:
    """Force [] on the cart of the stop it is in, MuJoCo's soft constraint with its default impedance.

    free: acceleration without it. compliance: acceleration per force. weight: the constraint's inverse weight.
    """
    inward = -jnp.sign(x)
    depth = jnp.maximum(jnp.abs(x) - RAIL, 0.0)
    share = jnp.minimum(depth / 1e-3, 1.0)
    impedance = 0.9 + 0.05 * jnp.where(share < 0.5, 2 * share**2, 1 - 2 * (1 - share) ** 2)
    wanted = -2 / (0.95 * STOP_TIME) * inward * v + impedance * depth / (0.95 * STOP_TIME) ** 2
    softness = (1 - impedance) / impedance * weight
    push = jnp.maximum((wanted - inward * free) / (compliance + softness), 0.0)
    return jnp.where(depth > 0, inward * push, 0.0)


def observe(params: Array, state: PhysicsState) -> Array:
    """[5]: position of the cart, cosine (1 is upright) and sine of the pole's angle, velocities of both."""
    angle = state.qpos[1]
    return jnp.stack([state.qpos[0], jnp.cos(angle), jnp.sin(angle), *state.qvel])


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """Sum over both frames of a step. Source: dm_control's smooth cartpole reward, with TD-MPC2's action repeat."""
    x, upright, spin = halfway(obs, next_obs)
    return frame_reward(x, upright, spin, action) + frame_reward(next_obs[0], next_obs[1], next_obs[4], action)


def frame_reward(x: Array, upright: Array, spin: Array, action: Array) -> Array:
    """From 0 to 1: upright, and less so off the centre (m), while the pole turns (rad/s), or with force.

    x, upright (a cosine), spin: [] after the frame; action: [1].
    """
    centred = (1 + bell(x / CART_MARGIN)) / 2
    calm = (1 + bell(spin / SPIN_MARGIN)) / 2
    gentle = (4 + jnp.maximum(1 - action[0] ** 2, 0.0)) / 5
    return (upright + 1) / 2 * centred * calm * gentle


def halfway(obs: Array, next_obs: Array) -> tuple[Array, Array, Array]:
    """Position, cosine and angular velocity after the first of a step's two frames: of the cubics through both ends.

    The reward thus is a function of observations and action. It misses that of the frame itself by up to 0.002 where
    the cart hits the end of the rail, and by 0.01 over an episode.
    """
    (x, cos, sin, v, w), (x_next, cos_next, sin_next, v_next, w_next) = obs, next_obs
    turn = jnp.arctan2(sin_next * cos - cos_next * sin, cos_next * cos + sin_next * sin)
    middle = (x + x_next) / 2 + CONTROL_DT / 8 * (v - v_next)
    angle = jnp.arctan2(sin, cos) + turn / 2 + CONTROL_DT / 8 * (w - w_next)
    return middle, jnp.cos(angle), 1.5 * turn / CONTROL_DT - (w + w_next) / 4


def success(obs: Array) -> Array:
    """Upright in the middle."""
    return (obs[1] >= UPRIGHT) & (jnp.abs(obs[0]) <= CENTRED)


SCENE = Scene(
    name="cartpole",
    observation=(
        Entry("cart_x", "m", 1),
        Entry("pole_cos", "", 1),
        Entry("pole_sin", "", 1),
        Entry("cart_velocity", "m/s", 1),
        Entry("pole_velocity", "rad/s", 1),
    ),
    action=(Entry("push", "force", 1),),
    parameters=PARAMETERS,
    episode_length=500,
    substeps=REPEAT,
    build=build,
    initial=initial,
    target=lambda qpos, action: jnp.clip(action, -1.0, 1.0),
    observe=observe,
    reward=reward,
    success=success,
    control_dt=CONTROL_DT,
    ramp=FRAME,
    score="return",
    engine=Engine(advance),
    view=View((0.0, 0.0, 1.0), 5.0, 90.0, -10.0),
)


def make(impl: str = "auto") -> Env:
    """The swing-up task. Its nominal parameters are dm_control's."""
    return make_env(SCENE, impl)
