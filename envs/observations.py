"""Observations that hold more than sensors measure: the last actions, and the parameters of the system.

The latter are for policies that read an estimate of them.
"""

import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from envs.base import (
    NOTHING,
    EffectRange,
    Effects,
    Entry,
    Env,
    EnvState,
    Theta,
    Value,
    Varying,
    World,
    changed,
    entries_of,
)
from envs.domains import parameter_ranges
from envs.effects import make_range
from envs.patches import patches
from envs.types import Array, Key, PyTree, UserError


def with_previous_actions(env: Env, n: int) -> Env:
    """The same task with `n` more vectors at the end of its observation: the last actions, the newest first.

    They are what the policy commanded, before any effect of the system, and zero before the first step. Whatever reads
    observations sees them: policy, critic, V_sim and dynamics models. n = 0 returns the task as it is. Source: states
    of delayed decision processes (Katsikopoulos and Engelbrecht 2003).
    """
    if n == 0:
        return env
    longer = extended(
        env,
        Entry("previous_actions", "1", n * env.act_dim),
        tell=lambda world, state, actions: actions.reshape(-1),
        start=lambda: jnp.zeros((n, env.act_dim)),
        remember=lambda actions, action: jnp.concatenate([action[None], actions[:-1]]),
        recall=lambda facts: facts.reshape(n, env.act_dim),
    )
    return longer._replace(previous_actions=n)


def extended(
    env: Env,
    entry: Entry,
    *,
    tell: Callable[[World, EnvState, PyTree], Array],
    start: Callable[[], PyTree],
    remember: Callable[[PyTree, Array], PyTree],
    recall: Callable[[Array], PyTree],
) -> Env:
    """The same task with one more entry at the end of its observation; rewards and success are what they were.

    tell(world, state of `env`, memory) -> [entry.size]. start() -> memory of an episode. remember(memory, action) ->
    memory. recall(what was told [entry.size]) -> memory.
    """
    inner_dim, success, restore = env.obs_dim, env.success, env.restore

    def outside(world: World, state: EnvState, memory: PyTree) -> EnvState:
        facts = tell(world, state, memory)
        return state._replace(
            physics=(state.physics, memory),
            obs=jnp.concatenate([state.obs, facts]),
            true_obs=jnp.concatenate([state.true_obs, facts]),
        )

    def reset(world: World, key: Key) -> EnvState:
        return outside(world, env.reset(world, key), start())

    def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
        physics, memory = state.physics
        inner = state._replace(physics=physics, obs=state.obs[:inner_dim], true_obs=state.true_obs[:inner_dim])
        return outside(world, env.step(world, inner, action, key), remember(memory, action))

    def restore_whole(world: World, obs: Array, key: Key) -> EnvState:
        assert restore is not None
        return outside(world, restore(world, obs[:inner_dim], key), recall(obs[inner_dim:]))

    def of_transition(function: Callable[..., Array] | None) -> Callable[..., Array] | None:
        return function and (lambda obs, action, next_obs: function(obs[:inner_dim], action, next_obs[:inner_dim]))

    return env._replace(
        observation=(*env.observation, entry),
        reset=reset,
        step=step,
        restore=restore and restore_whole,
        reward=of_transition(env.reward),
        terminated=of_transition(env.terminated),
        success=success and (lambda obs: success(obs[:inner_dim])),
        trace=lambda physics: env.trace(physics[0]),
    )


def with_memory(env: Env, measured: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """[..., obs_dim] what a policy reads where steps are taken outside jit, from what sensors say.

    measured: [..., measured_dim]. actions: [..., previous_actions, act_dim], the last ones, the newest first. Of the
    system it tells the middle of every range, see `envs.observations.concealed`.
    """
    memory = actions.reshape(*measured.shape[:-1], -1)
    return np.concatenate(
        [measured, memory, np.zeros((*measured.shape[:-1], len(env.system)))], axis=-1, dtype=np.float32
    )


def remember(actions: np.ndarray, action: np.ndarray) -> np.ndarray:
    """The last actions [..., n, act_dim], the newest first, after one more [..., act_dim]."""
    return np.concatenate([action[..., None, :], actions], axis=-2)[..., : actions.shape[-2], :]


def varying(
    env: Env, params: Mapping[str, Value] = NOTHING, effects: Mapping[str, Value] = NOTHING
) -> tuple[Varying, ...]:
    """Every number that differs between episodes of the training domain, or of the one with what is named here.

    params, effects: as in `envs.domains`. Raises UserError where nothing varies.
    """
    if not (entries := all_varying(env, params, effects)):
        raise UserError(f"{env.name}: no parameter and no effect varies; name a domain with --real FILE:NAME")
    return entries


def all_varying(
    env: Env, params: Mapping[str, Value] = NOTHING, effects: Mapping[str, Value] = NOTHING
) -> tuple[Varying, ...]:
    """The same; () where nothing varies."""
    low, high = parameter_ranges(env, params).T
    ends = make_range(env, {**env.training, **effects})
    low, high = (
        np.concatenate([ranges, *(np.ravel(x) for x in end)]) for ranges, end in ((low, ends.low), (high, ends.high))
    )
    named = zip(_names(env), low, high, strict=True)
    return tuple(Varying(*name, float(a), float(b)) for name, a, b in named if a < b)


def with_system(env: Env, system: tuple[Varying, ...]) -> Env:
    """The same task whose observation ends with the numbers listed in `system`, as drawn for the episode: [k].

    Each number is scaled so that its range becomes [-1, 1], then clipped to it. () returns the task as it is.
    """
    if not system:
        return env
    where = places(env, system)
    low, high = (np.array([getattr(v, end) for v in system], np.float32) for end in ("low", "high"))

    def tell(world: World, state: EnvState, memory: tuple) -> Array:
        everything = ravel_pytree((world.theta.params, state.effects))[0]
        return jnp.clip(2.0 * (everything[where] - low) / (high - low) - 1.0, -1.0, 1.0)

    longer = extended(
        env,
        Entry("system", "1", len(system)),
        tell=tell,
        start=lambda: (),
        remember=lambda memory, action: memory,
        recall=lambda facts: (),
    )
    make_simulator = None if env.restore is None else functools.partial(simulator, env, env.restore, system)
    return longer._replace(system=system, simulator=make_simulator)


def blurred(env: Env, noise: float) -> Env:
    """The same task with Gaussian noise of that std on what observations tell of the system, new at every step.

    Without it, networks tell the episodes of training apart by numbers that stay the same for a whole one.
    """
    first = env.obs_dim - len(env.system)

    def blur(state: EnvState, key: Key) -> EnvState:
        error = noise * jax.random.normal(key, (len(env.system),))
        return state._replace(obs=state.obs.at[first:].add(error), true_obs=state.true_obs.at[first:].add(error))

    def reset(world: World, key: Key) -> EnvState:
        key_own, key_noise = jax.random.split(key)
        return blur(env.reset(world, key_own), key_noise)

    def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
        key_own, key_noise = jax.random.split(key)
        return blur(env.step(world, state, action, key_own), key_noise)

    return env._replace(reset=reset, step=step)


def concealed(env: Env) -> Env:
    """The same task as a real system, whose parameters are unknown: the last k entries of observations are 0."""
    if not env.system:
        return env
    first = env.obs_dim - len(env.system)

    def hide(state: EnvState) -> EnvState:
        return state._replace(obs=state.obs.at[first:].set(0.0), true_obs=state.true_obs.at[first:].set(0.0))

    return changed(env, hide)


def simulator(
    env: Env, restore: Callable[[World, Array, Key], EnvState], system: tuple[Varying, ...]
) -> Callable[[Array, Array], Array]:
    """What the simulator says of one step: (obs, action) -> [measured_dim] by how much its measurements change.

    obs: what was measured in the real system, with a system [k] of `system` at its end, in which the step takes place;
    everything else is as the simulator has it. No noise is added. A step with exploded physics changes nothing. The
    derivative is that of finite differences over 5 % of a number's range, by the system alone.

    Its world is patched on the device, see `envs.patches`.
    """
    first, measured = env.obs_dim, env.measured_dim
    ranges = np.array([(p.nominal, p.nominal) for p in env.parameters], float).reshape(-1, 2)
    rows = {p.name: row for p, row in zip(env.parameters, ranges, strict=True)}
    for number in system:
        rows.get(number.name, np.zeros(2))[:] = number.low, number.high
    model_of, key, where = patches(env, ranges).model, jax.random.key(0), places(env, system)
    low, high = (np.array([getattr(v, end) for v in system]) for end in ("low", "high"))
    nominal, unravel = ravel_pytree(nominal_numbers(env, {"latency_jitter": 0.0}))

    def world_of(point: Array) -> World:
        params, drawn = unravel(nominal.at[where].set(low + 0.5 * (1.0 + point) * (high - low)))
        drawn = drawn._replace(latency_jitter=jnp.zeros(()))
        return World(Theta(params, EffectRange(drawn, drawn)), model_of(params))

    @jax.custom_jvp
    def change(obs: Array, action: Array) -> Array:
        world = world_of(obs[first:])
        before = restore(world, obs[:first], key)
        after = env.step(world, before, action, key)
        measured_state = after.true_obs[:measured] + after.effects.obs_bias
        return jnp.where(after.invalid, 0.0, measured_state - obs[:measured])

    @change.defjvp
    def differences(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
        (obs, action), step = primals, 0.05 * tangents[0].at[:first].set(0.0)
        return change(obs, action), 10.0 * (change(obs + step, action) - change(obs - step, action))

    return change


def nominal_numbers(env: Env, effects: Mapping[str, Value] = NOTHING) -> tuple[Array, Effects]:
    """Nominal parameters [n_params], and effects in the middle of their ranges in training, or of those named here."""
    ends = make_range(env, {**env.training, **effects})
    middle = jax.tree.map(lambda low, high: jnp.float32(0.5 * (low + high)), ends.low, ends.high)
    return jnp.array([p.nominal for p in env.parameters], jnp.float32), middle


def places(env: Env, system: tuple[Varying, ...]) -> np.ndarray:
    """[k] where the numbers of a system are among all of (parameters, effects), raveled. Raises UserError for others
    than these have.
    """
    place = {name: i for i, name in enumerate(_names(env))}
    if odd := [v for v in system if (v.name, v.index) not in place]:
        raise UserError(f"{env.name}: has no parameter or effect {odd[0].name!r} with a number {odd[0].index}")
    return np.array([place[v.name, v.index] for v in system])


def _names(env: Env) -> list[tuple[str, int]]:
    """Names of parameters and effects, with the place in those that are vectors."""
    sizes = {name: sum(e.size for e in entries_of(env, name)) or 1 for name in Effects._fields}
    return [(p.name, 0) for p in env.parameters] + [(name, i) for name, size in sizes.items() for i in range(size)]
