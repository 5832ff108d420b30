"""How much likelier a transition is in the real system than in the simulator, from two discriminators of their rows.

The ratio P / P_sim of the dynamics alone: what a discriminator of (s, a, s') sees, less what one of (s, a) sees.
Everything is in logarithms. Source: DARC (Eysenbach et al. 2021); H2O+ (Niu et al. 2023) Eq. (9), whose text names the
inverse, while Eq. (8) needs P / P_sim.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree, UserError
from sgft_jax import checks
from sgft_jax.math import losses, optim
from sgft_jax.models import normalizer
from sgft_jax.models.config import NetworkConfig, two_layers
from sgft_jax.models.networks import Network, make_mlp
from sgft_jax.types import Batch, Metrics, Normalizer

__all__ = ["RatioConfig", "RatioState", "difference", "domain_loss", "init", "log_ratio", "log_ratios"]
__all__ += ["make_discriminator", "split_rows", "step", "update", "weight"]

REAL, SIM = 0, 1  # the two logits of a discriminator


@dataclass(frozen=True)
class RatioConfig(checks.Checked):
    """The structure of the two discriminators.

    obs_dim, act_dim: sizes of what they read.
    network: body of both. bound: logits are bound * tanh, so that |log w| <= 2 bound; a logit can never say "surely".
    noise: std of what is added to s, a and s' while they train, and never else, in units of what the networks read.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=two_layers)
    bound: checks.Positive = 2.0
    noise: checks.NotNegative = 0.1


class RatioState(NamedTuple):
    """The discriminators in training.

    joint: reads (s, a, s'); pair: reads (s, a). normalizer: of the observations that both read. Raw velocities are far
    larger than angles: set it to the statistics of the data to standardise, or leave it as it is.
    """

    joint: optim.Fit
    pair: optim.Fit
    normalizer: Normalizer


# --- one transition -----------------------------------------------------------------------------------------------


def difference(joint: Array, pair: Array) -> Array:
    """The difference [] of log p(real|.) / p(sim|.) given (s, a, s') and given (s, a): log P / P_sim.

    joint, pair: [2] logits given (s, a, s') and given (s, a). Source: H2O+ Eq. (9).
    """
    chex.assert_shape([joint, pair], (2,))
    return (joint[REAL] - joint[SIM]) - (pair[REAL] - pair[SIM])


def weight(log_ratio: Array) -> Array:
    """min(w, 1) [], a constant for gradients. log_ratio: []. Source: H2O+ Eq. (8), the cap of the authors' code."""
    return jax.lax.stop_gradient(jnp.exp(jnp.minimum(log_ratio, 0.0)))


def domain_loss(joint: Array, pair: Array, is_sim: Array) -> Array:
    """Cross-entropy [] of both discriminators. joint, pair: [2] logits, not probabilities; is_sim: [] bool."""
    chex.assert_shape([joint, pair], (2,))
    label = jnp.where(is_sim, SIM, REAL)
    return -(jax.nn.log_softmax(joint)[label] + jax.nn.log_softmax(pair)[label])


# --- the discriminators -------------------------------------------------------------------------------------------


def make_discriminator(inputs: int, config: NetworkConfig, *, bound: float) -> Network:
    """apply(params, *parts) -> [2] logits in (-bound, bound); the parts, joined, are [inputs]."""
    body = make_mlp(inputs, 2, config, layer_norm=config.layer_norm)
    return Network(body.init, lambda params, *parts: bound * jnp.tanh(body.apply(params, *parts)))


def _discriminators(config: RatioConfig) -> tuple[Network, Network]:
    """Of (s, a, s') and of (s, a)."""
    pair_dim = config.obs_dim + config.act_dim
    joint = make_discriminator(pair_dim + config.obs_dim, config.network, bound=config.bound)
    return joint, make_discriminator(pair_dim, config.network, bound=config.bound)


def _logits(config: RatioConfig, params: tuple[PyTree, PyTree], *row: Array) -> tuple[Array, Array]:
    """Of both, given what the networks read of a row. The joint ones build upon the pair's, as in the authors' code."""
    (joint, pair), (obs, action, next_obs) = _discriminators(config), row
    of_pair = pair.apply(params[1], obs, action)
    return joint.apply(params[0], obs, action, next_obs) + of_pair, of_pair


def init(config: RatioConfig, key: Key) -> RatioState:
    """Fresh discriminators, which read observations as they are until `normalizer` is set."""
    fits = (
        optim.start(optim.adam(), network.init(key))
        for network, key in zip(_discriminators(config), jax.random.split(key), strict=True)
    )
    return RatioState(*fits, normalizer=normalizer.identity(config.obs_dim))


def log_ratio(config: RatioConfig, state: RatioState, obs: Array, action: Array, next_obs: Array) -> Array:
    """Log P / P_sim [] of a transition, without noise. obs, next_obs: [obs_dim] raw; action: [act_dim]."""
    obs, next_obs = (normalizer.normalize(state.normalizer, x) for x in (obs, next_obs))
    return difference(*_logits(config, (state.joint.params, state.pair.params), obs, action, next_obs))


def update(
    config: RatioConfig, state: RatioState, batch: Batch, key: Key, *, rate: Array | float
) -> tuple[RatioState, Metrics]:
    """One Adam step of both on rows [B, ...] raw, of which `batch.is_sim` says which are the simulator's.

    Both domains count alike, however many rows there are of either. rate: [] learning rate.
    """
    keys = jax.random.split(key, batch.reward.shape[0])

    def row_loss(params: tuple[PyTree, PyTree], row: Batch, key: Key) -> Array:
        obs, next_obs = (normalizer.normalize(state.normalizer, x) for x in (row.obs, row.next_obs))
        noisy = _with_noise((obs, row.action, next_obs), key, config.noise)
        return domain_loss(*_logits(config, params, *noisy), losses.is_simulated(row))

    def loss(params: tuple[PyTree, PyTree]) -> Array:
        values = jax.vmap(row_loss, (None, 0, 0))(params, batch, keys)
        return losses.real_mean(values, batch) + losses.sim_mean(values, batch)

    value, grads = jax.value_and_grad(loss)((state.joint.params, state.pair.params))
    fits = (
        optim.step(optim.adam(), fit, grad, rate) for fit, grad in zip((state.joint, state.pair), grads, strict=True)
    )
    return RatioState(*fits, normalizer=state.normalizer), {"ratio/loss": value}


def log_ratios(config: RatioConfig, state: RatioState, batch: Batch) -> Array:
    """`log_ratio` of every row [B]."""
    return jax.vmap(partial(log_ratio, config, state))(batch.obs, batch.action, batch.next_obs)


def split_rows(batch: Batch, last: int | None) -> tuple[Batch, Batch]:
    """The rows that a learner learns from, and the `last` rows, for its discriminators; None = all rows for both."""
    if last is None:
        return batch, batch
    rows = batch.reward.shape[0]
    if last >= rows:
        raise UserError(f"option ratio-rows is {last}: must be less than the batch, {rows}")
    return jax.tree.map(lambda x: x[:-last], batch), jax.tree.map(lambda x: x[-last:], batch)


def step(
    config: RatioConfig, state: RatioState, batch: Batch, for_ratio: Batch, key: Key, *, rate: Array | float
) -> tuple[RatioState, Array, Metrics]:
    """Discriminators after a step on `for_ratio`, and log w [B] of the rows of `batch` by the new ones, a constant."""
    state, metrics = update(config, state, for_ratio, key, rate=rate)
    log_w = log_ratios(config, state, batch)
    for name, mean in (("real", losses.real_mean), ("sim", losses.sim_mean)):
        metrics[f"ratio/log_{name}"] = mean(log_w, batch)
        metrics[f"ratio/weight_{name}"] = mean(jax.vmap(weight)(log_w), batch)
    return state, jax.lax.stop_gradient(log_w), metrics


def _with_noise(parts: tuple[Array, ...], key: Key, std: float) -> tuple[Array, ...]:
    keys = jax.random.split(key, len(parts))
    return tuple(x + std * jax.random.normal(k, x.shape) for x, k in zip(parts, keys, strict=True))
