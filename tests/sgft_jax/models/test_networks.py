"""Policy distribution, ensembles, and padding of the first layer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import UserError
from sgft_jax.models import networks

TINY = networks.NetworkConfig(hidden=(8, 8))


def test_tanh_gaussian_log_prob_by_hand():
    standard = jnp.zeros((2, 1))  # mean 0, std 1
    # u = 0: log N = -log(2 pi) / 2 = -0.9189385, tanh'(0) = 1
    assert networks.tanh_gaussian_log_prob(standard, jnp.zeros(1)) == pytest.approx(-0.9189385, abs=1e-6)
    # u = 1: -1/2 - 0.9189385 - log(1 - tanh(1)^2) = -1.4189385 + 0.8675617
    assert networks.tanh_gaussian_log_prob(standard, jnp.ones(1)) == pytest.approx(-0.5513768, abs=1e-6)


def test_tanh_gaussian_density_integrates_to_one():
    moments = jnp.array([[0.3], [-0.5]])
    a = jnp.linspace(-0.9999, 0.9999, 20_001)
    log_prob = jax.jit(jax.vmap(lambda x: networks.tanh_gaussian_log_prob(moments, jnp.arctanh(x)[None])))(a)
    assert np.trapezoid(np.exp(log_prob), a) == pytest.approx(1.0, abs=1e-3)


def test_tanh_gaussian_is_finite_at_the_bounds():
    both = jax.jit(jax.value_and_grad(lambda u: networks.tanh_gaussian_log_prob(jnp.zeros((2, 1)), u)))
    value, slope = both(jnp.full(1, 30.0))
    assert jnp.isfinite(value) and jnp.all(jnp.isfinite(slope))


def test_divergence_by_hand():
    """KL(N(1, 2^2) || N(0, 1)) = -ln 2 + (4 + 1 - 1) / 2 = 1.3068528, twice over two dimensions."""
    wide = jnp.stack([jnp.ones(2), jnp.full(2, jnp.log(2.0))])
    assert networks.tanh_gaussian_divergence(wide, jnp.zeros((2, 2))) == pytest.approx(2 * 1.3068528, abs=1e-5)
    assert networks.tanh_gaussian_divergence(wide, wide) == 0.0


def test_sample_and_mode(key):
    moments = jnp.array([[0.5, -0.5], [-5.0, -5.0]])
    assert jnp.allclose(networks.tanh_gaussian_action(moments, key, explore=False), jnp.tanh(moments[0]))
    sample = jax.jit(jax.vmap(networks.tanh_gaussian_sample, (None, 0)))
    draws, log_probs = sample(moments, jax.random.split(key, 500))
    # std exp(-5) = 0.0067 before the squashing: samples sit close to the mode
    assert jnp.allclose(jnp.mean(draws, 0), jnp.tanh(moments[0]), atol=2e-3) and log_probs.shape == (500,)


def test_log_std_is_clipped(key):
    actor = networks.make_actor(3, 2, TINY)
    params = jax.tree.map(lambda p: p * 1e4, jax.jit(actor.init)(key))
    log_std = jax.jit(jax.vmap(actor.apply, (None, 0)))(params, jax.random.normal(key, (50, 3)))[:, 1]
    assert log_std.min() == -5.0 and log_std.max() == 2.0


def test_twin_critics_differ_and_are_stacked(key):
    critic = networks.make_critic(3, 2, TINY)
    params, apply = jax.jit(critic.init)(key), jax.jit(critic.apply)
    assert all(leaf.shape[0] == 2 for leaf in jax.tree.leaves(params))
    q = apply(params, jnp.ones(3), jnp.ones(2))
    assert q.shape == (2,) and q[0] != q[1]
    alone = critic.apply(jax.tree.map(lambda p: p[1:], params), jnp.ones(3), jnp.ones(2))
    assert alone[0] == pytest.approx(q[1])


def test_layer_norm_only_where_asked(key):
    config = networks.NetworkConfig(hidden=(8, 8), layer_norm=True)

    def count(network):
        return sum("LayerNorm" in name for name in jax.eval_shape(network.init, key))

    assert count(networks.make_critic(3, 2, config)) == 2
    assert count(networks.make_value(3, config)) == 2
    assert count(networks.make_actor(3, 2, config)) == 0
    actor_norm = networks.NetworkConfig(hidden=(8, 8), actor_layer_norm=True)
    assert count(networks.make_actor(3, 2, actor_norm)) == 2


@pytest.mark.heavy
@pytest.mark.parametrize("extra", [[0.0, 0.0], [1.0, 0.0], [5.0, -7.0]])
def test_padding_leaves_the_function_alone(key, extra):
    obs, action, extra = jnp.arange(3.0), jnp.array([0.2, -0.4]), jnp.array(extra)
    small, big = networks.make_critic(3, 2, TINY), networks.make_critic(5, 2, TINY)
    params = small.init(key)
    padded = networks.pad_first_layer(params, 3, 2)
    assert jax.tree.map(jnp.shape, padded) == jax.tree.map(jnp.shape, jax.eval_shape(big.init, key))
    np.testing.assert_allclose(
        big.apply(padded, jnp.concatenate([obs, extra]), action), small.apply(params, obs, action), rtol=1e-6
    )


def test_fixed_entries_need_not_be_told(key):
    obs, action, extra = jnp.arange(3.0), jnp.array([0.2, -0.4]), jnp.array([0.0, 1.0])
    small, big = networks.make_critic(3, 2, TINY), networks.make_critic(5, 2, TINY)
    params = big.init(key)
    fixed = networks.fix_first_layer(params, 3, extra)
    expected = big.apply(params, jnp.concatenate([obs, extra]), action)
    np.testing.assert_allclose(small.apply(fixed, obs, action), expected, rtol=1e-5)


@pytest.mark.heavy
def test_padded_rows_can_learn(key):
    value = networks.make_value(4, TINY)
    padded = networks.pad_first_layer(networks.make_value(3, TINY).init(key), 3, 1)
    grads = jax.grad(value.apply)(padded, jnp.ones(4))
    assert jnp.any(grads["Dense_0"]["kernel"][3] != 0)


def test_unknown_activation_is_named():
    with pytest.raises(UserError, match="gelu"):
        networks.NetworkConfig(activation="gelu")


def test_affine_actor_by_hand(key):
    """Log std = scale * output + offset, from -20 to 2; at first nearly -1 everywhere."""
    actor = networks.make_affine_actor(3, 2, networks.NetworkConfig((8,)), output_gain=0.01)
    params, obs = actor.init(key), jnp.array([0.5, -1.0, 2.0])
    plain = actor.apply({**params, "scale": jnp.float32(1.0), "offset": jnp.float32(0.0)}, obs)
    mean, log_std = actor.apply({**params, "scale": jnp.float32(3.0), "offset": jnp.float32(-2.0)}, obs)
    np.testing.assert_allclose(mean, plain[0])
    np.testing.assert_allclose(log_std, 3 * plain[1] - 2, rtol=1e-6)
    np.testing.assert_allclose(actor.apply(params, obs)[1], -1.0, atol=0.05)
    for offset, bound in ((-30.0, -20.0), (9.0, 2.0)):
        assert jnp.all(actor.apply({**params, "offset": jnp.float32(offset)}, obs)[1] == bound)


def test_output_gain_is_xaviers(key):
    """Uniform up to gain * sqrt(6 / (inputs + outputs)); other layers are as without it."""
    small, plain = (
        networks.make_value(3, networks.NetworkConfig((64,)), output_gain=g).init(key) for g in (0.01, None)
    )
    limit = 0.01 * np.sqrt(6 / (64 + 1))
    kernel = np.abs(small["Dense_1"]["kernel"])
    assert 0.9 * limit < kernel.max() <= limit and not np.any(small["Dense_1"]["bias"])
    np.testing.assert_array_equal(small["Dense_0"]["kernel"], plain["Dense_0"]["kernel"])
