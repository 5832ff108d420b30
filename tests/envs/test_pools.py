"""Pools of worlds: the training domain, real systems, and the worlds of evaluations."""

import numpy as np
import pytest
import toy

from envs.gaps import Gap
from envs.pools import heldout_worlds, load_gap, real_worlds, training_worlds


def test_heldout_worlds_have_exact_sensors_in_simulation_only(tmp_path, key):
    (tmp_path / "g.toml").write_text("[params]\nmass = 2.0\nfriction = [3, 5]\n")
    env = toy.make()
    gap = load_gap(env, str(tmp_path / "g.toml"), ["mass=1.5"])
    assert load_gap(env, "sim", []) is None and load_gap(env, None, []) is None
    assert heldout_worlds(env, None, key, 3).theta.effects.high.obs_noise.tolist() == [0, 0, 0]
    assert training_worlds(env, None, key, 3).theta.effects.high.obs_noise.tolist() == pytest.approx([0.005] * 3)
    real = heldout_worlds(env, gap, key, 3)
    assert real.theta.params[:, 0].tolist() == [1.5] * 3
    assert float(real.theta.effects.high.obs_noise[0]) == pytest.approx(0.005)


def test_pools_of_different_size_are_brought_to_one(key):
    env, fixed = toy.make(), Gap("fixed", {"mass": 2.0, "friction": 4.0}, {"latency": 0.05})
    pools = real_worlds(env, [fixed, Gap("ranges", {"mass": [3.0, 4.0]}, {})], key, 5)
    np.testing.assert_array_equal(pools.theta.params[0], [[2.0, 4.0]] * 5)
    assert pools.theta.params.shape == (2, 5, 2) and len(np.unique(pools.theta.params[1, :, 0])) == 5
    np.testing.assert_allclose(pools.theta.effects.high.latency, [[0.05] * 5, [0.0] * 5])
    assert real_worlds(env, [fixed, fixed], key, 5).theta.params.shape == (2, 1, 2)
