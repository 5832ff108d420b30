"""Errors of commands that no effect of `envs.effects` expresses, for the real systems of gaps alone. Pure.

A gap names them in its `commands`, see `envs.base.COMMANDS`. A command meets them in this order: it comes late, is
lost, passes the dead band, then the play, and is warped; after that the effects of the episode. Nothing is clipped, as
by these. Where a reward counts commands, it counts those that arrive.

What a system remembers stays beside its physics, which becomes `(physics, Memory)`. How it errs is a part of its world,
so that systems that err and systems that do not share a program.
"""

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import COMMANDS, Env, EnvState, World
from envs.types import Array, Key, UserError

__all__ = ["Commands", "Memory", "change", "given", "make_commands", "warp", "with_commands"]

_LATEST = int(COMMANDS["late"])
_FEATURES, _GRID = 64, 17  # of the warp, and in how many places along an axis its largest value is looked for
_LENGTH = 1 / 3  # of the workspace: over how much of it the warp stays alike


class Commands(NamedTuple):
    """How one real system errs. Units are those of a command, whose range is [-1, 1].

    low, size: [d] raw units, of the task's `workspace`. frequencies: [k, d], phases: [k], weights: [k, act_dim],
    offset: [act_dim] of the warp, a sum of k cosines over the workspace. dead_band, backlash: []. lost: []
    probability. late: [] int32, control periods.
    """

    low: Array
    size: Array
    frequencies: Array
    phases: Array
    weights: Array
    offset: Array
    dead_band: Array
    backlash: Array
    lost: Array
    late: Array


class Memory(NamedTuple):
    """What a system remembers of an episode; all zero at its start.

    asked: [n, act_dim] the last commands of the policy, the newest first. arrived: [act_dim] the last one that was not
    lost. play: [act_dim] how far each drive is from the middle of its play.
    """

    asked: Array
    arrived: Array
    play: Array


def make_commands(env: Env, values: Mapping[str, float]) -> Commands:
    """The errors of that task's commands by name; what is not named is none. Raises UserError for an impossible warp.

    The warp has no mean over the workspace: that would be the effect `action_bias`.
    """
    named = {**dict.fromkeys(COMMANDS, 0.0), **values}
    if named["warp"] and not env.workspace:
        raise UserError(f"'warp' of 'commands' needs a task that declares its workspace, which {env.name} does not")
    low, high = np.array(env.workspace, float).reshape(-1, 2).T
    size = np.where(high > low, high - low, np.inf)
    rng = np.random.default_rng(int(named["warp_seed"]))
    frequencies = rng.normal(size=(_FEATURES, len(low))) / _LENGTH
    phases = rng.uniform(0.0, 2 * np.pi, _FEATURES)
    weights = rng.normal(size=(_FEATURES, env.act_dim))
    places = np.array(list(itertools.product(np.linspace(0.0, 1.0, _GRID), repeat=len(low)))) * (high > low)
    errors = np.cos(places @ frequencies.T + phases) @ weights
    mean = errors.mean(axis=0)
    share = named["warp"] / max(np.linalg.norm(errors - mean, axis=1).max(), 1e-9)
    warp = (low, size, frequencies, phases, share * weights, -share * mean)
    numbers = [jnp.asarray(x, jnp.float32) for x in (*warp, named["dead_band"], named["backlash"], named["lost"])]
    return Commands(*numbers, late=jnp.int32(named["late"]))


def warp(commands: Commands, position: Array) -> Array:
    """[act_dim] the error of commands at a position [d] in raw units."""
    place = (position - commands.low) / commands.size
    return jnp.cos(commands.frequencies @ place + commands.phases) @ commands.weights + commands.offset


def change(commands: Commands, memory: Memory, action: Array, lost: Array) -> tuple[Array, Memory]:
    """The command [act_dim] that arrives for an action [act_dim], but for the warp, and what is remembered then.

    lost: [] bool, whether the command of this step is.
    """
    asked = jnp.concatenate([action[None], memory.asked[:-1]])
    arrived = jnp.where(lost, memory.arrived, asked[commands.late])
    moved = jnp.sign(arrived) * jnp.maximum(jnp.abs(arrived) - commands.dead_band, 0.0)
    play = jnp.clip(memory.play + moved, -commands.backlash / 2, commands.backlash / 2)
    return memory.play + moved - play, Memory(asked, arrived, play)


def given(env: Env, worlds: World, values: Mapping[str, float]) -> World:
    """The worlds [n], of a task `with_commands`, in which commands err like this, see `make_commands`."""
    if not env.commands:
        raise UserError(f"{env.name}: commands err only in a real system; make it with envs.rollout.real_env")
    n = worlds.theta.params.shape[0]
    errors = jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), make_commands(env, values))
    return worlds._replace(commands=errors)


def with_commands(env: Env) -> Env:
    """The same task, whose worlds also say how commands err: not at all, unless they are `given` errors.

    What observations tell of previous actions stays what the policy commanded.
    """
    n, first, restore = env.previous_actions, env.measured_dim, env.restore
    told = slice(first, first + n * env.act_dim)

    def outside(state: EnvState, memory: Memory) -> EnvState:
        actions = memory.asked[:n].reshape(-1)
        vectors = {name: getattr(state, name).at[told].set(actions) for name in ("obs", "true_obs")}
        return state._replace(physics=(state.physics, memory), **vectors)

    def begun(asked: Array) -> Memory:
        nothing = jnp.zeros(env.act_dim)
        return Memory(jnp.zeros((max(n, _LATEST + 1), env.act_dim)).at[:n].set(asked), nothing, nothing)

    def reset(world: World, key: Key) -> EnvState:
        return outside(env.reset(world, key), begun(jnp.zeros((n, env.act_dim))))

    def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
        (physics, memory), errors = state.physics, world.commands
        # The step's own key stays, so that the same episodes can be played with and without errors.
        lost = jax.random.bernoulli(jax.random.fold_in(key, 0), errors.lost)
        command, memory = change(errors, memory, action, lost)
        command = command + warp(errors, state.true_obs[: len(env.workspace)])
        return outside(env.step(world, state._replace(physics=physics), command, key), memory)

    def restored(world: World, obs: Array, key: Key) -> EnvState:
        assert restore is not None
        return outside(restore(world, obs, key), begun(obs[told].reshape(n, env.act_dim)))

    wrapped = env._replace(
        commands=True,
        reset=reset,
        step=step,
        restore=restore and restored,
        trace=lambda physics: env.trace(physics[0]),
    )
    return wrapped._replace(make_worlds=lambda theta: given(wrapped, env.make_worlds(theta), {}))
