"""The estimator learns posteriors that are known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sgft_jax.posterior import estimator, learning
from sgft_jax.posterior.estimator import MOST, Estimator, Rollout, draw, init, log_density
from sgft_jax.posterior.learning import Lessons

STEPS, NOISE = 6, 0.5
BINS = 64


@pytest.fixture(autouse=True)
def _few_bins(monkeypatch):
    """They are learned in seconds."""
    monkeypatch.setattr(estimator, "_BINS", BINS)


def lessons(key, n):
    """Systems of two numbers: every step measures the first one with much noise; nothing tells the second one."""
    key_points, key_noise = jax.random.split(key)
    points = jax.random.uniform(key_points, (n, 2))
    measured = points[:, None, None, :1] + NOISE * jax.random.normal(key_noise, (n, MOST, STEPS + 1, 1))
    still = jnp.zeros((n, MOST, STEPS, 1))
    return Lessons(points, Rollout(measured, still, jnp.ones((n, MOST, STEPS), bool), jnp.zeros((n, MOST), bool)))


def fresh(key):
    return init(key, lessons(key, 8).rollouts, 2)


def counted(n):
    return jnp.arange(MOST) < n


def test_every_number_has_a_density(key):
    """Whatever the network says, the histogram of a number integrates to one given those before it."""
    one = jax.tree.map(lambda x: x[0], lessons(key, 1).rollouts)
    middles = (jnp.arange(BINS) + 0.5) / BINS
    known = fresh(key)
    points = jnp.stack([jnp.full(BINS, 0.3), middles], axis=1)
    nats = jax.vmap(lambda point: log_density(known, one, counted(3), point))(points)
    assert jnp.exp(nats[:, 1]).mean() == pytest.approx(1.0, abs=1e-4)
    np.testing.assert_allclose(nats[:, 0], nats[0, 0], rtol=1e-5)  # what comes later changes nothing before


def test_draws_follow_the_density(key):
    one = jax.tree.map(lambda x: x[0], lessons(key, 1).rollouts)
    known = fresh(key)
    sharp = jax.tree.map(lambda x: 3.0 * x, known.params)
    points = draw(known._replace(params=sharp), one, counted(2), 2, key, 4000)
    middles = jnp.stack(jnp.meshgrid(*[(jnp.arange(BINS) + 0.5) / BINS] * 2, indexing="ij"), -1).reshape(-1, 2)
    nats = jax.vmap(lambda point: log_density(known._replace(params=sharp), one, counted(2), point))(middles)
    weights = jnp.exp(nats.sum(1)) / BINS**2
    assert weights.sum() == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(points.mean(0), weights @ middles, atol=0.02)
    np.testing.assert_allclose(points.T @ points / len(points), (weights[None] * middles.T) @ middles, atol=0.02)


def test_rollouts_that_do_not_count_change_nothing(key):
    rollouts = jax.tree.map(lambda x: x[0], lessons(key, 1).rollouts)
    cut = rollouts._replace(measured=rollouts.measured.at[3:].set(7.0))
    known, point = fresh(key), jnp.array([0.2, 0.7])
    np.testing.assert_allclose(*(log_density(known, r, counted(3), point) for r in (rollouts, cut)), rtol=1e-5)


@pytest.mark.slow
def test_it_learns_the_posterior(key, monkeypatch):
    """Mean and std of the truth's posterior, which many rollouts narrow; what nothing tells stays uniform."""
    for module, sizes in (
        (estimator, {"_WIDTH": 32, "_HIDDEN": 64, "_STEPS": 1, "_ROLLOUTS": 1}),
        (learning, {"_BATCH": 128, "_WARMUP": 50, "_RATE": 2e-3}),
    ):
        for name, value in sizes.items():
            monkeypatch.setattr(module, name, value)
    data = lessons(key, 4096)
    state = learning.begin(key, data)
    steps = [jax.jit(functools.partial(learning.learn, together=n, updates=100, total=600)) for n in learning.TOGETHER]
    for i in range(6):
        for step in steps:
            state = step(state, data, jax.random.fold_in(key, i))
    test = lessons(jax.random.fold_in(key, 1), 64)
    for n in (1, MOST):
        counts = jnp.broadcast_to(counted(n), (64, MOST))
        points = jax.vmap(lambda *x: draw(state.estimator, *x[:2], 2, x[2], 256))(
            test.rollouts, counts, jax.random.split(key, 64)
        )
        mean, std = points.mean(axis=1), points.std(axis=1)
        exact = _exact(test.rollouts.measured[:, :n, :, 0])
        assert np.abs(mean[:, 0] - exact[0]).mean() < 0.05, n
        assert np.abs(std[:, 0] - exact[1]).mean() < 0.05, n
        np.testing.assert_allclose(std[:, 1].mean(), 12**-0.5, atol=0.02)


def _exact(measured):
    """Mean and std [g] of the first number, by a grid. measured: [g, k, T + 1]."""
    grid = np.linspace(0.0, 1.0, 101)
    nats = [-0.5 * jnp.sum(((measured - x) / NOISE) ** 2, axis=(1, 2)) for x in grid]
    weights = jax.nn.softmax(jnp.stack(nats, axis=1))
    mean = weights @ grid
    return mean, jnp.sqrt(weights @ grid**2 - mean**2)


@pytest.mark.parametrize("wrong", [1.4, 0.5])
def test_ranks_undo_what_makes_it_too_sure_or_not_sure_enough(wrong, key, monkeypatch):
    """Of a histogram around a number that it reads, wrong times as narrow as the truth lies around it."""
    std, d = 0.05, 2
    monkeypatch.setattr(estimator._Encoder, "apply", lambda self, params, *read: read[0])
    monkeypatch.setattr(estimator, "_read", lambda statistics, rollouts, counts: (rollouts.measured[0, 0],))
    middles = (jnp.arange(BINS) + 0.5) / BINS
    monkeypatch.setattr(
        estimator._Head,
        "apply",
        lambda self, params, context, before, which: -0.5 * ((middles - context @ which) * wrong / std) ** 2,
    )
    key_middle, key_off, key_draw = jax.random.split(key, 3)
    middle = jax.random.uniform(key_middle, (2000, d), minval=0.3, maxval=0.7)
    data = lessons(key, 2000)
    measured = jnp.broadcast_to(middle[:, None, None], (2000, MOST, STEPS + 1, d))
    data = Lessons(middle + std * jax.random.normal(key_off, middle.shape), data.rollouts._replace(measured=measured))
    known = Estimator({"encoder": None, "head": None}, None, jnp.zeros((MOST, d, 20)), jnp.zeros(MOST))
    right = jax.jit(lambda *args: learning.finish(*args))(known, data, key)
    one = jax.tree.map(lambda x: x[0], data.rollouts)

    def inside(some):
        missed = np.asarray(draw(some, one, counted(4), d, key_draw, 20_000)) - np.asarray(middle[0])
        return np.mean(np.abs(missed) < 1.2816 * std)

    assert abs(inside(right) - 0.8) < 0.5 * abs(inside(known) - 0.8)


def test_halves_of_two_systems_contradict_each_other(key, monkeypatch):
    """Of a network that reads what it is told: half of the rollouts are high, half are low."""
    monkeypatch.setattr(estimator, "histograms", lambda known, rollouts, counts, point: read(rollouts, counts))
    monkeypatch.setattr(
        estimator,
        "draw",
        lambda known, rollouts, counts, d, key, n: jnp.full((n, 1), mean(rollouts, counts)),
    )

    def mean(rollouts, counts):
        return jnp.sum(rollouts.measured[:, 0, 0] * counts) / counts.sum()

    def read(rollouts, counts):
        middles = (jnp.arange(BINS) + 0.5) / BINS
        return jax.nn.log_softmax(-0.5 * ((middles - mean(rollouts, counts)) / 0.1) ** 2)[None]

    one = jax.tree.map(lambda x: x[0], lessons(key, 1).rollouts)
    even = jnp.where(jnp.arange(MOST) % 2 == 0, 0.2, 0.8)[:, None, None]
    for values, wanted in ((jnp.full_like(even, 0.5), 0.0), (even, 0.5 * 6.0**2)):
        alike = one._replace(measured=jnp.broadcast_to(values, one.measured.shape))
        nats = estimator.contradiction(fresh(key), alike, estimator.alternating(counted(6)), 1, key)
        assert nats == pytest.approx(wanted, rel=0.1, abs=1e-4)


def test_its_size_is_that_of_a_part_of_a_prior(key):
    assert sum(x.size for x in jax.tree.leaves(fresh(key).params)) < 1_000_000
