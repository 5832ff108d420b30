"""What recorded rollouts say of V_sim: does it promise what they return? Pure."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.types import Array, Transition
from sgft_jax.math.stats import rank_correlation
from sgft_jax.models.value import discounted_returns


class Rollouts(NamedTuple):
    """Recorded episodes of T steps, [n, T, ...], with `valid` [n, T] and `success` [n]; see `envs.rollout.Episode`."""

    transitions: Transition
    valid: Array
    success: Array


def promises(value: Callable[[Array], Array], rollouts: Rollouts) -> tuple[Array, Array]:
    """V_sim [n, T] of visited states, and the discounted returns [n, T] that followed, V_sim standing for what comes
    after the last valid step. value: V_sim of an observation. Numbers of invalid steps mean nothing.
    """

    def one(rows: Transition, valid: Array) -> tuple[Array, Array]:
        last = value(rows.next_obs[jnp.max(jnp.arange(len(valid)) * valid)])
        reward, discount = jnp.where(valid, rows.reward, 0.0), jnp.where(valid, rows.discount, 1.0)
        return jax.vmap(value)(rows.obs), discounted_returns(reward, discount, last)

    return jax.vmap(one)(rollouts.transitions, rollouts.valid)


def honesty(values: np.ndarray, returns: np.ndarray, valid: np.ndarray) -> dict[str, float]:
    """V_sim against returns [n, T] over the valid steps: their means, and Spearman's rank correlation, 0 where one of
    them is constant.
    """
    promised, earned = values[valid], returns[valid]
    order = rank_correlation(np.stack([promised, earned], axis=1))
    return {"promised": float(promised.mean()), "returned": float(earned.mean()), "rank_correlation": float(order)}
