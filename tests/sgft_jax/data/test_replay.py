"""Ring buffer: order, overwriting, invalid rows, vmap."""

import jax
import jax.numpy as jnp
import pytest

from envs.types import Transition, UserError
from sgft_jax.data import replay


def rows(values):
    """Transitions that carry `values` in every field that can hold them."""
    x = jnp.asarray(values, jnp.float32)
    obs = x[..., None]
    return Transition(obs, obs, x, x, obs)


add_batch, sample = jax.jit(replay.add_batch), jax.jit(replay.sample, static_argnums=2)
EMPTY = replay.init(rows(0.0), 5)


def test_dtypes_and_sizes():
    assert all(x.dtype == jnp.float32 for x in EMPTY.data)
    assert EMPTY.data.obs.shape == (5, 1) and EMPTY.data.reward.shape == (5,) and EMPTY.size == 0


def test_oldest_rows_are_overwritten():
    state = add_batch(EMPTY, rows([1, 2, 3]))
    assert state.data.reward.tolist() == [1, 2, 3, 0, 0] and (state.position, state.size) == (3, 3)
    state = add_batch(state, rows([4, 5, 6]))
    # 6 goes round the corner and replaces 1
    assert state.data.reward.tolist() == [6, 2, 3, 4, 5] and (state.position, state.size) == (1, 5)


def test_invalid_rows_take_no_space():
    state = add_batch(EMPTY, rows([1, jnp.nan, 3]), jnp.array([True, False, True]))
    assert state.data.reward.tolist() == [1, 3, 0, 0, 0] and state.size == 2
    full = add_batch(EMPTY, rows([1, 2, 3, 4, 5]))
    same = add_batch(full, rows([jnp.nan, jnp.nan]), jnp.zeros(2, bool))
    assert same.data.reward.tolist() == [1, 2, 3, 4, 5] and same.position == full.position


def test_invalid_rows_are_never_sampled(key):
    state = replay.init(rows(0.0), 7)
    held = []
    for step in range(6):
        values = [10 * step + i + 1 for i in range(4)]
        valid = [(step + i) % 3 != 0 for i in range(4)]
        held += [v for v, ok in zip(values, valid, strict=True) if ok]
        batch = rows([v if ok else jnp.nan for v, ok in zip(values, valid, strict=True)])
        state = add_batch(state, batch, jnp.array(valid))
        drawn = sample(state, jax.random.fold_in(key, step), 400).reward
        assert set(drawn.tolist()) == set(held[-7:])


def test_the_spread_of_observations_is_that_of_filled_rows():
    """1, 3 and 5: mean 3, variance 8/3. With the two rows of zeros it would be 1.94."""
    state = add_batch(EMPTY, rows([1, 3, 5]))
    assert replay.obs_std(state)[0] == pytest.approx((8 / 3) ** 0.5, rel=1e-6)
    assert replay.obs_std(EMPTY)[0] == 0.0


def test_sampling_is_uniform_and_keeps_rows_together(key):
    state = add_batch(EMPTY, rows([1, 2, 3, 4]))
    batch = sample(state, key, 8000)
    counts = jnp.bincount(batch.reward.astype(int), length=6)
    assert counts[0] == 0 and counts[5] == 0
    assert jnp.all(jnp.abs(counts[1:5] - 2000) < 200)  # 5 standard deviations: sqrt(8000 / 4 * 3 / 4) = 39
    assert jnp.all(batch.obs[:, 0] == batch.reward) and jnp.all(batch.next_obs[:, 0] == batch.reward)


@pytest.mark.heavy
def test_vmap_over_seeds_equals_a_loop(key):
    batch = rows([[1, 2, 3], [4, 5, 6]])
    valid = jnp.array([[True, True, True], [True, False, True]])
    both = jax.vmap(replay.add_batch, (None, 0, 0))(EMPTY, batch, valid)
    for i in range(2):
        one = add_batch(EMPTY, jax.tree.map(lambda x, i=i: x[i], batch), valid[i])
        assert all(jnp.array_equal(a[i], b) for a, b in zip(jax.tree.leaves(both), jax.tree.leaves(one), strict=True))


def test_a_batch_that_does_not_fit_is_an_error():
    with pytest.raises(UserError, match="capacity of 5"):
        add_batch(EMPTY, rows([1, 2, 3, 4, 5, 6]))
    with pytest.raises(UserError, match="capacity 0"):
        replay.init(rows(0.0), 0)
