"""Fine-tuning of many seeds on one real system as jitted functions: collect, learn, evaluate. Pure.

Every random draw of a run follows from (seed, purpose, rollout number), so no key is carried along, a resumed run draws
what an uninterrupted one would have drawn, and all methods meet the same real starts.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax

from envs.base import Env, World
from envs.rollout import Episode
from experiments.evaluation import play_episodes, score
from sgft_jax.finetune import Finetuner, FinetuneState
from sgft_jax.types import Array, Key, Metrics, Prior

_INIT, _COLLECT, _LEARN, _EVALUATE = range(4)  # purposes, folded into a seed's key


class Program(NamedTuple):
    """Jitted functions over a leading seeds axis S. The state given to `learn` is donated.

    init(priors [S], seeds [S]) -> state [S].
    collect(state, pool, seeds, rollout, n) -> Episode [S, n]: exploring episodes on the real system; n is static.
    learn(state, episodes, seeds, rollout, updates) -> (state, metrics [S]): store them, then `updates` steps (static).
    evaluate(state, pool, seeds, n) -> metrics [S]: n episodes (static) with the mean action, the same ones every time.
    """

    init: Callable[[Prior, Array], FinetuneState]
    collect: Callable[[FinetuneState, World, Array, int, int], Episode]
    learn: Callable[[FinetuneState, Episode, Array, int, int], tuple[FinetuneState, Metrics]]
    evaluate: Callable[[FinetuneState, World, Array, int], Metrics]


def make_program(env: Env, tuner: Finetuner, *, gamma: float) -> Program:
    """The program of one method on one task."""

    def init(prior: Prior, seed: Array) -> FinetuneState:
        return tuner.init(prior, _key(seed, _INIT, 0))

    def collect(state: FinetuneState, pool: World, seed: Array, rollout: Array, n: int) -> Episode:
        act = lambda obs, key: tuner.act(state, obs, key, explore=True)  # noqa: E731
        return play_episodes(env, pool, act, _key(seed, _COLLECT, rollout), n, gamma=gamma)

    def learn(
        state: FinetuneState, episodes: Episode, seed: Array, rollout: Array, updates: int
    ) -> tuple[FinetuneState, Metrics]:
        rows, valid = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (episodes.transitions, episodes.valid))
        return tuner.learn(tuner.observe(state, rows, valid), _key(seed, _LEARN, rollout), updates)

    def evaluate(state: FinetuneState, pool: World, seed: Array, n: int) -> Metrics:
        act = lambda obs, key: tuner.act(state, obs, key, explore=False)  # noqa: E731
        return score(play_episodes(env, pool, act, _key(seed, _EVALUATE, 0), n, gamma=gamma))

    return Program(
        init=jax.jit(jax.vmap(init)),
        collect=jax.jit(_over_seeds(collect, (0, None, 0, None)), static_argnums=4),
        learn=jax.jit(_over_seeds(learn, (0, 0, 0, None)), static_argnums=4, donate_argnums=0),
        evaluate=jax.jit(_over_seeds(evaluate, (0, None, 0)), static_argnums=3),
    )


def _over_seeds(function: Callable, axes: tuple[int | None, ...]) -> Callable:
    """Maps over all arguments but the last, which is a static number."""
    return lambda *args: jax.vmap(lambda *a: function(*a, args[-1]), axes)(*args[:-1])


def _key(seed: Array, purpose: int, rollout: Array | int) -> Key:
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), purpose), rollout)
