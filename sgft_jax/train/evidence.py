"""The best policy by evidence: what episodes say of the policies that have played them.

An episode whose physics exploded, or that was broken off, has no return: what it earned until then may be more than a
whole one earns, as where rewards are costs. It counts as the worst that is known, its own part included. That is
decided anew whenever policies are compared, because a worse whole episode may come later.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array, PyTree
from sgft_jax.types import Finetuner

WINDOW = 5  # real rollouts whose mean is the evidence for a policy in fine-tuning


class Best(NamedTuple):
    """The best policies, one for each member: those with the highest mean score, then mean return, of N episodes.

    N episodes outweigh fewer, whatever these scored. In pretraining they are those of an evaluation. In fine-tuning
    they are the last training rollouts, of policies that learned in between; they speak for the one that played the
    last of them, and while there are fewer than `WINDOW`, all of them do.

    params: [M, ...] of that policy; those at the start before there is any evidence. age: [M] int32, the real rollouts
    it had learned from, or the rounds of pretraining. kept: [M, N, 2] scores and returns of its episodes, -inf where
    one exploded, nan where there were fewer. worst: [M, 2] the lowest score and return known, inf before any. recent:
    [M, N, 2], as `kept`, the last rollouts. count: [M] int32, how many rollouts it has seen. Pretraining leaves the
    last two as they are.
    """

    params: PyTree
    age: Array
    kept: Array
    worst: Array
    recent: Array
    count: Array

    @property
    def score(self) -> Array:
        """[M] the mean score that is its evidence, -inf before there is any."""
        return means(self.kept, self.worst)[..., 0]

    @property
    def total(self) -> Array:
        """[M] the mean return of the same rollouts."""
        return means(self.kept, self.worst)[..., 1]


def nothing_known(params: PyTree, members: int, episodes: int = WINDOW) -> Best:
    """Before the first episode. params: [M, ...] of the policy at the start. episodes: N of `Best`."""
    window = jnp.full((members, episodes, 2), jnp.nan, jnp.float32)
    none = jnp.zeros(members, jnp.int32)
    return Best(params, none, window, jnp.full((members, 2), jnp.inf, jnp.float32), jnp.copy(window), jnp.copy(none))


def means(window: Array, worst: Array) -> Array:
    """[M, 2] mean score and return of windows [M, N, 2], see `Best`; -inf where one is empty."""
    rows = ~jnp.isnan(window)
    mean = jnp.mean(jnp.where(jnp.isneginf(window), worst[..., None, :], window), axis=-2, where=rows)
    return jnp.where(rows.any(-2), mean, -jnp.inf)


def witnessed(best: Best, score: Array, total: Array) -> Best:
    """`best` when episodes with these scores and returns [M, ...], as far as they came, are known, whoever played."""
    known = jnp.stack([jnp.where(jnp.isneginf(score), total, score), total], -1)
    return best._replace(worst=jnp.minimum(best.worst, known.min(tuple(range(1, known.ndim - 1)))))


def as_known(best: Best, score: Array, total: Array, exploded: Array) -> tuple[Array, Array]:
    """Score and return [M] of a witnessed rollout, as they count today."""
    return jnp.where(exploded, best.worst[:, 0], score), jnp.where(exploded, best.worst[:, 1], total)


def evaluated(
    best: Best, params: PyTree, score: Array, total: Array, exploded: Array, age: Array, since: Array | float = 0
) -> Best:
    """`best` after an evaluation of `params` [M, ...]: N episodes, their scores, returns, whether they exploded [M, N].

    age: [M], see `Best`. since: [] the age from which on policies compete: a younger one always gives way.
    """
    best = witnessed(best, score, total)
    window = jnp.where(exploded[..., None], -jnp.inf, jnp.stack([score, total], -1))
    return _keep(best, params, window, age, _better(window, best) | (best.age < since))


def judged(
    finetuner: Finetuner, best: Best, agent: PyTree, score: Array, total: Array, exploded: Array, age: Array
) -> Best:
    """`best` after one more rollout by `agent` [M], with its score, return and whether it exploded [M].

    agent: None where nobody knows who played it. age: [] the rollouts that it had learned from.
    """
    best = witnessed(best, score, total)
    row = jnp.where(exploded[:, None], -jnp.inf, jnp.stack([score, total], axis=1))
    recent = jnp.concatenate([best.recent[:, 1:], row[:, None]], axis=1)
    best = best._replace(recent=recent, count=best.count + 1)
    if agent is None:
        return best
    played = jax.vmap(finetuner.trial or finetuner.export)(agent)
    return _keep(best, played, recent, age, _better(recent, best))


def _keep(best: Best, params: PyTree, window: Array, age: Array, better: Array) -> Best:
    """`best`, but for the members [M] that are `better` the policy of this evidence."""

    def keep(new: Array, old: Array) -> Array:
        return jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    now = {"params": params, "age": jnp.broadcast_to(age, better.shape), "kept": window}
    return best._replace(**{name: jax.tree.map(keep, x, getattr(best, name)) for name, x in now.items()})


def _better(new: Array, best: Best) -> Array:
    """[M] whether windows [M, N, 2] are better evidence than the best: by score, explosions, return, length."""
    old, full = best.kept, new.shape[1]
    count_new, count_old = (jnp.sum(~jnp.isnan(x[..., 0]), axis=-1) for x in (new, old))
    verdict = count_new > count_old  # of equals the one that says more
    for new_mean, old_mean in reversed([*zip(_ranked(new, best.worst), _ranked(old, best.worst), strict=True)]):
        verdict = (new_mean > old_mean) | ((new_mean == old_mean) & verdict)
    return verdict | ((count_new == full) & (count_old < full))


def _ranked(window: Array, worst: Array) -> tuple[Array, Array, Array]:
    """[M] each, what decides between windows, in order; more is better."""
    score, total = jnp.moveaxis(means(window, worst), -1, 0)
    return score, -jnp.mean(jnp.isneginf(window[..., 0]), axis=-1, where=~jnp.isnan(window[..., 0])), total
