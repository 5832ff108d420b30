"""What is unknown of a real system, and the simulated systems that may be it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Parameter
from sgft_jax.posterior.candidates import (
    Unknown,
    candidates,
    draw,
    nominal_of,
    point_of,
    real_range,
    unknowns_of,
    values,
)

# Of the tasks whose posteriors are tested. A name that is added after the test's gaps were drawn spoils the test.
LISTED = {
    "push": ["object_mass", "table_friction", "finger_friction", "servo_stiffness"]
    + ["action_scale"] * 2
    + ["action_bias"] * 2
    + ["action_rotation", "latency"]
    + ["obs_bias"] * 2,
    "insert": ["part_rotation", "part_friction", "hole_radius", "peg_radius", "servo_stiffness"]
    + ["action_scale"] * 3
    + ["action_bias"] * 3
    + ["action_rotation", "latency"]
    + ["obs_bias"] * 3,
    "hammer": ["nail_damping", "nail_radius", "head_radius", "head_thickness", "hammer_mass", "nail_friction"]
    + ["servo_stiffness"]
    + ["action_scale"] * 3
    + ["action_bias"] * 3
    + ["latency"]
    + ["obs_bias"] * 2,
}


@pytest.mark.parametrize("task", LISTED)
def test_the_unknowns_are_those_that_were_written_down(task):
    assert [unknown.name for unknown in unknowns_of(envs.make(task, "c"))] == LISTED[task]


@pytest.mark.parametrize("task", LISTED)
def test_drawn_gaps_lie_within_the_ranges(task):
    """Of parameters that gaps are drawn from, the widest range of each."""
    from envs import gap_distribution

    env = envs.make(task, "c")
    ranges = {p.name: real_range(p) for p in env.parameters}
    for family in gap_distribution.load(env).families.values():
        for name in ranges.keys() & family.keys():
            (drawn,) = family[name].values()
            assert ranges[name][0] <= drawn.low and drawn.high <= ranges[name][1], name


def test_numbers_over_decades_are_uniform_in_their_logarithm():
    point = jnp.array([0.0, 0.5, 1.0, 0.5])
    unknowns = (*[Unknown("friction", 0, 0.1, 10.0)] * 3, Unknown("place", 0, -1.0, 2.0))
    np.testing.assert_allclose(values(unknowns, point), [0.1, 1.0, 10.0, 0.5], rtol=1e-5)
    np.testing.assert_allclose(point_of(unknowns, values(unknowns, point)), point, atol=1e-6)


@pytest.mark.parametrize(
    ("parameter", "expected"),
    [
        (Parameter("mass", "kg", 1.0, 0.8, 1.5), (0.4, 3.0)),
        (Parameter("mass", "kg", 1.0, 0.8, 1.5, minimum=0.5, maximum=2.0), (0.5, 2.0)),
        (Parameter("angle", "rad", 0.0, -1.0, 1.0), (-2.0, 2.0)),
        (Parameter("mass", "kg", 1.0, 0.8, 1.5, real=(0.1, 9.0)), (0.1, 9.0)),
    ],
)
def test_where_a_parameter_is_looked_for(parameter, expected):
    np.testing.assert_allclose(real_range(parameter), expected)


def test_a_point_says_the_world():
    env = envs.make("push", "c")
    systems = candidates(env)
    names = [unknown.name for unknown in systems.unknowns]
    point = jnp.full(len(names), 0.5).at[names.index("object_mass")].set(1.0).at[names.index("obs_bias")].set(0.0)
    world = jax.jit(systems.episode)(point, jax.random.key(0))
    params = dict(zip([p.name for p in env.parameters], world.theta.params, strict=True))
    assert params["object_mass"] == pytest.approx(0.6) and params["table_friction"] == pytest.approx(0.0560**0.5)
    assert 0.15 <= params["object_x"] <= 0.30  # as pretraining draws it
    effects = world.theta.effects.low
    np.testing.assert_allclose(effects.obs_bias, [0.0, 0.0, -0.025, 0.0], atol=1e-6)
    np.testing.assert_allclose(effects.action_scale, (0.35 * 1.7) ** 0.5, rtol=1e-5)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, *world.theta.effects))


def test_parameters_may_be_anything_and_errors_are_often_small():
    env = envs.make("hammer", "c")
    unknowns, nominal = unknowns_of(env), nominal_of(env)
    numbers = values(unknowns, nominal)
    assert [float(x) for u, x in zip(unknowns, numbers, strict=True) if u.name == "action_scale"] == [1.0] * 3
    points = np.asarray(draw(unknowns, nominal, jax.random.key(0), 4000))
    assert points.min() >= 0 and points.max() <= 1
    names = np.array([u.name for u in unknowns])
    assert (points[:, names == "nail_friction"] < 0.1).mean() == pytest.approx(0.1, abs=0.02)
    # Uniform in half of the systems; in the others a share of the range, uniform too: .1 - .1 log(.1) are below .1.
    expected = 0.5 * 0.1 + 0.5 * (0.1 - 0.1 * np.log(0.1))
    assert (points[:, names == "latency"] < 0.1).mean() == pytest.approx(expected, abs=0.02)
    size = np.abs(points - np.asarray(nominal)).astype(float)
    together = np.corrcoef(size[:, names == "action_bias"].mean(axis=1), size[:, names == "action_scale"].mean(axis=1))
    apart = np.corrcoef(size[:, names == "action_bias"].mean(axis=1), size[:, names == "obs_bias"].mean(axis=1))
    assert together[0, 1] > 0.4 and abs(apart[0, 1]) < 0.1, "commands err together, sensors on their own"
