"""A walk along a line that an alarm may end at any step: an Env without a physics engine, with dict observations.

The alarm is a part of the observation, so that the end is a function of it. Parameter `risk` is its probability.
A test may declare more actions; the first one alone moves something.
"""

import jax
import jax.numpy as jnp

from envs.base import Entry, Env, EnvState, Parameter, Theta, World, packed
from envs.effects import distort, draw, measure
from envs.types import Array, Key

STEP, LENGTH = 0.1, 12
OBSERVATION = (Entry("position", "m", 1), Entry("alarm", "", 1))


def make(impl: str = "auto") -> Env:
    """12 steps unless the alarm comes first. Judged by return."""
    return packed(
        Env(
            name="toy_terminating",
            observation=OBSERVATION,
            action=(Entry("step", "10 cm", 1),),
            parameters=(Parameter("risk", "", 0.2, 0.2, 0.2, 0.0, 1.0),),
            episode_length=LENGTH,
            control_dt=0.1,
            make_worlds=make_worlds,
            reset=reset,
            step=step,
            reward=reward,
            terminated=terminated,
            score="return",
        )
    )


def make_worlds(theta: Theta) -> World:
    return World(theta._replace(params=jnp.asarray(theta.params, jnp.float32)), {})


def reset(world: World, key: Key) -> EnvState:
    no = jnp.zeros((), bool)
    obs = {"position": jnp.zeros(1), "alarm": jnp.zeros(1)}
    own = draw(world.theta.effects, key)
    return EnvState(jnp.zeros(1), obs, obs, jnp.float32(0), no, no, no, no, jnp.int32(0), own)


def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
    """The state arrives with packed observations; the new ones are a dict."""
    key_alarm, key_noise = jax.random.split(key)
    position = state.physics + STEP * distort(state.effects, action)[:1]
    alarm = jax.random.bernoulli(key_alarm, world.theta.params[0]).astype(jnp.float32)
    seen = measure(state.effects, jnp.append(position, alarm), key_noise)
    true_obs = jnp.append(position, alarm)
    time = state.time + 1
    return EnvState(
        physics=position,
        obs={"alarm": seen[1:], "position": seen[:1]},  # in another order than declared
        true_obs={"alarm": alarm[None], "position": position},
        reward=reward(state.true_obs, action, true_obs),
        terminated=terminated(state.true_obs, action, true_obs),
        truncated=time >= LENGTH,
        success=jnp.zeros((), bool),
        invalid=~jnp.isfinite(position).all(),
        time=time,
        effects=state.effects,
    )


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """1 a step, and the position."""
    return 1.0 + next_obs[0]


def terminated(obs: Array, action: Array, next_obs: Array) -> Array:
    return next_obs[1] > 0.5
