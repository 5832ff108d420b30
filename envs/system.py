"""Observations that tell which system an episode takes place in: for policies that are told what is identified."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import NOTHING, Effects, Entry, Env, EnvState, Value, Varying, World, entries_of
from envs.domains.uniform import parameter_ranges
from envs.effects import make_range
from envs.history import extended
from sgft_jax.types import Array, Key, UserError


def varying(
    env: Env, params: Mapping[str, Value] = NOTHING, effects: Mapping[str, Value] = NOTHING
) -> tuple[Varying, ...]:
    """Every number that differs between episodes of the training domain, or of the one with what is named here.

    params, effects: as in `envs.domains.uniform.uniform`. Raises UserError where nothing varies.
    """
    low, high = parameter_ranges(env, params).T
    ends = make_range(env, {**env.training, **effects})
    low, high = (
        np.concatenate([own, *(np.ravel(x) for x in end)]) for own, end in ((low, ends.low), (high, ends.high))
    )
    named = zip(_names(env), low, high, strict=True)
    found = tuple(Varying(*name, float(a), float(b)) for name, a, b in named if a < b)
    if not found:
        raise UserError(f"{env.name}: no parameter and no effect varies; name a domain with --real FILE:NAME")
    return found


def with_system(env: Env, system: tuple[Varying, ...]) -> Env:
    """The same task with one more entry at the end of its observation: what `system` lists, as of this episode.

    Each number is scaled so that its range becomes [-1, 1], and clipped to that. () returns the task as it is.
    """
    if not system:
        return env
    place = {name: i for i, name in enumerate(_names(env))}
    where = np.array([place[v.name, v.index] for v in system])
    low, high = (np.array([getattr(v, end) for v in system], np.float32) for end in ("low", "high"))

    def tell(world: World, state: EnvState, memory: tuple) -> Array:
        everything = jnp.concatenate([world.theta.params, *(jnp.ravel(x) for x in state.effects)])
        return jnp.clip(2.0 * (everything[where] - low) / (high - low) - 1.0, -1.0, 1.0)

    longer = extended(
        env,
        Entry("system", "1", len(system)),
        tell=tell,
        start=lambda: (),
        remember=lambda memory, action: memory,
    )
    return longer._replace(system=system)


def blurred(env: Env, noise: float) -> Env:
    """The same task with Gaussian noise of that std on what observations tell of the system, new at every step.

    Without it, networks tell the episodes of training apart by numbers that stay the same for a whole one.
    """
    own_dim = env.obs_dim - len(env.system)

    def blur(state: EnvState, key: Key) -> EnvState:
        told = noise * jax.random.normal(key, (len(env.system),))
        return state._replace(obs=state.obs.at[own_dim:].add(told), true_obs=state.true_obs.at[own_dim:].add(told))

    def reset(world: World, key: Key) -> EnvState:
        key_own, key_noise = jax.random.split(key)
        return blur(env.reset(world, key_own), key_noise)

    def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
        key_own, key_noise = jax.random.split(key)
        return blur(env.step(world, state, action, key_own), key_noise)

    return env._replace(reset=reset, step=step)


def concealed(env: Env) -> Env:
    """The same task as a real system, which cannot tell what it is: it tells the middle of every range."""
    if not env.system:
        return env
    own_dim = env.obs_dim - len(env.system)
    silent = lambda obs: obs.at[own_dim:].set(0.0)  # noqa: E731

    def hide(state: EnvState) -> EnvState:
        return state._replace(obs=silent(state.obs), true_obs=silent(state.true_obs))

    def reset(world: World, key: Key) -> EnvState:
        return hide(env.reset(world, key))

    def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
        return hide(env.step(world, state, action, key))

    return env._replace(reset=reset, step=step)


def _names(env: Env) -> list[tuple[str, int]]:
    """Names of parameters and effects, with the place in those that are vectors."""
    sizes = {name: sum(e.size for e in entries_of(env, name)) or 1 for name in Effects._fields}
    return [(p.name, 0) for p in env.parameters] + [(name, i) for name, size in sizes.items() for i in range(size)]
