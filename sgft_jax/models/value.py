"""V_sim: the frozen, deterministic value of the simulator's policy, and how well it predicts returns.

It is fitted to returns of the policy as it is deployed, see `train.value_fit`: no entropy, no exploration.
"""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from envs.types import Array, PyTree
from sgft_jax.math.stats import rank_correlation
from sgft_jax.models.networks import Network, NetworkConfig, ensemble, make_value, precision
from sgft_jax.models.normalizer import normalize
from sgft_jax.types import Normalizer

__all__ = ["discounted_returns", "explainable", "inputs", "lambda_returns", "make_v_sim", "predict", "report"]


def inputs(obs: Array, system: Array, known: Array | float) -> Array:
    """What a member of V_sim reads [obs_dim + k + 1]: the system [k] where it is known, else zeros, and which it is.

    obs: [obs_dim] normalised. known: [] 1 or 0.
    """
    return jnp.concatenate([obs, known * system, jnp.asarray(known)[None]])


def make_v_sim(obs_dim: int, config: NetworkConfig, *, system: int = 0, members: int = 1) -> Network:
    """apply(params, obs [obs_dim], system [k] = None) -> []: the mean of an ensemble; without a system V(obs).

    system: k numbers in [-1, 1] that members can be told, see `envs.observations.with_system`. members: of a new one;
    how many are applied, and what they read, is that of `params`. A single network without an axis of members reads
    observations alone: priors from before V_sim had a stage of its own.
    """
    member = make_value(obs_dim + system + 1, config)

    def apply(params: PyTree, obs: Array, system: Array | None = None) -> Array:
        kernel = params["Dense_0"]["kernel"]
        if kernel.ndim == 2:
            return member.apply(params, obs)
        told = jnp.zeros(kernel.shape[-2] - obs_dim - 1) if system is None else system
        seen = inputs(obs, told, float(system is not None))
        return jnp.mean(jax.vmap(member.apply, (0, None))(params, seen))

    return Network(ensemble(member, members).init, apply)


def predict(network: Network, params: PyTree, normalizer: Normalizer, obs: Array, system: Array | None = None) -> Array:
    """V(obs) [], or V(obs, system). obs: [obs_dim] raw units. system: see `make_v_sim`.

    Full float32 on every device: the shaped reward is the small difference of two large values, and the ten mantissa
    bits of a GPU's default matrix products would drown it.
    """
    with precision("float32"):
        return network.apply(params, normalize(normalizer, obs), system)


def discounted_returns(rewards: Array, discounts: Array, bootstrap: Array) -> Array:
    """Monte-Carlo returns G_t = r_t + d_t G_{t+1} of one trajectory. rewards, discounts: [T]; bootstrap: [] G_T."""

    def back(later: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, discount = inputs
        now = reward + discount * later
        return now, now

    return jax.lax.scan(back, bootstrap, (rewards, discounts), reverse=True)[1]


def lambda_returns(rewards: Array, discounts: Array, values: Array, *, mixed: float) -> Array:
    """[T] returns that end in V everywhere, with weight 1 - `mixed`, and in V of the last state. values: [T + 1]."""
    ended = rewards + (1 - mixed) * discounts * values[1:]
    return discounted_returns(ended, mixed * discounts, values[-1])


def report(values: ArrayLike, returns: ArrayLike) -> dict[str, float]:
    """Quality of V against Monte-Carlo returns, both [N], on the host.

    The explained variance is 1 - Var(returns - values) / Var(returns): 1 is perfect, 0 no better than a constant. The
    rank correlation is Spearman's: shaping cares about order more than about scale. bias_of_range: the bias over the
    range of the returns.
    """
    promised, earned = np.asarray(values, np.float64), np.asarray(returns, np.float64)
    bias = float(np.mean(promised - earned))
    return {
        "value/explained_variance": float(1 - np.var(earned - promised) / max(np.var(earned), 1e-12)),
        "value/rank_correlation": float(rank_correlation(np.stack([promised, earned], axis=1))),
        "value/bias": bias,
        "value/bias_of_range": bias / max(float(np.ptp(earned)), 1e-12),
    }


def explainable(replays: ArrayLike) -> dict[str, float]:
    """What no function of an observation can exceed, from returns [states, worlds] that followed the same observations.

    explainable_variance: 1 - E[Var(returns | obs)] / Var(returns). rank_ceiling: Spearman's of the returns in one world
    with the mean in the others. system_explainable_variance: of a function that knows the system, from the first two
    worlds of a state, which are one.
    """
    earned = np.asarray(replays, np.float64)
    total, others = max(np.var(earned[:, 1:]), 1e-12), earned[:, 2:].mean(axis=1)
    again = np.mean((earned[:, 0] - earned[:, 1]) ** 2) / 2
    return {
        "value/explainable_variance": float(1 - earned[:, 1:].var(axis=1, ddof=1).mean() / total),
        "value/rank_ceiling": float(rank_correlation(np.stack([earned[:, 1], others], axis=1))),
        "value/system_explainable_variance": float(1 - again / total),
    }
