"""V_sim: the frozen, deterministic value of the simulator's policy, and how well it predicts returns.

It is the mean of the critic over the policy's actions. A critic of SAC counts later entropy too, see `value_loss`.
"""

import jax
import jax.numpy as jnp

from envs.types import Array, PyTree
from sgft_jax.models.networks import Network, precision
from sgft_jax.models.normalizer import normalize
from sgft_jax.types import Metrics, Normalizer

__all__ = ["discounted_returns", "explained_variance", "predict", "rank_correlation", "report"]


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


def explained_variance(values: Array, returns: Array) -> Array:
    """1 - Var(returns - values) / Var(returns), both [N]: 1 is perfect, 0 no better than a constant."""
    return 1 - jnp.var(returns - values) / jnp.maximum(jnp.var(returns), 1e-12)


def rank_correlation(values: Array, returns: Array) -> Array:
    """Spearman's rho, both [N], ties broken by order: shaping cares about order more than about scale."""
    ranks = [jnp.argsort(jnp.argsort(x)).astype(jnp.float32) for x in (values, returns)]
    a, b = (r - jnp.mean(r) for r in ranks)
    return jnp.sum(a * b) / jnp.maximum(jnp.sqrt(jnp.sum(a**2) * jnp.sum(b**2)), 1e-12)


def report(values: Array, returns: Array) -> Metrics:
    """Quality of V against Monte-Carlo returns, both [N]."""
    return {
        "value/explained_variance": explained_variance(values, returns),
        "value/rank_correlation": rank_correlation(values, returns),
        "value/bias": jnp.mean(values - returns),
    }
