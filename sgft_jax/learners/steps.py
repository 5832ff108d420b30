"""Steps of actors, critics and temperatures that several learners share, each of one network with its own Adam.

Source: SAC (Haarnoja et al. 2018). Those of real and simulated rows are in `mixed.py`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from envs.types import Array, Key, PyTree
from sgft_jax.math import losses, optim
from sgft_jax.models import networks, normalizer
from sgft_jax.models.networks import Network
from sgft_jax.types import Batch, Metrics

LOG_ALPHA_MIN = -10.0  # dense negative rewards would drive an auto-tuned temperature to zero

Critic = Callable[[PyTree, Array, Array], Array]  # (params of members, obs, action) -> [members]
Sampler = Callable[[Array, Key], tuple[Array, Array]]  # (obs, key) -> (action of the policy, its log pi [])


class Networks(NamedTuple):
    """A configuration with the networks and the optimiser that it describes; None where it has no such network."""

    config: Any
    actor: Network
    critic: Network
    optimiser: optax.GradientTransformation
    value: Any = None
    dynamics: Any = None
    ratio: Any = None
    memory: Any = None


# In this file `state` is that of a learner, with a network in training for actor and critic, the temperature
# `log_alpha`, and `normalizer`, `hyper`.


def begin(nets: Networks, key_actor: Key, key_critic: Key) -> dict[str, Any]:
    """What is part of every fresh agent. Its statistics leave observations as they are."""
    critic = nets.critic.init(key_critic)
    return {
        "actor": optim.start(nets.optimiser, nets.actor.init(key_actor)),
        "critic": optim.start(nets.optimiser, critic),
        "target_critic": jax.tree.map(jnp.copy, critic),  # its own buffers: a donated state must not hold one twice
        "normalizer": normalizer.identity(nets.config.obs_dim),
        "step": jnp.int32(0),
    }


# --- critics ----------------------------------------------------------------------------------------------------------


def sample(nets: Networks, state: Any, obs: Array, key: Key) -> tuple[Array, Array]:
    """An action [act_dim] of the policy and its log pi []. obs: what the actor reads."""
    return networks.tanh_gaussian_sample(nets.actor.apply(state.actor.params, obs), key)


def soft_targets(
    nets: Networks, state: Any, batch: Batch, key: Key, *, alpha: Array | float, members: Array | slice = slice(None)
) -> Array:
    """Targets r + discount (min_i Q_i(s', a') - alpha log pi(a'|s')) [B] with a' ~ pi.

    batch: what the networks read. members: of the target critic, over which the minimum is taken.
    """

    def target(row: Batch, key: Key) -> Array:
        action, log_prob = sample(nets, state, row.next_obs, key)
        next_q = nets.critic.apply(state.target_critic, row.next_obs, action)[members]
        return losses.td_target(row.reward, row.discount, next_q, log_prob, alpha=alpha)

    return jax.vmap(target)(batch, jax.random.split(key, batch.reward.shape[0]))


def step_critic(
    nets: Networks,
    state: Any,
    batch: Batch,
    targets: Array,
    *,
    rate: Array | float,
    term: Callable[[PyTree], Array] | None = None,
) -> tuple[optim.Fit, Metrics]:
    """The critics after a step on their squared errors. targets: [B]. term(params) -> [] joins the loss."""

    def loss(params: PyTree) -> tuple[Array, Array]:
        q = jax.vmap(nets.critic.apply, (None, 0, 0))(params, batch.obs, batch.action)
        error = losses.row_mean(jax.vmap(losses.critic_loss)(q, targets), batch)
        return error if term is None else error + term(params), q

    fit, value, q = optim.minimise(nets.optimiser, loss, state.critic, rate)
    return fit, {"critic/loss": value, "critic/q_mean": jnp.mean(q), "critic/target_mean": jnp.mean(targets)}


def step_value(
    nets: Networks,
    state: Any,
    batch: Batch,
    row_losses: Callable[[Array], Array],
    mean: Callable[[Array, Batch], Array] = losses.row_mean,
) -> tuple[optim.Fit, Metrics]:
    """V after a step on the mean of row_losses(values [B]) -> [B]. mean: over the rows that count."""

    def loss(params: PyTree) -> tuple[Array, Array]:
        values = jax.vmap(nets.value.apply, (None, 0))(params, batch.obs)
        return mean(row_losses(values), batch), values

    fit, value, values = optim.minimise(nets.optimiser, loss, state.value, state.hyper.lr_value)
    return fit, {"value/loss": value, "value/mean": mean(values, batch)}


def lowest_target(nets: Networks, state: Any, batch: Batch) -> Array:
    """min_i Q_i(s, a) [B] of the target critic at the rows' own actions."""
    return jnp.min(jax.vmap(nets.critic.apply, (None, 0, 0))(state.target_critic, batch.obs, batch.action), axis=1)


# --- policies ---------------------------------------------------------------------------------------------------------


def step_actor(
    nets: Networks,
    state: Any,
    rows: Batch,
    key: Key,
    *,
    rate: Array | float,
    mean: bool = False,
    penalty: Callable[[PyTree, Array], Array] | None = None,
) -> tuple[optim.Fit, Array, Metrics]:
    """The actor after a step on alpha log pi(a|s) - min_i Q_i(s, a) with a ~ pi. Source: H2O+ Eq. (10).

    Also returns log pi [B] of the actions drawn. mean: follow the members' mean, not their minimum.
    penalty(params, obs) -> [] joins the loss of each row.
    """
    alpha, keys = jnp.exp(state.log_alpha.params), jax.random.split(key, rows.reward.shape[0])

    def row_loss(params: PyTree, obs: Array, key: Key) -> tuple[Array, Array]:
        action, log_prob = networks.tanh_gaussian_sample(nets.actor.apply(params, obs), key)
        q = nets.critic.apply(state.critic.params, obs, action)
        loss = losses.actor_loss(log_prob, jnp.mean(q, keepdims=True) if mean else q, alpha=alpha)
        return loss if penalty is None else loss + penalty(params, obs), log_prob

    def loss(params: PyTree) -> tuple[Array, Array]:
        values, log_prob = jax.vmap(row_loss, (None, 0, 0))(params, rows.obs, keys)
        return losses.row_mean(values, rows), log_prob

    fit, value, log_prob = optim.minimise(nets.optimiser, loss, state.actor, rate)
    return fit, log_prob, {"actor/loss": value, "actor/entropy": -jnp.mean(log_prob)}


def step_temperature(
    nets: Networks, state: Any, rows: Batch, log_prob: Array, *, target: float | Array, rate: float | Array
) -> optim.Fit:
    """One step of the temperature's logarithm. log_prob: [B] of the actions drawn. target: [] entropy, nats."""

    def loss(log_alpha: Array) -> tuple[Array, tuple[()]]:
        row_loss = partial(losses.temperature_loss, log_alpha, target_entropy=target)
        return losses.row_mean(jax.vmap(row_loss)(log_prob), rows), ()

    fit, _, _ = optim.minimise(nets.optimiser, loss, state.log_alpha, rate)
    return fit._replace(params=jnp.maximum(fit.params, LOG_ALPHA_MIN))
