"""Effects on commands and measurements, worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.mujoco import scene as task
from sgft_jax.types import UserError

KEY = jax.random.key(0)


def effects(**values):
    return task.make_effects(values, 3, 2)


def test_no_effects_change_nothing():
    none = effects()
    np.testing.assert_array_equal(task.distort(none, jnp.array([0.3, -0.7])), np.float32([0.3, -0.7]))
    np.testing.assert_array_equal(task.measure(none, jnp.arange(3.0), KEY), [0, 1, 2])


def test_commands_are_turned_then_scaled_then_offset():
    quarter = effects(action_rotation=np.pi / 2, action_scale=[0.5, 2.0], action_bias=[0.0, 0.3])
    # x -> y and y -> -x, then scaled and offset: (0.4, 0.2) -> (-0.2, 0.4) -> (-0.1, 0.8) -> (-0.1, 1.1)
    np.testing.assert_allclose(task.distort(quarter, jnp.array([0.4, 0.2])), [-0.1, 1.1], atol=1e-6)


def test_rotation_leaves_z_alone():
    turned = task.make_effects({"action_rotation": np.pi / 2}, 9, 3)
    np.testing.assert_allclose(task.distort(turned, jnp.array([1.0, 0.0, 0.3])), [0, 1, 0.3], atol=1e-6)


def test_bias_and_noise_of_measurements():
    measure = jax.vmap(task.measure, (None, None, 0))
    keys = jax.random.split(KEY, 4000)
    noisy = measure(effects(obs_noise=0.1, obs_noise_prob=0.25, obs_bias=[0.0, 1.0, -1.0]), jnp.zeros(3), keys)
    error = np.asarray(noisy) - [0.0, 1.0, -1.0]
    hit = (error != 0).any(1)
    assert (error[hit] != 0).all()  # a vector is noisy as a whole
    np.testing.assert_allclose(hit.mean(), 0.25, atol=4 * np.sqrt(0.25 * 0.75 / 4000))
    np.testing.assert_allclose(error[hit].std(0), 0.1, rtol=0.1)


@pytest.mark.parametrize(
    ("latency", "substep", "progress"),
    # RAMP = 0.1 s, dt = 5 ms: substep i ends at (i + 1) * 5 ms
    [(0.0, 9, 0.5), (0.0, 19, 1.0), (0.0, 39, 1.0), (0.05, 9, 0.0), (0.05, 19, 0.5), (0.05, 29, 1.0), (0.15, 39, 0.5)],
)
def test_command_ramps_after_the_latency(latency, substep, progress):
    control = task._ramp(effects(latency=latency), jnp.array([1.0, 0.0]), jnp.array([3.0, -1.0]), 0.005, KEY)
    np.testing.assert_allclose(control(substep), [1 + 2 * progress, -progress], atol=1e-5)


def test_jitter_spreads_the_latency_and_never_foresees():
    jittery = effects(latency=0.02, latency_jitter=0.04)
    zero, one = jnp.zeros(1), jnp.ones(1)
    at_ramp_end = jax.vmap(lambda key: task._ramp(jittery, zero, one, 0.005, key)(19))  # t = 0.1 s
    progress = np.asarray(at_ramp_end(jax.random.split(KEY, 500)))
    # start = clip(0.02 + [-0.04, 0.04], 0) is in [0, 0.06]; progress = 1 - start / 0.1, and a quarter starts at 0
    assert 0.4 <= progress.min() < 0.43 and progress.max() == 1.0
    np.testing.assert_allclose((progress > 0.9999).mean(), 0.25, atol=4 * np.sqrt(0.25 * 0.75 / 500))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"lateny": 0.1}, "no effect is called 'lateny'; there are: action_scale"),
        ({"action_scale": [1.0, 1.0, 1.0]}, "effect 'action_scale' needs 2 value"),
        ({"latency": [0.1, 0.2]}, "effect 'latency' needs one value"),
        ({"obs_noise": -0.1}, "effect 'obs_noise' must not be negative"),
    ],
)
def test_bad_effects_are_named(values, message):
    with pytest.raises(UserError, match=message.replace("(", r"\(")):
        effects(**values)
