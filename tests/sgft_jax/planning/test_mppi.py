"""The planner on scores whose best sequence is known."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import UserError
from sgft_jax.planning import mppi

CONFIG, HYPER = mppi.MPPIConfig(samples=256, elites=32, iterations=10), mppi.MPPIHyper()
TARGET = jnp.array([[0.6, -0.4], [-0.7, 0.2], [0.1, 0.9]])  # [H, act_dim]
NONE = jnp.zeros((0, 3, 2))


def quadratic(sequence):
    return -4 * jnp.sum((sequence - TARGET) ** 2)


def run(score, *, config=CONFIG, hyper=HYPER, proposals=NONE, previous=None, explore=False):
    """key -> (action, mean), jitted."""
    previous = jnp.zeros(proposals.shape[1:]) if previous is None else previous
    return jax.jit(lambda key: mppi.plan(config, hyper, score, proposals, previous, key, explore=explore))


PLAN = run(quadratic)


def test_finds_the_optimum_of_a_quadratic(key):
    action, mean = PLAN(key)
    np.testing.assert_allclose(mean, TARGET, atol=0.06)
    np.testing.assert_allclose(action, TARGET[0], atol=0.2)  # one elite: spread 0.05


def test_actions_stay_in_the_box(key):
    best = jnp.full((3, 2), 1.5)
    action, mean = run(lambda s: -4 * jnp.sum((s - best) ** 2), explore=True)(key)
    np.testing.assert_allclose(mean, 1.0, atol=0.02)
    assert jnp.all(action <= 1.0)


def test_warm_start_is_the_last_plan_one_step_later(key):
    tight = mppi.MPPIHyper(std_min=1e-6, std_max=1e-6)  # samples are the mean of the first iteration
    _, mean = run(quadratic, hyper=tight, previous=TARGET)(key)
    np.testing.assert_allclose(mean, jnp.array([[-0.7, 0.2], [0.1, 0.9], [0.0, 0.0]]), atol=1e-4)


# Two proposals alone are any good. With temperature 0.5 the second weighs exp(0.5 * -2 log 3) = 1/3 of the first, that
# is 1/4 of all: mean 0.1 (3/4 - 1/4) = 0.05, variance 0.01 - 0.05^2 = 0.0075.
PAIR = jnp.array([[[0.1]], [[-0.1]]])


def pair_score(sequence):
    a = sequence[0, 0]
    return jnp.where(a == 0.1, 3.0, jnp.where(a == -0.1, 3.0 - 2 * jnp.log(3.0), -1e6))


@pytest.mark.parametrize("explore", [False, True])
def test_weights_choice_and_noise_by_hand(key, explore):
    two = mppi.MPPIConfig(samples=8, elites=2, iterations=2)
    plan = run(pair_score, config=two, proposals=PAIR, explore=explore)
    actions, means = jax.vmap(plan)(jax.random.split(key, 4000))
    np.testing.assert_allclose(means, 0.05, rtol=1e-5)
    assert actions.mean() == pytest.approx(0.05, abs=0.006)
    # exploring adds noise of the elites' own spread to the elite drawn
    assert actions.std() == pytest.approx((0.015 if explore else 0.0075) ** 0.5, rel=0.05)
    assert explore or set(actions.flatten().tolist()) == {float(np.float32(0.1)), float(np.float32(-0.1))}


def test_noise_is_that_of_the_first_step_of_a_plan(key):
    """The elites agree on the first step, so its spread is the floor, 0.05; they differ by 2 in the second one."""
    apart = jnp.array([[[0.1], [-1.0]], [[0.1], [1.0]]])

    def score(sequence):
        return jnp.where((sequence[0, 0] == 0.1) & (jnp.abs(sequence[1, 0]) == 1.0), 0.0, -1e6)

    plan = run(score, config=mppi.MPPIConfig(samples=8, elites=2, iterations=2), proposals=apart, explore=True)
    actions = jax.vmap(plan)(jax.random.split(key, 1000))[0]
    assert actions.std() == pytest.approx(0.05, rel=0.1)


def test_spread_has_a_floor(key):
    one = mppi.MPPIConfig(samples=8, elites=1, iterations=2)
    plan = run(pair_score, config=one, proposals=PAIR, explore=True)
    actions = jax.vmap(plan)(jax.random.split(key, 4000))[0]
    assert actions.mean() == pytest.approx(0.1, abs=0.005) and actions.std() == pytest.approx(0.05, rel=0.05)


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf, -jnp.inf])
@pytest.mark.parametrize("other", [-100.0, -1.0, 1.0])
def test_scores_that_are_not_finite_rank_last(key, bad, other):
    """Also where all true scores are negative, so that 0 would be the best of them."""
    actions, means = jax.vmap(run(lambda s: jnp.where(s[0, 0] > 0, bad, other)))(jax.random.split(key, 20))
    assert (actions[:, 0] <= 0).all() and (means[:, 0, 0] < 0).all()


def test_no_score_at_all_gives_a_finite_plan(key):
    action, mean = run(lambda s: jnp.nan * s[0, 0], proposals=TARGET[None], explore=True)(key)
    assert jnp.isfinite(action).all() and jnp.isfinite(mean).all() and (jnp.abs(action) <= 1).all()


def test_a_good_proposal_is_taken(key):
    def needle(s):
        return 50 * jnp.all(s == TARGET) - jnp.sum(s**2)

    action, mean = run(needle, proposals=TARGET[None])(key)
    np.testing.assert_allclose(action, TARGET[0])
    np.testing.assert_allclose(mean, TARGET, atol=1e-4)


def test_vmap_equals_a_loop_and_keys_decide(key):
    keys = jax.random.split(key, 2)
    both = jax.vmap(PLAN)(keys)
    for i in range(2):
        chex.assert_trees_all_close(jax.tree.map(lambda x, i=i: x[i], both), PLAN(keys[i]), atol=1e-5)
    assert jnp.array_equal(PLAN(key)[0], PLAN(key)[0]) and not jnp.array_equal(both[0][0], both[0][1])
    with jax.debug_key_reuse(True):
        run(quadratic, explore=True)(jax.random.key(3))


def test_hyperparameters_vmap(key):
    greed = jnp.array([1e-6, 100.0])

    def plan(t):
        return mppi.plan(CONFIG, HYPER._replace(temperature=t), quadratic, NONE, TARGET, key, explore=False)

    error = jnp.abs(jax.jit(jax.vmap(plan))(greed)[1] - TARGET[None]).max((1, 2))
    assert error[0] != error[1]


def test_impossible_options_are_refused(key):
    for options, match in (
        ({"samples": 4, "elites": 5}, "elites is 5"),
        ({"elites": 0}, "elites is 0"),
        ({"iterations": 0}, "iterations"),
    ):
        with pytest.raises(UserError, match=match):
            mppi.MPPIConfig(**options)
    with pytest.raises(UserError, match="256 proposals"):
        run(quadratic, proposals=jnp.zeros((256, 3, 2)))(key)
