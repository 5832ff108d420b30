"""Losses and targets of one transition; the caller vmaps and averages once.

Those of V(s) over recorded actions make V the value of a policy that stays with the data. All are functions of
y = Q(s, a) - V(s), each belongs to a penalty on leaving the behaviour; together they are the backbones of H2O+. Source:
H2O+ (Niu et al. 2023) Eq. (4); IQL (Kostrikov et al. 2021), SQL and EQL (Xu et al. 2023), XQL (Garg et al. 2023).
"""

from functools import partial

import chex
import jax
import jax.numpy as jnp

from envs.types import Array, UserError
from sgft_jax.types import Batch, ValueLoss

SHIFT_MIN = -1.0  # the shift of a batch in which V is far above every Q would make exp(-shift) overflow


# --- over the rows of a batch ----------------------------------------------------------------------------------------


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


# --- of one transition -----------------------------------------------------------------------------------------------


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


def dynamics_loss(prediction: Array, delta: Array) -> Array:
    """Mean over entries of the squared error in the change of the normalised observation. Both [obs_dim].

    Source: SGFT Appendix C, with the mean in place of the sum so that tasks of any size read alike.
    """
    chex.assert_rank([prediction, delta], 1)
    chex.assert_equal_shape([prediction, delta])
    return jnp.mean((prediction - delta) ** 2)


# --- of V over recorded actions --------------------------------------------------------------------------------------


def expectile_loss(value: Array, q: Array, *, expectile: Array | float) -> Array:
    """Squared error that counts `expectile` where V is below Q and 1 - `expectile` where it is above.

    value, q: []; q is min_i Q_target_i(s, a) of the data's action, a constant for gradients.
    Source: Kostrikov et al. 2021. The minimiser over V is the expectile of Q over the data's actions.
    """
    error = _gap(value, q)
    return jnp.where(error < 0, 1 - expectile, expectile) * error**2


def sparse_loss(value: Array, q: Array, *, alpha: Array | float) -> Array:
    """max(1 + y / 2 alpha, 0)^2 - y / alpha. value, q: [], q is a constant; alpha: [] in units of return.

    The minimiser solves mean(max(1 + y / 2 alpha, 0)) = 1: actions far below V do not count at all. Source: SQL.
    """
    y = _gap(value, q) / alpha
    return jnp.maximum(1 + y / 2, 0.0) ** 2 - y


def exponential_loss(value: Array, q: Array, shift: Array, *, alpha: Array | float, cut: Array | float) -> Array:
    """exp(-shift) (exp(y / alpha) - y / alpha), the exponent cut off at `cut`. value, q: [], q is a constant.

    shift: [] from `shift_of`, a constant for gradients; 0 gives the plain loss.
    The minimiser is V = alpha log mean exp(Q / alpha). Above the cut only -y / alpha has a gradient, which lowers V: as
    in the authors' code. Source: EQL.
    """
    y = _gap(value, q) / alpha
    return jnp.exp(jnp.minimum(y, cut) - shift) - jnp.exp(-shift) * y


def gumbel_loss(value: Array, q: Array, shift: Array, *, alpha: Array | float, cut: Array | float) -> Array:
    """As `exponential_loss`, with both terms cut off: rows above the cut have no gradient. Source: XQL."""
    y = jnp.minimum(_gap(value, q) / alpha, cut)
    return jnp.exp(y - shift) - jnp.exp(-shift) * y


def shift_of(values: Array, q: Array, counted: Array, *, alpha: Array | float, cut: Array | float) -> Array:
    """The largest exponent [] of a batch, which the exponential losses subtract from all. values, q, counted: [B].

    counted: bool, the rows that the loss is a mean of. At least -1.
    """
    exponents = jnp.minimum(jax.vmap(_gap)(values, q) / alpha, cut)
    return jax.lax.stop_gradient(jnp.max(jnp.where(counted, exponents, SHIFT_MIN), initial=SHIFT_MIN))


def in_sample_loss(
    kind: ValueLoss,
    values: Array,
    q: Array,
    counted: Array,
    *,
    expectile: Array | float,
    alpha: Array | float,
    cut: Array | float,
) -> Array:
    """The loss [B] of every row. values, q: [B], q is a constant; counted: [B] bool, the rows of the batch's mean.

    expectile: [] for "iql" alone. alpha: [] for the others, in units of return. cut: [] largest exponent y / alpha of
    "eql" and "xql". Source: H2O+ Eq. (4).
    """
    if kind == "iql":
        return jax.vmap(partial(expectile_loss, expectile=expectile))(values, q)
    if kind == "sql":
        return jax.vmap(partial(sparse_loss, alpha=alpha))(values, q)
    loss = exponential_loss if kind == "eql" else gumbel_loss
    shift = shift_of(values, q, counted, alpha=alpha, cut=cut)
    return jax.vmap(lambda v, q: loss(v, q, shift, alpha=alpha, cut=cut))(values, q)


def _gap(value: Array, q: Array) -> Array:
    """Q - V [], with Q a constant for gradients."""
    chex.assert_rank([value, q], 0)
    chex.assert_type([value, q], float)
    return jax.lax.stop_gradient(q) - value
