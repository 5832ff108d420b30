"""The domain that widens with success: its distributions, and what the next ones are."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
from scipy import optimize, stats

from envs import doraemon
from envs.doraemon import Betas, widened
from envs.types import UserError

ENV = toy.make()
RNG = np.random.default_rng(0)


def betas(*a, reached=False):
    a = jnp.array(a, jnp.float32)
    return Betas(a, a, jnp.array(reached))


def drawn(state, n=4000):
    return RNG.beta(state.a, state.b, (n, len(state.a)))


def numbers(state):
    return np.concatenate([state.a, state.b]).astype(float)


def test_it_begins_around_the_nominal_system_and_says_how_likely_a_system_is():
    domain = doraemon.doraemon(ENV)
    state = domain.init()
    theta = domain.sample(state, jax.random.key(0), 2000)
    names = [p.nominal for p in ENV.parameters]
    np.testing.assert_allclose(np.median(theta.params, axis=0), names, atol=0.02)
    assert np.ptp(theta.params[:, 0]) < 0.15, "of .4 in the whole domain"
    noise = np.asarray(theta.effects.low.obs_noise)
    np.testing.assert_array_equal(noise, theta.effects.high.obs_noise)
    one = jax.tree.map(lambda x: x[0], theta)
    points = (np.array(one.params) - [0.8, 3.5]) / [0.4, 1.0]
    expected = stats.beta.logpdf(points, state.a[:2], state.b[:2]).sum() - np.log(0.4)
    assert len(state.a) == 2 and domain.log_prob(state, one) == pytest.approx(expected, rel=1e-4)


def test_gradients_are_those_of_finite_differences():
    now = np.array([40.0, 3.0, 20.0, 9.0])
    points, success = RNG.uniform(0.2, 0.8, (50, 2)), RNG.integers(0, 2, 50).astype(float)
    functions = (
        doraemon._entropy,
        functools.partial(doraemon._divergence, now),
        functools.partial(doraemon._rate, now, points, success),
    )
    for function in functions:
        slope = optimize.approx_fprime(now * 1.02, lambda x, f=function: f(x)[0], 1e-6)
        np.testing.assert_allclose(function(now * 1.02)[1], slope, rtol=1e-3, atol=1e-5)


def test_entropy_and_divergence_are_those_of_scipy():
    assert doraemon._entropy(np.array([3.0, 2.0]))[0] == pytest.approx(stats.beta.entropy(3.0, 2.0))
    points = stats.beta.rvs(3.0, 2.0, size=200_000, random_state=1)
    ratio = stats.beta.logpdf(points, 3.0, 2.0) - stats.beta.logpdf(points, 8.0, 4.0)
    assert doraemon._divergence(np.array([3.0, 2.0]), np.array([8.0, 4.0]))[0] == pytest.approx(ratio.mean(), abs=0.02)


def test_nothing_changes_before_the_policy_succeeds_often_enough():
    state, points = betas(100.0, 100.0), RNG.uniform(0.4, 0.6, (100, 2))
    assert widened(state, points, np.zeros(100)) is state
    lost = betas(100.0, 100.0, reached=True)
    assert widened(lost, points, np.zeros(100)) is lost, "nowhere to turn to"


def test_it_widens_within_the_trust_region_as_far_as_the_policy_succeeds():
    state = betas(100.0, 100.0)
    wider = widened(state, drawn(state), np.ones(4000))
    assert doraemon._divergence(numbers(state), numbers(wider))[0] == pytest.approx(doraemon._STEP, abs=2e-3)
    assert doraemon._entropy(numbers(wider))[0] > doraemon._entropy(numbers(state))[0] and wider.reached
    for _ in range(30):  # it fails beyond .6 of the first number
        points = drawn(state)
        state = widened(state, points, (points[:, 0] < 0.6).astype(float))
    success = (drawn(state)[:, 0] < 0.6).mean()
    uniform = stats.beta.std(state.a[1], state.b[1])
    assert success == pytest.approx(0.6, abs=0.03) and uniform > 0.27, "no constraint binds"
    for _ in range(20):
        points = drawn(state)
        state = widened(state, points, (points[:, 0] < 0.3).astype(float))
    assert (drawn(state)[:, 0] < 0.3).mean() == pytest.approx(0.5, abs=0.04), "it has narrowed until half succeed"


def test_where_it_fails_it_turns_to_where_it_succeeds():
    state = betas(20.0, 20.0, reached=True)
    points = drawn(state)
    turned = widened(state, points, (points[:, 0] > 0.7).astype(float))
    mean = turned.a / (turned.a + turned.b)
    assert mean[0] > 0.52 and mean[1] == pytest.approx(0.5, abs=0.01)
    assert doraemon._divergence(numbers(state), numbers(turned))[0] < doraemon._STEP + 2e-3


def test_a_task_that_is_judged_by_its_return_is_refused():
    with pytest.raises(UserError, match="widens with success, and toy is judged by its return"):
        doraemon.doraemon(ENV._replace(score="return"))
