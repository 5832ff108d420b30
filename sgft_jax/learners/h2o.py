"""H2O: one critic from a fixed set of real data and simulated rows, pushed down where the simulator is wrong.

The critic falls on simulated pairs (s, a), the more the further the simulator's dynamics are from the real ones there,
and rises on real ones. Structure is static in `H2OConfig`; every number is a leaf of the state in `H2OHyper`.
Source: Niu et al. 2022 (H2O), H2O+ Eq. (1), and the released code.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.learners import mixed, steps
from sgft_jax.learners.mixed import MixedConfig
from sgft_jax.learners.steps import Networks
from sgft_jax.math import losses, optim
from sgft_jax.models import normalizer, ratio
from sgft_jax.types import Batch, Learner, Metrics, Normalizer

__all__ = ["H2OConfig", "H2OHyper", "H2OState", "init", "log_shares", "make_h2o", "penalty", "update"]

GAP_MIN = 1e-6  # a pair that looks more real than simulated is not pushed; 1e-45, as published, may flush to 0 / 0
PENALTY_MAX = 1000.0


@dataclass(frozen=True)
class H2OConfig(MixedConfig):
    """The structure of an agent: that of `MixedConfig` and a number.

    successors: noisy copies of s' over which the gap of the dynamics at (s, a) is averaged.
    """

    successors: checks.Count = 10


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

    def of_member(q: Array) -> Array:
        difference = jax.nn.logsumexp(shares + q) - losses.real_mean(q, batch)
        return jnp.clip(difference, -PENALTY_MAX, PENALTY_MAX)

    return jnp.sum(jax.vmap(of_member, 1)(q))


# --- the learner ------------------------------------------------------------------------------------------------------


def init(config: H2OConfig, key: Key, hyper: Any = None) -> H2OState:
    """A fresh agent. Set `H2OState.spread`, and the observation statistics with `state.replace(normalizer=...)`."""
    nets, numbers, keys = mixed.make_networks(config), optim.as_leaves(H2OHyper, hyper), jax.random.split(key, 3)
    return H2OState(
        **steps.begin(nets, keys[0], keys[1]),
        log_alpha=optim.start(nets.optimiser, jnp.log(numbers.alpha)),
        ratio=ratio.init(nets.ratio, keys[2]),
        spread=jnp.zeros(config.obs_dim),
        hyper=numbers,
    )


act = mixed.act


def update(config: H2OConfig, state: H2OState, batch: Batch, key: Key) -> tuple[H2OState, Metrics]:
    """Discriminators first. All other losses are those of the networks before the update. Source: the released code.

    batch: [B, ...] raw, which says which rows are simulated (`Batch.is_sim`). metrics: [] each.
    """
    batch, for_ratio = ratio.split_rows(batch, config.ratio_rows)
    nets, hyper = mixed.make_networks(config), state.hyper
    key_ratio, key_gap, key_actor, key_target = jax.random.split(key, 4)
    fit, log_w, metrics = ratio.step(nets.ratio, state.ratio, batch, for_ratio, key_ratio, rate=hyper.lr_ratio)
    state = state.replace(ratio=fit)
    gaps = _gaps(nets, state, batch, key_gap)
    shares, weights = log_shares(gaps, batch), jax.vmap(ratio.weight)(log_w)
    batch = normalizer.normalize_rows(state.normalizer, batch)

    def push_down(params: PyTree, q: Array) -> Array:
        del params
        return hyper.conservatism * penalty(q, shares, batch)

    actor, log_alpha, of_actor = mixed.step_policy(nets, state, batch, key_actor)
    targets = steps.soft_targets(nets, state, batch, key_target, alpha=0.0)  # without the entropy
    critic, of_critic = mixed.step_critic(nets, state, batch, targets, weights, penalty=push_down)
    target = optax.incremental_update(critic.params, state.target_critic, hyper.tau)
    metrics |= of_actor | of_critic | {"ratio/gap_sim": losses.sim_mean(gaps, batch)}
    state = state.replace(actor=actor, log_alpha=log_alpha, critic=critic, target_critic=target, step=state.step + 1)
    return state, metrics


def make_h2o(config: H2OConfig, hyper: Any = None) -> Learner:
    """The functions of this module for one configuration."""
    return Learner(partial(init, config, hyper=hyper), lambda: (), partial(act, config), partial(update, config))


def _gaps(nets: Networks, state: H2OState, batch: Batch, key: Key) -> Array:
    """KL(P_sim || P) at every pair [B], nats: the mean of log P_sim / P over noisy copies of its successor."""
    std, log_ratio = state.hyper.spread_scale * state.spread, partial(ratio.log_ratio, nets.ratio, state.ratio)

    def gap(row: Batch, key: Key) -> Array:
        noise = jax.random.normal(key, (nets.config.successors, nets.config.obs_dim))
        successors = jax.vmap(lambda n: row.next_obs + std * n)(noise)
        return -jnp.mean(jax.vmap(log_ratio, (None, None, 0))(row.obs, row.action, successors))

    return jax.lax.stop_gradient(jax.vmap(gap)(batch, jax.random.split(key, batch.reward.shape[0])))
