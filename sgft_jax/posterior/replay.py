"""How well a simulated system explains a rollout: the recorded commands again, in a bootstrap filter. Pure.

Replay through contact is chaotic: on push a start that is 1 mm off ends 19 mm off, and a third of all successes flip.
So a few states follow the rollout together. They begin where the first measurement may have been, and every measurement
says which of them go on. At every step half of them follow the command exactly, so free motion is compared exactly; the
others follow it with a jolt of random size, so that contact does not lose them all.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Effects, Env, EnvState, World
from envs.types import Array, Key, Transition, UserError
from sgft_jax.posterior.candidates import Candidates

# Of Student's t, which forgives a measurement that is far off, and still tells far from farther: with a floor under a
# step's likelihood nearly all systems were equally bad, and nothing led to the true one.
_FREEDOM = 4.0
_ALLOWED = 2.0  # times the simulator's noise: real sensors may be noisier
_EXPLODED = -1e4  # nats
_LEAST = 1e-4  # raw units: a sensor's noise is at least this
_STEP = 0.05  # of a place's range, between which its measurements are taken to be linear
_EXACT = 0.5  # of the states
_JOLTS = 0.01, 0.3  # std of the least and the largest, in units of the command's range; their logarithm is uniform


class Rollout(NamedTuple):
    """What a real rollout of T steps left.

    measured: [T + 1, measured_dim] at the start and after each step. action: [T, act_dim] as commanded.
    valid: [T] bool. success: [] bool.
    """

    measured: Array
    action: Array
    valid: Array
    success: Array


class Evidence(NamedTuple):
    """log_likelihood: [T] nats, of each measurement given those before; 0 where the step is not valid.

    success: [] share of the states that end in success.
    """

    log_likelihood: Array
    success: Array


def rollout_of(env: Env, rows: Transition, valid: Array, success: Array) -> Rollout:
    """A recorded episode, without what observations hold beside measurements. rows, valid: [T]."""
    measured = jnp.concatenate([rows.obs[:1], rows.next_obs])[:, : env.measured_dim]
    return Rollout(measured, rows.action, valid, success)


def replay(env: Env, candidates: Candidates, point: Array, rollout: Rollout, key: Key, *, states: int = 8) -> Evidence:
    """The evidence of a rollout for the candidate at a point [d]; vmap over points and rollouts.

    env: the task in the simulator. states: of the filter. Raises UserError for a task that cannot be set to what was
    measured.
    """
    key_start, key_steps = jax.random.split(key)
    worlds, start = _starts(env, candidates, point, rollout.measured[0], key_start, states)
    noise, bias = _ALLOWED * _noise(start.effects)[0], start.effects.obs_bias[0]

    def weigh(state: EnvState, measured: Array) -> Array:
        """[] nats of one state."""
        missed = (state.true_obs[: env.measured_dim] + bias - measured) / noise
        return jnp.where(state.invalid, _EXPLODED, (_log_density(missed) - jnp.log(noise)).sum())

    def step(carry: tuple[Array, EnvState], row: tuple[Array, ...]) -> tuple[tuple[Array, EnvState], Array]:
        which, before = carry
        action, measured, valid, key = row
        key_jolt, key_step, key_choice = jax.random.split(key, 3)
        here = jax.tree.map(lambda x: x[which], worlds)
        keys = jax.random.split(key_step, states)
        after = jax.vmap(env.step, (0, 0, None, 0))(here, _jolted(before, key_jolt), action, keys)
        log_weights = jax.vmap(weigh, (0, None))(after, measured)
        chosen = _systematic(key_choice, log_weights)
        moved = jax.tree.map(lambda x: x[chosen], (which, after))
        carry = jax.tree.map(lambda new, old: jnp.where(valid, new, old), moved, carry)
        return carry, jnp.where(valid, jax.nn.logsumexp(log_weights) - jnp.log(states), 0.0)

    rows = rollout.action, rollout.measured[1:], rollout.valid, jax.random.split(key_steps, len(rollout.valid))
    (_, last), log_likelihood = jax.lax.scan(step, (jnp.arange(states), start), rows)
    return Evidence(log_likelihood, (last.success & ~last.invalid).mean())


def replays(
    env: Env, candidates: Candidates, point: Array, rollouts: Rollout, key: Key, *, states: int = 8
) -> Evidence:
    """The evidence [k] of rollouts [k] for the candidate at a point [d], see `replay`."""
    keys = jax.random.split(key, len(rollouts.success))
    return jax.vmap(functools.partial(replay, env, candidates, point, states=states))(rollouts, keys)


def _systematic(key: Key, log_weights: Array) -> Array:
    """[n] indices, each as often as its weight [n] says, up to one."""
    n = len(log_weights)
    ends = jnp.cumsum(jax.nn.softmax(log_weights))
    return jnp.clip(jnp.searchsorted(ends, (jnp.arange(n) + jax.random.uniform(key)) / n), 0, n - 1)


def _jolted(state: EnvState, key: Key) -> EnvState:
    """States [states] of which some will follow their next command with noise."""
    noise, (low, high) = state.effects.action_noise, _JOLTS
    exact, share = jax.random.uniform(key, (2, len(noise), 1))
    jolts = jnp.where(exact < _EXACT, 0.0, low * (high / low) ** share)
    return state._replace(effects=state.effects._replace(action_noise=jnp.broadcast_to(jolts, noise.shape)))


def _starts(
    env: Env, candidates: Candidates, point: Array, measured: Array, key: Key, states: int
) -> tuple[World, EnvState]:
    """Worlds and states [states] in which the first measurement is likely."""
    key_effects, key_place, key_noise = jax.random.split(key, 3)
    middle, spread = _place(env, candidates, point, measured, key_effects)
    drawn = jax.random.normal(key_place, (states, len(middle)))
    noisy = jax.random.normal(key_noise, (states, len(measured)))

    def begin(drawn: Array, noisy: Array) -> tuple[World, EnvState]:
        world = candidates.world(point, jnp.clip(middle + spread @ drawn, candidates.low, candidates.high))
        noise = _noise(world.theta.effects.low)  # of a candidate both ends are alike
        return world, _restore(env)(world, measured + noise * noisy, key_effects)

    return jax.vmap(begin)(drawn, noisy)


def _place(env: Env, candidates: Candidates, point: Array, measured: Array, key: Key) -> tuple[Array, Array]:
    """Where the episode takes place by its first measurement: mean [k] and a root of the covariance [k, k].

    What the simulator measures there is taken to be linear in the place.
    """
    low, high = candidates.low, candidates.high
    middle, size = 0.5 * (low + high), high - low
    if not low.size:
        return middle, jnp.zeros((0, 0))

    def seen(place: Array) -> EnvState:
        return _restore(env)(candidates.world(point, place), measured, key)

    here, steps = seen(middle), jnp.diag(_STEP * size)
    beside = jax.vmap(lambda step: seen(middle + step).true_obs)(steps)
    slope = jax.vmap(lambda obs, width: (obs - here.true_obs) / width)(beside, _STEP * size).T
    missed, noise = measured - here.effects.obs_bias - here.true_obs, _noise(here.effects)
    with jax.default_matmul_precision("highest"):
        precision = slope.T @ slope / noise**2 + jnp.diag(12.0 / size**2)
        covariance = jnp.linalg.inv(precision)
        mean = middle + covariance @ (slope.T @ missed) / noise**2
    return mean, jnp.linalg.cholesky(covariance)


def _restore(env: Env) -> Callable[[World, Array, Key], EnvState]:
    """How the simulator is set to what was measured."""
    if env.restore is None:
        raise UserError(f"task {env.name} has no 'settled': no rollout of it can be replayed")
    return env.restore


def _noise(effects: Effects) -> Array:
    """[...] std of a number that is measured, raw units."""
    return jnp.maximum(effects.obs_noise * jnp.sqrt(effects.obs_noise_prob), _LEAST)


def _log_density(x: Array) -> Array:
    """Of Student's t with `_FREEDOM` degrees of freedom, per number."""
    half = 0.5 * (_FREEDOM + 1.0)
    constant = math.lgamma(half) - math.lgamma(0.5 * _FREEDOM) - 0.5 * math.log(_FREEDOM * math.pi)
    return constant - half * jnp.log1p(x**2 / _FREEDOM)
