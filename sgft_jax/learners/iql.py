"""Implicit Q-learning: the best of the data's own actions, without ever asking what another action is worth.

The same update serves the offline phase, on simulator data, and fine-tuning, where real transitions join the buffer: a
state is simply carried over. Structure is static in `IQLConfig`; every number is a leaf of the state in `IQLHyper`, so
that expectiles and learning rates vmap like seeds do. Source: Kostrikov et al. 2021.
"""

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree
from sgft_jax.learners import steps
from sgft_jax.learners.steps import Networks
from sgft_jax.math import losses, optim
from sgft_jax.models import networks, normalizer
from sgft_jax.models.networks import Network, NetworkConfig
from sgft_jax.types import Batch, Learner, Metrics, Normalizer

__all__ = ["IQLConfig", "IQLHyper", "IQLState", "act", "advantage_weight", "as_tanh_gaussian", "gaussian_action"]
__all__ += ["gaussian_log_prob", "init", "make_gaussian_actor", "make_iql", "policy_loss", "td_target", "update"]

ACTION_MAX = 1 - 1e-5  # a mean that ends in tanh never reaches 1: it would chase such an action forever


@dataclass(frozen=True)
class IQLConfig:
    """The structure of an agent.

    obs_dim, act_dim: sizes of what the environment gives and takes.
    network: body of all networks. The paper's is 256 x 2; the default is the one that other methods use here.
    max_grad_norm: per network, None = no clipping.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=NetworkConfig)
    max_grad_norm: float | None = None


class IQLHyper(NamedTuple):
    """The numbers of an agent, each []. The defaults are the paper's for locomotion.

    lr_*: Adam learning rates. tau: target averaging rate.
    expectile: in [0.5, 1); V is the mean of the data's actions at 0.5 and their best towards 1.
    beta: inverse temperature of the advantage weights, 1 / scaled return; 0 clones the data.
    max_weight: cap of these weights.
    reward_scale: factor on every reward. beta and the cap mean something only where returns span about 1.
    actor_updates: updates over which lr_actor falls to 0 along a cosine; inf = it stays as it is.
    """

    lr_actor: float | Array = 3e-4
    lr_critic: float | Array = 3e-4
    lr_value: float | Array = 3e-4
    tau: float | Array = 0.005
    expectile: float | Array = 0.7
    beta: float | Array = 3.0
    max_weight: float | Array = 100.0
    reward_scale: float | Array = 1.0
    actor_updates: float | Array = math.inf


class IQLState(struct.PyTreeNode):
    """An agent in training. step: [] int32 updates done."""

    actor: optim.Fit
    critic: optim.Fit
    target_critic: PyTree
    value: optim.Fit
    normalizer: Normalizer
    hyper: IQLHyper
    step: Array


# --- the policy -------------------------------------------------------------------------------------------------------


def make_gaussian_actor(obs_dim: int, act_dim: int, config: NetworkConfig) -> Network:
    """apply(params, obs [obs_dim]) -> [2, act_dim]: mean in (-1, 1) and log standard deviation, the same everywhere.

    tanh bounds the mean alone, not what is drawn around it.
    """
    body = networks.make_mlp(obs_dim, act_dim, config, layer_norm=config.actor_layer_norm)

    def init(key: Key) -> PyTree:
        return {"mean": body.init(key), "log_std": jnp.zeros(act_dim)}

    def apply(params: PyTree, obs: Array) -> Array:
        return jnp.stack([jnp.tanh(body.apply(params["mean"], obs)), params["log_std"]])

    return Network(init, apply)


def as_tanh_gaussian(params: PyTree) -> PyTree:
    """Parameters of an actor of `make_actor` with the same mean action and, before the tanh, the same spread."""
    mean, log_std = params["mean"], params["log_std"]
    last = max(mean, key=lambda name: (name.startswith("Dense"), name))
    kernel, bias = mean[last]["kernel"], mean[last]["bias"]
    wide = jnp.concatenate([kernel, jnp.zeros_like(kernel)], axis=1)
    return {**mean, last: {"kernel": wide, "bias": jnp.concatenate([bias, log_std])}}


def gaussian_log_prob(moments: Array, action: Array) -> Array:
    """Log density [] of a diagonal Gaussian. moments: [2, act_dim] mean and log-std; action: [act_dim]."""
    mean, log_std = moments
    return jnp.sum(-0.5 * ((action - mean) * jnp.exp(-log_std)) ** 2 - log_std - 0.5 * jnp.log(2 * jnp.pi))


def gaussian_action(moments: Array, key: Key, *, explore: bool | Array) -> Array:
    """[act_dim] in [-1, 1]: a draw, clipped, to explore, else the mean. moments: [2, act_dim] mean and log-std."""
    mean, log_std = moments
    return jnp.where(explore, networks.add_noise(mean, jnp.exp(log_std), key), mean)


# --- losses of one transition -----------------------------------------------------------------------------------------


def advantage_weight(value: Array, q: Array, *, beta: Array | float, max_weight: Array | float) -> Array:
    """How much the policy should imitate a data action: min(exp(beta (Q - V)), max_weight). value, q: [], constants.

    Source: Kostrikov et al. 2021, after advantage-weighted regression (Peng et al. 2019).
    """
    chex.assert_rank([value, q], 0)
    return jax.lax.stop_gradient(jnp.minimum(jnp.exp(beta * (q - value)), max_weight))


def policy_loss(moments: Array, action: Array, weight: Array) -> Array:
    """-weight log pi(a|s). moments: [2, act_dim]; action: [act_dim] of the data, pulled off the bounds; weight: []."""
    chex.assert_rank([moments, action, weight], [2, 1, 0])
    return -weight * gaussian_log_prob(moments, jnp.clip(action, -ACTION_MAX, ACTION_MAX))


def td_target(reward: Array, discount: Array, next_value: Array, *, reward_scale: Array | float) -> Array:
    """reward_scale r + discount V(s'), a constant for gradients. All []; the discount is gamma (1 - terminated)."""
    chex.assert_rank([reward, discount, next_value], 0)
    chex.assert_type([reward, discount, next_value], float)
    return jax.lax.stop_gradient(reward_scale * reward + discount * next_value)


# --- the learner ------------------------------------------------------------------------------------------------------


def _networks(config: IQLConfig) -> Networks:
    sizes, optimiser = (config.obs_dim, config.act_dim, config.network), optim.adam(config.max_grad_norm)
    value = networks.make_value(config.obs_dim, config.network)
    return Networks(config, make_gaussian_actor(*sizes), networks.make_critic(*sizes), optimiser, value)


def init(config: IQLConfig, key: Key, hyper: Any = None) -> IQLState:
    """A fresh agent. Set the observation statistics with `state.replace(normalizer=...)`.

    New numbers, set with `state.replace(hyper=...)`, must be float32 arrays like the old ones, or the update is
    compiled again.
    """
    nets, (key_actor, key_critic, key_value) = _networks(config), jax.random.split(key, 3)
    value = optim.start(nets.optimiser, nets.value.init(key_value))
    numbers = optim.as_leaves(IQLHyper, hyper)
    return IQLState(**steps.begin(nets, key_actor, key_critic), value=value, hyper=numbers)


def act(
    config: IQLConfig, state: IQLState, carry: tuple[()], obs: Array, key: Key, *, explore: bool | Array
) -> tuple[Array, tuple[()]]:
    """Action [act_dim] in [-1, 1] for a raw obs [obs_dim], and the carry as it was."""
    moments = _networks(config).actor.apply(state.actor.params, normalizer.normalize(state.normalizer, obs))
    return gaussian_action(moments, key, explore=explore), carry


def update(config: IQLConfig, state: IQLState, batch: Batch, key: Key) -> tuple[IQLState, Metrics]:
    """One step of value, then of actor and critic, which both use the new value, then of the target critic.

    batch: [B, ...] raw. metrics: [] each. Draws nothing: the key is there because other learners need one.
    """
    del key
    nets, batch = _networks(config), normalizer.normalize_rows(state.normalizer, batch)
    q = steps.lowest_target(nets, state, batch)
    row_loss = partial(losses.expectile_loss, expectile=state.hyper.expectile)
    value, of_value = steps.step_value(nets, state, batch, lambda values: jax.vmap(row_loss)(values, q))
    state, of_actor = _update_actor(nets, state.replace(value=value), batch, q)
    state, of_critic = _update_critic(nets, state, batch)
    target = optax.incremental_update(state.critic.params, state.target_critic, state.hyper.tau)
    return state.replace(target_critic=target, step=state.step + 1), of_value | of_actor | of_critic


def make_iql(config: IQLConfig, hyper: Any = None) -> Learner:
    """The functions of this module for one configuration."""
    return Learner(partial(init, config, hyper=hyper), lambda: (), partial(act, config), partial(update, config))


# --- one update -------------------------------------------------------------------------------------------------------


def _update_actor(nets: Networks, state: IQLState, batch: Batch, q: Array) -> tuple[IQLState, Metrics]:
    """q: [B] of the target critic, as the value saw them."""
    hyper = state.hyper
    values = jax.vmap(nets.value.apply, (None, 0))(state.value.params, batch.obs)
    weights = jax.vmap(partial(advantage_weight, beta=hyper.beta, max_weight=hyper.max_weight))(values, q)

    def loss(params: PyTree) -> tuple[Array, tuple[()]]:
        moments = jax.vmap(nets.actor.apply, (None, 0))(params, batch.obs)
        return losses.row_mean(jax.vmap(policy_loss)(moments, batch.action, weights), batch), ()

    rate = hyper.lr_actor * optim.cosine_factor(state.step, hyper.actor_updates)
    fit, mean, _ = optim.minimise(nets.optimiser, loss, state.actor, rate)
    # The parameter itself is kept in bounds: a bound in `apply` has no gradient beyond it, and would hold it for ever.
    log_std = jnp.clip(fit.params["log_std"], networks.LOG_STD_MIN, networks.LOG_STD_MAX)
    metrics = {
        "actor/loss": mean,
        "actor/lr": rate,
        "actor/advantage_mean": jnp.mean(q - values),
        "actor/weight_saturated_share": jnp.mean(weights >= hyper.max_weight),
        "actor/std_mean": jnp.mean(jnp.exp(log_std)),
    }
    return state.replace(actor=fit._replace(params={**fit.params, "log_std": log_std})), metrics


def _update_critic(nets: Networks, state: IQLState, batch: Batch) -> tuple[IQLState, Metrics]:
    next_values = jax.vmap(nets.value.apply, (None, 0))(state.value.params, batch.next_obs)
    target = partial(td_target, reward_scale=state.hyper.reward_scale)
    targets = jax.vmap(target)(batch.reward, batch.discount, next_values)
    fit, metrics = steps.step_critic(nets, state, batch, targets, rate=state.hyper.lr_critic)
    return state.replace(critic=fit), metrics
