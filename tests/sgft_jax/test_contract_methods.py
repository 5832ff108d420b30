"""What every method keeps: compiled once, members apart, resumed exactly, exported as it acts, no key used twice."""

import functools

import jax
import jax.numpy as jnp
import keys
import numpy as np
import pytest
import tuners
from tuners import METHODS, T, bits, equal

from sgft_jax.algorithms import make_policy
from sgft_jax.io import checkpoint

VARIANTS = ("sgft-relabel:ratio", "guarded:ratio")  # a method with an option on
# Each shows what others are put together of; all of them are compiled in `make test-all`.
FAST = {"sgft-sac"}
each_method = pytest.mark.parametrize("name", tuners.slow_but(FAST, [*METHODS, *VARIANTS]))
OBS = jnp.array([0.3, -0.8])


def case_of(name):
    method, _, option = name.partition(":")
    return tuners.tuner(method, **({option: True} if option else {}))


@functools.cache
def two(name):
    """Two members of a method: their case, their states after some updates, and the program that both share."""
    case = case_of(name)
    together = jax.jit(jax.vmap(lambda state, key: case.fine.learn(state, key)))
    begin = jax.tree.map(lambda *x: jnp.stack(x), *(tuners.started(case, seed) for seed in (0, 1)))
    traced = case.traces[0]
    states, metrics = together(begin, jax.random.split(jax.random.key(2)))
    assert case.traces[0] <= traced + 1  # not at all where another test has compiled it
    assert all(x.shape == (2,) and jnp.isfinite(x).all() for x in metrics.values())
    return case, states, together


def member(tree, i):
    return jax.tree.map(lambda x: x[i], tree)


@pytest.mark.heavy_after_first
@each_method
def test_one_program_learns_for_all_members_and_keeps_them_apart(name, key):
    """Swapped members give swapped results, to the bit; `learn` is not traced again for what it has returned."""
    case, states, together = two(name)
    seeds, traced = jax.random.split(key), case.traces[0]
    after, metrics = together(states, seeds)
    swapped, other = together(jax.tree.map(lambda x: x[::-1], states), seeds[::-1])
    assert equal(after, jax.tree.map(lambda x: x[::-1], swapped))
    assert equal(metrics, jax.tree.map(lambda x: x[::-1], other))
    assert not equal(member(after, 0), member(after, 1))
    assert case.traces == [traced]


@pytest.mark.heavy
@each_method
def test_a_saved_state_goes_on_with_the_same_bits(name, key, tmp_path):
    _, states, together = two(name)
    checkpoint.save(tmp_path, 1, states, meta={})
    restored, _ = checkpoint.restore(tmp_path, jax.eval_shape(lambda: states))
    seeds = jax.random.split(key)
    assert bits(together(restored, seeds)) == bits(together(states, seeds))


@pytest.mark.heavy
@each_method
def test_what_is_exported_acts_like_the_agent(name, key):
    """Also as loaded from a file, by the prior's card and what the method adds to it."""
    case, states, _ = two(name)
    state, fine, card = member(states, 0), case.fine, tuners.prior(METHODS[name.partition(":")[0]].prior).card
    params = fine.export(state)
    for policy in (case.plain.policy, make_policy({**card, **case.plain.card}, tuners.TASK)):
        act = jax.jit(policy.act)
        for explore in (jnp.bool_(False), jnp.bool_(name != "iql" and policy is case.plain.policy)):
            expected, carry = fine.act(state, fine.init_carry(), OBS, key, explore=explore)
            action, own = act(params, policy.init_carry(), OBS, key, explore=explore)
            np.testing.assert_allclose(action, expected, rtol=1e-4, atol=1e-5)
            assert jax.tree.map(jnp.shape, own) == jax.tree.map(jnp.shape, carry)
    assert expected.shape == (2,) and (jnp.abs(expected) <= 1).all()


@each_method
def test_exploring_differs_and_the_best_action_follows_from_the_key(name, key):
    case, states, _ = two(name)
    act = functools.partial(case.fine.act, member(states, 0), case.fine.init_carry(), OBS)
    best, again, explored = (act(key, explore=jnp.bool_(x))[0] for x in (False, False, True))
    assert equal(best, again) and not jnp.allclose(best, explored, atol=1e-4)


@pytest.mark.heavy
@each_method
def test_no_key_is_used_twice(name):
    """In beginning, acting, learning and the offline phase."""
    case = case_of(name)
    plain = case.plain

    def whole(key):
        parts = jax.random.split(key, 4)
        state = plain.init(case.params, parts[0])
        state = plain.prepare(state, case.data) if case.data else state
        offline = plain.learn(state, parts[1], 1, case.data, offline=True) if case.data else ()
        learned = plain.learn(state, parts[2], 1, case.data)
        return offline, learned, plain.act(state, plain.init_carry(), OBS, parts[3], explore=True)

    assert keys.used_twice(whole) == 0


def test_the_check_of_keys_finds_them():
    """A loop over one key, a key derived twice (`split(key)[1]` is `fold_in(key, 1)`), one used by a loop and after it;
    of two branches only one is taken.
    """
    normal, split, scan = jax.random.normal, jax.random.split, jax.lax.scan

    def loop(key):
        return scan(lambda x, _: (x + normal(key), None), 0.0, length=3)[0]

    def twins(key):
        return [normal(k) for k in (split(key)[1], jax.random.fold_in(key, 1))]

    def chain(key):
        return scan(lambda k, _: tuple(split(k)), key, length=2)

    def either(key, x):
        return jax.lax.cond(x > 0, normal, lambda k: normal(split(k)[0]), key)

    assert keys.used_twice(loop) == keys.used_twice(twins) == 1
    assert keys.used_twice(lambda key: (chain(key), normal(key))) == 1
    assert keys.used_twice(lambda key: jax.vmap(normal)(chain(key)[1])) == 0
    assert keys.used_twice(lambda key, x: (either(key, x), normal(key)), 1.0) == 1
    assert keys.used_twice(lambda key: jax.vmap(normal)(split(key, 5))) == keys.used_twice(either, 1.0) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_members_together_equal_each_alone(name, key):
    case, states, together = two(name)
    seeds = jax.random.split(key)
    after, _ = together(states, seeds)
    for i in range(2):
        one, _ = case.fine.learn(member(states, i), seeds[i])
        jax.tree.map(lambda x, y, i=i: np.testing.assert_allclose(x[i], y, rtol=1e-3, atol=1e-3), after, one)


@each_method
def test_invalid_rows_are_not_stored_and_may_hold_anything(name):
    case = case_of(name)
    state = case.fine.init(case.params, jax.random.key(0))
    valid = jnp.arange(T) % 2 == 1
    torn = jax.tree.map(lambda x: x.at[::2].set(jnp.nan), tuners.episode(jax.random.key(0)))
    state = case.fine.observe(state, torn, valid, jnp.float32(0))
    kept = getattr(state, "agent", state).replay  # what learns is inside of a guard, if there is one
    assert kept.size == T // 2
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(kept.data))
