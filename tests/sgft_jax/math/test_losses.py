"""Losses of one transition against arithmetic done by hand."""

import jax
import jax.numpy as jnp
import pytest

from sgft_jax.math import losses
from sgft_jax.types import Batch

f = jnp.float32


def test_td_target_by_hand():
    # min Q = 2; 1 + 0.9 * (2 - 0.5 * (-1)) = 1 + 0.9 * 2.5 = 3.25
    target = losses.td_target(f(1.0), f(0.9), jnp.array([3.0, 2.0]), f(-1.0), alpha=0.5)
    assert target == pytest.approx(3.25)
    # terminated: the reward alone, whatever the networks say
    assert losses.td_target(f(1.0), f(0.0), jnp.array([3.0, 2.0]), f(-1.0), alpha=0.5) == 1.0


def test_td_target_is_a_constant_for_gradients():
    grad = jax.grad(lambda q: losses.td_target(f(1.0), f(0.9), q, f(0.0), alpha=0.1))(jnp.ones(2))
    assert jnp.all(grad == 0)


def test_td_target_refuses_a_batch():
    with pytest.raises(AssertionError):
        losses.td_target(jnp.ones(3), f(0.9), jnp.ones(2), f(0.0), alpha=0.1)


def test_critic_loss_by_hand():
    # (3 - 1)^2 + (0 - 1)^2 = 5
    assert losses.critic_loss(jnp.array([3.0, 0.0]), f(1.0)) == 5.0


def test_actor_loss_by_hand():
    # 0.5 * (-2) - min(3, 4) = -4; only the smaller critic gets a gradient
    assert losses.actor_loss(f(-2.0), jnp.array([3.0, 4.0]), alpha=0.5) == -4.0
    grad = jax.grad(lambda q: losses.actor_loss(f(-2.0), q, alpha=0.5))(jnp.array([3.0, 4.0]))
    assert grad.tolist() == [-1.0, 0.0]


def test_temperature_loss_by_hand():
    # alpha = 1; -log_prob = entropy 1 below the target 2: slope 1 - 2 = -1, so descent raises alpha
    value, slope = jax.value_and_grad(lambda a: losses.temperature_loss(a, f(-1.0), target_entropy=2.0))(f(0.0))
    assert value == -1.0 and slope == -1.0


def test_dynamics_loss_by_hand():
    # ((1 - 0)^2 + (2 - 4)^2) / 2 = 2.5
    assert losses.dynamics_loss(jnp.array([1.0, 2.0]), jnp.array([0.0, 4.0])) == 2.5


# --- which rows count -----------------------------------------------------------------------------------------------


def batch_of(**fields):
    x = jnp.zeros(3)
    return Batch(x[:, None], x[:, None], x, x, x[:, None], **fields)


def test_row_mean_by_hand():
    each = jnp.array([1.0, 2.0, 6.0])
    valid, weight = jnp.array([True, False, True]), jnp.array([0.5, 1.0, 1.5])
    assert losses.row_mean(each, batch_of()) == 3.0
    assert losses.row_mean(each, batch_of(valid=valid)) == 3.5  # (1 + 6) / 2
    assert losses.row_mean(each, batch_of(weight=weight)) == pytest.approx(11.5 / 3)  # (0.5 + 2 + 9) / 3
    assert losses.row_mean(each, batch_of(valid=valid, weight=weight)) == pytest.approx(9.5 / 2)
    assert losses.row_mean(each, batch_of(valid=jnp.zeros(3, bool))) == 0.0
    assert losses.row_mean(each.at[1].set(jnp.nan), batch_of(valid=valid)) == 3.5


def test_fields_that_nobody_uses_cost_nothing():
    """The program is the plain mean."""
    each, batch = jnp.arange(3.0), batch_of()
    assert str(jax.make_jaxpr(lambda x: losses.row_mean(x, batch))(each)) == str(jax.make_jaxpr(jnp.mean)(each))
