"""The ensemble: prediction, drift by horizon, and members that differ."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sgft_jax.math import optim
from sgft_jax.models import dynamics, networks
from sgft_jax.types import Batch, Normalizer

# A stand-in whose member m moves the normalised observation by action + m's own bias.
BIASED = networks.Network(lambda key: jnp.zeros(2), lambda params, obs, action: action[None, :] + params[:, None])
SCALED = Normalizer(jnp.array([1.0]), jnp.array([2.0]))


def data(key, n=64):
    keys = jax.random.split(key, 3)
    obs, action = jax.random.normal(keys[0], (n, 2)), jax.random.uniform(keys[1], (n, 1), minval=-1)
    zero = jnp.zeros(n)
    return Batch(obs, action, zero, zero, obs + 0.5 * action)


def test_predict_by_hand():
    # from 3: normalised change 0.5 + bias {0, 1}, times std 2: 3 + 1 = 4 and 3 + 3 = 6
    out = dynamics.predict(BIASED, jnp.array([0.0, 1.0]), SCALED, jnp.array([3.0]), jnp.array([0.5]))
    assert out.tolist() == [[4.0], [6.0]]


def test_rollout_error_by_hand():
    # truth adds 2 * action; member 0 is exact, member 1 drifts by 1 std a step: RMS sqrt((0 + t^2) / 2)
    actions = jnp.array([[0.5], [-0.25], [1.0]])
    obs = jnp.concatenate([jnp.zeros((1, 1)), jnp.cumsum(2 * actions, axis=0)])
    error = dynamics.rollout_error(BIASED, jnp.array([0.0, 1.0]), SCALED, obs, actions)
    np.testing.assert_allclose(error, np.array([1, 2, 3]) / np.sqrt(2), rtol=1e-6)


@pytest.mark.slow
def test_members_part_even_from_equal_weights(key):
    network = networks.make_dynamics(2, 1, networks.NetworkConfig((8,)), members=3)
    params = jax.tree.map(lambda p: jnp.broadcast_to(p[:1], p.shape), network.init(key))
    fit = optim.start(optim.adam(), params)
    unit = Normalizer(jnp.zeros(2), jnp.ones(2))
    new, _ = dynamics.update(network, optim.adam(), fit, unit, data(key), key, rate=1e-3)
    kernel = new.params["Dense_0"]["kernel"]
    assert not jnp.array_equal(kernel[0], kernel[1]) and not jnp.array_equal(kernel[1], kernel[2])


@pytest.mark.heavy
def test_every_member_learns(key):
    network = networks.make_dynamics(2, 1, networks.NetworkConfig((16,)), members=3)
    unit, batch = Normalizer(jnp.zeros(2), jnp.ones(2)), data(key)
    optimiser = optim.adam()

    def step(fit, key):
        return dynamics.update(network, optimiser, fit, unit, batch, key, rate=1e-2)

    @jax.jit
    def learned(key):
        return jax.lax.scan(step, optim.start(optimiser, network.init(key)), jax.random.split(key, 300))

    fit, metrics = learned(key)
    assert metrics["dynamics/mse"][0] > 0.05 and metrics["dynamics/mse"][-1] < 2e-3
    out = dynamics.predict(network, fit.params, unit, jnp.array([0.2, -0.3]), jnp.array([0.4]))
    np.testing.assert_allclose(out, np.tile([0.4, -0.1], (3, 1)), atol=0.05)


def test_a_drawn_member_is_one_of_the_ensemble(key):
    draw = jax.jit(jax.vmap(lambda k: dynamics.draw_member(jnp.array([0.0, 1.0, 2.0]), k)[0]))
    seen = set(draw(jax.random.split(key, 40)).tolist())
    assert seen == {0.0, 1.0, 2.0}


@pytest.mark.parametrize("members", [1, 4])
def test_leading_axis_is_the_member(key, members):
    network = networks.make_dynamics(2, 1, networks.NetworkConfig((8,)), members=members)
    out = jax.eval_shape(lambda key: network.apply(network.init(key), jnp.ones(2), jnp.ones(1)), key)
    assert out.shape == (members, 2)
