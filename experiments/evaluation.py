"""Success and return of a policy on a pool of worlds: one batch of whole episodes. Pure."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env, World
from envs.rollout import Act, Episode, play_episode
from sgft_jax.analysis import stats
from sgft_jax.mesh import split_vmap, whole
from sgft_jax.players import Player
from sgft_jax.types import Array, Key, Metrics, PyTree


def play_episodes(
    env: Env,
    pool: World,
    policy: Act,
    carry: PyTree,
    keys: Key,
    *,
    gamma: float,
    length: int | None = None,
    which: Array | None = None,
) -> Episode:
    """Episodes [n, ...] of `policy(carry, obs, key) -> (action, carry)`, one per key [n], each in a random world.

    A key gives the same world, start and noise to every policy: differences between policies are paired. length, which:
    as for `play_episode`.
    """
    one = lambda key: play_episode(env, pool, policy, carry, key, gamma=gamma, length=length, which=which)  # noqa: E731
    return split_vmap(one)(keys)


class Outcome(NamedTuple):
    """How episodes went: the fields of `Episode` of these names, [n]."""

    success: Array
    total_reward: Array
    exploded: Array
    trace: Array


def score(episodes: Episode | Outcome) -> Metrics:
    """Mean success, return and share of exploded episodes."""
    return {
        "success": episodes.success.mean(),
        "return": episodes.total_reward.mean(),
        "exploded": episodes.exploded.astype(jnp.float32).mean(),
    }


def prior_policy(player: Player, prior: PyTree, *, explore: bool) -> Act:
    """pi_sim: what it takes for best, or, to explore, a sample."""
    return lambda carry, obs, key: player.act(prior, carry, obs, key, explore=explore)


def grade(env: Env, player: Player, pool: World, key: Key, prior: PyTree, *, gamma: float, episodes: int) -> Outcome:
    """That many episodes of what the prior takes for best."""
    policy = prior_policy(player, prior, explore=False)
    keys = jax.random.split(key, episodes)
    played = play_episodes(env, pool, policy, player.init_carry(), keys, gamma=gamma)
    return whole(Outcome(played.success, played.total_reward, played.exploded, played.trace))


def describe(outcome: Outcome) -> dict[str, Any]:
    """The numbers of one policy's episodes (NumPy arrays) as JSON data, success with its 95 % Wilson interval."""
    interval = stats.success_interval(int(outcome.success.sum()), len(outcome.success))
    return {
        "episodes": len(outcome.success),
        "success": float(interval.estimate),
        "success/interval": [float(interval.low), float(interval.high)],
        "return": float(outcome.total_reward.mean()),
        "exploded": float(outcome.exploded.mean()),
    }


class Best(NamedTuple):
    """The best policy so far with all that belongs to it.

    success, total: [] of its evaluation. steps: [] int32, when that was.
    """

    prior: PyTree
    success: Array
    total: Array
    steps: Array


def keep_better(old: Best, new: Best, since: float | Array) -> Best:
    """The one with the higher success, then the higher return; the old one if they tie, or the new one in any case if
    the old one is from before `since` [] steps.
    """
    better = (new.success > old.success) | ((new.success == old.success) & (new.total > old.total))
    better |= old.steps < since
    return jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
