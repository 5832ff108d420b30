"""Pendulum swing-up: a weak motor swings a pole up and holds it there."""

import jax
import jax.numpy as jnp
import mujoco

from envs.base import Entry, Env, Parameter
from envs.mujoco.scene import Scene, make_env
from envs.mujoco.worlds import PhysicsState
from sgft_jax.types import Array, Key

MJCF = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body pos="0 0 1"><joint name="hinge" axis="0 1 0" damping="0.05"/>
      <geom name="pole" type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0.5"/></body>
  </worldbody>
  <actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The scene of one theta."""
    spec = mujoco.MjSpec.from_string(MJCF)
    spec.geom("pole").mass = theta["pole_mass"]
    return spec


def initial(params: Array, key: Key) -> PhysicsState:
    """Hanging down, almost at rest."""
    angle = jnp.pi + 0.1 * jax.random.normal(key, (1,))
    return PhysicsState(angle, jnp.zeros(1), jnp.zeros(1), jnp.zeros(1))


def observe(params: Array, state: PhysicsState) -> Array:
    """[3]: cosine (1 is upright) and sine of the angle, angular velocity in rad/s."""
    return jnp.concatenate([jnp.cos(state.qpos), jnp.sin(state.qpos), state.qvel])


SCENE = Scene(
    name="pendulum",
    observation=(Entry("cos", "", 1), Entry("sin", "", 1), Entry("spin", "rad/s", 1)),
    action=(Entry("torque", "0.7 N m", 1),),
    parameters=(Parameter("pole_mass", "kg", 0.5, 0.4, 0.6, 0.01),),
    episode_length=100,
    control_dt=0.05,
    substeps=5,
    build=build,
    initial=initial,
    target=lambda qpos, action: 0.7 * action,
    observe=observe,
    reward=lambda obs, action, next_obs: next_obs[0] - 0.01 * next_obs[2] ** 2 - 0.01 * action[0] ** 2,
    success=lambda obs: obs[0] > 0.95,
)


def make(impl: str = "auto") -> Env:
    """The task."""
    return make_env(SCENE, impl)
