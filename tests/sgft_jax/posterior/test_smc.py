"""Particles find posteriors that are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sgft_jax.posterior.smc import begin, effective, sample, systematic

MEAN, STD = np.array([0.3, 0.6, 0.5, 0.8]), np.array([0.02, 0.05, 0.1, 0.03])


def gaussian(points, keys, noise=0.0):
    """Nats of a Gaussian, estimated with noise."""
    exact = -0.5 * (((points - jnp.asarray(MEAN)[None]) / jnp.asarray(STD)[None]) ** 2).sum(axis=1)
    return exact + noise * jax.vmap(jax.random.normal)(keys)


def run(likelihood, key, d=4, n=256, exponent=1.0):
    key_points, key_begin, key_run = jax.random.split(key, 3)
    points = jax.random.uniform(key_points, (n, d))

    @jax.jit
    def whole(points):
        return sample(likelihood, begin(likelihood, points, key_begin), key_run, exponent=exponent)

    return whole(points)


def test_a_gaussian_posterior(key):
    particles = run(gaussian, key, n=1024)
    assert particles.exponent == 1 and 3 <= particles.stages < 20
    np.testing.assert_allclose(particles.points.mean(0), MEAN, atol=0.25 * STD.max())
    np.testing.assert_allclose(particles.points.std(0), STD, rtol=0.15)


@pytest.mark.parametrize("exponent", [0.25, 1.0])
def test_an_exponent_widens(exponent, key):
    particles = run(gaussian, key, n=1024, exponent=exponent)
    np.testing.assert_allclose(particles.points.std(0)[:2], STD[:2] / exponent**0.5, rtol=0.15)


def test_estimates_with_noise_have_the_same_posterior(key):
    particles = run(lambda points, keys: gaussian(points, keys, noise=1.0), key, n=1024)
    np.testing.assert_allclose(particles.points.std(0), STD, rtol=0.3)
    assert 0.1 < particles.acceptance < 0.6


def test_a_posterior_goes_on_from_a_wider_one(key):
    wide = run(gaussian, key, n=1024, exponent=0.25)
    narrow = jax.jit(lambda particles: sample(gaussian, particles, key, exponent=1.0))(wide)
    np.testing.assert_allclose(narrow.points.std(0), STD, rtol=0.15)
    assert narrow.stages > wide.stages


@pytest.mark.heavy
def test_both_modes_stay(key):
    def likelihood(points, keys):
        return jnp.logaddexp(*(-0.5 * (((points - x) / 0.03) ** 2).sum(axis=1) for x in (0.2, 0.8)))

    share = jnp.mean(run(likelihood, key, n=2048).points.mean(axis=1) < 0.5)
    assert 0.35 < share < 0.65


def test_nothing_learned_leaves_the_prior(key):
    particles = run(lambda points, keys: jnp.zeros(len(points)), key)
    assert particles.stages == 1 and len(np.unique(particles.ancestor)) == 256
    np.testing.assert_allclose(particles.points.std(0), 12**-0.5, rtol=0.15)


def test_two_runs_agree_and_ancestors_survive(key):
    one, other = (run(gaussian, k, n=256) for k in jax.random.split(key))
    assert (np.abs(one.points.mean(0) - other.points.mean(0)) < 0.5 * STD).all()
    assert len(np.unique(one.ancestor)) >= 10


def test_weights_choose(key):
    log_weights = jnp.log(jnp.array([0.5, 0.25, 0.25, 1e-9]))
    counts = np.bincount(systematic(key, jnp.tile(log_weights, 4)), minlength=16).reshape(4, 4).sum(0)
    np.testing.assert_allclose(counts, [8, 4, 4, 0], atol=1)
    assert effective(jnp.zeros(7)) == pytest.approx(7) and effective(jnp.array([0.0, -1e9])) == pytest.approx(1)
