"""What is said of a posterior's points: the box in which one can train."""

import compiled
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import gaps
from envs.domains import parameter_ranges
from experiments.runner.narrowed import likely
from sgft_jax.posterior.candidates import point_of, unknowns_of


def named(env, **numbers):
    """The point at which these unknowns have these values; the others are in the middle."""
    unknowns = unknowns_of(env)
    middle = np.full(len(unknowns), 0.5)
    wanted = [numbers.get(u.name, numbers.get(f"{u.name}_{u.index}", np.nan)) for u in unknowns]
    point = np.asarray(point_of(unknowns, jnp.nan_to_num(jnp.array(wanted), nan=1.0)))
    return np.where(np.isnan(wanted), middle, point)


def test_the_box_holds_most_systems_and_is_a_gap_that_can_be_read(tmp_path):
    env = compiled.make("push")
    low, high = (
        named(env, object_mass=m, action_scale_1=s, obs_bias_3=b) for m, s, b in ((0.1, 0.6, 0.0), (0.2, 0.8, 0.004))
    )
    shares = np.linspace(0, 1, 101)[:, None]
    gap = likely(env, low + shares * (high - low), "like")
    assert gap.effects["action_scale"][0][1] == pytest.approx(0.605, abs=2e-3)
    assert gap.effects["action_scale"][1][1] == pytest.approx(0.795, abs=2e-3)
    assert gap.effects["obs_bias"][0][:3] == [0, 0, gap.effects["obs_bias"][1][2]], "what cannot err has no error"
    assert 0.1 < gap.params["object_mass"][0] < gap.params["object_mass"][1] < 0.2
    path = tmp_path / "system.toml"
    path.write_text(gaps.to_toml([gap]))
    again = gaps.load(env, str(path))
    assert (again.params, again.effects) == (gap.params, gap.effects)
    assert gaps.worlds(env, again, jax.random.key(0), 3).theta.params.shape[0] == 3


def test_a_box_with_an_impossible_corner_is_made_smaller():
    env = compiled.make("insert")
    points = np.random.default_rng(0).uniform(size=(64, len(unknowns_of(env))))
    gap = likely(env, points, "like")
    assert gap.params["peg_radius"][1] < gap.params["hole_radius"][0]
    parameter_ranges(env, gap.params)
    assert gap.params["peg_radius"][0] < gap.params["peg_radius"][1], "and no smaller than it must be"
