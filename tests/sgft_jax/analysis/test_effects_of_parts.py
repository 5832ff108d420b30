"""Effects in a factorial experiment: what was planted is found, and nothing else."""

import itertools

import numpy as np
import pytest

from sgft_jax.analysis.factorial import effects

FACTORS = ("a", "b", "c")


def planted(members=12):
    """Scores in which a adds 0.3, b adds 0.2 where c is on, and priors differ by far more."""
    rng = np.random.default_rng(0)
    prior = rng.normal(size=members)
    return {
        (a, b, c): prior + 0.3 * a + 0.2 * (b and c) + rng.normal(scale=0.01, size=members)
        for a, b, c in itertools.product((False, True), repeat=3)
    }


def test_planted_effects_are_found_although_priors_differ():
    found = effects(planted(), FACTORS)
    assert set(found) == {"a", "b", "c", "a x b", "a x c", "b x c"}
    wanted = {"a": 0.3, "b": 0.1, "c": 0.1, "b x c": 0.1, "a x b": 0.0, "a x c": 0.0}
    for name, effect in wanted.items():
        np.testing.assert_allclose(found[name].estimate, effect, atol=0.01, err_msg=name)
        assert found[name].low <= found[name].estimate <= found[name].high
    assert found["a"].low > 0.25 and found["a x b"].low < 0.01


def test_a_missing_cell_is_named():
    cells = planted()
    del cells[True, False, True]
    with pytest.raises(ValueError, match=r"\(True, False, True\)"):
        effects(cells, FACTORS)
