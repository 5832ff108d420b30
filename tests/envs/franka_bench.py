"""What the tests of environments share."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from compiled import compiled

from envs.base import Env, World
from envs.franka import hammer, insert, push

SCENES = {"push": push.SCENE, "hammer": hammer.SCENE, "insert": insert.SCENE}
EXACT = {"obs_noise": 0.0}  # effects that leave commands and measurements alone


class Bench(NamedTuple):
    """An environment, some worlds [n] of it, and its functions, compiled at their first call."""

    env: Env
    worlds: World
    reset: Callable
    step: Callable
    step_batch: Callable


def bench(env: Env, worlds: World) -> Bench:
    env = compiled(env)
    return Bench(env, worlds, env.reset, jax.jit(_lenient(env.step)), jax.jit(jax.vmap(_lenient(env.step))))


def _lenient(function: Callable) -> Callable:
    """MJX broadcasts matrices against vectors."""

    def call(*args):
        with jax.numpy_rank_promotion("allow"):
            return function(*args)

    return call


def member(tree, i: int):
    """The i-th of a stacked pytree."""
    return jax.tree.map(lambda x: x[i], tree)


def theta_of(scene, rng):
    """Every parameter varied: inside its range, or by up to 10 % where training keeps it fixed; something possible."""
    ranges = {
        p.name: (p.low, p.high) if p.low < p.high else (0.9 * p.nominal, 1.1 * p.nominal) for p in scene.parameters
    }
    while scene.check(theta := {name: float(rng.uniform(*span)) for name, span in ranges.items()}):
        pass
    return theta


def push_hard(obs):
    """[2]: what brings a puck to the edge, see `scripted.push_puck`."""
    off = obs[2:] - obs[:2]
    ahead = jnp.where(jnp.abs(off[1]) > 0.01, 0.0, push.EDGE - push.TOLERANCE / 2 - obs[2])
    return jnp.clip(jnp.stack([ahead, off[1]]) / push.STEP, -1.0, 1.0)


def periods_apart(one: Bench, other: Bench, act: Callable, *, steps: int, key):
    """[steps, obs_dim] how far two engines are apart after one period from each state of an episode of the first one,
    and the state in which that ends. act(true observation [obs_dim]) -> action.
    """
    world, theirs, errors = member(one.worlds, 0), member(other.worlds, 0), []
    state = one.reset(world, key)
    for _ in range(steps):
        action = jnp.asarray(act(np.asarray(state.true_obs)), jnp.float32)
        found = other.step(theirs, state, action, key)
        state = one.step(world, state, action, key)
        errors.append(np.abs(found.true_obs - state.true_obs))
    return np.stack(errors), state
