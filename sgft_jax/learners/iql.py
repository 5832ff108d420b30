"""Implicit Q-learning: the best of the data's own actions, without ever asking what another action is worth.

The same update serves the offline phase, on simulator data, and fine-tuning, where real transitions join the buffer: a
state is simply carried over. Structure is static in `IQLConfig`; every number is a leaf of the state in `IQLHyper`, so
that expectiles and learning rates vmap like seeds do. Source: Kostrikov et al. 2021.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree
from sgft_jax.math import losses, optim, value_losses
from sgft_jax.models import normalizer
from sgft_jax.models.networks import (
    LOG_STD_MAX,
    LOG_STD_MIN,
    MLP,
    Network,
    NetworkConfig,
    add_noise,
    make_critic,
    make_value,
)
from sgft_jax.types import Batch, Learner, Metrics, Normalizer

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
    body = MLP(config.hidden, act_dim, config.actor_layer_norm, config.activation)

    def init(key: Key) -> PyTree:
        return {"mean": body.init(key, jnp.zeros(obs_dim))["params"], "log_std": jnp.zeros(act_dim)}

    def apply(params: PyTree, obs: Array) -> Array:
        mean = cast(Array, body.apply({"params": params["mean"]}, obs))
        return jnp.stack([jnp.tanh(mean), params["log_std"]])

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
    return jnp.where(explore, add_noise(mean, jnp.exp(log_std), key), mean)


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


class _Parts(NamedTuple):
    """The networks and the optimiser that a configuration describes."""

    actor: Network
    critic: Network
    value: Network
    optimiser: optax.GradientTransformation


def make_iql(config: IQLConfig, hyper: IQLHyper | None = None) -> Learner:
    """The learner of a configuration. Set the observation statistics with `state.replace(normalizer=...)`.

    New numbers, set with `state.replace(hyper=...)`, must be float32 arrays like the old ones, or the update is
    compiled again.
    """
    sizes, body = (config.obs_dim, config.act_dim), config.network
    parts = _Parts(
        actor=make_gaussian_actor(*sizes, body),
        critic=make_critic(*sizes, body),
        value=make_value(config.obs_dim, body),
        optimiser=optim.adam(config.max_grad_norm),
    )
    leaves = hyper or IQLHyper()

    def init(key: Key) -> IQLState:
        keys = jax.random.split(key, 3)
        critic = parts.critic.init(keys[1])
        return IQLState(
            actor=optim.start(parts.optimiser, parts.actor.init(keys[0])),
            critic=optim.start(parts.optimiser, critic),
            target_critic=jax.tree.map(jnp.copy, critic),  # its own buffers: a donated state must not hold one twice
            value=optim.start(parts.optimiser, parts.value.init(keys[2])),
            normalizer=normalizer.identity(config.obs_dim),
            hyper=jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), leaves),
            step=jnp.int32(0),
        )

    def act(
        state: IQLState, carry: tuple[()], obs: Array, key: Key, *, explore: bool | Array, context: Array | None = None
    ) -> tuple[Array, tuple[()]]:
        del context  # it reads the observation alone
        moments = parts.actor.apply(state.actor.params, normalizer.normalize(state.normalizer, obs))
        return gaussian_action(moments, key, explore=explore), carry

    def update(state: IQLState, batch: Batch, key: Key) -> tuple[IQLState, Metrics]:
        return _update(parts, state, batch)  # draws nothing: the key is there because other learners need one

    return Learner(init, lambda: (), act, update)


# --- one update -------------------------------------------------------------------------------------------------------


def _update(parts: _Parts, state: IQLState, batch: Batch) -> tuple[IQLState, Metrics]:
    """Value, then actor and critic, which both use the new value, then the target critic."""
    normal = jax.vmap(normalizer.normalize, (None, 0))
    batch = batch._replace(obs=normal(state.normalizer, batch.obs), next_obs=normal(state.normalizer, batch.next_obs))
    q = jnp.min(jax.vmap(parts.critic.apply, (None, 0, 0))(state.target_critic, batch.obs, batch.action), axis=1)

    state, metrics = _update_value(parts, state, batch, q)
    state, more = _update_actor(parts, state, batch, q)
    metrics |= more
    state, more = _update_critic(parts, state, batch)
    metrics |= more
    target = optax.incremental_update(state.critic.params, state.target_critic, state.hyper.tau)
    return state.replace(target_critic=target, step=state.step + 1), metrics


def _update_value(parts: _Parts, state: IQLState, batch: Batch, q: Array) -> tuple[IQLState, Metrics]:
    def loss(params: PyTree) -> tuple[Array, Array]:
        values = jax.vmap(parts.value.apply, (None, 0))(params, batch.obs)
        each = jax.vmap(lambda v, q: value_losses.expectile_loss(v, q, expectile=state.hyper.expectile))(values, q)
        return losses.row_mean(each, batch), values

    (mean, values), grads = jax.value_and_grad(loss, has_aux=True)(state.value.params)
    fit = optim.step(parts.optimiser, state.value, grads, state.hyper.lr_value)
    return state.replace(value=fit), {"value/loss": mean, "value/mean": jnp.mean(values)}


def _update_actor(parts: _Parts, state: IQLState, batch: Batch, q: Array) -> tuple[IQLState, Metrics]:
    """q: [B] of the target critic, as the value saw them."""
    hyper = state.hyper
    values = jax.vmap(parts.value.apply, (None, 0))(state.value.params, batch.obs)
    weight = jax.vmap(lambda v, q: advantage_weight(v, q, beta=hyper.beta, max_weight=hyper.max_weight))
    weights = weight(values, q)

    def loss(params: PyTree) -> Array:
        moments = jax.vmap(parts.actor.apply, (None, 0))(params, batch.obs)
        return losses.row_mean(jax.vmap(policy_loss)(moments, batch.action, weights), batch)

    mean, grads = jax.value_and_grad(loss)(state.actor.params)
    rate = hyper.lr_actor * optim.cosine_factor(state.step, hyper.actor_updates)
    fit = optim.step(parts.optimiser, state.actor, grads, rate)
    # The parameter itself is kept in bounds: a bound in `apply` has no gradient beyond it, and would hold it for ever.
    log_std = jnp.clip(fit.params["log_std"], LOG_STD_MIN, LOG_STD_MAX)
    metrics = {
        "actor/loss": mean,
        "actor/lr": rate,
        "actor/advantage_mean": jnp.mean(q - values),
        "actor/weight_saturated_share": jnp.mean(weights >= hyper.max_weight),
        "actor/std_mean": jnp.mean(jnp.exp(log_std)),
    }
    return state.replace(actor=fit._replace(params={**fit.params, "log_std": log_std})), metrics


def _update_critic(parts: _Parts, state: IQLState, batch: Batch) -> tuple[IQLState, Metrics]:
    next_values = jax.vmap(parts.value.apply, (None, 0))(state.value.params, batch.next_obs)
    target = jax.vmap(lambda r, d, v: td_target(r, d, v, reward_scale=state.hyper.reward_scale))
    targets = target(batch.reward, batch.discount, next_values)

    def loss(params: PyTree) -> tuple[Array, Array]:
        q = jax.vmap(parts.critic.apply, (None, 0, 0))(params, batch.obs, batch.action)
        return losses.row_mean(jax.vmap(losses.critic_loss)(q, targets), batch), q

    (mean, q), grads = jax.value_and_grad(loss, has_aux=True)(state.critic.params)
    fit = optim.step(parts.optimiser, state.critic, grads, state.hyper.lr_critic)
    metrics = {"critic/loss": mean, "critic/q_mean": jnp.mean(q), "critic/target_mean": jnp.mean(targets)}
    return state.replace(critic=fit), metrics
