"""V_sim: the frozen, deterministic value of the simulator's policy, and how well it predicts returns.

It is the mean of the critic over the policy's actions. A critic of SAC counts later entropy too, see `value_loss`.
"""

import jax
import numpy as np
from numpy.typing import ArrayLike

from envs.types import Array, PyTree
from sgft_jax.math.stats import rank_correlation
from sgft_jax.models.networks import Network, precision
from sgft_jax.models.normalizer import normalize
from sgft_jax.types import Normalizer

__all__ = ["discounted_returns", "predict", "report"]


def predict(network: Network, params: PyTree, normalizer: Normalizer, obs: Array) -> Array:
    """V(obs) []. obs: [obs_dim] raw units.

    Full float32 on every device: the shaped reward is the small difference of two large values, and the ten mantissa
    bits of a GPU's default matrix products would drown it.
    """
    with precision("float32"):
        return network.apply(params, normalize(normalizer, obs))


def discounted_returns(rewards: Array, discounts: Array, bootstrap: Array) -> Array:
    """Monte-Carlo returns G_t = r_t + d_t G_{t+1} of one trajectory. rewards, discounts: [T]; bootstrap: [] G_T."""

    def back(later: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, discount = inputs
        now = reward + discount * later
        return now, now

    return jax.lax.scan(back, bootstrap, (rewards, discounts), reverse=True)[1]


def report(values: ArrayLike, returns: ArrayLike) -> dict[str, float]:
    """Quality of V against Monte-Carlo returns, both [N], on the host.

    The explained variance is 1 - Var(returns - values) / Var(returns): 1 is perfect, 0 no better than a constant. The
    rank correlation is Spearman's: shaping cares about order more than about scale.
    """
    promised, earned = np.asarray(values, np.float64), np.asarray(returns, np.float64)
    return {
        "value/explained_variance": float(1 - np.var(earned - promised) / max(np.var(earned), 1e-12)),
        "value/rank_correlation": float(rank_correlation(np.stack([promised, earned], axis=1))),
        "value/bias": float(np.mean(promised - earned)),
    }
