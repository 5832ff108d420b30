"""Worlds patched on the device are those that MuJoCo compiles, over the widest ranges that any gap draws from."""

import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
from scipy.spatial.transform import Rotation

import envs
from envs.base import Theta
from envs.effects import make_range
from envs.patches import patches

DISTRIBUTIONS = Path(envs.__file__).parent / "gaps/distributions"
WORLDS = 24
LARGEST = 0.01  # of a number's std between worlds


def widest(env):
    """[n_params, 2]: training and the gaps that are drawn; a fifth around the nominal value without either."""
    ranges = {p.name: (p.low, p.high) for p in env.parameters}
    drawn = DISTRIBUTIONS / f"{env.name}.toml"
    for family in tomllib.loads(drawn.read_text()).values() if drawn.exists() else ():
        for name in ranges.keys() & family.keys():
            ranges[name] = (min(ranges[name][0], family[name][0]), max(ranges[name][1], family[name][1]))
    if all(low == high for low, high in ranges.values()):
        ranges = {p.name: sorted((0.8 * p.nominal, 1.2 * p.nominal + 0.02)) for p in env.parameters}
    return np.array(list(ranges.values()), float)


def compiled(env, params):
    ends = make_range(env, env.training)
    effects = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(params), *x.shape)), ends)
    return env.make_worlds(Theta(params, effects)).model


def tensors(model):
    """Inertias without their axes, whose order is free."""
    model = {name: np.asarray(x, float) for name, x in model.items()}
    if {"body_iquat", "body_inertia"} <= model.keys():
        axes = Rotation.from_quat(np.roll(model.pop("body_iquat"), -1, -1).reshape(-1, 4)).as_matrix()
        axes = axes.reshape(*model["body_inertia"].shape, 3)
        model["body_inertia"] = np.einsum("nbij,nbj,nbkj->nbik", axes, model["body_inertia"], axes)
    return model


@pytest.mark.parametrize(
    "task", ["push", *(pytest.param(t, marks=pytest.mark.heavy) for t in sorted(envs.TASKS) if t != "push")]
)
def test_patched_worlds_are_compiled_ones(task):
    env = envs.make(task, "c")
    ranges = widest(env)
    fitted = patches(env, ranges)
    low, high = ranges.T
    params = low + (high - low) * np.random.default_rng(7).uniform(size=(WORLDS, len(ranges)))
    exact, patched = compiled(env, params), jax.jit(jax.vmap(fitted.model))(jnp.asarray(params, jnp.float32))
    assert patched.keys() == {name for name, x in exact.items() if jnp.issubdtype(x.dtype, jnp.floating)}
    there = tensors(patched)
    for name, values in tensors({name: exact[name] for name in patched}).items():
        missed, rounding = np.abs(there[name] - values).max(0), 5e-6 * np.abs(values).max()
        assert (missed <= LARGEST * values.std(0) + rounding).all(), name
        assert fitted.errors[name] < LARGEST, name


def test_errors_tell_what_no_polynomial_follows(monkeypatch):
    """A field that jumps where a parameter passes a threshold."""
    env = envs.make("push", "c")
    ranges, make_worlds = widest(env), env.make_worlds

    def jumping(theta):
        world = make_worlds(theta)
        jump = jnp.asarray(np.asarray(theta.params)[:, 2] > 0.3, jnp.float32)
        return world._replace(model=world.model | {"stat.meaninertia": jump})

    errors = patches(env._replace(make_worlds=jumping), ranges).errors
    assert errors["stat.meaninertia"] > 0.5 > 100 * errors["body_mass"]


def test_worlds_without_a_model_have_none():
    assert patches(toy.make(), np.array([[1.0, 2.0]])).model(jnp.ones(1)) == {}


def test_parameters_that_stay_leave_one_model():
    env = envs.make("push", "c")
    ranges = np.array([(p.nominal, p.nominal) for p in env.parameters])
    fitted = patches(env, ranges)
    exact = compiled(env, ranges[:, :1].T)
    for name, values in fitted.model(jnp.asarray(ranges[:, 0], jnp.float32)).items():
        np.testing.assert_allclose(values, exact[name][0], rtol=1e-6)
