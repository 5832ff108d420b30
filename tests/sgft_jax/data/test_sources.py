"""Sources: which rows a batch holds, in which order, and how many of each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import Transition
from sgft_jax.data import replay, sequences, sources
from sgft_jax.types import SimulatedData

REAL, SIM = 1.0, 100.0


def rows(value, n):
    """Rows that cannot be mistaken for others."""
    x = jnp.full(n, value)
    return Transition(x[:, None], x[:, None], x, x, x[:, None])


STATE = (
    replay.add_batch(replay.init(replay.blank(1, 1), 5), rows(REAL, 3)),
    SimulatedData(lambda key, n: rows(SIM, n), jnp.zeros(1)),
)


@pytest.mark.parametrize(
    ("source", "real", "simulated"),
    [
        (sources.real_rows(4), 4, 0),
        (sources.simulated_rows(4), 0, 4),
        (sources.mixture(3, 2), 3, 2),
        (sources.mixture(5, 0), 5, 0),
        (sources.mixture(0, 3), 0, 3),
    ],
)
def test_real_rows_come_first_and_the_numbers_are_static(source, real, simulated, key):
    batch = jax.jit(lambda key: source.sample(STATE, key))(key)
    assert (source.n_real, source.n_sim) == (real, simulated)
    for x in (batch.obs[:, 0], batch.action[:, 0], batch.reward, batch.discount, batch.next_obs[:, 0]):
        assert x.tolist() == [REAL] * real + [SIM] * simulated
    if real and simulated:
        assert batch.is_sim.tolist() == [False] * real + [True] * simulated


def test_two_buffers_draw_from_a_fixed_set_and_a_growing_one(key):
    """Of the growing one only what it holds."""
    source = sources.two_buffers(3, 20)
    assert (source.n_real, source.n_sim) == (3, 20)
    growing = replay.add_batch(replay.init(replay.blank(1, 1), 500), rows(SIM, 2))
    batch = jax.jit(source.sample)((replay.full(rows(REAL, 4)), growing), key)
    assert batch.reward.tolist() == batch.next_obs[:, 0].tolist() == [REAL] * 3 + [SIM] * 20
    assert batch.is_sim.tolist() == [False] * 3 + [True] * 20


def test_beside_draws_twice_and_independently(key):
    """A mixture, then another mixture of rows of their own."""
    source = sources.beside(sources.two_buffers(2, 1), sources.two_buffers(30, 30))
    real, sim = (replay.full(rows(0.0, 500)._replace(reward=jnp.arange(500.0) + start)) for start in (0, 1000))
    batch = jax.jit(source.sample)((real, sim), key)
    assert (source.n_real, source.n_sim) == (32, 31)
    assert batch.is_sim.tolist() == (batch.reward >= 1000).tolist() == [False] * 2 + [True] + [False] * 30 + [True] * 30
    assert batch.reward[:2].tolist() != batch.reward[3:5].tolist()


def test_what_a_source_does_not_say_is_none(key):
    """It then costs nothing: a batch of real rows has five arrays."""
    assert len(jax.tree.leaves(sources.real_rows(4).sample(STATE, key))) == 5
    assert len(jax.tree.leaves(sources.mixture(3, 2).sample(STATE, key))) == 6


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize(("share", "simulated"), [(0.0, 0), (0.5, 4), (0.8, 6), (1.0, 8)])
def test_a_blend_has_its_share_of_simulated_rows(key, share, simulated, traced):
    def draw(share):
        return sources.blend(sources.mixture(8, 8), share).sample(STATE, key)

    batch = jax.jit(draw)(jnp.float32(share)) if traced else draw(share)
    assert batch.reward.tolist() == [REAL] * (8 - simulated) + [SIM] * simulated
    assert batch.is_sim.tolist() == [False] * (8 - simulated) + [True] * simulated
    np.testing.assert_array_equal(batch.obs[:, 0], batch.reward)


@pytest.mark.heavy
def test_windows_of_real_steps(key):
    ring = sequences.add_episode(sequences.init(replay.blank(1, 1), 6), rows(REAL, 4), jnp.ones(4, bool))
    batch = sources.real_windows(16, 3).sample((ring, None), key)
    assert batch.obs.shape == (16, 3, 1) and batch.valid.shape == (16, 3) and batch.valid[:, 0].all()
    np.testing.assert_array_equal(batch.reward, np.where(batch.valid, REAL, 0.0))


def test_draws_follow_the_key_and_are_independent(key):
    """The real and the simulated rows have keys of their own."""
    seen = []
    data = SimulatedData(lambda key, n: (seen.append(key), rows(SIM, n))[1], jnp.zeros(1))
    many = replay.add_batch(replay.init(replay.blank(1, 1), 500), rows(0.0, 500)._replace(reward=jnp.arange(500.0)))
    one, again = (sources.mixture(40, 2).sample((many, data), key) for _ in range(2))
    other = sources.mixture(40, 2).sample((many, data), jax.random.key(1))
    np.testing.assert_array_equal(one.reward, again.reward)
    assert not jnp.array_equal(one.reward, other.reward) and seen[0] != key and seen[0] == seen[1] != seen[2]
