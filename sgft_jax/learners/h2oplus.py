"""H2O+: one policy from a fixed set of real data and the rows that it collects in an imperfect simulator.

Both feed one critic. Its target mixes two bootstraps, the in-sample value of the real data and SAC's; simulated errors
weigh as much as the simulator's dynamics can be trusted there. The critic is a twin, or an ensemble whose members must
not agree on how to leave the real data, as in EDAC (An et al. 2021). Structure is static in `H2OPlusConfig`; every
number is a leaf of the state in `H2OPlusHyper`. Source: Niu et al. 2023 (H2O+), and where it is silent its released
code.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree, UserError, unknown
from sgft_jax import checks
from sgft_jax.learners import edac, iql, mixed, steps
from sgft_jax.learners.mixed import MixedConfig
from sgft_jax.learners.steps import Networks
from sgft_jax.math import losses, optim
from sgft_jax.models import normalizer, ratio
from sgft_jax.types import Batch, Learner, Metrics, Normalizer, ValueLoss

__all__ = ["H2OPlusConfig", "H2OPlusHyper", "H2OPlusState", "init", "make_h2oplus", "mixed_target", "update"]


@dataclass(frozen=True)
class H2OPlusConfig(MixedConfig):
    """The structure of an agent: that of `MixedConfig` and what follows.

    critics: members; targets and actor use the minimum of all.
    diversity: weight eta of what keeps the members' gradients apart at the real pairs; 0 = nothing does.
    value_loss: the backbone, which says what V is.
    ratio: weigh simulated errors by the ratio of the dynamics; False counts them like real ones.
    """

    critics: checks.Count = 2
    diversity: checks.NotNegative = 0.0
    value_loss: ValueLoss = "iql"
    ratio: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.diversity and self.critics < 2:
            raise checks.refusal("critics", self.critics, "at least 2, or diversity 0")
        if self.value_loss not in (known := get_args(ValueLoss)):
            raise UserError(unknown("value loss", self.value_loss, known))


class H2OPlusHyper(NamedTuple):
    """The numbers of an agent, each []. The defaults are the paper's, else those of IQL and the released code.

    lr_*: Adam learning rates. tau: target averaging rate.
    alpha: initial (or fixed) temperature; entropy_per_dim: target entropy / act_dim, nats.
    value_share: lambda, share of the bootstrap from V; 0 is SAC on both sources, 1 never asks the policy.
    expectile: of the value loss "iql". value_alpha: scale of the others, in units of return. value_cut: largest
    exponent of "eql" and "xql".
    """

    lr_actor: float | Array = 3e-4
    lr_critic: float | Array = 3e-4
    lr_value: float | Array = 3e-4
    lr_alpha: float | Array = 3e-4
    lr_ratio: float | Array = 3e-4
    tau: float | Array = 0.005
    alpha: float | Array = 1.0
    entropy_per_dim: float | Array = -1.0
    value_share: float | Array = 0.1
    expectile: float | Array = 0.7
    value_alpha: float | Array = 1.0
    value_cut: float | Array = 5.0


class H2OPlusState(struct.PyTreeNode):
    """An agent in training. step: [] int32 updates done.

    normalizer: of the observations that actor, critic and value read. ratio: a `RatioState` with a normaliser of its
    own, None where the ratio is off. Both leave observations as they are until they are set.
    """

    actor: optim.Fit
    critic: optim.Fit
    target_critic: PyTree
    value: optim.Fit
    log_alpha: optim.Fit
    ratio: PyTree
    normalizer: Normalizer
    hyper: H2OPlusHyper
    step: Array


def mixed_target(
    reward: Array,
    discount: Array,
    next_value: Array,
    next_q: Array,
    next_log_prob: Array,
    *,
    value_share: Array | float,
    alpha: Array | float,
) -> Array:
    """A share lambda of r + discount V(s'), the rest of r + discount (min_i Q_i(s', a') - alpha log pi(a'|s')).

    next_q: [members]; all others []. A constant for gradients. The discount is gamma (1 - terminated).
    Source: H2O+ Eq. (7).
    """
    in_sample = iql.td_target(reward, discount, next_value, reward_scale=1.0)
    online = losses.td_target(reward, discount, next_q, next_log_prob, alpha=alpha)
    return value_share * in_sample + (1 - value_share) * online


# --- the learner ------------------------------------------------------------------------------------------------------


def init(config: H2OPlusConfig, key: Key, hyper: Any = None) -> H2OPlusState:
    """A fresh agent. Set the observation statistics with `state.replace(normalizer=...)`."""
    nets, numbers, keys = mixed.make_networks(config), optim.as_leaves(H2OPlusHyper, hyper), jax.random.split(key, 4)
    return H2OPlusState(
        **steps.begin(nets, keys[0], keys[1]),
        value=optim.start(nets.optimiser, nets.value.init(keys[2])),
        log_alpha=optim.start(nets.optimiser, jnp.log(numbers.alpha)),
        ratio=ratio.init(nets.ratio, keys[3]) if config.ratio else None,
        hyper=numbers,
    )


act = mixed.act


def update(config: H2OPlusConfig, state: H2OPlusState, batch: Batch, key: Key) -> tuple[H2OPlusState, Metrics]:
    """Discriminators first. All other losses are those of the networks before the update. Source: the released code.

    batch: [B, ...] raw, which says which rows are simulated (`Batch.is_sim`). metrics: [] each.
    """
    batch, for_ratio = ratio.split_rows(batch, config.ratio_rows)
    nets, hyper = mixed.make_networks(config), state.hyper
    key_ratio, key_actor, key_target = jax.random.split(key, 3)
    weights, metrics = jnp.ones_like(batch.reward), {}
    if config.ratio:
        fit, log_w, metrics = ratio.step(nets.ratio, state.ratio, batch, for_ratio, key_ratio, rate=hyper.lr_ratio)
        state, weights = state.replace(ratio=fit), jax.vmap(ratio.weight)(log_w)
    batch = normalizer.normalize_rows(state.normalizer, batch)

    actor, log_alpha, of_actor = mixed.step_policy(nets, state, batch, key_actor)
    value, of_value = _step_value(nets, state, batch)
    critic, of_critic = _step_critic(nets, state, batch, weights, key_target)
    target = optax.incremental_update(critic.params, state.target_critic, hyper.tau)
    state = state.replace(
        actor=actor, log_alpha=log_alpha, value=value, critic=critic, target_critic=target, step=state.step + 1
    )
    return state, metrics | of_actor | of_value | of_critic


def make_h2oplus(config: H2OPlusConfig, hyper: Any = None) -> Learner:
    """The functions of this module for one configuration."""
    return Learner(partial(init, config, hyper=hyper), lambda: (), partial(act, config), partial(update, config))


# --- one update -------------------------------------------------------------------------------------------------------


def _step_value(nets: Networks, state: H2OPlusState, batch: Batch) -> tuple[optim.Fit, Metrics]:
    """V after a step on the real rows alone, against the minimum of the target critics. Source: H2O+ Eq. (4)."""
    q, hyper, counted = steps.lowest_target(nets, state, batch), state.hyper, losses.real_rows(batch)
    numbers = {"expectile": hyper.expectile, "alpha": hyper.value_alpha, "cut": hyper.value_cut}

    def row_losses(values: Array) -> Array:
        return losses.in_sample_loss(nets.config.value_loss, values, q, counted, **numbers)

    return steps.step_value(nets, state, batch, row_losses, losses.real_mean)


def _step_critic(
    nets: Networks, state: H2OPlusState, batch: Batch, weights: Array, key: Key
) -> tuple[optim.Fit, Metrics]:
    """The critics after a step on real and weighted simulated errors, a mean of each. Source: H2O+ Eqs. (7), (8)."""
    hyper, alpha, diversity = state.hyper, jnp.exp(state.log_alpha.params), nets.config.diversity

    def target(row: Batch, key: Key) -> Array:
        action, log_prob = steps.sample(nets, state, row.next_obs, key)
        next_q = nets.critic.apply(state.target_critic, row.next_obs, action)
        next_value = nets.value.apply(state.value.params, row.next_obs)
        return mixed_target(
            row.reward, row.discount, next_value, next_q, log_prob, value_share=hyper.value_share, alpha=alpha
        )

    def crowding(params: PyTree, q: Array) -> Array:
        del q  # it looks at gradients alone
        real = batch._replace(valid=losses.real_rows(batch))  # the policy itself tries what lies beside simulated pairs
        return diversity * edac.mean_alignment(nets.critic.apply, params, real)

    targets = jax.vmap(target)(batch, jax.random.split(key, batch.reward.shape[0]))
    penalty = crowding if diversity else None
    return mixed.step_critic(nets, state, batch, targets, weights, penalty=penalty)
