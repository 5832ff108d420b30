"""H2O: one critic from a fixed set of real data and simulated rows, pushed down where the simulator is wrong.

The critic falls on simulated pairs (s, a), the more the further the simulator's dynamics are from the real ones there,
and rises on real ones. Structure is static in `H2OConfig`; every number is a leaf of the state in `H2OHyper`.
Source: Niu et al. 2022 (H2O), H2O+ Eq. (1), and the released code.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.learners import soft
from sgft_jax.math import losses, optim
from sgft_jax.models import normalizer, ratio
from sgft_jax.models.config import NetworkConfig, two_layers
from sgft_jax.models.networks import (
    Network,
    make_affine_actor,
    make_critic,
    tanh_gaussian_sample,
)
from sgft_jax.types import Batch, Learner, Metrics, Normalizer

GAP_MIN = 1e-6  # a pair that looks more real than simulated is not pushed; 1e-45, as published, may flush to 0 / 0
PENALTY_MAX = 1000.0


@dataclass(frozen=True)
class H2OConfig:
    """The structure of an agent.

    obs_dim, act_dim: sizes of what the environment gives and takes.
    network: body of actor and critics; ratio_network: of the discriminators. ratio_noise: std of their training noise.
    ratio_rows: the last so many rows of a batch train the discriminators and nothing else; None = all rows train all.
    successors: noisy copies of s' over which the gap of the dynamics at (s, a) is averaged.
    tune_alpha: follow the target entropy; False keeps the temperature at `H2OHyper.alpha`.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=two_layers)
    ratio_network: NetworkConfig = field(default_factory=two_layers)
    ratio_noise: float = 0.1
    ratio_rows: int | None = None
    successors: int = 10
    tune_alpha: bool = True

    def __post_init__(self) -> None:
        checks.at_least(self, 1, "ratio_rows", "successors")


class H2OHyper(NamedTuple):
    """The numbers of an agent, each []. The defaults are the paper's.

    lr_*: Adam learning rates. tau: target averaging rate.
    alpha: initial (or fixed) temperature; entropy_per_dim: target entropy / act_dim, nats.
    conservatism: weight of the penalty, in units of return.
    spread_scale: factor on `H2OState.spread`.
    """

    lr_actor: float | Array = 3e-4
    lr_critic: float | Array = 3e-4
    lr_alpha: float | Array = 3e-4
    lr_ratio: float | Array = 3e-4
    tau: float | Array = 0.005
    alpha: float | Array = 1.0
    entropy_per_dim: float | Array = -1.0
    conservatism: float | Array = 0.01
    spread_scale: float | Array = 1.0


class H2OState(struct.PyTreeNode):
    """An agent in training. step: [] int32 updates done.

    spread: [obs_dim] std of the noise on s', raw units; 0 until it is set, e.g. to `replay.obs_std`.
    normalizer: of the observations that actor and critic read; the one of `ratio` is its own. Both leave observations
    as they are until they are set.
    """

    actor: optim.Fit
    critic: optim.Fit
    target_critic: PyTree
    log_alpha: optim.Fit
    ratio: ratio.RatioState
    spread: Array
    normalizer: Normalizer
    hyper: H2OHyper
    step: Array


class _Parts(NamedTuple):
    """The networks and the optimiser that a configuration describes."""

    actor: Network
    critic: Network
    ratio: ratio.Ratio
    optimiser: optax.GradientTransformation


# --- the penalty ------------------------------------------------------------------------------------------------------


def log_shares(gaps: Array, batch: Batch) -> Array:
    """Logarithm [B] of how much of the push down each pair gets; together the simulated rows get 1, real ones nothing.

    gaps: [B] estimated KL(P_sim || P) at (s, a), nats. Those that are not positive get next to nothing; if none is, all
    get the same.
    """
    chex.assert_rank(gaps, 1)
    logs = jnp.log(jnp.maximum(gaps, GAP_MIN))
    if batch.weight is not None:
        logs += jnp.log(batch.weight)
    return jax.nn.log_softmax(jnp.where(losses.sim_rows(batch), logs, -1e30))


def penalty(q: Array, shares: Array, batch: Batch) -> Array:
    """Sum [] over members of log sum_B omega exp Q - E_D Q, each within +-1000. q: [B, members]; shares: [B] logs.

    Source: H2O+ Eq. (1).
    """
    chex.assert_rank([q, shares], [2, 1])

    def one(q: Array) -> Array:
        difference = jax.nn.logsumexp(shares + q) - losses.real_mean(q, batch)
        return jnp.clip(difference, -PENALTY_MAX, PENALTY_MAX)

    return jnp.sum(jax.vmap(one, 1)(q))


# --- the learner ------------------------------------------------------------------------------------------------------


def make_h2o(config: H2OConfig, hyper: H2OHyper | None = None) -> Learner:
    """The learner of a configuration. Its batches must say which rows are simulated; set `H2OState.spread`."""
    sizes, body = (config.obs_dim, config.act_dim), config.network
    parts = _Parts(
        actor=make_affine_actor(*sizes, body, output_gain=soft.OUTPUT_GAIN),
        critic=make_critic(*sizes, body, output_gain=soft.OUTPUT_GAIN),
        ratio=ratio.make_ratio(ratio.RatioConfig(*sizes, config.ratio_network, noise=config.ratio_noise)),
        optimiser=optim.adam(),
    )
    leaves = hyper or H2OHyper()

    def init(key: Key) -> H2OState:
        keys = jax.random.split(key, 3)
        critic = parts.critic.init(keys[1])
        numbers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), leaves)
        return H2OState(
            actor=optim.start(parts.optimiser, parts.actor.init(keys[0])),
            critic=optim.start(parts.optimiser, critic),
            target_critic=jax.tree.map(jnp.copy, critic),  # its own buffers: a donated state must not hold one twice
            log_alpha=optim.start(parts.optimiser, jnp.log(numbers.alpha)),
            ratio=parts.ratio.init(keys[2]),
            spread=jnp.zeros(config.obs_dim),
            normalizer=normalizer.identity(config.obs_dim),
            hyper=numbers,
            step=jnp.int32(0),
        )

    def update(state: H2OState, batch: Batch, key: Key) -> tuple[H2OState, Metrics]:
        return _update(config, parts, state, batch, key)

    return Learner(init, lambda: (), soft.make_act(parts.actor), update)


# --- one update -------------------------------------------------------------------------------------------------------


def _update(config: H2OConfig, parts: _Parts, state: H2OState, batch: Batch, key: Key) -> tuple[H2OState, Metrics]:
    """Discriminators first. All other losses are those of the networks before the update. Source: the released code."""
    key_ratio, key_gap, key_actor, key_target = jax.random.split(key, 4)
    batch, for_ratio = ratio.split_rows(batch, config.ratio_rows)
    fit, log_w, metrics = ratio.step(parts.ratio, state.ratio, batch, for_ratio, key_ratio, rate=state.hyper.lr_ratio)
    state = state.replace(ratio=fit)
    gaps = _gaps(config, parts, state, batch, key_gap)
    shares, weights = log_shares(gaps, batch), jax.vmap(ratio.weight)(log_w)
    normal = jax.vmap(normalizer.normalize, (None, 0))
    batch = batch._replace(obs=normal(state.normalizer, batch.obs), next_obs=normal(state.normalizer, batch.next_obs))

    target_entropy = state.hyper.entropy_per_dim * config.act_dim if config.tune_alpha else None
    actor, log_alpha, of_actor = soft.step_policy(
        parts.actor, parts.critic, parts.optimiser, state, batch, key_actor, target_entropy=target_entropy
    )
    critic, of_critic = soft.step_critic(
        parts.critic, parts.optimiser, state, batch, _targets(parts, state, batch, key_target), weights,
        penalty=lambda params, q: state.hyper.conservatism * penalty(q, shares, batch),
    )  # fmt: skip
    target = optax.incremental_update(critic.params, state.target_critic, state.hyper.tau)
    metrics |= of_actor | of_critic | {"ratio/gap_sim": losses.sim_mean(gaps, batch)}
    state = state.replace(actor=actor, log_alpha=log_alpha, critic=critic, target_critic=target, step=state.step + 1)
    return state, metrics


def _gaps(config: H2OConfig, parts: _Parts, state: H2OState, batch: Batch, key: Key) -> Array:
    """KL(P_sim || P) at every pair [B], nats: the mean of log P_sim / P over noisy copies of its successor."""
    std = state.hyper.spread_scale * state.spread

    def one(row: Batch, key: Key) -> Array:
        noise = jax.random.normal(key, (config.successors, config.obs_dim))
        following = jax.vmap(lambda n: row.next_obs + std * n)(noise)
        log_w = jax.vmap(parts.ratio.log_ratio, (None, None, None, 0))(state.ratio, row.obs, row.action, following)
        return -jnp.mean(log_w)

    return jax.lax.stop_gradient(jax.vmap(one)(batch, jax.random.split(key, batch.reward.shape[0])))


def _targets(parts: _Parts, state: H2OState, batch: Batch, key: Key) -> Array:
    """Targets r + discount min_i Q_i(s', a') [B], without the entropy."""

    def one(row: Batch, key: Key) -> Array:
        action, log_prob = tanh_gaussian_sample(parts.actor.apply(state.actor.params, row.next_obs), key)
        next_q = parts.critic.apply(state.target_critic, row.next_obs, action)
        return losses.td_target(row.reward, row.discount, next_q, log_prob, alpha=0.0)

    return jax.vmap(one)(batch, jax.random.split(key, batch.reward.shape[0]))
