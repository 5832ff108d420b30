"""What every learner keeps: compiled once, one program for all seeds, resumed exactly, and it learns."""

import chex
import jax
import jax.numpy as jnp
import keys
import numpy as np
import probes
import pytest
from probes import MAKERS, PROBES

from sgft_jax.io import checkpoint

PLANNERS = {"tdmpc2", "sgft-tdmpc2"}
OF_WINDOWS = PLANNERS | {"recurrent", "rebrac"}
LATER = {"reward one step later", "time limit", "termination"}  # a memory must have seen the second step for these
# What takes long: the fast tests see less of it.
SOME = {"time limit", "termination", "state and action decide"}
QUICK = {
    "sac": SOME,
    "iql": SOME,
    "h2oplus": set(),
    "tdmpc2": set(),
    "sgft-tdmpc2": set(),
    "sac, ten critics": set(),
    "h2oplus, four critics": set(),
    "h2o": set(),
    "darc": set(),
    "cql": set(),
    "edac": set(),
    "rebrac": set(),
    "recurrent": set(),
}
# Made of what the others are made of, or tested at length in a file of their own.
SLOW = {
    "sac, ten critics",
    "h2oplus",
    "h2oplus, four critics",
    "h2o",
    "darc",
    "cql",
    "edac",
    "rebrac",
    "tdmpc2",
    "sgft-tdmpc2",
    "recurrent",
}


def slow_if(slow, *values):
    return pytest.param(*values, marks=[pytest.mark.slow] if slow else [])


each_learner = pytest.mark.parametrize("name", [slow_if(name in SLOW, name) for name in MAKERS])


def trained(name, probe, key, steps):
    """A state after so many updates on fresh rows of a probe, and the one before."""
    case = probes.case(name)
    batches = jax.jit(jax.vmap(lambda key: case.feed(probes.rows(PROBES[probe], key))))(jax.random.split(key, 20))
    batches = [jax.tree.map(lambda x, i=i: x[i], batches) for i in range(20)]
    state = start = case.start(key)
    for step, sub in enumerate(jax.random.split(key, steps)):
        state, _ = case.learner.update(state, batches[step % 20], sub)
    return start, state


def bits(tree):
    """Every leaf as bytes."""

    def raw(x):
        return jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x

    return [np.asarray(raw(jnp.asarray(x))).tobytes() for x in jax.tree.leaves(tree)]


# --- learners -------------------------------------------------------------------------------------------------------


@pytest.mark.heavy_after_first
@each_learner
def test_update_compiles_once(name, key):
    """However often it has run before."""
    trained(name, "constant reward", key, 1)
    before = list(probes.case(name).traces)
    trained(name, "termination", key, 3)
    assert probes.case(name).traces == before


@pytest.mark.heavy
@pytest.mark.parametrize("name", [slow_if(name != "iql", name) for name in MAKERS])
def test_vmap_over_seeds_equals_each_alone(name, key):
    """From states with Adam moments: a first step would make rounding errors as long as any other step."""
    case, seeds = probes.case(name), jax.random.split(key, 2)
    alone = [trained(name, "state and action decide", seed, 2)[1] for seed in seeds]
    batch = case.feed(probes.rows(PROBES["time limit"], key))
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *alone)
    together, metrics = jax.jit(jax.vmap(probes.MAKERS[name]().learner.update, (0, None, 0)))(stacked, batch, seeds)
    for i in range(2):
        one = case.learner.update(alone[i], batch, seeds[i])
        chex.assert_trees_all_close(jax.tree.map(lambda x, i=i: x[i], (together, metrics)), one, rtol=1e-3, atol=1e-4)
    assert bits(jax.tree.map(lambda x: x[0], together)) != bits(jax.tree.map(lambda x: x[1], together))


@pytest.mark.heavy
@each_learner
def test_a_restored_state_goes_on_with_the_same_bits(name, key, tmp_path):
    case = probes.case(name)
    _, state = trained(name, "time limit", key, 2)
    checkpoint.save(tmp_path, 2, state, meta={})
    restored, _ = checkpoint.restore(tmp_path, jax.eval_shape(case.start, key))
    batch = case.feed(probes.rows(PROBES["time limit"], key))
    assert bits(case.learner.update(restored, batch, key)) == bits(case.learner.update(state, batch, key))


@each_learner
def test_the_best_action_is_deterministic_and_in_bounds(name, key):
    case = probes.case(name)
    _, state = trained(name, "action decides", key, 2)
    for s in (-3.0, 0.0, 50.0):
        action, carry = case.learner.act(state, case.learner.init_carry(), probes.obs_of(s), key, explore=False)
        again, same = case.learner.act(state, case.learner.init_carry(), probes.obs_of(s), key, explore=False)
        assert bits((action, carry)) == bits((again, same)) and action.shape == (1,) and jnp.abs(action[0]) <= 1
        chex.assert_trees_all_equal_shapes_and_dtypes(carry, case.learner.init_carry())
        if name not in PLANNERS:  # a plan is a search and has a key; without noise the same key finds the same
            carry = case.learner.init_carry()
            other = case.learner.act(state, carry, probes.obs_of(s), jax.random.key(1), explore=False)[0]
            assert bits(action) == bits(other)


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("name", [slow_if(name in {"sac, ten critics", "sgft-tdmpc2"}, name) for name in MAKERS])
def test_no_key_is_used_twice(name):
    """In beginning, exploring and learning."""
    learner = probes.case(name).learner

    def whole(key):
        key_init, key_rows, key_act, key_update = jax.random.split(key, 4)
        state, batch = learner.init(key_init), probes.case(name).feed(probes.rows(PROBES["action decides"], key_rows))
        action, _ = learner.act(state, learner.init_carry(), probes.obs_of(0.0), key_act, explore=True)
        return action, learner.update(state, batch, key_update)

    assert keys.used_twice(whole) == 0


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("name", "probe"),
    [
        slow_if(probe not in QUICK.get(name, PROBES), name, probe)
        for name in MAKERS
        for probe in PROBES
        if name != "recurrent" or probe not in LATER
    ],
)
def test_probe(name, probe, key):
    case, known = probes.case(name), PROBES[probe]
    start, state = trained(name, probe, key, case.steps)
    for s, value in known.values.items():
        if case.values is None:  # V_sim of SGFT-TDMPC-2
            assert bits((state.critic, state.encoder)) == bits((start.critic, start.encoder))
        else:
            np.testing.assert_allclose(case.values(state, probes.obs_of(s)), value, atol=0.1 * max(1, abs(value)))
    # An action that is 0.2 off costs 0.04 of reward: about what the bins of a planner's heads resolve.
    near = 0.25 if name in PLANNERS else 0.15
    for s, action in known.actions.items():
        assert case.mode(state, probes.obs_of(s))[0] == pytest.approx(action, abs=near)


# --- which rows count -----------------------------------------------------------------------------------------------

FLAT = [name for name in MAKERS if name not in OF_WINDOWS]
HALF = probes.ROWS // 2


def weighed(name, fields):
    """One update of a state with Adam moments on a batch with further fields; the new state and the losses."""
    case, key = probes.case(name), jax.random.key(4)
    _, state = trained(name, "state and action decide", key, 2)
    batch = case.feed(probes.rows(PROBES["state and action decide"], key))
    new, metrics = case.learner.update(state, fields(batch), jax.random.key(5))
    return new, {loss: x for loss, x in metrics.items() if loss.endswith("loss")}


each_flat_learner = pytest.mark.parametrize("name", [slow_if(name != "iql", name) for name in FLAT])


def counted(batch, valid=None, weight=None):
    """Rows as they count, with all fields that say so, which is one program for all that follows."""
    ones = jnp.ones(probes.ROWS)
    return batch._replace(valid=ones > 0 if valid is None else valid, weight=ones if weight is None else weight)


def rows_where(mask, new, old):
    return jnp.where(jnp.expand_dims(mask, tuple(range(1, new.ndim))), new, old)


@pytest.mark.heavy
@each_flat_learner
def test_invalid_rows_do_not_count(name):
    """Whatever finite numbers they hold."""
    valid = jnp.arange(probes.ROWS) < HALF
    numbers = ("obs", "action", "reward", "discount", "next_obs")

    def torn(batch):
        other = {x: rows_where(valid, getattr(batch, x), 0.5 * jnp.flip(getattr(batch, x)) + 3.0) for x in numbers}
        return counted(batch, valid=valid)._replace(**other)

    clean, dirty = weighed(name, lambda batch: counted(batch, valid=valid)), weighed(name, torn)
    chex.assert_trees_all_close(clean, dirty, rtol=1e-5, atol=1e-6)
    assert bits(clean) != bits(weighed(name, lambda batch: batch))


@pytest.mark.heavy
@each_flat_learner
def test_a_row_of_weight_two_counts_twice(name):
    """Of weight 0 it does not count at all; weights of 1 change nothing."""
    twice = jnp.where(jnp.arange(probes.ROWS) < HALF, 2.0, 0.0)
    heavy = weighed(name, lambda batch: counted(batch, weight=twice))
    alone = weighed(name, lambda batch: counted(batch, valid=twice > 0))
    chex.assert_trees_all_close(heavy, alone, rtol=1e-5, atol=1e-6)
    ones = weighed(name, counted)
    chex.assert_trees_all_close(ones, weighed(name, lambda batch: batch), rtol=1e-5, atol=1e-6)


def test_a_row_of_weight_two_is_the_row_twice(key):
    """With a learner that draws nothing: rows 0, 1, 1 are rows 0 and 1 with weights 2/3 and 4/3."""
    case = probes.case("iql")
    state = case.start(key)
    rows, places = probes.rows(PROBES["state and action decide"], key), np.arange(probes.ROWS)
    again = jax.tree.map(lambda x: x[np.minimum(places, 1)], rows)  # 0, 1, 1, ...
    weights = jnp.asarray(np.where(places == 0, 2 / 3, 4 / 3), jnp.float32)
    weighted = case.learner.update(state, counted(rows, valid=places < 2, weight=weights), key)[0]
    doubled = case.learner.update(state, counted(again, valid=places < 3), key)[0]
    for part in ("critic", "value", "actor"):
        moments = [getattr(new, part).moments for new in (weighted, doubled)]
        chex.assert_trees_all_close(*moments, rtol=1e-3, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(OF_WINDOWS))
def test_a_window_of_weight_two_counts_twice(name):
    """The range of values, which scales the policy's loss, counts all windows."""
    twice = jnp.where(jnp.arange(probes.ROWS) < HALF, 2.0, 0.0)
    heavy, metrics = weighed(name, lambda batch: batch._replace(weight=twice))
    alone, same = weighed(name, lambda batch: batch._replace(valid=batch.valid & (twice > 0)[:, None]))
    chex.assert_trees_all_close(heavy, alone, rtol=1e-4, atol=1e-5)
    chex.assert_trees_all_close(metrics, same, rtol=1e-4, atol=1e-5)
