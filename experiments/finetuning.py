"""Fine-tuning of many seeds on several real systems as jitted functions: collect, store, learn, evaluate. Pure.

Every random draw of a run follows from (seed, purpose, rollout number), so no key is carried along, a resumed run draws
what an uninterrupted one would have drawn, all methods meet the same real starts, and a real system gives the same
whether it is stepped alone or together with others.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env, World
from envs.rollout import Episode, play_episode
from experiments.evaluation import play_episodes, prior_policy
from sgft_jax.data import replay
from sgft_jax.mesh import split_vmap
from sgft_jax.players import Player
from sgft_jax.types import Array, Finetuner, Key, Metrics, PyTree, Simulated, Transition

_INIT, _COLLECT, _LEARN, _EVALUATE, _OFFLINE = range(5)  # purposes, folded into a seed's key
_AT_ONCE = 1024  # simulated episodes played together


class Simulation(NamedTuple):
    """What the simulator's policies did in simulation.

    replay: [P], one per prior. which: [M], the prior of each member. returns: [P, episodes] of the task, undiscounted.
    """

    replay: replay.ReplayState
    which: Array
    returns: Array


class Reals(NamedTuple):
    """The real systems. pools: worlds [G, W], a pool of each. which: [M], the real system of each member."""

    pools: World
    which: Array


class Program(NamedTuple):
    """Compiled functions over a leading axis of members M, each a seed on a real system, which the devices of a mesh
    share. The state given to `store` and `learn` is donated.

    init(priors [M], seeds [M]) -> state [M].
    collect(state, reals, seeds, rollout, n) -> Episode [M, n]: exploring episodes on the real systems.
    store(state, episodes) -> state.
    learn(state, seeds, rollout, updates, simulation) -> (state, metrics [M]): that many updates (static) after that
        rollout; simulation: None for methods that do without.
    offline(state, seeds, part, updates, simulation) -> (state, metrics [M]): the same on the simulation alone.
    evaluate(state, reals, seeds, n) -> Episode [M, n]: with the mean action; the first n of a fixed series of episodes.
    """

    init: Callable[[PyTree, Array], PyTree]
    collect: Callable[[PyTree, Reals, Array, int, int], Episode]
    store: Callable[[PyTree, Episode], PyTree]
    learn: Callable[[PyTree, Array, int, int, Simulation | None], tuple[PyTree, Metrics]]
    offline: Callable[[PyTree, Array, int, int, Simulation | None], tuple[PyTree, Metrics]]
    evaluate: Callable[[PyTree, Reals, Array, int], Episode]


def make_program(env: Env, tuner: Finetuner, *, gamma: float) -> Program:
    """The program of one method on one task."""

    def init(prior: PyTree, seed: Array) -> PyTree:
        return tuner.init(prior, _key(seed, _INIT, 0))

    def play(state: PyTree, pools: World, which: Array, keys: Key, explore: Array) -> Episode:
        policy = lambda carry, obs, key: tuner.act(state, carry, obs, key, explore=explore)  # noqa: E731
        return play_episodes(env, pools, policy, tuner.init_carry(), keys, gamma=gamma, which=which)

    def store(state: PyTree, episodes: Episode) -> PyTree:
        """One episode after another: some learners need to know where each ends."""
        one = lambda state, episode: (tuner.observe(state, *episode), None)  # noqa: E731
        return jax.lax.scan(one, state, (episodes.transitions, episodes.valid))[0]

    def learn(
        purpose: int, state: PyTree, seeds: Array, part: Array, updates: int, simulation: Simulation | None
    ) -> tuple[PyTree, Metrics]:
        def one(state: PyTree, seed: Array, which: Array, buffers: Any) -> tuple[PyTree, Metrics]:
            source = None if buffers is None else _rows_of(buffers, which)
            return tuner.learn(state, _key(seed, purpose, part), updates, source, offline=purpose == _OFFLINE)

        which, buffers = (seeds, None) if simulation is None else (simulation.which, simulation.replay)
        return split_vmap(one, (0, 0, 0, None))(state, seeds, which, buffers)

    # One program explores and evaluates: compiling MJX takes longer than many an experiment on a small machine.
    played = jax.jit(split_vmap(play, (0, None, 0, 0, None)))
    keys = jax.jit(jax.vmap(_episode_keys, (0, None, None, None)), static_argnums=3)

    def collect(state: PyTree, reals: Reals, seeds: Array, rollout: int, n: int) -> Episode:
        """One after another, as on a robot: a program for n at once would be used for the initial rollouts alone."""
        each = jnp.split(keys(seeds, _COLLECT, rollout, n), n, axis=1)
        episodes = [played(state, *reals, key, True) for key in each]
        return jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *episodes)

    def evaluate(state: PyTree, reals: Reals, seeds: Array, n: int) -> Episode:
        return played(state, *reals, keys(seeds, _EVALUATE, 0, n), False)

    return Program(
        init=jax.jit(split_vmap(init)),
        collect=collect,
        store=jax.jit(split_vmap(store), donate_argnums=0),
        learn=jax.jit(functools.partial(learn, _LEARN), static_argnums=3, donate_argnums=0),
        offline=jax.jit(functools.partial(learn, _OFFLINE), static_argnums=3, donate_argnums=0),
        evaluate=evaluate,
    )


def simulate(
    env: Env,
    player: Player,
    pool: World,
    prior: PyTree,
    key: Key,
    *,
    gamma: float,
    transitions: int,
    ladder: float,
) -> tuple[replay.ReplayState, Array]:
    """Whole episodes of an exploring simulator's policy in simulated worlds, at least that many transitions.

    ladder: in the i-th of n episodes a share i / (n - 1) * ladder of the actions is uniformly random, as along the
    fleet of pretraining. Returns a replay of just their size (without exploded steps) and their returns [n].
    """
    n = -(-transitions // env.episode_length)
    at_once = min(n, _AT_ONCE)
    parts = -(-n // at_once)
    own = prior_policy(player, prior, explore=True)

    def play(key: Key, share: Array) -> Episode:
        def policy(carry: PyTree, obs: Array, key: Key) -> tuple[Array, PyTree]:
            key_policy, key_replace, key_random = jax.random.split(key, 3)
            action, carry = own(carry, obs, key_policy)
            random = jax.random.uniform(key_random, (env.act_dim,), minval=-1.0, maxval=1.0)
            return jnp.where(jax.random.uniform(key_replace) < share, random, action), carry

        return play_episode(env, pool, policy, player.init_carry(), key, gamma=gamma)

    def part(buffer: replay.ReplayState, inputs: tuple[Key, Array]) -> tuple[replay.ReplayState, Array]:
        key, shares = inputs
        episodes = jax.vmap(play)(jax.random.split(key, at_once), shares)
        rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (episodes.transitions, episodes.valid))
        return replay.add_batch(buffer, *rows), episodes.total_reward

    empty = replay.init(replay.blank(env.obs_dim, env.act_dim), parts * at_once * env.episode_length)
    shares = jnp.linspace(0.0, ladder, parts * at_once).reshape(parts, at_once)
    buffer, returns = jax.lax.scan(part, empty, (jax.random.split(key, parts), shares))
    return buffer, returns.reshape(-1)


def _rows_of(buffers: replay.ReplayState, which: Array) -> Simulated:
    """Draws from one of several buffers [P], without a copy of the one."""

    def draw(key: Key, n: int) -> Transition:
        rows = jax.random.randint(key, (n,), 0, jnp.maximum(buffers.size[which], 1))
        return jax.tree.map(lambda x: x[which, rows], buffers.data)

    return draw


def _key(seed: Array, purpose: int | Array, rollout: int | Array) -> Key:
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), purpose), rollout)


def _episode_keys(seed: Array, purpose: Array, rollout: Array, n: int) -> Key:
    """Keys [n]; the first ones are the same for every n."""
    return jax.vmap(lambda i: jax.random.fold_in(_key(seed, purpose, rollout), i))(jnp.arange(n))
