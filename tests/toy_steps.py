"""A hand that moves by exactly what is commanded, to a goal: an Env whose real systems one matrix describes."""

import jax
import jax.numpy as jnp

from envs.base import Entry, Env, EnvState, Parameter, World
from envs.effects import distort, draw, measure
from envs.types import Array, Key

STEP, TOLERANCE, LENGTH = 0.1, 0.05, 20  # m at full action, m, control steps


def make(impl: str = "auto") -> Env:
    """The task: reach the goal within 20 steps of 0.1 s, and be there at the end."""
    return Env(
        name="toy_steps",
        observation=(Entry("goal", "m", 2), Entry("hand_xy", "m", 2)),
        action=(Entry("hand_xy_step", "10 cm", 2),),
        parameters=(Parameter("slip", "", 0.0, 0.0, 0.0, minimum=0.0, maximum=0.5),),
        episode_length=LENGTH,
        control_dt=0.1,
        make_worlds=lambda theta: World(theta._replace(params=jnp.asarray(theta.params, jnp.float32)), {}),
        reset=reset,
        step=step,
        reward=reward,
        success=success,
        cartesian=True,
        training={"obs_noise": 0.002},
    )


def reset(world: World, key: Key) -> EnvState:
    key_start, key_noise, key_effects = jax.random.split(key, 3)
    obs = jax.random.uniform(key_start, (4,), minval=-0.5, maxval=0.5)
    own, no = draw(world.theta.effects, key_effects), jnp.zeros((), bool)
    seen = measure(own, obs, key_noise)
    return EnvState(obs, seen, obs, jnp.float32(0), no, no, no, no, jnp.int32(0), own)


def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
    move = STEP * (1.0 - world.theta.params[0]) * distort(state.effects, action)
    obs, no, time = state.true_obs.at[2:].add(move), jnp.zeros((), bool), state.time + 1
    return EnvState(
        physics=obs,
        obs=measure(state.effects, obs, key),
        true_obs=obs,
        reward=reward(state.true_obs, action, obs),
        terminated=no,
        truncated=time >= LENGTH,
        success=success(obs),
        invalid=no,
        time=time,
        effects=state.effects,
    )


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """Minus the distance from the goal, plus 1 within the tolerance."""
    distance = jnp.linalg.norm(next_obs[2:] - next_obs[:2])
    return -distance + (distance <= TOLERANCE)


def success(obs: Array) -> Array:
    return jnp.linalg.norm(obs[2:] - obs[:2]) <= TOLERANCE
