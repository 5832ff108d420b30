"""The pendulum of the SGFT paper (Yin et al. 2025, example 1): a torque balances it, against friction.

The angle s1 (rad, 0 is upright) and the angular velocity s2 follow Euler steps: s1' = s1 + dt s2 and, with a torque a,
s2' = s2 + dt (g / l sin s1 + a + e(s)). In training e is 0. A real system has e(s) = -damping s2 - dry tanh(10 s2), two
parameters that training does not vary: a policy that takes e(s) off its torque moves there as it did in the simulator.
The paper gives no numbers; these are ours.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Effects, Entry, Env, EnvState, Parameter, World
from envs.effects import distort, draw, measure, shake
from envs.types import Array, Key

__all__ = ["DT", "FASTEST", "TORQUE", "friction", "make", "move", "reward_of"]

DT, GRAVITY, LENGTH = 0.05, 9.81, 1.0  # s, m/s^2, m
TORQUE = 20.0  # rad/s^2 at full command
FASTEST = 6.0  # rad/s
STEPS = 100
SHARP = 10.0  # s/rad: dry friction turns round within .1 rad/s
UPRIGHT, STILL = 0.1, 0.5  # rad and rad/s: success
_SPREAD, _PUSH = 1.0, 1.0  # rad and rad/s of starts
PARAMETERS = (
    Parameter("damping", "1/s", 0.0, 0.0, 0.0, minimum=0.0, maximum=5.0),
    Parameter("dry", "rad/s^2", 0.0, 0.0, 0.0, minimum=0.0, maximum=20.0),
)


class Angle(NamedTuple):
    """state: [2] rad and rad/s. command: [1] the last one, in force until the latency has passed."""

    state: Array
    command: Array


def make(impl: str = "auto") -> Env:
    """The task in closed form, 100 steps of 0.05 s. impl: none is needed."""
    del impl
    return Env(
        name="pendulum",
        observation=(Entry("cos_sin", "", 2), Entry("velocity", "rad/s", 1)),
        action=(Entry("torque", f"{TORQUE:g} rad/s^2", 1),),
        parameters=PARAMETERS,
        episode_length=STEPS,
        control_dt=DT,
        make_worlds=lambda theta: World(theta._replace(params=jnp.asarray(theta.params, jnp.float32)), {}),
        reset=_reset,
        step=_step,
        restore=_restore,
        reward=lambda obs, action, next_obs: reward_of(_state(obs)),
        success=lambda obs: _succeeds(_state(obs)),
        trace=lambda physics: physics.state,
    )


def move(state: Array, torque: Array, params: Array) -> Array:
    """[2] the state after a step, its angle in [-pi, pi). torque: [] rad/s^2. params: [2] as `PARAMETERS`."""
    angle, speed = state
    faster = speed + DT * (GRAVITY / LENGTH * jnp.sin(angle) + torque + friction(state, params))
    return jnp.stack([_wrapped(angle + DT * speed), jnp.clip(faster, -FASTEST, FASTEST)])


def friction(state: Array, params: Array) -> Array:
    """[] rad/s^2, the paper's e(s)."""
    return -params[0] * state[1] - params[1] * jnp.tanh(SHARP * state[1])


def reward_of(state: Array) -> Array:
    """[] of a step from a state [2]: 0 where it stands upright and still, else less."""
    return -(state[0] ** 2) - 0.1 * state[1] ** 2


def _succeeds(state: Array) -> Array:
    return (jnp.abs(state[0]) < UPRIGHT) & (jnp.abs(state[1]) < STILL)


def _wrapped(angle: Array) -> Array:
    return jnp.mod(angle + jnp.pi, 2.0 * jnp.pi) - jnp.pi


def _state(obs: Array) -> Array:
    """[2] of an observation [3]."""
    return jnp.stack([jnp.arctan2(obs[1], obs[0]), obs[2]])


def _seen(state: Array) -> Array:
    """[3] without errors of sensors."""
    return jnp.stack([jnp.cos(state[0]), jnp.sin(state[0]), state[1]])


def _reset(world: World, key: Key) -> EnvState:
    key_start, key_noise, key_effects = jax.random.split(key, 3)
    start = jax.random.uniform(key_start, (2,), minval=-1.0) * jnp.array([_SPREAD, _PUSH])
    effects = draw(world.theta.effects, key_effects)
    state = _begun(start, effects)
    return state._replace(obs=measure(effects, state.true_obs, key_noise))


def _restore(world: World, obs: Array, key: Key) -> EnvState:
    effects = draw(world.theta.effects, key)
    return _begun(_state(obs - effects.obs_bias), effects)._replace(obs=obs)


def _begun(start: Array, effects: Effects) -> EnvState:
    obs, no = _seen(start), jnp.zeros((), bool)
    return EnvState(Angle(start, jnp.zeros(1)), obs, obs, jnp.float32(0), no, no, no, no, jnp.int32(0), effects)


def _step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
    key_noise, key_command, key_late = jax.random.split(key, 3)
    effects, before = state.effects, state.physics
    command = jnp.clip(shake(effects, distort(effects, action), key_command), -1.0, 1.0)
    jitter = jax.random.uniform(key_late, minval=-1.0) * effects.latency_jitter
    late = jnp.clip((effects.latency + jitter) / DT, 0.0, 1.0)
    torque = TORQUE * (late * before.command + (1.0 - late) * command)[0]
    after = move(before.state, torque, world.theta.params)
    obs, time = _seen(after), state.time + 1
    return state._replace(
        physics=Angle(after, command),
        obs=measure(effects, obs, key_noise),
        true_obs=obs,
        reward=reward_of(before.state),
        truncated=time >= STEPS,
        success=_succeeds(after),
        invalid=~jnp.isfinite(obs).all(),
        time=time,
    )
