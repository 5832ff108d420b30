"""MJX compiles slowly: the pushing environment is compiled once per batch layout and shared by all tests."""

import jax
import pytest
from franka_bench import EXACT, Bench, bench

import envs
from envs.base import EnvState


@pytest.fixture(scope="session", params=["c", pytest.param("jax", marks=pytest.mark.slow)])
def pushing(request) -> Bench:
    """Four worlds that differ in mass, friction and stiffness."""
    env = envs.make("push", request.param)
    ranges = {"object_mass": [0.1, 0.3], "servo_stiffness": [0.8, 1.2], "finger_friction": [0.3, 0.6]}
    return bench(env, envs.sample_worlds(env, jax.random.key(7), 4, params=ranges, effects=EXACT))


@pytest.fixture
def started(pushing) -> EnvState:
    """Fresh episodes [4] of `pushing`."""
    return jax.vmap(pushing.env.reset)(pushing.worlds, jax.random.split(jax.random.key(8), 4))
