"""How much likelier a transition is in the real system than in the simulator, from two discriminators of their rows.

The ratio P / P_sim of the dynamics alone: what a discriminator of (s, a, s') sees, less what one of (s, a) sees.
Everything is in logarithms. Source: DARC (Eysenbach et al. 2021); H2O+ (Niu et al. 2023) Eq. (9), whose text names the
inverse, while Eq. (8) needs P / P_sim.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, cast

import chex
import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree, UserError
from sgft_jax import checks
from sgft_jax.math import losses, optim
from sgft_jax.models import normalizer
from sgft_jax.models.networks import MLP, Network, NetworkConfig
from sgft_jax.types import Batch, Metrics, Normalizer

__all__ = ["Ratio", "RatioConfig", "RatioState", "domain_loss", "log_ratio", "make_discriminator", "make_ratio"]
__all__ += ["split_rows", "step", "weight"]

REAL, SIM = 0, 1  # the two logits of a discriminator


@dataclass(frozen=True)
class RatioConfig:
    """The structure of the two discriminators.

    obs_dim, act_dim: sizes of what they read.
    network: body of both. bound: logits are bound * tanh, so that |log w| <= 2 bound; a logit can never say "surely".
    noise: std of what is added to s, a and s' while they train, and never else, in units of what the networks read.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=lambda: NetworkConfig((256, 256)))
    bound: float = 2.0
    noise: float = 0.1

    def __post_init__(self) -> None:
        checks.positive(self, "bound")
        checks.not_negative(self, "noise")


class RatioState(NamedTuple):
    """The discriminators in training.

    joint: reads (s, a, s'); pair: reads (s, a). normalizer: of the observations that both read. Raw velocities are far
    larger than angles: set it to the statistics of the data to standardise, or leave it as it is.
    """

    joint: optim.Fit
    pair: optim.Fit
    normalizer: Normalizer


class Ratio(NamedTuple):
    """Two discriminators as pure functions.

    init(key) -> RatioState.
    update(state, batch, key, *, rate) -> (state, metrics): one Adam step of both; `batch.is_sim` says which rows are
        the simulator's. Both domains count alike, however many rows each has.
    log_ratio(state, obs [obs_dim], action [act_dim], next_obs [obs_dim]) -> []: log P / P_sim, without noise.
    """

    init: Callable[[Key], RatioState]
    update: Callable[..., tuple[RatioState, Metrics]]
    log_ratio: Callable[[RatioState, Array, Array, Array], Array]


# --- one transition -----------------------------------------------------------------------------------------------


def log_ratio(joint: Array, pair: Array) -> Array:
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
    body = MLP(config.hidden, 2, config.layer_norm, config.activation)

    def apply(params: PyTree, *parts: Array) -> Array:
        return bound * jnp.tanh(cast(Array, body.apply({"params": params}, jnp.concatenate(parts))))

    return Network(lambda key: body.init(key, jnp.zeros(inputs))["params"], apply)


def make_ratio(config: RatioConfig) -> Ratio:
    """The discriminators of a configuration."""
    pair_dim = config.obs_dim + config.act_dim
    joint = make_discriminator(pair_dim + config.obs_dim, config.network, bound=config.bound)
    pair = make_discriminator(pair_dim, config.network, bound=config.bound)
    optimiser = optim.adam()

    def init(key: Key) -> RatioState:
        key_joint, key_pair = jax.random.split(key)
        fits = optim.start(optimiser, joint.init(key_joint)), optim.start(optimiser, pair.init(key_pair))
        return RatioState(*fits, normalizer=normalizer.identity(config.obs_dim))

    def logits(params: tuple[PyTree, PyTree], obs: Array, action: Array, next_obs: Array) -> tuple[Array, Array]:
        """Of both, given what the networks read. The joint ones build upon the pair's, as in the authors' code."""
        of_pair = pair.apply(params[1], obs, action)
        return joint.apply(params[0], obs, action, next_obs) + of_pair, of_pair

    def ratio_of(state: RatioState, obs: Array, action: Array, next_obs: Array) -> Array:
        obs, next_obs = (normalizer.normalize(state.normalizer, x) for x in (obs, next_obs))
        return log_ratio(*logits((state.joint.params, state.pair.params), obs, action, next_obs))

    def loss_of(params: tuple[PyTree, PyTree], statistics: Normalizer, row: Batch, key: Key) -> Array:
        obs, next_obs = (normalizer.normalize(statistics, x) for x in (row.obs, row.next_obs))
        noisy = _with_noise((obs, row.action, next_obs), key, config.noise)
        return domain_loss(*logits(params, *noisy), losses.is_simulated(row))

    def update(state: RatioState, batch: Batch, key: Key, *, rate: Array | float) -> tuple[RatioState, Metrics]:
        keys = jax.random.split(key, batch.reward.shape[0])

        def loss(params: tuple[PyTree, PyTree]) -> Array:
            each = jax.vmap(loss_of, (None, None, 0, 0))(params, state.normalizer, batch, keys)
            return losses.real_mean(each, batch) + losses.sim_mean(each, batch)

        value, grads = jax.value_and_grad(loss)((state.joint.params, state.pair.params))
        joint_fit, pair_fit = (
            optim.step(optimiser, fit, grad, rate) for fit, grad in zip((state.joint, state.pair), grads, strict=True)
        )
        return RatioState(joint_fit, pair_fit, state.normalizer), {"ratio/loss": value}

    return Ratio(init, update, ratio_of)


def split_rows(batch: Batch, last: int | None) -> tuple[Batch, Batch]:
    """The rows that a learner learns from, and the `last` rows, for its discriminators; None = all rows for both."""
    if last is None:
        return batch, batch
    rows = batch.reward.shape[0]
    if last >= rows:
        raise UserError(f"option ratio-rows is {last}: must be less than the batch, {rows}")
    return jax.tree.map(lambda x: x[:-last], batch), jax.tree.map(lambda x: x[-last:], batch)


def step(
    ratio: Ratio, state: RatioState, batch: Batch, for_ratio: Batch, key: Key, *, rate: Array | float
) -> tuple[RatioState, Array, Metrics]:
    """Discriminators after a step on `for_ratio`, and log w [B] of the rows of `batch` by the new ones, a constant."""
    state, metrics = ratio.update(state, for_ratio, key, rate=rate)
    log_w = jax.vmap(ratio.log_ratio, (None, 0, 0, 0))(state, batch.obs, batch.action, batch.next_obs)
    for name, mean in (("real", losses.real_mean), ("sim", losses.sim_mean)):
        metrics[f"ratio/log_{name}"] = mean(log_w, batch)
        metrics[f"ratio/weight_{name}"] = mean(jax.vmap(weight)(log_w), batch)
    return state, jax.lax.stop_gradient(log_w), metrics


def _with_noise(parts: tuple[Array, ...], key: Key, std: float) -> tuple[Array, ...]:
    keys = jax.random.split(key, len(parts))
    return tuple(x + std * jax.random.normal(k, x.shape) for x, k in zip(parts, keys, strict=True))
