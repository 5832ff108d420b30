"""Losses and targets of one transition; the caller vmaps and averages once."""

import chex
import jax
import jax.numpy as jnp

from envs.types import Array, UserError
from sgft_jax.types import Batch


def row_mean(row_losses: Array, batch: Batch) -> Array:
    """Mean [] of one loss per row, row_losses [B], over the valid rows of a batch, weighted where it has weights."""
    if batch.valid is None and batch.weight is None:
        return jnp.mean(row_losses)
    ones = jnp.ones_like(row_losses)
    valid = ones if batch.valid is None else batch.valid.astype(row_losses.dtype)
    weight = ones if batch.weight is None else batch.weight
    return jnp.sum(jnp.where(valid > 0, row_losses, 0.0) * weight) / jnp.maximum(jnp.sum(valid), 1.0)


def is_simulated(batch: Batch) -> Array:
    """Which rows [B] bool are the simulator's; raises UserError where the batch does not say so."""
    if batch.is_sim is None:
        raise UserError("this learner must know which rows are simulated: give it batches of a source that mixes both")
    return batch.is_sim


def real_mean(row_losses: Array, batch: Batch) -> Array:
    """`row_mean` [] over the rows of the real system alone."""
    return row_mean(row_losses, batch._replace(valid=real_rows(batch)))


def sim_mean(row_losses: Array, batch: Batch) -> Array:
    """`row_mean` [] over the simulator's rows alone."""
    return row_mean(row_losses, batch._replace(valid=sim_rows(batch)))


def real_rows(batch: Batch) -> Array:
    """The valid rows [B] bool of the real system."""
    real = ~is_simulated(batch)
    return real if batch.valid is None else real & batch.valid


def sim_rows(batch: Batch) -> Array:
    """The valid rows [B] bool of the simulator."""
    simulated = is_simulated(batch)
    return simulated if batch.valid is None else simulated & batch.valid


def td_target(reward: Array, discount: Array, next_q: Array, next_log_prob: Array, *, alpha: Array | float) -> Array:
    """Soft TD target r + discount (min_i Q_i(s', a') - alpha log pi(a'|s')), a constant for gradients.

    reward, discount, next_log_prob: []; next_q: [members]. The discount is gamma (1 - terminated), or 0 at the end of a
    segment.
    Source: SAC (Haarnoja et al. 2018).
    """
    chex.assert_rank([reward, discount, next_q, next_log_prob], [0, 0, 1, 0])
    chex.assert_type([reward, discount, next_q, next_log_prob], float)
    return jax.lax.stop_gradient(reward + discount * (jnp.min(next_q) - alpha * next_log_prob))


def critic_loss(q: Array, target: Array) -> Array:
    """Sum over members of the squared TD error. q: [members]; target: []."""
    chex.assert_rank([q, target], [1, 0])
    return jnp.sum((q - target) ** 2)


def actor_loss(log_prob: Array, q: Array, *, alpha: Array | float) -> Array:
    """Soft policy loss alpha log pi(a|s) - min_i Q_i(s, a) for a reparameterised a. log_prob: []; q: [members]."""
    chex.assert_rank([log_prob, q], [0, 1])
    return alpha * log_prob - jnp.min(q)


def temperature_loss(log_alpha: Array, log_prob: Array, *, target_entropy: Array | float) -> Array:
    """Loss alpha (-log pi(a|s) - target entropy); alpha rises while the policy is too certain. All [], nats."""
    chex.assert_rank([log_alpha, log_prob], 0)
    return jnp.exp(log_alpha) * jax.lax.stop_gradient(-log_prob - target_entropy)


def value_loss(value: Array, q: Array) -> Array:
    """(V(s) - min_i Q_i(s, a))^2 with a ~ pi and Q constant, without entropy term. value: []; q: [members].

    Source: SGFT Appendix C. The minimiser is the mean of Q over the policy's actions. Where Q is SAC's, that is the
    value of the policy plus the entropy bonus alpha H of every later step, so V is above the returns of the task: with
    reward 1, gamma 0.9, alpha 0.1 and entropy 2 it is 11.8, where the value is 10.
    """
    chex.assert_rank([value, q], [0, 1])
    return (value - jax.lax.stop_gradient(jnp.min(q))) ** 2


def dynamics_loss(prediction: Array, delta: Array) -> Array:
    """Mean over entries of the squared error in the change of the normalised observation. Both [obs_dim].

    Source: SGFT Appendix C, with the mean in place of the sum so that tasks of any size read alike.
    """
    chex.assert_rank([prediction, delta], 1)
    chex.assert_equal_shape([prediction, delta])
    return jnp.mean((prediction - delta) ** 2)
