"""Pushing along a rail: a pusher slides a puck to a mark, and cannot pull it back."""

import jax
import jax.numpy as jnp
import mujoco

from envs.base import Entry, Env, Parameter
from envs.mujoco.parts import add_pair, add_servo, add_slide, add_sphere, stiff_spec
from envs.mujoco.scene import Scene, View, make_env
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

MARK, TOLERANCE, STEP = 0.3, 0.03, 0.08  # m: where the puck should stop, how exactly, the pusher's way in a step

PARAMETERS = (
    Parameter("puck_mass", "kg", 0.1, 0.08, 0.12, minimum=0.001),
    Parameter("rail_friction", "N", 0.6, 0.5, 0.7, minimum=0.001),
)


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The scene for one theta."""
    spec = stiff_spec(0.01, iterations=4, ls_iterations=8)
    spec.option.gravity = [0, 0, 0]
    pusher, puck = (spec.worldbody.add_body(name=name) for name in ("pusher", "puck"))
    add_slide(pusher, [1, 0, 0], name="pusher", damping=1.0)
    add_slide(puck, [1, 0, 0], name="puck", frictionloss=theta["rail_friction"])
    add_sphere(pusher, 0.02, name="tip", mass=0.2)
    add_sphere(puck, 0.02, name="disc", mass=theta["puck_mass"])
    add_pair(spec, "tip", "disc", 0.0, condim=1)
    add_servo(spec, "pusher", 200.0, 12.0, most=20.0)
    return spec


def initial(params: Array, key: Key) -> PhysicsState:
    """At rest, the puck somewhere before the mark, the pusher behind it."""
    pusher, puck = jnp.float32(-0.15), jax.random.uniform(key, minval=-0.05, maxval=0.1)
    return PhysicsState(jnp.stack([pusher, puck]), jnp.zeros(2), jnp.zeros(2), pusher[None])


def observe(params: Array, state: PhysicsState) -> Array:
    """[3]: pusher and puck in m, speed of the puck in m/s."""
    return jnp.concatenate([state.qpos, state.qvel[1:]])


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """[]: minus the puck's distance from the mark and a tenth of the pusher's from the puck, plus 1 at the mark."""
    return -jnp.abs(next_obs[1] - MARK) - 0.1 * jnp.abs(next_obs[1] - next_obs[0]) + success(next_obs)


def success(obs: Array) -> Array:
    """[] bool: the puck is at the mark."""
    return jnp.abs(obs[1] - MARK) <= TOLERANCE


SCENE = Scene(
    name="rail",
    observation=(Entry("pusher_x", "m", 1), Entry("puck_x", "m", 1), Entry("puck_speed", "m/s", 1)),
    action=(Entry("pusher_step", "8 cm", 1),),
    parameters=PARAMETERS,
    episode_length=15,
    control_dt=0.2,
    substeps=20,
    ramp=0.1,
    build=build,
    initial=initial,
    observe=observe,
    reward=reward,
    success=success,
    target=lambda qpos, action: jnp.clip(qpos[:1] + STEP * action, -0.2, 0.5),
    training={"obs_noise": 0.004, "obs_noise_prob": 0.3},
    view=View((0.15, 0.0, 0.0), 0.7, 90.0, -30.0),
)


def make(impl: str = "auto") -> Env:
    """The task."""
    return make_env(SCENE, impl)
