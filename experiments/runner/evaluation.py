"""Success and return of policies in held-out worlds, and how they are summarised."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import mesh
from envs.rollout import Episode, counted
from envs.types import Array, Key, Policy, PyTree
from sgft_jax.math import stats
from sgft_jax.systems.simulated import System
from sgft_jax.train import evidence
from sgft_jax.train.evidence import Best
from sgft_jax.types import Metrics


def play(system: System, policy: Policy, params: PyTree, key: Key, episodes: int) -> Episode:
    """Episodes [M, episodes] of each of M policies without exploration, as NumPy arrays on every host.

    All policies play the same episodes, so that differences between them are paired.
    """
    members = jax.tree.leaves(params)[0].shape[0]
    keys = jnp.broadcast_to(jax.random.split(key, episodes), (members, episodes))
    played = mesh.local(system.play(policy, params, keys, explore=False))
    return jax.tree.map(np.asarray, played)


def scores(played: Episode, worst: Array | None = None) -> Metrics:
    """Mean score, success, return and share of exploded episodes [M] of episodes [M, n].

    worst: [M, 2] the lowest score and return of earlier episodes: one that exploded counts as the worst known.
    """
    score, total = counted(played, worst)
    return {
        "score": score.mean(-1),
        "success": played.success.mean(-1),
        "return": total.mean(-1),
        "exploded": played.exploded.mean(-1),
    }


def describe(played: Episode) -> dict[str, Any]:
    """The numbers of one policy's episodes [n] as JSON data, success with its 95 % Wilson interval."""
    interval = stats.success_interval(int(played.success.sum()), len(played.success))
    return {
        "episodes": len(played.success),
        "success": float(interval.estimate),
        "success/interval": [float(interval.low), float(interval.high)],
        "return": float(counted(played)[1].mean()),
        "exploded": float(played.exploded.mean()),
    }


def best_of(best: Best | None, params: PyTree, played: Episode, age: Array, *, since: float = 0) -> Best:
    """The best [M] of an earlier evaluation, if there was one, and of this one of `params` [M, ...]; see `Best`.

    params may be donated afterwards. age: [M]. since: see `evidence.evaluated`.
    """
    best = evidence.nothing_known(params, *played.exploded.shape) if best is None else best
    return _evaluated(best, params, played.score, played.total_reward, played.exploded, age, since)


_evaluated: Callable[..., Best] = jax.jit(evidence.evaluated)
