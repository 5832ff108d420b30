"""Observation statistics against numpy."""

import jax
import jax.numpy as jnp
import numpy as np

from sgft_jax.models import normalizer


def test_batches_add_up_to_numpy(key):
    data = 5 + 2 * jax.random.normal(key, (1000, 3))
    statistics = normalizer.init(3)
    for batch in jnp.split(data, 10):
        statistics = normalizer.update(statistics, batch)
    mean, std = normalizer.finish(statistics)
    np.testing.assert_allclose(mean, np.mean(data, 0), rtol=1e-5)
    np.testing.assert_allclose(std, np.std(data, 0), rtol=1e-4)


def test_invalid_rows_do_not_count():
    data = jnp.array([[1.0], [jnp.nan], [3.0]])
    statistics = normalizer.update(normalizer.init(1), data, jnp.array([True, False, True]))
    mean, std = normalizer.finish(statistics)
    assert mean[0] == 2.0 and std[0] == 1.0  # of {1, 3}
    nothing = normalizer.update(statistics, jnp.full((2, 1), jnp.nan), jnp.zeros(2, bool))
    assert normalizer.finish(nothing).mean[0] == 2.0


def test_an_entry_that_never_moved_gets_the_floor():
    statistics = normalizer.update(normalizer.init(2), jnp.array([[0.3, 1.0], [0.3, -1.0]]))
    result = normalizer.finish(statistics)
    np.testing.assert_allclose(result.std, [1e-2, 1.0], rtol=1e-6)
    # 5 cm away: 5 floors of 1 cm
    np.testing.assert_allclose(normalizer.normalize(result, jnp.array([0.35, 1.0])), [5.0, 1.0], rtol=1e-4)
