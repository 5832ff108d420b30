"""A task of your own: a pusher slides a puck along a rail to a mark. It can push, not pull: too far is too far."""

import jax
import jax.numpy as jnp
import mujoco

from envs import Entry, Env, Parameter
from envs.mujoco.scene import Scene, View, make_env
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

MARK, TOLERANCE, STEP = 0.3, 0.03, 0.08  # m: where the puck should stop, how exactly, pusher's way per step at |a| = 1
MJCF = f"""
<mujoco>
  <option timestep="0.01" integrator="implicitfast" gravity="0 0 0" iterations="4" ls_iterations="8"/>
  <default><geom type="sphere" size="0.02" contype="0" conaffinity="0"/></default>
  <worldbody>
    <site name="mark" type="cylinder" pos="{MARK} 0 -0.02" size="{TOLERANCE} 0.001" rgba="0.2 0.7 0.3 1"/>
    <body><joint name="pusher" type="slide" axis="1 0 0" damping="1"/><geom name="tip" mass="0.2"/></body>
    <body><joint name="puck" type="slide" axis="1 0 0" frictionloss="0.1"/><geom name="disc" mass="0.1"/></body>
  </worldbody>
  <contact><pair geom1="tip" geom2="disc" condim="1"/></contact>
  <actuator><position joint="pusher" kp="200" kv="12" forcelimited="true" forcerange="-20 20"/></actuator>
</mujoco>
"""
PARAMETERS = (  # nominal, training range, physical bounds
    Parameter("puck_mass", "kg", 0.1, 0.08, 0.12, minimum=0.001),
    Parameter("rail_friction", "N", 0.6, 0.5, 0.7, minimum=0.001),
)


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The scene of one theta: MuJoCo's own compiler makes a model of it, once per world."""
    spec = mujoco.MjSpec.from_string(MJCF)
    spec.geom("disc").mass, spec.joint("puck").frictionloss = theta["puck_mass"], theta["rail_friction"]
    return spec


def initial(params: Array, key: Key) -> PhysicsState:
    """At rest, the puck somewhere before the mark, the pusher behind it."""
    puck = jax.random.uniform(key, minval=-0.05, maxval=0.1)
    pusher = jnp.float32(-0.15)
    return PhysicsState(jnp.stack([pusher, puck]), jnp.zeros(2), jnp.zeros(2), pusher[None])


def observe(params: Array, state: PhysicsState) -> Array:
    """[3]: pusher and puck in m, speed of the puck in m/s."""
    return jnp.concatenate([state.qpos, state.qvel[1:]])


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """[]: minus the puck's distance from the mark, minus a little of the pusher's from the puck, plus 1 at the mark."""
    return -jnp.abs(next_obs[1] - MARK) - 0.1 * jnp.abs(next_obs[1] - next_obs[0]) + success(next_obs)


def success(obs: Array) -> Array:
    """[] bool: the puck is at the mark."""
    return jnp.abs(obs[1] - MARK) <= TOLERANCE


SCENE = Scene(
    name="own_task",
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
    """The task: what `--task docs/examples/own_task.py` looks for."""
    return make_env(SCENE, impl)
