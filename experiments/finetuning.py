"""Fine-tuning of many seeds on one real system as jitted functions: collect, store, learn, evaluate. Pure.

Every random draw of a run follows from (seed, purpose, rollout number), so no key is carried along, a resumed run draws
what an uninterrupted one would have drawn, and all methods meet the same real starts.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env, World
from envs.rollout import Episode
from experiments.evaluation import play_episodes
from sgft_jax.finetune import Finetuner, FinetuneState
from sgft_jax.mesh import split_vmap
from sgft_jax.types import Array, Key, Metrics, Prior

_INIT, _COLLECT, _LEARN, _EVALUATE = range(4)  # purposes, folded into a seed's key


class Program(NamedTuple):
    """Compiled functions over a leading seeds axis S, which the devices of a mesh share. The state given to `store` and
    `learn` is donated.

    init(priors [S], seeds [S]) -> state [S].
    collect(state, pool, seeds, rollout, n) -> Episode [S, n]: exploring episodes on the real system.
    store(state, episodes) -> state.
    learn(state, seeds, rollout, updates) -> (state, metrics [S]): that many updates (static) after that rollout.
    evaluate(state, pool, seeds, n) -> Episode [S, n]: with the mean action; the first n of a fixed series of episodes.
    """

    init: Callable[[Prior, Array], FinetuneState]
    collect: Callable[[FinetuneState, World, Array, int, int], Episode]
    store: Callable[[FinetuneState, Episode], FinetuneState]
    learn: Callable[[FinetuneState, Array, int, int], tuple[FinetuneState, Metrics]]
    evaluate: Callable[[FinetuneState, World, Array, int], Episode]


def make_program(env: Env, tuner: Finetuner, *, gamma: float) -> Program:
    """The program of one method on one task."""

    def init(prior: Prior, seed: Array) -> FinetuneState:
        return tuner.init(prior, _key(seed, _INIT, 0))

    def play(state: FinetuneState, pool: World, keys: Key, explore: Array) -> Episode:
        def act(obs: Array, key: Key) -> Array:
            sample, mode = (tuner.act(state, obs, key, explore=choice) for choice in (True, False))
            return jnp.where(explore, sample, mode)

        return play_episodes(env, pool, act, keys, gamma=gamma)

    def store(state: FinetuneState, episodes: Episode) -> FinetuneState:
        rows, valid = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (episodes.transitions, episodes.valid))
        return tuner.observe(state, rows, valid)

    def learn(state: FinetuneState, seeds: Array, rollout: Array, updates: int) -> tuple[FinetuneState, Metrics]:
        one = lambda state, seed: tuner.learn(state, _key(seed, _LEARN, rollout), updates)  # noqa: E731
        return split_vmap(one)(state, seeds)

    # One program explores and evaluates: compiling MJX takes longer than many an experiment on a small machine.
    played = jax.jit(split_vmap(play, (0, None, 0, None)))
    keys = jax.jit(jax.vmap(_episode_keys, (0, None, None, None)), static_argnums=3)

    def collect(state: FinetuneState, pool: World, seeds: Array, rollout: int, n: int) -> Episode:
        """One after another, as on a robot: a program for n at once would be used for the initial rollouts alone."""
        each = jnp.split(keys(seeds, _COLLECT, rollout, n), n, axis=1)
        episodes = [played(state, pool, key, True) for key in each]
        return jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *episodes)

    def evaluate(state: FinetuneState, pool: World, seeds: Array, n: int) -> Episode:
        return played(state, pool, keys(seeds, _EVALUATE, 0, n), False)

    return Program(
        init=jax.jit(split_vmap(init)),
        collect=collect,
        store=jax.jit(split_vmap(store), donate_argnums=0),
        learn=jax.jit(learn, static_argnums=3, donate_argnums=0),
        evaluate=evaluate,
    )


def _key(seed: Array, purpose: int | Array, rollout: int | Array) -> Key:
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), purpose), rollout)


def _episode_keys(seed: Array, purpose: Array, rollout: Array, n: int) -> Key:
    """Keys [n]; the first ones are the same for every n."""
    return jax.vmap(lambda i: jax.random.fold_in(_key(seed, purpose, rollout), i))(jnp.arange(n))
