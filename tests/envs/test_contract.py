"""What every environment promises to learners and rollouts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled
from franka_bench import SCENES, member

import envs
from envs.control import cartpole
from envs.mujoco.scene import make_env

KEYS = jax.random.split(jax.random.key(3), 4)
ACTIONS = jnp.array([[1.0, 0.0], [0.3, -1.0], [-0.5, 0.5], [1.0, 1.0]])


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("name", SCENES)
def test_description_fits_observations(name):
    env = compiled(make_env(SCENES[name], "c"))
    world = member(envs.sample_worlds(env, jax.random.key(0), 1), 0)
    state = env.reset(world, jax.random.key(1))
    assert state.obs.shape == (env.obs_dim,) == (sum(e.size for e in env.observation),)
    assert env.act_dim == {"push": 2, "hammer": 3, "insert": 3}[name]
    assert np.isfinite(state.obs).all() and not state.success
    assert env.reward(state.obs, jnp.zeros(env.act_dim), state.obs).shape == ()


@pytest.mark.heavy
def test_resets_are_fresh_and_repeatable(pushing):
    world = member(pushing.worlds, 0)
    first, again, other = (pushing.reset(world, jax.random.key(k)).obs for k in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert abs(first[1] - other[1]) > 1e-3  # another start


@pytest.mark.slow
def test_step_of_a_batch_is_the_steps_of_its_members(pushing, started):
    batch = pushing.step_batch(pushing.worlds, started, ACTIONS, KEYS)
    for i in range(4):
        alone = pushing.step(member(pushing.worlds, i), member(started, i), ACTIONS[i], KEYS[i])
        pair = [state._replace(physics=state.physics._asdict()) for state in (member(batch, i), alone)]
        accelerations = [state.physics.pop("warmstart") for state in pair]  # tens of rad/s^2
        np.testing.assert_allclose(*accelerations, atol=5e-3)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=2e-4, rtol=1e-3), *pair)
    moved = batch.true_obs[:, :2] - started.true_obs[:, :2]
    np.testing.assert_allclose(moved[0], [0.05, 0.0], atol=0.003)  # one full step, 5 cm; the rest obey as well
    assert (jnp.sign(moved[1:]) == jnp.sign(ACTIONS[1:])).all()


@pytest.mark.heavy
def test_reward_is_a_function_of_true_observations(pushing, started):
    after = pushing.step_batch(pushing.worlds, started, ACTIONS, KEYS)
    wanted = jax.jit(jax.vmap(pushing.env.reward))(started.true_obs, ACTIONS, after.true_obs)
    np.testing.assert_allclose(after.reward, wanted, atol=1e-6)


@pytest.mark.heavy
def test_time_limit_truncates_and_never_terminates(pushing, started):
    late = started._replace(time=jnp.array([0, 37, 38, 39], jnp.int32))
    after = pushing.step_batch(pushing.worlds, late, ACTIONS, KEYS)
    assert after.truncated.tolist() == [False, False, False, True]  # 40 steps
    assert not after.terminated.any()
    assert after.time.tolist() == [1, 38, 39, 40]


def test_exploded_physics_is_flagged(pushing, started):
    velocity = started.physics.qvel.at[1, 0].set(jnp.nan).at[2, 8].set(1e7).at[3, 7].set(jnp.inf)
    broken = started._replace(physics=started.physics._replace(qvel=velocity))
    after = pushing.step_batch(pushing.worlds, broken, ACTIONS, KEYS)
    assert after.invalid.tolist() == [False, True, True, True]


@pytest.mark.heavy
def test_success_counts_at_the_end_or_at_any_time(pushing, started):
    """In `push` only where the episode ends; where it counts at any time, a success is never lost again."""
    assert not pushing.env.success_anytime and SCENES["insert"].success_anytime
    was = started._replace(success=jnp.array([True] * 4))
    assert not pushing.step_batch(pushing.worlds, was, ACTIONS, KEYS).success.any()
    cart = cartpole.SCENE._replace(success_anytime=True)
    env = compiled(make_env(cart, "c"))
    world = member(envs.sample_worlds(env, jax.random.key(0), 1), 0)
    state = env.reset(world, jax.random.key(1))
    for before in (True, False):
        after = env.step(world, state._replace(success=jnp.array(before)), jnp.zeros(1), jax.random.key(2))
        assert bool(after.success) == before  # hanging down is none
