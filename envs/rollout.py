"""Pools of worlds (to train in, real systems, to evaluate in), and running them: fleets and whole episodes."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

import envs
from envs import gaps
from envs.base import Env, EnvState, World
from envs.commands import with_commands
from envs.domains import sample_worlds
from envs.gaps import SIM, Gap
from envs.mesh import split_vmap
from envs.observations import concealed
from envs.types import Array, Key, PyTree, Transition, UserError

__all__ = ["Episode", "Fleet", "begin_episode", "counted", "episode_keys", "heldout_worlds", "judged", "launch"]
__all__ += ["load_gap", "padded", "pick", "play_episode", "pool_size", "real_env", "real_worlds", "select"]
__all__ += ["step_fleet", "training_worlds"]

# act(carry, obs, key) -> (action, carry), for one environment
Act = Callable[[PyTree, Array, Key], tuple[Array, PyTree]]


class Fleet(NamedTuple):
    """n environments in flight.

    index: [n] which world of the pool each one lives in. state: EnvState [n]. carry: [n, ...] what the policy remembers
    of each episode.
    """

    index: Array
    state: EnvState
    carry: PyTree


class Episode(NamedTuple):
    """One whole episode of T control steps.

    transitions: [T]; `valid`: [T] bool, False after the step that terminated the episode and from the first step with
        exploded physics on (such rows hold zeros).
    total_reward: [] undiscounted, of the task, never reshaped, of the valid steps. success, exploded: [] bool.
    score: [] float, what the task is judged by: success, or total_reward, -inf if it exploded: what came before says
        nothing of a whole episode and may be more, see `counted`.
    world: [] int32, where it took place in the pool.
    trace: [T + 1, k] what a renderer needs of the start and of the state after each step, see `Env.trace`.
    command: [T, act_dim] what the policy asked for, where something else may have been sent; else None.
    """

    transitions: Transition
    valid: Array
    total_reward: Array
    success: Array
    exploded: Array
    score: Array
    world: Array
    trace: PyTree
    command: Array | None = None


def load_gap(env: Env, real: str | None, overrides: Sequence[str]) -> Gap | None:
    """The gap that `--real` and `--set` describe; None for the simulator itself."""
    if real is None or real == SIM:
        if overrides:
            raise UserError(f"--set {overrides[0]}: changes a real system; name one with --real")
        return None
    return gaps.load(env, real, overrides)


def real_env(env: Env, real_gaps: Sequence[Gap]) -> Env:
    """The Env of these real systems: that of the simulator, or of the other scene that they name.

    None of them tells what system it is, see `envs.observations.concealed`. Where commands of any err,
    every world says how, see `envs.commands`.

    Raises UserError where they name several, which no one program can step.
    """
    scenes = {gap.scene: gap.name for gap in real_gaps}
    if len(scenes) > 1:
        (one, first), (other, second) = sorted(scenes.items())[:2]
        differ = f"{first} is in {f"scene '{one}'" if one else 'the simulated scene'} and {second} in scene '{other}'"
        raise UserError(f"{differ}: real systems of different scenes cannot share a program, run them one at a time")
    scene = "".join(scenes)
    seen = env.previous_actions, env.system, env.sparse
    real = envs.make(env.name, env.impl, scene, *seen) if scene not in ("", env.scene) else env
    err = any(gap.commands for gap in real_gaps) and not real.commands
    return concealed(with_commands(real) if err else real)


def training_worlds(env: Env, gap: Gap | None, key: Key, n: int) -> World:
    """Worlds to learn in: the training domain, or the real system of a gap."""
    return sample_worlds(env, key, n) if gap is None else gaps.worlds(env, gap, key, n)


def real_worlds(env: Env, real_gaps: Sequence[Gap], key: Key, n: int = 256) -> World:
    """The real systems of gaps as pools of one size, [gaps, n]; [gaps, 1] where nothing varies in any of them."""
    pools = [gaps.worlds(env, gap, key, n) for gap in real_gaps]
    size = max(map(pool_size, pools))
    return jax.tree.map(lambda *x: jnp.stack(x), *[padded(pool, size) for pool in pools])


def padded(pool: World, n: int) -> World:
    """The same worlds as a pool [n], where there are n of them or one."""
    return jax.tree.map(lambda x: jnp.repeat(x, n // x.shape[0], axis=0), pool)


def heldout_worlds(env: Env, gap: Gap | None, key: Key, n: int) -> World:
    """Worlds to evaluate in: the training domain without sensor noise, or the real system as its gap describes it."""
    return sample_worlds(env, key, n, effects={"obs_noise": 0.0}) if gap is None else gaps.worlds(env, gap, key, n)


def pick(pool: World, index: Array | tuple[Array, Array]) -> World:
    """The worlds of a pool at `index` (any shape); of several stacked pools, those at (pool, index)."""
    return jax.tree.map(lambda x: x[index], pool)


def pool_size(pool: World) -> int:
    """Number of worlds in a pool, or in each of several stacked ones."""
    return pool.theta.params.shape[-2]


def launch(env: Env, pool: World, key: Key, n: int, carry: PyTree) -> Fleet:
    """N environments, each in a random world of the pool, freshly reset. carry: the policy's initial one, of one."""
    key_world, key_reset = jax.random.split(key)
    index = jax.random.randint(key_world, (n,), 0, pool_size(pool))
    carries = jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *jnp.shape(x))), carry)
    return Fleet(index, split_vmap(env.reset)(pick(pool, index), jax.random.split(key_reset, n)), carries)


def step_fleet(
    env: Env,
    pool: World,
    fleet: Fleet,
    actions: Array,
    carry: PyTree,
    key: Key,
    *,
    initial_carry: PyTree,
    gamma: float | Array,
) -> tuple[Fleet, Transition, Array, EnvState]:
    """One step of every environment, then a fresh random world, start and carry for those whose episode ended.

    actions, carry: [n, ...] what the policy returned for the fleet's observations and carries. initial_carry: of one.

    Returns the new fleet, the transitions [n] with the true successor also at an episode's end, which of them are valid
    [n], and the states the step led to before any reset (rewards, success, explosions).
    """
    n = fleet.index.shape[0]
    key_step, key_reset = jax.random.split(key)
    after = split_vmap(env.step)(pick(pool, fleet.index), fleet.state, actions, jax.random.split(key_step, n))
    valid = ~after.invalid
    transitions = split_vmap(lambda *step: _transition(*step, gamma=gamma))(fleet.state, actions, after)
    done = after.terminated | after.truncated | after.invalid
    # Fixed-length episodes end together, so most steps skip the (inverse kinematics of the) resets altogether.
    fleet = jax.lax.cond(
        done.any(),
        lambda: select(done, launch(env, pool, key_reset, n, initial_carry), Fleet(fleet.index, after, carry)),
        lambda: Fleet(fleet.index, after, carry),
    )
    return fleet, transitions, valid, after


def episode_keys(key: Key, length: int) -> tuple[Key, Key, Key]:
    """What an episode draws from its key: the keys of its world, of its start and of its steps.

    Those of the steps are [length, 2]: of each step the policy's key, then the environment's.
    """
    key_world, key_reset, key_steps = jax.random.split(key, 3)
    return key_world, key_reset, jax.vmap(jax.random.split)(jax.random.split(key_steps, length))


def begin_episode(
    env: Env, pool: World, key_world: Key, key_reset: Key, which: Array | None = None
) -> tuple[Array, World, EnvState]:
    """A random world of the pool with its number, and a start in it. which: see `play_episode`."""
    index = jax.random.randint(key_world, (), 0, pool_size(pool))
    # Of stacked pools, too, the one world is gathered: under vmap an episode costs a copy of a world, never of a pool.
    world = pick(pool, index if which is None else (which, index))
    return index, world, env.reset(world, key_reset)


def play_episode(
    env: Env,
    pool: World,
    act: Act,
    carry: PyTree,
    key: Key,
    *,
    gamma: float | Array,
    length: int | None = None,
    which: Array | None = None,
) -> Episode:
    """One episode in a random world of the pool; nothing is batched: vmap over keys.

    length: control steps, default `env.episode_length`; a longer one looks past the time limit. which: [] which one of
    several pools stacked to [pools, worlds]; the episode is that of this pool alone.
    """
    key_world, key_reset, key_steps = episode_keys(key, length or env.episode_length)
    index, world, start = begin_episode(env, pool, key_world, key_reset, which)

    def step(loop: tuple[EnvState, PyTree, Array], keys: Key) -> tuple[tuple[EnvState, PyTree, Array], tuple]:
        state, carry, over = loop
        key_act, key_env = keys
        action, carry = act(carry, state.obs, key_act)
        after = env.step(world, state, action, key_env)
        exploded = after.invalid & ~over
        valid = ~(over | after.invalid)
        row = _transition(state, action, after, gamma=gamma)
        row = jax.tree.map(lambda x: jnp.where(valid, x, jnp.zeros_like(x)), row)
        over = over | after.terminated | after.invalid
        return (after, carry, over), (row, valid, after.success & valid, exploded, env.trace(after.physics))

    (_, _, _), (rows, valid, success, exploded, trace) = jax.lax.scan(
        step, (start, carry, jnp.zeros((), bool)), key_steps
    )
    total, failed = rows.reward.sum(), exploded.any()
    succeeded = success[jnp.maximum(valid.sum() - 1, 0)] & ~failed
    return Episode(
        transitions=rows,
        valid=valid,
        total_reward=total,
        success=succeeded,
        exploded=failed,
        score=judged(env, total, succeeded, failed),
        world=index,
        trace=jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), env.trace(start.physics), trace),
    )


def judged(env: Env, total: Array, success: Array, exploded: Array) -> Array:
    """`Episode.score` of episodes, from what else is known of them (any shape)."""
    return success.astype(jnp.float32) if env.score == "success" else jnp.where(exploded, -jnp.inf, total)


def counted(episodes: Episode, worst: Array | None = None) -> tuple[Array, Array]:
    """Scores and returns [..., n] of n episodes of one policy in which one that exploded counts as the worst known.

    Its part until then is known too. worst: [..., 2] the lowest score and return of the policy's other episodes.
    """
    total, exploded = episodes.total_reward, episodes.exploded
    xp = total.__array_namespace__()
    results = []
    for i, values in enumerate((xp.where(xp.isneginf(episodes.score), total, episodes.score), total)):
        low = values.min(-1, keepdims=True)
        low = low if worst is None else xp.minimum(low, worst[..., i, None])
        results.append(xp.where(exploded, low, values))
    return results[0], results[1]


def _transition(before: EnvState, action: Array, after: EnvState, *, gamma: float | Array) -> Transition:
    """One row of experience; zeros if the physics exploded: no NaN can travel further even if a mask is forgotten."""
    row = Transition(
        obs=before.obs,
        action=action,
        reward=after.reward,
        discount=gamma * (1.0 - after.terminated.astype(jnp.float32)),
        next_obs=after.obs,
    )
    return jax.tree.map(lambda x: jnp.where(after.invalid, jnp.zeros_like(x), x), row)


def select(mask: Array, new: PyTree, old: PyTree) -> PyTree:
    """Of members [n], the new ones where `mask` [n] is true, else the old ones."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)
