"""Cartpole swing-up: the reward by hand, the motion in closed form against C MuJoCo, the course of an episode."""

import c_reference
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiled import compiled
from franka_bench import member, theta_of

import envs
from envs.control import cartpole

KEY = jax.random.key(0)
STEPS = 120


@pytest.mark.parametrize(
    ("x", "upright", "spin", "action", "wanted"),
    [
        (0.0, 1.0, 0.0, 0.0, 1.0),
        (0.0, -1.0, 0.0, 0.0, 0.0),
        (2.0, 1.0, 0.0, 0.0, 0.55),  # at the margin the bell is 0.1, of which half counts: (1 + 0.1) / 2
        (0.0, 1.0, -5.0, 0.0, 0.55),
        (0.0, 1.0, 0.0, 0.5, 0.95),  # (4 + 1 - 0.25) / 5
        (2.0, 0.0, 5.0, 1.0, 0.121),  # 0.5 * 0.55 * 0.55 * 0.8
        (1.0, 1.0, 0.0, 0.0, 0.78117),  # (1 + 0.1^(1/4)) / 2
    ],
)
def test_reward_of_a_frame(x, upright, spin, action, wanted):
    found = cartpole.frame_reward(*map(jnp.float32, (x, upright, spin)), jnp.array([action]))
    np.testing.assert_allclose(found, wanted, atol=1e-5)


@pytest.fixture(scope="module")
def played():
    """Episodes in three worlds, thrown to and fro so that the cart hits both ends: (thetas, worlds, starts, after)."""
    env, rng = compiled(cartpole.make("jax")), np.random.default_rng(0)
    thetas = [theta_of(cartpole.SCENE, rng) for _ in range(3)]
    pools = [envs.sample_worlds(env, KEY, 1, params=theta) for theta in thetas]
    worlds = jax.tree.map(lambda *x: jnp.concatenate(x), *pools)
    starts = jax.vmap(env.reset)(worlds, jax.random.split(KEY, 3))

    def episode(world, start):
        def step(state, action):
            after = env.step(world, state, action, KEY)
            return after, after

        return jax.lax.scan(step, start, actions())[1]

    return thetas, starts, jax.jit(jax.vmap(episode))(worlds, starts)


def actions():
    return jnp.sign(jnp.sin(jnp.arange(STEPS) / 16.0))[:, None] * 0.9


@pytest.mark.heavy
@pytest.mark.parametrize("i", range(3))
def test_motion_is_that_of_mujoco(played, i):
    thetas, starts, after = played
    wanted = c_reference.play(cartpole.SCENE, thetas[i], member(starts, i).physics, actions(), iterations=100)
    qpos, qvel = (np.array([getattr(state, name) for state in wanted]) for name in ("qpos", "qvel"))
    assert qpos[:, 0].max() > cartpole.RAIL and qpos[:, 0].min() < -cartpole.RAIL  # both ends were hit
    np.testing.assert_allclose(after.physics.qpos[i], qpos, atol=1e-4)
    np.testing.assert_allclose(after.physics.qvel[i], qvel, atol=2e-3)


@pytest.mark.heavy
def test_reward_of_a_step_is_that_of_both_frames(played):
    thetas, starts, after = played
    model = cartpole.build(thetas[0]).compile()
    data, wanted = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = starts.physics.qpos[0], starts.physics.qvel[0]
    for action in np.asarray(actions()):
        data.ctrl[:], total = action, 0.0
        for _ in range(2):
            mujoco.mj_step(model, data)
            state = data.qpos[0], np.cos(data.qpos[1]), data.qvel[1]
            total += float(cartpole.frame_reward(*map(jnp.float32, state), jnp.asarray(action)))
        wanted.append(total)
    np.testing.assert_allclose(after.reward[0], wanted, atol=2e-3)
    np.testing.assert_allclose(after.reward[0].sum(), np.sum(wanted), atol=0.01)


@pytest.mark.heavy
def test_an_episode_starts_hanging_and_ends_by_time_alone(played):
    _, starts, after = played
    hanging = jnp.array([0.0, -1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(starts.true_obs, jnp.broadcast_to(hanging, (3, 5)), atol=0.05)
    assert starts.obs.tolist() == starts.true_obs.tolist()  # exact sensors
    assert not after.terminated.any() and not after.truncated.any() and not after.invalid.any()
    env = compiled(cartpole.make("jax"))
    assert env.episode_length * cartpole.REPEAT == 1000 and env.control_dt == 0.02
    late = env.step(env_world(env), env.reset(env_world(env), KEY)._replace(time=jnp.int32(499)), jnp.zeros(1), KEY)
    assert late.truncated and not late.terminated


def env_world(env):
    return member(envs.sample_worlds(env, KEY, 1), 0)


def test_success_is_upright_in_the_middle():
    upright = jnp.array([0.2, 0.996, 0.09, 0.0, 0.0])
    assert cartpole.success(upright)
    assert not cartpole.success(upright.at[0].set(-0.3)) and not cartpole.success(upright.at[1].set(0.99))
