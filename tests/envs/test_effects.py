"""Effects on commands and measurements, worked out by hand, and what of them is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

import envs
from envs import effects as env_effects
from envs.base import Entry
from envs.types import UserError

KEY = jax.random.key(0)
ENV = toy.make()._replace(observation=(Entry("xyz", "m", 3),), control_dt=0.2)  # actions [2]


def effects(**values):
    return env_effects.make_range(ENV, values).low


def ramp(own, previous, target, key=KEY):
    return env_effects.ramp(own, previous, target, key, dt=0.005, duration=0.1)


def test_no_effects_change_nothing():
    none = effects()
    np.testing.assert_array_equal(env_effects.distort(none, jnp.array([0.3, -0.7])), np.float32([0.3, -0.7]))
    np.testing.assert_array_equal(env_effects.measure(none, jnp.arange(3.0), KEY), [0, 1, 2])
    np.testing.assert_array_equal(env_effects.shake(none, jnp.array([1.3, -0.7]), KEY), np.float32([1.3, -0.7]))


def test_commands_are_turned_then_scaled_then_offset():
    quarter = effects(action_rotation=np.pi / 2, action_scale=[0.5, 2.0], action_bias=[0.0, 0.3])
    # x -> y and y -> -x, then scaled and offset: (0.4, 0.2) -> (-0.2, 0.4) -> (-0.1, 0.8) -> (-0.1, 1.1)
    np.testing.assert_allclose(env_effects.distort(quarter, jnp.array([0.4, 0.2])), [-0.1, 1.1], atol=1e-6)


def test_rotation_leaves_z_alone():
    arm = ENV._replace(action=(Entry("xyz", "m", 3),))
    turned = env_effects.make_range(arm, {"action_rotation": np.pi / 2}).low
    np.testing.assert_allclose(env_effects.distort(turned, jnp.array([1.0, 0.0, 0.3])), [0, 1, 0.3], atol=1e-6)


def test_noisy_commands_are_clipped_and_exact_ones_are_not():
    """Of the second entry alone; the first one, which is too large, stays as it is."""
    own = effects(action_noise=[0.0, 0.5])
    shake = jax.jit(jax.vmap(env_effects.shake, (None, None, 0)))
    shaken = shake(own, jnp.array([1.4, 0.2]), jax.random.split(KEY, 4000))
    assert set(shaken[:, 0].tolist()) == {np.float32(1.4)}
    noisy = np.asarray(shaken[:, 1])
    assert noisy.max() == 1.0 and noisy.min() == -1.0
    # P(n > 1.6 std) = 0.0548, P(n < -2.4 std) = 0.0082; the median is that of the command
    np.testing.assert_allclose([(noisy == 1).mean(), (noisy == -1).mean()], [0.0548, 0.0082], atol=0.012)
    np.testing.assert_allclose(np.median(noisy), 0.2, atol=0.04)


def test_bias_and_noise_of_measurements():
    measure = jax.jit(jax.vmap(env_effects.measure, (None, None, 0)))
    keys = jax.random.split(KEY, 4000)
    noisy = measure(effects(obs_noise=0.1, obs_noise_prob=0.25, obs_bias=[0.0, 1.0, -1.0]), jnp.zeros(3), keys)
    error = np.asarray(noisy) - [0.0, 1.0, -1.0]
    hit = (error != 0).any(1)
    assert (error[hit] != 0).all()  # a vector is noisy as a whole
    np.testing.assert_allclose(hit.mean(), 0.25, atol=4 * np.sqrt(0.25 * 0.75 / 4000))
    np.testing.assert_allclose(error[hit].std(0), 0.1, rtol=0.1)


@pytest.mark.parametrize(
    ("latency", "substep", "progress"),
    # ramps last 0.1 s, dt = 5 ms: substep i ends at (i + 1) * 5 ms
    [(0.0, 9, 0.5), (0.0, 19, 1.0), (0.0, 39, 1.0), (0.05, 9, 0.0), (0.05, 19, 0.5), (0.05, 29, 1.0), (0.15, 39, 0.5)],
)
def test_command_ramps_after_the_latency(latency, substep, progress):
    control = ramp(effects(latency=latency), jnp.array([1.0, 0.0]), jnp.array([3.0, -1.0]))
    np.testing.assert_allclose(control(substep), [1 + 2 * progress, -progress], atol=1e-5)


def test_without_a_ramp_the_command_is_there_at_once_or_after_the_latency():
    for latency, expected in ((0.0, [1, 1, 1]), (0.008, [0, 1, 1])):
        control = env_effects.ramp(effects(latency=latency), jnp.zeros(1), jnp.ones(1), KEY, dt=0.005, duration=0.0)
        assert [float(control(i)[0]) for i in range(3)] == expected


def test_jitter_spreads_the_latency_and_never_foresees():
    jittery = effects(latency=0.02, latency_jitter=0.04)
    zero, one = jnp.zeros(1), jnp.ones(1)
    at_ramp_end = jax.jit(jax.vmap(lambda key: ramp(jittery, zero, one, key)(19)))  # t = 0.1 s
    progress = np.asarray(at_ramp_end(jax.random.split(KEY, 500)))
    # start = clip(0.02 + [-0.04, 0.04], 0) is in [0, 0.06]; progress = 1 - start / 0.1, and a quarter starts at 0
    assert 0.4 <= progress.min() < 0.43 and progress.max() == 1.0
    np.testing.assert_allclose((progress > 0.9999).mean(), 0.25, atol=4 * np.sqrt(0.25 * 0.75 / 500))


def test_draws_fill_their_range_and_are_exact_where_it_is_a_point():
    own = env_effects.make_range(
        ENV, {"latency": [0.02, 0.06], "action_scale": [[0.5, 1.1], [0.7, 1.1]], "obs_noise": 0.0123}
    )
    drawn = jax.jit(jax.vmap(lambda key: env_effects.draw(own, key)))(jax.random.split(KEY, 400))
    assert set(drawn.obs_noise.tolist()) == {np.float32(0.0123)}
    assert set(drawn.action_scale[:, 1].tolist()) == {np.float32(1.1)}
    for values, low, high in ((drawn.latency, 0.02, 0.06), (drawn.action_scale[:, 0], 0.5, 0.7)):
        assert low <= values.min() < low + 0.02 * (high - low) and high - 0.02 * (high - low) < values.max() <= high
    assert abs(np.corrcoef(drawn.latency, drawn.action_scale[:, 0])[0, 1]) < 0.15  # independent


def test_an_episode_keeps_the_effects_that_it_drew():
    env, key = toy.make(), jax.random.key(0)
    pool = toy_pool(env, {"latency": [0.0, 0.09]})
    state = env.reset(pool, key)
    later = env.step(pool, state, jnp.ones(2), key)
    assert 0 < state.effects.latency < 0.09 and later.effects.latency == state.effects.latency
    other = env.reset(pool, jax.random.key(1))
    assert other.effects.latency != state.effects.latency


def toy_pool(env, effects):
    return jax.tree.map(lambda x: x[0], envs.sample_worlds(env, KEY, 1, effects=effects))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"lateny": 0.1}, r"'lateny' is neither .* nor an effect of toy; did you mean 'latency'\? Parameters: mass, "),
        ({"action_scale": [1.0, 1.0, 1.0]}, r"effect 'action_scale' needs 2 values or a range \[\[low, "),
        ({"latency": [0.0, 0.1, 0.2]}, r"effect 'latency' needs one value or a range \[low, high\], got \[0.0, 0.1,"),
        ({"obs_bias": [[1.0], [2.0, 3.0]]}, "effect 'obs_bias' needs 3 values"),
        ({"latency": "0.1"}, "effect 'latency' needs one value"),
        ({"obs_noise": True}, "effect 'obs_noise' needs one value"),
        ({"action_scale": [1.0, "1"]}, "effect 'action_scale' needs 2 values"),
        ({"action_bias": float("nan")}, "effect 'action_bias' needs finite numbers"),
        ({"action_scale": [1.0, float("inf")]}, "effect 'action_scale' needs finite numbers"),
        ({"latency": [0.1, 0.05]}, "effect 'latency' needs finite numbers, low before high"),
        ({"obs_noise": -0.1}, "effect 'obs_noise' must not be negative, got -0.1"),
        ({"action_noise": [0.2, -0.3]}, "effect 'action_noise' must not be negative, got -0.3"),
        ({"latency": [-0.1, 0.1]}, "effect 'latency' must not be negative, got -0.1"),
        ({"obs_noise_prob": 1.5}, "effect 'obs_noise_prob' is a probability, at most 1, got 1.5"),
        (
            {"latency": 0.3},
            "'latency' with 'latency_jitter' comes to 0.3 s: it must be shorter than the control period",
        ),
        ({"latency": 0.15, "latency_jitter": 0.1}, "comes to 0.25 s.* of toy, 0.2 s"),
        ({"action_scale": 1e38}, r"effect 'action_scale' must be at most 100 in size, got 1e\+38"),
        ({"action_scale": 10**400}, "effect 'action_scale' needs 2 values"),
        ({"action_bias": [0.0, -1e6]}, "effect 'action_bias' must be at most 100 in size"),
        ({"obs_noise": 1e10}, r"effect 'obs_noise' must be at most 1e\+06 in size"),
    ],
)
def test_impossible_effects_are_named(values, message):
    with pytest.raises(UserError, match=message):
        effects(**values)


def test_joints_are_not_rotated():
    with pytest.raises(UserError, match="'action_rotation' needs Cartesian actions, which toy does not have"):
        env_effects.make_range(ENV._replace(cartesian=False), {"action_rotation": [0.0, 0.1]})
