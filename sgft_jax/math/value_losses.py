"""Losses of V(s) over recorded actions, in which V becomes the value of a policy that stays with the data.

All are functions of y = Q(s, a) - V(s). Each belongs to a penalty on leaving the behaviour; together they are the
backbones of H2O+. Source: H2O+ (Niu et al. 2023) Eq. (4); IQL (Kostrikov et al. 2021), SQL and EQL (Xu et al. 2023),
XQL (Garg et al. 2023).
"""

from typing import get_args

import chex
import jax
import jax.numpy as jnp

from envs.types import Array, UserError, unknown
from sgft_jax.types import ValueLoss

SHIFT_MIN = -1.0  # the shift of a batch in which V is far above every Q would make exp(-shift) overflow


def expectile_loss(value: Array, q: Array, *, expectile: Array | float) -> Array:
    """Squared error that counts `expectile` where V is below Q and 1 - `expectile` where it is above.

    value, q: []; q is min_i Q_target_i(s, a) of the data's action, a constant for gradients.
    Source: Kostrikov et al. 2021. The minimiser over V is the expectile of Q over the data's actions.
    """
    chex.assert_rank([value, q], 0)
    chex.assert_type([value, q], float)
    error = jax.lax.stop_gradient(q) - value
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


def value_loss(
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
    if kind not in (known := get_args(ValueLoss)):
        raise UserError(unknown("value loss", kind, known))
    if kind == "iql":
        return jax.vmap(lambda v, q: expectile_loss(v, q, expectile=expectile))(values, q)
    if kind == "sql":
        return jax.vmap(lambda v, q: sparse_loss(v, q, alpha=alpha))(values, q)
    loss = exponential_loss if kind == "eql" else gumbel_loss
    shift = shift_of(values, q, counted, alpha=alpha, cut=cut)
    return jax.vmap(lambda v, q: loss(v, q, shift, alpha=alpha, cut=cut))(values, q)


def _gap(value: Array, q: Array) -> Array:
    """Q - V [], with Q a constant for gradients."""
    chex.assert_rank([value, q], 0)
    chex.assert_type([value, q], float)
    return jax.lax.stop_gradient(q) - value
