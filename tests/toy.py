"""A point mass on a plane that is pushed to the origin: an Env without a physics engine, learned in seconds."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Entry, Env, EnvState, Parameter, World
from envs.effects import distort, draw, measure
from envs.types import Array, Key

DT, FORCE, TOLERANCE = 0.1, 4.0, 0.15  # s, N at full action, m
PARAMETERS = (Parameter("mass", "kg", 1.0, 0.8, 1.2, 0.01), Parameter("friction", "1/s", 4.0, 3.5, 4.5, 0.0))
TRAINING = {"obs_noise": 0.005, "obs_noise_prob": 0.3}


class Point(NamedTuple):
    """qpos: [2] m. qvel: [2] m/s. ctrl: [2] the last command, in force until the latency has passed."""

    qpos: Array
    qvel: Array
    ctrl: Array


def make(impl: str = "auto") -> Env:
    """The toy task, 20 steps of 0.1 s."""
    return Env(
        name="toy",
        observation=(Entry("xy", "m", 2), Entry("velocity", "m/s", 2)),
        action=(Entry("force", "4 N", 2),),
        parameters=PARAMETERS,
        episode_length=20,
        control_dt=DT,
        make_worlds=lambda theta: World(theta._replace(params=jnp.asarray(theta.params, jnp.float32)), {}),
        reset=reset,
        step=step,
        restore=restore,
        reward=reward,
        success=success,
        training=TRAINING,
        cartesian=True,
        trace=lambda physics: physics.qpos,
    )


def reset(world: World, key: Key) -> EnvState:
    key_start, key_noise, key_effects = jax.random.split(key, 3)
    start = jax.random.uniform(key_start, (2,), minval=-0.8, maxval=0.8)
    no, rest = jnp.zeros((), bool), jnp.zeros(2)
    obs, own = jnp.concatenate([start, rest]), draw(world.theta.effects, key_effects)
    measured = measure(own, obs, key_noise)
    return EnvState(Point(start, rest, rest), measured, obs, jnp.float32(0), no, no, no, no, jnp.int32(0), own)


def restore(world: World, obs: Array, key: Key) -> EnvState:
    own = draw(world.theta.effects, key)
    true_obs, command, no = obs - own.obs_bias, jnp.zeros(2), jnp.zeros((), bool)
    point = Point(true_obs[:2], true_obs[2:], command)
    return EnvState(point, obs, true_obs, jnp.float32(0), no, no, no, no, jnp.int32(0), own)


def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
    mass, friction = world.theta.params
    command = distort(state.effects, action)
    late = jnp.clip(state.effects.latency / DT, 0.0, 1.0)
    force = FORCE * (late * state.physics.ctrl + (1 - late) * command)
    velocity = state.physics.qvel + DT * (force / mass - friction * state.physics.qvel)
    position = state.physics.qpos + DT * velocity
    obs = jnp.concatenate([position, velocity])
    no, time = jnp.zeros((), bool), state.time + 1
    return EnvState(
        physics=Point(position, velocity, command),
        obs=measure(state.effects, obs, key),
        true_obs=obs,
        reward=reward(state.true_obs, action, obs),
        terminated=no,
        truncated=time >= 20,
        success=success(obs),
        invalid=~jnp.isfinite(obs).all(),
        time=time,
        effects=state.effects,
    )


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """Minus the distance from the origin, plus a bonus of 1 within the tolerance."""
    distance = jnp.linalg.norm(next_obs[:2])
    return -distance + (distance <= TOLERANCE)


def success(obs: Array) -> Array:
    return jnp.linalg.norm(obs[:2]) <= TOLERANCE
