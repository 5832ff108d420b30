"""The domain in which actuators differ: ranges of every effect, and a task's own."""

import functools

import jax
import numpy as np
import toy

from envs.domains.actuators import with_actuators
from envs.domains.uniform import sample_worlds
from envs.effects import draw
from envs.system import varying

ENV = toy.make()


def test_what_differs_between_episodes():
    env = with_actuators(ENV)
    ranges = jax.tree.map(lambda x: x[0], sample_worlds(env, jax.random.key(0), 1).theta.effects)
    found = jax.vmap(functools.partial(draw, ranges))(jax.random.split(jax.random.key(1), 400))
    for name, low, high in (
        ("action_scale", 0.7, 1.4),
        ("action_bias", -0.15, 0.15),
        ("latency", 0.0, 0.6 * env.control_dt),
        ("latency_jitter", 0.0, 0.1 * env.control_dt),
    ):
        values, margin = np.asarray(getattr(found, name)), 0.05 * (high - low)
        assert low <= values.min() < low + margin and high - margin < values.max() <= high, name
    assert not np.asarray(found.action_rotation).any() or env.cartesian
    np.testing.assert_allclose(found.obs_noise, 0.005)  # the simulator's own


def test_a_task_may_have_ranges_of_its_own():
    env = with_actuators(ENV._replace(actuators={"action_scale": 1.0, "obs_noise": [0.0, 0.01]}))
    names = {v.name: (v.low, v.high) for v in varying(env)}
    assert "action_scale" not in names and names["obs_noise"] == (0.0, np.float32(0.01))
    assert names["latency"] == (0.0, np.float32(0.6 * env.control_dt))
