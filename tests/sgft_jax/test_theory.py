"""The paper's lemmas and theorem on random systems, and where their printed forms fail or say nothing."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sgft_jax import theory

STATES, ACTIONS, GAMMA, HORIZONS = 6, 3, 0.9, (1, 2, 5)
CLOSE = 2e-3  # of values up to 10 in single precision

seeds = st.integers(0, 2**31 - 1)
examples = settings(max_examples=60, deadline=None)


@functools.partial(jax.jit, static_argnames="horizon")
def measured(seed, horizon):
    """Random systems and a V_sim that is improvable."""
    key_systems, key_plan = jax.random.split(jax.random.key(seed))
    sim, real, model = theory.draw_systems(key_systems, STATES, ACTIONS)
    guide = theory.lowered(real, theory.optimal(sim, GAMMA), GAMMA)
    return theory.measure(real, model, guide, GAMMA, horizon, key_plan)


@examples
@given(seed=seeds, horizon=st.sampled_from(HORIZONS))
def test_no_bound_is_ever_broken(seed, horizon):
    x, bound = measured(seed, horizon), {"gamma": GAMMA, "horizon": horizon}
    assert x.improvability > -CLOSE
    assert x.growth > -CLOSE, "Lemma 3"
    assert x.apart <= theory.lemma_1(x.constants, **bound) + CLOSE
    assert x.plan <= theory.lemma_2(x.constants, **bound) + CLOSE
    assert x.policy <= theory.lemma_4(x.constants, **bound, loss=x.first) + CLOSE
    assert x.policy <= theory.theorem_1(x.constants, **bound) + CLOSE
    assert x.policy <= theory.bhardwaj(x.constants, **bound) + CLOSE
    assert x.any_plan <= theory.lemma_2(x.constants, **bound, printed=True) + CLOSE, "whatever the model"


@jax.jit
def random_system(seed):
    """A system and a V_sim that have nothing to do with each other."""
    key_system, key_guide = jax.random.split(jax.random.key(seed))
    return theory.draw_systems(key_system, STATES, ACTIONS)[0], jax.random.normal(key_guide, (STATES,))


def two_states(likely):
    """Both actions lead to the second state with this probability, from everywhere."""
    return theory.dense(jnp.broadcast_to(jnp.array([1.0 - likely, likely]), (2, 2, 2)), jnp.zeros(2))


def test_lemma_1_as_printed_fails_where_the_model_misses_one_step():
    """The corrected bound is met exactly: the model's error counts once, discounted once."""
    real, model, guide = two_states(0.5), two_states(0.8), jnp.array([0.0, 1.0])
    still = jnp.zeros((1, 2), jnp.int32)
    apart = jnp.abs(theory.worth(real, still, guide, GAMMA) - theory.worth(model, still, guide, GAMMA)).max()
    c = theory.constants(real, model, guide, theory.optimal(real, GAMMA))
    np.testing.assert_allclose([apart, c.model], [GAMMA * 0.3, 0.6], rtol=1e-5)
    np.testing.assert_allclose(theory.lemma_1(c, GAMMA, 1), apart, rtol=1e-5)
    assert theory.lemma_1(c, GAMMA, 1, printed=True) < 0.95 * apart


def test_lemma_2_as_printed_does_not_shrink_with_the_error_of_the_model():
    real, guide = two_states(0.5), jnp.array([0.0, 1.0])
    value = theory.optimal(real, GAMMA)
    near, far = (theory.constants(real, two_states(p), guide, value) for p in (0.5, 0.9))
    assert theory.lemma_2(near, GAMMA, 4) < 1e-5 < theory.lemma_2(far, GAMMA, 4)
    assert theory.lemma_2(near, GAMMA, 4, printed=True) == theory.lemma_2(far, GAMMA, 4, printed=True) > 0.5


@jax.jit
def renamed(seed):
    """Feasible next states alike, actions different: real actions are the simulator's by other names."""
    sim, _ = random_system(seed)
    names = jnp.argsort(jax.random.uniform(jax.random.key(seed), (STATES, ACTIONS)), axis=1)
    real = theory.dense(jnp.take_along_axis(sim.odds, names[..., None], axis=1), sim.reward)
    guide = theory.optimal(sim, GAMMA)
    best, same = (theory.plan(system, guide, GAMMA, 1).actions[0] for system in (sim, real))
    meant = jnp.take_along_axis(names, same[:, None], axis=1)[:, 0]
    return theory.improvability(real, guide, GAMMA).min(), best, meant


@examples
@given(seed=seeds)
def test_the_simulators_value_is_improvable_where_every_move_is_possible(seed):
    least, best, meant = renamed(seed)
    assert least > -CLOSE
    np.testing.assert_array_equal(meant, best)


@jax.jit
def lower(seed):
    system, guide = random_system(seed)
    lower = theory.lowered(system, guide, GAMMA)
    plans = [theory.plan(system, v, GAMMA, 3) for v in (guide, lower)]
    return theory.improvability(system, lower, GAMMA), guide - lower, *plans


@examples
@given(seed=seeds)
def test_lowering_v_sim_makes_it_improvable_and_changes_no_plan(seed):
    improvability, by, before, after = lower(seed)
    assert improvability.min() > -CLOSE and np.ptp(by) < 1e-5 and by[0] >= 0
    np.testing.assert_allclose(after.values[3] - before.values[3], by * (1 - GAMMA**3), atol=CLOSE)
    np.testing.assert_array_equal(after.actions, before.actions)


def test_a_plan_is_worth_what_it_promises_in_its_own_system():
    system, guide = random_system(0)
    plan = theory.plan(system, guide, GAMMA, 4)
    np.testing.assert_allclose(theory.worth(system, plan.actions, guide, GAMMA), plan.values[4], atol=1e-4)
    np.testing.assert_array_equal(plan.values[0], 0)


def test_values_are_those_of_linear_equations():
    system, _ = random_system(0)
    actions = np.array([0, 1, 2, 0, 1, 2])
    exact = np.linalg.solve(np.eye(STATES) - GAMMA * system.odds[np.arange(STATES), actions], system.reward)
    np.testing.assert_allclose(theory.followed(system, jnp.array(actions), GAMMA), exact, atol=1e-3)
    value = theory.optimal(system, GAMMA)
    best = theory.plan(system, value, GAMMA, 1).actions[0]
    np.testing.assert_allclose(theory.followed(system, best, GAMMA), value, atol=1e-3)


@pytest.mark.parametrize(
    ("start", "wanted"),
    [
        ((1.0, 0.0), {(2, 0): 1.0}),  # on the grid
        ((1.0, 0.25), {(2, 0): 0.75, (2, 1): 0.25}),
        ((3.0, 9.0), {(0, 2): 1.0}),  # round, and beyond the end
    ],
)
def test_a_grid_interpolates_turns_round_and_ends(start, wanted):
    axes = np.arange(4.0), np.arange(3.0)
    system = theory.gridded(
        lambda state, action: jnp.asarray(start) + jnp.array([action, 0.0]),
        lambda state: state[0],
        axes,
        jnp.array([1.0]),
        wraps=(True, False),
    )
    odds = np.zeros(12)
    np.add.at(odds, system.successors[0, 0], system.odds[0, 0])
    assert {divmod(int(i), 3): float(odds[i]) for i in np.flatnonzero(odds)} == wanted
    np.testing.assert_array_equal(system.reward, np.repeat(np.arange(4.0), 3))
