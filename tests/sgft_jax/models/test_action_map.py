"""The map from commands to moves: by hand, on pushing, and behind a policy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
import toy_steps

import envs
from envs import gaps
from envs.rollout import play_episode
from sgft_jax.identify import place_of
from sgft_jax.models import action_map
from sgft_jax.models.action_map import ActionMap
from sgft_jax.types import UserError


def turn(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def random_actions(carry, obs, key):
    return jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0), carry


def fitted(env, gap, key, **given):
    """The map from one rollout of random actions."""
    pool = gaps.worlds(env, gap, key, 1)
    played = jax.jit(lambda key: play_episode(env, pool, random_actions, (), key, gamma=0.9))(key)
    rows, place = played.transitions, place_of(env)
    moves = rows.next_obs[:, place] - rows.obs[:, place]
    return action_map.action_map(moves, rows.action, played.valid, **given)


def test_exact_moves_give_the_exact_map_and_rows_that_do_not_count_change_nothing():
    actions = jnp.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 1.0], [0.5, 0.5]])
    truth = ActionMap(jnp.array([[2.0, 1.0], [0.0, 3.0], [1.0, 0.0]]), jnp.array([0.1, -0.2, 0.0]))
    moves = (actions @ truth.matrix.T + truth.offset[None]).at[3].set(99.0)
    found = action_map.action_map(moves, actions, jnp.arange(4) < 3, ridge=1e-7)
    np.testing.assert_allclose(found.matrix, truth.matrix, atol=1e-4)
    np.testing.assert_allclose(found.offset, truth.offset, atol=1e-4)


def test_steps_that_hit_something_are_left_out():
    """Two of ten steps were stopped after a fifth of their way."""
    actions = jax.random.uniform(jax.random.key(0), (10, 2), minval=-1.0, maxval=1.0)
    moves = (0.05 * actions).at[:2].multiply(0.2)
    found = action_map.action_map(moves, actions, jnp.ones(10, bool), ridge=1e-6)
    np.testing.assert_allclose(found.matrix, 0.05 * np.eye(2), atol=1e-4)


def test_where_the_rows_say_nothing_the_known_map_stays():
    """Only the first axis was moved, 3 m per unit: of the second and of the offset what was known is kept."""
    known = ActionMap(jnp.eye(2), jnp.zeros(2))
    actions = jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    moves = jnp.array([[3.0, 0.0], [-3.0, 0.0]])
    found = action_map.action_map(moves, actions, jnp.ones(2, bool), around=known, ridge=0.5)
    # First column: (2 rows * 3 + 0.5 * 1) / 2.5 = 2.6.
    np.testing.assert_allclose(found.matrix, [[2.6, 0.0], [0.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(found.offset, 0.0, atol=1e-6)
    nothing = action_map.action_map(moves, actions, jnp.zeros(2, bool), around=known)
    np.testing.assert_allclose(nothing.matrix, np.eye(2), atol=1e-6)


def test_a_correction_makes_the_real_system_move_like_the_simulated_one():
    sim = ActionMap(0.05 * jnp.eye(2), jnp.zeros(2))
    real = ActionMap(0.05 * 0.6 * jnp.asarray(turn(0.7), jnp.float32), jnp.array([0.006, 0.0]))
    action = jnp.array([0.3, -0.2])
    sent = action_map.correction(real, sim).apply(action)
    np.testing.assert_allclose(real.matrix @ sent + real.offset, sim.matrix @ action, atol=1e-6)
    assert jnp.abs(action_map.correction(real, sim).apply(jnp.ones(2))).max() == 1.0  # more cannot be commanded
    np.testing.assert_array_equal(action_map.no_correction(2).apply(action), action)


def test_one_rollout_of_pushing_tells_how_commands_are_turned_and_scaled():
    env = envs.make("push", "c")
    gap = gaps.from_dict(env, "g", {"effects": {"obs_noise": 0.001, "action_rotation": 0.7, "action_scale": 0.6}})
    key_sim, key_real = jax.random.split(jax.random.key(0))
    sim = fitted(env, gaps.load(env, "sim"), key_sim)
    real = fitted(env, gap, key_real, around=sim)
    truth = 0.6 * turn(0.7)
    relative = np.asarray(real.matrix) @ np.linalg.inv(sim.matrix)
    assert np.linalg.norm(relative - truth) < 0.1 * np.linalg.norm(truth)


def test_behind_the_correction_a_policy_reaches_the_goal_again(key):
    """Commands are turned by 100 degrees and drift by a third of a step: alone it circles away from the goal."""
    env = toy_steps.make()
    gap = gaps.from_dict(env, "g", {"effects": {"action_rotation": 1.75, "action_scale": 0.8, "action_bias": 0.3}})
    keys = jax.random.split(key, 3)
    sim = fitted(env, gaps.load(env, "sim"), keys[0])
    real = fitted(env, gap, keys[1], around=sim)

    pool = gaps.worlds(env, gap, keys[2], 1)

    def succeeds(correction, key):
        straight = lambda obs: jnp.clip(5.0 * (obs[:2] - obs[2:]), -1.0, 1.0)  # noqa: E731
        act = lambda carry, obs, key: (correction.apply(straight(obs)), carry)  # noqa: E731
        return play_episode(env, pool, act, (), key, gamma=0.9).success

    rate = jax.jit(lambda own: jax.vmap(succeeds, (None, 0))(own, jax.random.split(keys[2], 50)).mean())
    assert rate(action_map.no_correction(2)) < 0.2
    assert rate(action_map.correction(real, sim)) > 0.9


def test_what_moves_is_found_by_name():
    assert place_of(toy_steps.make()).tolist() == [2, 3]
    assert place_of(envs.make("insert", "c")).tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("env", "words"), [("hammer", "hammer commands joints"), ("toy", "no observation entry says where 'force' moves")]
)
def test_other_actions_are_refused_in_one_line(env, words):
    with pytest.raises(UserError, match=words) as refused:
        place_of(toy.make() if env == "toy" else envs.make(env, "c"))
    assert "\n" not in str(refused.value)
