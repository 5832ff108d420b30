"""The best policy by real evidence: what training rollouts say of the policies that have played them.

A rollout whose physics exploded, or that was broken off, has no return: what it earned until then may be more than a
whole one earns, as where rewards are costs. It counts as the worst that is known, its own part included. That is
decided anew whenever windows are compared, because a worse whole rollout may come later.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array, PyTree
from sgft_jax.types import Finetuner

WINDOW = 5  # real rollouts whose mean is the evidence for a policy


class Best(NamedTuple):
    """The best policy: that with the highest mean score, then mean return, of up to WINDOW training rollouts in a row.

    The rollouts of a window come from policies that learned in between; it speaks for the one that played the last of
    them. WINDOW rollouts outweigh fewer, whatever these scored; while there are fewer, all of them are the window.

    params: [M, ...] of that policy; those at the start before there is any evidence. rollouts: [M] int32, the real
    rollouts it had learned from. kept: [M, WINDOW, 2] scores and returns of its window, -inf where one exploded, nan
    where there were fewer. recent: the same of the last rollouts. worst: [M, 2] the lowest score and return known, inf
    before any. count: [M] int32, how many rollouts of the agent it has seen.
    """

    params: PyTree
    rollouts: Array
    kept: Array
    recent: Array
    worst: Array
    count: Array

    @property
    def score(self) -> Array:
        """[M] the mean score that is its evidence, -inf before there is any."""
        return means(self.kept, self.worst)[..., 0]

    @property
    def total(self) -> Array:
        """[M] the mean return of the same rollouts."""
        return means(self.kept, self.worst)[..., 1]


def nothing_known(params: PyTree, members: int) -> Best:
    """Before the first rollout. params: [M, ...] of the policy at the start."""
    window = jnp.full((members, WINDOW, 2), jnp.nan, jnp.float32)
    none = jnp.zeros(members, jnp.int32)
    return Best(params, none, window, jnp.copy(window), jnp.full((members, 2), jnp.inf, jnp.float32), jnp.copy(none))


def means(window: Array, worst: Array) -> Array:
    """[M, 2] mean score and return of windows [M, WINDOW, 2], see `Best`; -inf where one is empty."""
    rows = ~jnp.isnan(window)
    mean = jnp.mean(jnp.where(jnp.isneginf(window), worst[..., None, :], window), axis=-2, where=rows)
    return jnp.where(rows.any(-2), mean, -jnp.inf)


def witnessed(best: Best, score: Array, total: Array) -> Best:
    """`best` when a rollout with this score and return [M], as far as it came, is known, whoever played it."""
    return best._replace(
        worst=jnp.minimum(best.worst, jnp.stack([jnp.where(jnp.isneginf(score), total, score), total], 1))
    )


def as_known(best: Best, score: Array, total: Array, exploded: Array) -> tuple[Array, Array]:
    """Score and return [M] of a witnessed rollout, as they count today."""
    return jnp.where(exploded, best.worst[:, 0], score), jnp.where(exploded, best.worst[:, 1], total)


def judged(
    finetuner: Finetuner, best: Best, agent: PyTree, score: Array, total: Array, exploded: Array, learned: Array
) -> Best:
    """`best` after one more rollout by `agent` [M], with its score, return and whether it exploded [M].

    agent: None where nobody knows who played it. learned: [] the rollouts that it had learned from.
    """
    best = witnessed(best, score, total)
    row = jnp.where(exploded[:, None], -jnp.inf, jnp.stack([score, total], axis=1))
    recent = jnp.concatenate([best.recent[:, 1:], row[:, None]], axis=1)
    best = best._replace(recent=recent, count=best.count + 1)
    if agent is None:
        return best
    better = _better(recent, best.kept, best.worst)
    keep = lambda new, old: jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)  # noqa: E731
    return best._replace(
        params=jax.tree.map(keep, jax.vmap(finetuner.export)(agent), best.params),
        rollouts=keep(jnp.broadcast_to(learned, better.shape), best.rollouts),
        kept=keep(recent, best.kept),
    )


def _better(new: Array, old: Array, worst: Array) -> Array:
    """[M] whether windows [M, WINDOW, 2] are better evidence than older ones: by score, explosions, return, length."""
    count_new, count_old = (jnp.sum(~jnp.isnan(x[..., 0]), axis=-1) for x in (new, old))
    verdict = count_new > count_old  # of equals the one that says more
    for new_mean, old_mean in reversed([*zip(_ranked(new, worst), _ranked(old, worst), strict=True)]):
        verdict = (new_mean > old_mean) | ((new_mean == old_mean) & verdict)
    return verdict | ((count_new == WINDOW) & (count_old < WINDOW))


def _ranked(window: Array, worst: Array) -> tuple[Array, Array, Array]:
    """[M] each, what decides between windows, in order; more is better."""
    score, total = jnp.moveaxis(means(window, worst), -1, 0)
    return score, -jnp.mean(jnp.isneginf(window[..., 0]), axis=-1, where=~jnp.isnan(window[..., 0])), total
