"""Fine-tuning of many seeds on one real system as jitted functions: collect, learn, evaluate. Pure.

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
from sgft_jax.types import Array, Key, Metrics, Prior

_INIT, _COLLECT, _LEARN, _EVALUATE = range(4)  # purposes, folded into a seed's key


class Program(NamedTuple):
    """Compiled functions over a leading seeds axis S. The state given to `learn` is donated.

    init(priors [S], seeds [S]) -> state [S].
    collect(state, pool, seeds, rollout, n) -> Episode [S, n]: exploring episodes on the real system; n is static.
    learn(state, episodes, seeds, rollout, updates) -> (state, metrics [S]): store them, then `updates` steps (static).
    evaluate(state, pool, seeds, n) -> Episode [S, n]: with the mean action, the same ones every time; n is static.
    """

    init: Callable[[Prior, Array], FinetuneState]
    collect: Callable[[FinetuneState, World, Array, int, int], Episode]
    learn: Callable[[FinetuneState, Episode, Array, int, int], tuple[FinetuneState, Metrics]]
    evaluate: Callable[[FinetuneState, World, Array, int], Episode]


def make_program(env: Env, tuner: Finetuner, *, gamma: float) -> Program:
    """The program of one method on one task."""

    def init(prior: Prior, seed: Array) -> FinetuneState:
        return tuner.init(prior, _key(seed, _INIT, 0))

    def play(state: FinetuneState, pool: World, key: Key, explore: Array, n: int) -> Episode:
        def act(obs: Array, key: Key) -> Array:
            sample, mode = (tuner.act(state, obs, key, explore=choice) for choice in (True, False))
            return jnp.where(explore, sample, mode)

        return play_episodes(env, pool, act, key, n, gamma=gamma)

    def learn(
        state: FinetuneState, episodes: Episode, seed: Array, rollout: Array, updates: int
    ) -> tuple[FinetuneState, Metrics]:
        rows, valid = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (episodes.transitions, episodes.valid))
        return tuner.learn(tuner.observe(state, rows, valid), _key(seed, _LEARN, rollout), updates)

    # One program explores and evaluates: compiling the physics takes longer than many an experiment on a small machine.
    played = jax.jit(_over_seeds(play, (0, None, 0, None)), static_argnums=4)
    keys = jax.jit(jax.vmap(_key, (0, None, None)))

    def collect(state: FinetuneState, pool: World, seeds: Array, rollout: int, n: int) -> Episode:
        return played(state, pool, keys(seeds, _COLLECT, rollout), True, n)

    def evaluate(state: FinetuneState, pool: World, seeds: Array, n: int) -> Episode:
        return played(state, pool, keys(seeds, _EVALUATE, 0), False, n)

    return Program(
        init=jax.jit(jax.vmap(init)),
        collect=collect,
        learn=jax.jit(_over_seeds(learn, (0, 0, 0, None)), static_argnums=4, donate_argnums=0),
        evaluate=evaluate,
    )


def _over_seeds(function: Callable, axes: tuple[int | None, ...]) -> Callable:
    """Maps over all arguments but the last, which is a static number."""
    return lambda *args: jax.vmap(lambda *a: function(*a, args[-1]), axes)(*args[:-1])


def _key(seed: Array, purpose: int | Array, rollout: int | Array) -> Key:
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), purpose), rollout)
