"""Steps of actors, critics and temperatures that several learners share, each of one network with its own Adam.

Sources: SAC (Haarnoja et al. 2018); for real and simulated rows H2O (Niu et al. 2022) and H2O+ (2023).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

from envs.types import Array, Key, PyTree
from sgft_jax.math import losses, optim
from sgft_jax.models import normalizer
from sgft_jax.models.networks import Network, tanh_gaussian_action, tanh_gaussian_sample
from sgft_jax.types import Batch, Metrics

LOG_ALPHA_MIN = -10.0  # dense negative rewards would drive an auto-tuned temperature to zero
OUTPUT_GAIN = 0.01  # of the last layers in the released codes of H2O: all values and means begin near 0

Critic = Callable[[PyTree, Array, Array], Array]  # (params of members, obs, action) -> [members]


def act(actor: Network, state: Any, obs: Array, key: Key, *, explore: bool | Array) -> Array:
    """Action [act_dim] of a tanh-Gaussian actor. state: with `actor` and `normalizer`. obs: [obs_dim] raw."""
    moments = actor.apply(state.actor.params, normalizer.normalize(state.normalizer, obs))
    return tanh_gaussian_action(moments, key, explore=explore)


# --- critics ----------------------------------------------------------------------------------------------------------


def soft_targets(
    policy: Callable[[Array], Array],
    target_critic: Callable[[Array, Array], Array],
    batch: Batch,
    key: Key,
    *,
    alpha: Array | float,
) -> Array:
    """Targets r + discount (min_i Q_i(s', a') - alpha log pi(a'|s')) [B] with a' ~ pi.

    policy(obs) -> moments [2, act_dim]. target_critic(obs, action) -> [members]. batch: what both read.
    """

    def target(row: Batch, key: Key) -> Array:
        action, log_prob = tanh_gaussian_sample(policy(row.next_obs), key)
        next_q = target_critic(row.next_obs, action)
        return losses.td_target(row.reward, row.discount, next_q, log_prob, alpha=alpha)

    return jax.vmap(target)(batch, jax.random.split(key, batch.reward.shape[0]))


def step_critic(
    critic: Critic,
    optimiser: optax.GradientTransformation,
    fit: optim.Fit,
    batch: Batch,
    targets: Array,
    *,
    rate: Array | float,
    term: Callable[[PyTree], Array] | None = None,
) -> tuple[optim.Fit, Metrics]:
    """The critics after a step on their squared errors. targets: [B]. term(params) -> [] joins the loss."""

    def loss(params: PyTree) -> tuple[Array, Array]:
        q = jax.vmap(critic, (None, 0, 0))(params, batch.obs, batch.action)
        error = losses.row_mean(jax.vmap(losses.critic_loss)(q, targets), batch)
        return error if term is None else error + term(params), q

    fit, value, q = optim.minimise(optimiser, loss, fit, rate)
    return fit, {"critic/loss": value, "critic/q_mean": jnp.mean(q), "critic/target_mean": jnp.mean(targets)}


def step_mixed_critic(
    critic: Critic,
    optimiser: optax.GradientTransformation,
    fit: optim.Fit,
    batch: Batch,
    targets: Array,
    weights: Array,
    *,
    rate: Array | float,
    penalty: Callable[[PyTree, Array], Array] | None = None,
) -> tuple[optim.Fit, Metrics]:
    """The critics after a step on real and weighted simulated errors, a mean of each. Source: H2O+ Eq. (8).

    targets: [B]. weights: [B], of which those of simulated rows count. penalty(params, q) -> [] joins the loss; it is
    given the critics' parameters and their values [B, members].
    """

    def loss(params: PyTree) -> tuple[Array, Metrics]:
        q = jax.vmap(critic, (None, 0, 0))(params, batch.obs, batch.action)
        errors = jax.vmap(losses.critic_loss)(q, targets)
        real, simulated = losses.real_mean(errors, batch), losses.sim_mean(weights * errors, batch)
        metrics = {"critic/real_loss": real, "critic/sim_loss": simulated, "critic/q_mean": jnp.mean(q)}
        if penalty is None:
            return real + simulated, metrics
        metrics["critic/penalty"] = penalty(params, q)
        return real + simulated + metrics["critic/penalty"], metrics

    fit, total, metrics = optim.minimise(optimiser, loss, fit, rate)
    return fit, metrics | {"critic/loss": total, "critic/target_mean": jnp.mean(targets)}


# --- policies ---------------------------------------------------------------------------------------------------------


def step_actor(
    actor: Network,
    critic: Callable[[Array, Array], Array],
    optimiser: optax.GradientTransformation,
    fit: optim.Fit,
    rows: Batch,
    key: Key,
    *,
    alpha: Array,
    rate: Array | float,
    mean: bool = False,
    penalty: Callable[[PyTree, Array], Array] | None = None,
) -> tuple[optim.Fit, Array, Array, Metrics]:
    """The actor after a step on alpha log pi(a|s) - min_i Q_i(s, a) with a ~ pi. Source: H2O+ Eq. (10).

    Also returns q [B, members] and log pi [B] of the actions drawn. critic(obs, action) -> [members]. mean: follow the
    members' mean, not their minimum. penalty(params, obs) -> [] joins the loss of each row.
    """
    keys = jax.random.split(key, rows.reward.shape[0])

    def row_loss(params: PyTree, obs: Array, key: Key) -> tuple[Array, Array, Array]:
        action, log_prob = tanh_gaussian_sample(actor.apply(params, obs), key)
        q = critic(obs, action)
        loss = losses.actor_loss(log_prob, jnp.mean(q, keepdims=True) if mean else q, alpha=alpha)
        return loss if penalty is None else loss + penalty(params, obs), q, log_prob

    def loss(params: PyTree) -> tuple[Array, tuple[Array, Array]]:
        values, q, log_prob = jax.vmap(row_loss, (None, 0, 0))(params, rows.obs, keys)
        return losses.row_mean(values, rows), (q, log_prob)

    fit, value, (q, log_prob) = optim.minimise(optimiser, loss, fit, rate)
    return fit, q, log_prob, {"actor/loss": value, "actor/entropy": -jnp.mean(log_prob)}


def step_policy(
    actor: Network,
    critic: Network,
    optimiser: optax.GradientTransformation,
    state: Any,
    batch: Batch,
    key: Key,
    *,
    target_entropy: Array | float | None,
) -> tuple[optim.Fit, optim.Fit, Metrics]:
    """Actor and temperature after a step on the states of all rows.

    state: of a learner, with `actor`, `critic`, `log_alpha` and the rates of `hyper`. batch: what its networks read.
    target_entropy: [] nats of a whole action; None keeps the temperature.
    """
    fit, _, log_prob, metrics = step_actor(
        actor,
        partial(critic.apply, state.critic.params),
        optimiser,
        state.actor,
        batch,
        key,
        alpha=jnp.exp(state.log_alpha.params),
        rate=state.hyper.lr_actor,
    )
    log_alpha = state.log_alpha
    if target_entropy is not None:  # the released loss has log alpha in the place of alpha: with Adam nearly the same
        log_alpha = step_temperature(
            optimiser, log_alpha, batch, log_prob, target=target_entropy, rate=state.hyper.lr_alpha
        )
    return fit, log_alpha, metrics | {"actor/alpha": jnp.exp(log_alpha.params)}


def step_temperature(
    optimiser: optax.GradientTransformation,
    log_alpha: optim.Fit,
    rows: Batch,
    log_prob: Array,
    *,
    target: float | Array,
    rate: float | Array,
) -> optim.Fit:
    """One step of the temperature's logarithm. log_prob: [B] of the actions drawn. target: [] entropy, nats."""

    def loss(log_alpha: Array) -> tuple[Array, tuple[()]]:
        row_loss = partial(losses.temperature_loss, log_alpha, target_entropy=target)
        return losses.row_mean(jax.vmap(row_loss)(log_prob), rows), ()

    fit, _, _ = optim.minimise(optimiser, loss, log_alpha, rate)
    return fit._replace(params=jnp.maximum(fit.params, LOG_ALPHA_MIN))
