"""The ring of time slots against one made of Python lists."""

import random

import chex
import jax
import jax.numpy as jnp
import pytest

from envs.types import Transition, UserError
from sgft_jax.data import sequences

LENGTH, DRAWS = 4, 300


def rows(values):
    """Transitions that carry `values` in every field that can hold them; next_obs is the value + 0.5."""
    x = jnp.asarray(values, jnp.float32)
    return Transition(x[..., None], x[..., None], x, x, x[..., None] + 0.5)


add = jax.jit(sequences.add)
add_episode = jax.jit(sequences.add_episode)
sample = jax.jit(sequences.sample, static_argnames=("n", "length"))
sample_episodes = jax.jit(sequences.sample_episodes, static_argnames=("n", "length"))


def windows(ring, key, sample=sample):
    """The valid parts of DRAWS windows, as a set of tuples of values; checks that masks are prefixes and rest is 0."""
    drawn = sample(ring, key, DRAWS, LENGTH)
    found = set()
    for values, next_obs, valid in zip(
        drawn.reward.tolist(), drawn.next_obs[..., 0].tolist(), drawn.valid.tolist(), strict=True
    ):
        n = sum(valid)
        assert valid == [True] * n + [False] * (LENGTH - n)
        assert not any(values[n:]) and next_obs == [v + 0.5 for v in values[:n]] + [0] * (LENGTH - n)
        found.add(tuple(int(v) for v in values[:n]))
    return found


def expected(held):
    """The windows from every valid row of one environment; held: [(value, valid, last)], oldest first."""
    return {window_at(held, start) for start, (_, valid, _) in enumerate(held) if valid}


def window_at(held, start):
    """The window that begins at that row."""
    window = []
    for value, ok, last in held[start : start + LENGTH]:
        if not ok:
            break
        window.append(value)
        if last:
            break
    return tuple(window)


@pytest.mark.heavy
def test_a_fixed_set_is_drawn_from_without_a_look_at_all_its_rows(key):
    """The same windows as from a ring that counts its valid rows."""
    ring = sequences.full(rows(jnp.arange(50.0)), jnp.arange(50) % 7 == 6)
    counted = ring.replace(fixed=False)
    chex.assert_trees_all_equal(*(sample(r, key, DRAWS, LENGTH) for r in (ring, counted)))
    programs = [str(jax.make_jaxpr(lambda r: sequences.sample(r, key, DRAWS, LENGTH))(r)) for r in (ring, counted)]
    assert ["cumsum" in program for program in programs] == [False, True]
    with pytest.raises(UserError, match="a fixed set of data, which takes no further rows"):
        sequences.add(ring, rows(jnp.zeros(1)), jnp.ones(1, bool), jnp.zeros(1, bool))


def test_windows_equal_those_of_a_python_ring(key):
    n_envs, slots, rng = 3, 7, random.Random(0)
    ring, held = sequences.init(rows(0.0), slots, n_envs), [[] for _ in range(n_envs)]
    for step in range(25):
        values = [100 * (env + 1) + step for env in range(n_envs)]
        valid = [rng.random() > 0.15 for _ in range(n_envs)]
        last = [not ok or rng.random() < 0.2 for ok in valid]
        ring = add(ring, rows(values), jnp.array(valid), jnp.array(last))
        for env in range(n_envs):
            held[env] = [*held[env], (values[env], valid[env], last[env])][-slots:]
        got = windows(ring, jax.random.fold_in(key, step))
        assert got == set.union(*(expected(h) for h in held)), step


def test_episodes_equal_those_of_a_python_ring(key):
    slots, rng = 12, random.Random(1)
    ring, held = sequences.init(rows(0.0), slots), []
    for episode in range(8):
        values = [10 * (episode + 1) + t for t in range(5)]
        exploded = rng.choice([2, 4, 5, 5])  # 5: not at all
        valid = [t < exploded for t in range(5)]
        ring = add_episode(ring, rows(values), jnp.array(valid))
        held = [*held, *((v, True, t == exploded - 1) for t, v in enumerate(values[:exploded]))][-slots:]
        assert windows(ring, jax.random.fold_in(key, episode)) == expected(held)
        assert ring.size == len(held)


def test_a_hole_in_an_episode_ends_the_windows_before_it(key):
    ring = add_episode(sequences.init(rows(0.0), 12), rows([1, 2, 3, 4, 5]), jnp.array([True, True, False, True, True]))
    assert windows(ring, key) == {(1, 2), (2,), (4, 5), (5,)}


def test_starts_are_uniform_over_valid_rows(key):
    ring = add_episode(sequences.init(rows(0.0), 8), rows([1, 2, 3, 4]), jnp.ones(4, bool))
    starts = sample(ring, key, 8000, LENGTH).reward[:, 0].astype(int)
    counts = jnp.bincount(starts, length=6)
    assert counts[0] == 0 and jnp.all(jnp.abs(counts[1:5] - 2000) < 200)  # 5 standard deviations


def test_an_empty_ring_gives_nothing(key):
    drawn = sample(sequences.init(rows(0.0), 3, 2), key, 5, LENGTH)
    assert not drawn.valid.any() and not drawn.obs.any()


def test_windows_longer_than_the_ring(key):
    ring = sequences.init(rows(0.0), 2)
    for value in (1, 2, 3):
        ring = add(ring, rows([value]), jnp.ones(1, bool), jnp.zeros(1, bool))
    assert windows(ring, key) == {(2, 3), (3,)}


def test_an_exploded_row_may_hold_anything(key):
    ring = sequences.init(rows(0.0), 4)
    for value, valid in ((1, True), (jnp.nan, False), (3, True)):
        ring = add(ring, rows([value]), jnp.array([valid]), jnp.array([not valid]))
    assert windows(ring, key) == {(1,), (3,)}


@pytest.mark.heavy
def test_vmap_over_seeds(key):
    rings = jax.vmap(lambda _: sequences.init(rows(0.0), 6))(jnp.arange(2))
    valid = jnp.array([[True, True, True], [True, False, False]])
    rings = jax.jit(jax.vmap(sequences.add_episode))(rings, rows([[1, 2, 3], [4, 5, 6]]), valid)
    assert rings.size.tolist() == [3, 1]
    drawn = jax.jit(jax.vmap(lambda r, k: sequences.sample(r, k, 50, LENGTH)))(rings, jax.random.split(key, 2))
    assert set(drawn.reward[0, :, 0].tolist()) == {1, 2, 3}
    assert set(drawn.reward[1, :, 0].tolist()) == {4} and drawn.valid[1].sum() == 50


def test_impossible_sizes_are_refused():
    with pytest.raises(UserError, match="0 slots"):
        sequences.init(rows(0.0), 0)
    ring = sequences.init(rows(0.0), 2, 3)
    with pytest.raises(UserError, match="2 environments, but it is for 3"):
        sequences.add(ring, rows([1, 2]), jnp.ones(2, bool), jnp.zeros(2, bool))
    with pytest.raises(UserError, match="ring of 1 environment"):
        sequences.add_episode(ring, rows([1, 2]), jnp.ones(2, bool))
    with pytest.raises(UserError, match="3 steps does not fit 2 slots"):
        sequences.add_episode(sequences.init(rows(0.0), 2), rows([1, 2, 3]), jnp.ones(3, bool))


@pytest.mark.heavy
def test_episodes_begin_where_those_of_a_python_ring_do(key):
    """All windows from the first rows of episodes, none from elsewhere; a full ring's oldest row may be anywhere."""
    n_envs, slots, rng = 2, 9, random.Random(2)
    ring, held = sequences.init(rows(0.0), slots, n_envs), [[] for _ in range(n_envs)]
    assert not sample_episodes(ring, key, 5, LENGTH).valid.any()
    for step in range(25):
        values = [100 * (env + 1) + step for env in range(n_envs)]
        valid = [rng.random() > 0.1 for _ in range(n_envs)]
        last = [not ok or rng.random() < 0.3 for ok in valid]
        ring = add(ring, rows(values), jnp.array(valid), jnp.array(last))
        if step == 13:
            ring = sequences.end_episodes(ring)
            last = [True] * n_envs
        wanted = set()
        for env in range(n_envs):
            held[env] = [*held[env], (values[env], valid[env], last[env])][-slots:]
            firsts = [i for i in range(1, len(held[env])) if held[env][i - 1][2]] + [0] * (len(held[env]) < slots)
            wanted |= {window_at(held[env], i) for i in firsts if held[env][i][1]}
        got = windows(ring, jax.random.fold_in(key, step), sample_episodes)
        assert got == (wanted or {()}), step


@pytest.mark.heavy
def test_without_a_beginning_no_window_is_valid(key):
    """Slots of a full ring in the middle of one long episode."""
    ring, no = sequences.init(rows(0.0), 3, 1), jnp.zeros(1, bool)
    for step in range(4):
        ring = add(ring, rows([step]), ~no, no)
    assert sample(ring, key, DRAWS, LENGTH).valid.any()
    assert not sample_episodes(ring, key, DRAWS, LENGTH).valid.any()
