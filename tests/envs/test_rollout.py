"""Pools; fleets and whole episodes, where episodes end early, physics explodes and policies remember."""

import functools

import jax
import jax.numpy as jnp
import keys
import numpy as np
import pytest
import toy
import toy_terminating
from compiled import compiled

import envs
from envs.gaps import Gap
from envs.rollout import (
    counted,
    heldout_worlds,
    launch,
    load_gap,
    pick,
    play_episode,
    pool_size,
    real_worlds,
    step_fleet,
    training_worlds,
)
from envs.types import UserError

N = 64


def push(carry, obs, key):
    return -obs[:2], carry


@pytest.mark.heavy
def test_an_episode_in_a_stacked_pool_is_that_in_the_pool_alone(key):
    env = compiled(toy.make())
    stacked = jax.tree.map(lambda x: x.reshape(2, 5, *x.shape[1:]), envs.sample_worlds(env, key, 10))
    assert pool_size(stacked) == 5
    play = functools.partial(play_episode, env, act=push, carry=(), gamma=1.0, length=2)

    @jax.jit
    @jax.vmap
    def both(key, which):
        return play(stacked, key=key, which=which), play(pick(stacked, which), key=key)

    together, alone = both(jax.random.split(key, 6), jnp.array([0, 1, 1, 0, 1, 0]))
    jax.tree.map(np.testing.assert_array_equal, together, alone)
    assert len(set(together.world.tolist())) > 1


def counting(carry, obs, key):
    """An action that is the number of steps since the start of the episode."""
    return carry[None].astype(jnp.float32), carry + 1


@pytest.fixture(scope="module")
def episodes():
    """[N] episodes of `counting`, of which most end early."""
    env = compiled(toy_terminating.make())
    pool = envs.sample_worlds(env, jax.random.key(0), 1)
    keys = jax.random.split(jax.random.key(1), N)
    return jax.jit(jax.vmap(lambda key: play_episode(env, pool, counting, jnp.int32(0), key, gamma=0.9)))(keys)


def test_an_episode_is_over_when_it_terminates(episodes):
    rows, valid = episodes.transitions, np.asarray(episodes.valid)
    alarm = np.asarray(rows.next_obs[..., 1]) > 0.5
    lengths = valid.sum(1)
    assert lengths.min() < 4 and lengths.max() == toy_terminating.LENGTH
    for i, length in enumerate(lengths):
        assert valid[i, :length].all() and not valid[i, length:].any()
        assert alarm[i, : length - 1].sum() == 0 and (alarm[i, length - 1] or length == toy_terminating.LENGTH)
    np.testing.assert_allclose(rows.discount, np.where(valid, 0.9 * (1 - alarm), 0.0), atol=1e-6)
    assert all((np.asarray(x)[~valid] == 0).all() for x in jax.tree.leaves(rows))


def test_return_and_score_count_up_to_the_end(episodes):
    # Steps of 0, 1, 2, ... times 0.1 m: after k of them the position is 0.05 k (k - 1), and a step earns 1 + position.
    lengths = np.asarray(episodes.valid).sum(1)
    earned = np.array([sum(1 + 0.05 * k * (k - 1) for k in range(1, n + 1)) for n in lengths])
    np.testing.assert_allclose(episodes.total_reward, earned, rtol=1e-5)
    np.testing.assert_array_equal(episodes.score, episodes.total_reward)
    assert not episodes.exploded.any() and episodes.trace.shape == (N, toy_terminating.LENGTH + 1, 0)


@pytest.mark.heavy
def test_what_is_judged_by_success_scores_success(key):
    env = compiled(toy.make())
    pool = envs.sample_worlds(env, key, 1, effects={"obs_noise": 0.0})

    def brake(carry, obs, key):
        return jnp.clip(-3 * obs[:2] - obs[2:], -1, 1), carry

    play = jax.jit(jax.vmap(lambda key: play_episode(env, pool, brake, (), key, gamma=1.0)))
    played = play(jax.random.split(key, 8))
    assert played.success.any()
    np.testing.assert_array_equal(played.score, played.success.astype(jnp.float32))
    np.testing.assert_array_equal(played.trace[:, 1:, :], played.transitions.next_obs[..., :2])


@pytest.mark.heavy
def test_an_explosion_after_the_end_is_none(key):
    """The simulator goes on unseen after a termination; what it does then does not count."""
    env = compiled(toy_terminating.make())

    def step(*inputs):
        after = env.step(*inputs)
        return after._replace(invalid=after.time > 1)

    late = env._replace(step=step)
    play = jax.jit(lambda pool: play_episode(late, pool, counting, jnp.int32(0), key, gamma=1.0))
    for risk, exploded in ((1.0, False), (0.0, True)):
        played = play(envs.sample_worlds(env, key, 1, params={"risk": risk}))
        assert bool(played.exploded) == exploded and played.valid.sum() == 1


@pytest.fixture(scope="module")
def costly():
    """Five episodes in which each step costs 1; all but one of them explode, later and later, one at once."""
    env = compiled(toy_terminating.make())
    pool = envs.sample_worlds(env, jax.random.key(0), 1, params={"risk": 0.0})

    def play(boom):
        def step(*args):
            after = env.step(*args)
            return after._replace(reward=jnp.float32(-1), invalid=after.time >= boom)

        return play_episode(env._replace(step=step), pool, counting, jnp.int32(0), jax.random.key(1), gamma=1.0)

    return jax.jit(jax.vmap(play))(jnp.array([1, 3, 99, 2, 12]))


@pytest.mark.heavy
def test_an_episode_that_exploded_scores_less_than_any_whole_one(costly):
    assert costly.total_reward.tolist() == [0, -2, -12, -1, -11]
    assert costly.score.tolist() == [-np.inf, -np.inf, -12, -np.inf, -np.inf]
    assert int(jnp.argmax(costly.score)) == 2


@pytest.mark.parametrize("kind", [jnp.asarray, np.asarray])
def test_explosions_count_as_the_worst_that_is_known(costly, kind):
    episodes = jax.tree.map(kind, costly)
    for found in counted(episodes):
        assert found.tolist() == [-12] * 5 and isinstance(found, type(kind(0.0)))
    score, total = counted(episodes, kind([[-20.0, -30.0]])[0])
    assert score.tolist() == [-20, -20, -12, -20, -20] and total.tolist() == [-30, -30, -12, -30, -30]
    burst = jax.tree.map(lambda x: x[:2], episodes)  # none is whole
    assert counted(burst)[0].tolist() == [-2, -2]


@pytest.mark.heavy
def test_a_fleet_starts_episodes_anew_with_their_carry():
    """What `counting` remembers of an environment is always the age of its episode."""
    env = compiled(toy_terminating.make())
    pool = envs.sample_worlds(env, jax.random.key(0), 1, params={"risk": 0.3})

    def step(fleet, key):
        actions, carry = jax.vmap(counting)(fleet.carry, fleet.state.obs, jax.random.split(key, N))
        after, rows, valid, ended = step_fleet(
            env, pool, fleet, actions, carry, key, initial_carry=jnp.int32(0), gamma=0.9
        )
        return after, (fleet, after, rows, valid, ended)

    fleet = jax.jit(lambda: launch(env, pool, jax.random.key(1), N, jnp.int32(0)))()
    assert fleet.carry.shape == (N,)
    play = jax.jit(lambda fleet: jax.lax.scan(step, fleet, jax.random.split(jax.random.key(2), 30))[1])
    before, after, rows, valid, ended = jax.tree.map(np.asarray, play(fleet))
    over = np.asarray(ended.terminated | ended.truncated)
    assert over.any(axis=0).all() and not over.all(axis=1).any() and valid.all()
    assert ended.truncated.any() and (ended.terminated & ~ended.truncated).any()
    np.testing.assert_array_equal(after.state.time, np.where(over, 0, ended.time))
    np.testing.assert_array_equal(after.carry, after.state.time)
    np.testing.assert_array_equal(after.state.obs[over], np.zeros((over.sum(), 2)))
    np.testing.assert_array_equal(rows.action[..., 0], before.state.time)
    np.testing.assert_allclose(rows.discount, 0.9 * (1.0 - ended.terminated), atol=1e-6)
    np.testing.assert_array_equal(rows.next_obs, ended.obs)  # the true successor, not the next start


def test_no_key_is_used_twice_by_fleets_and_episodes(key):
    """Worlds, starts, steps, measurements and resets draw apart, in several steps and in several environments."""
    env = compiled(toy.make())
    pool = envs.sample_worlds(env, key, 3)

    def act(carry, obs, key):
        return jax.random.normal(key, (2,)), carry

    def whole(key):
        key_launch, key_steps, key_episodes = jax.random.split(key, 3)
        fleet = launch(env, pool, key_launch, 2, ())

        def step(fleet, key):
            return step_fleet(env, pool, fleet, jnp.zeros((2, 2)), (), key, initial_carry=(), gamma=0.9)[0], None

        play = functools.partial(play_episode, env, pool, act, (), gamma=0.9, length=3)
        played = jax.vmap(lambda key: play(key))(jax.random.split(key_episodes))
        return jax.lax.scan(step, fleet, jax.random.split(key_steps))[0], played

    assert keys.used_twice(whole) == 0


@pytest.mark.heavy
def test_exploded_environments_of_a_fleet_begin_anew():
    """Also those whose physics is broken for good; the others go on, and no row of an exploded step is valid."""
    env = compiled(toy_terminating.make())
    pool = envs.sample_worlds(env, jax.random.key(0), 1, params={"risk": 0.0})

    def step(world, state, action, key):
        after = env.step(world, state, action, key)
        return after._replace(invalid=(action[0] > 0) | state.invalid)

    begun = jnp.int32(0)
    fleet = launch(env, pool, jax.random.key(1), 4, begun)
    advance = jax.jit(functools.partial(step_fleet, env._replace(step=step), pool, initial_carry=begun, gamma=0.9))
    for actions in ([-1.0, 1.0, -1.0, -1.0], [-1.0, -1.0, -1.0, 1.0]):
        fleet, rows, valid, _ = advance(fleet, jnp.array(actions)[:, None], fleet.carry + 1, jax.random.key(2))
        np.testing.assert_array_equal(valid, np.array(actions) < 0)
        np.testing.assert_allclose(rows.reward, np.where(valid, 1 + fleet.state.obs[:, 0], 0), rtol=1e-6)
    for ages in (fleet.state.time, fleet.carry):
        np.testing.assert_array_equal(ages, [2, 1, 2, 0])
    np.testing.assert_allclose(fleet.state.obs[:, 0], [-0.2, -0.1, -0.2, 0.0], rtol=1e-6)


def test_dicts_are_packed_in_the_declared_order(key):
    env = compiled(toy_terminating.make())
    world = pick(envs.sample_worlds(env, key, 1, params={"risk": 1.0}), jnp.int32(0))
    state = env.step(world, env.reset(world, key), jnp.ones(1), key)
    np.testing.assert_allclose(state.obs, [0.1, 1.0])
    parts = envs.unpack(env.observation, state.obs)
    assert set(parts) == {"position", "alarm"} and parts["alarm"].tolist() == [1.0]


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"position": jnp.zeros(1)}, "'alarm' is not both declared and returned"),
        ({"position": jnp.zeros(1), "alarm": jnp.zeros(1), "depth": jnp.zeros(1)}, "'depth' is not both"),
        ({"position": jnp.zeros(2), "alarm": jnp.zeros(1)}, "'position' has 2 numbers, 1 are declared"),
    ],
)
def test_a_dict_that_is_not_as_declared_is_refused(parts, words):
    with pytest.raises(UserError, match=words):
        envs.base.pack(toy_terminating.OBSERVATION, parts)


def test_heldout_worlds_have_exact_sensors_in_simulation_only(tmp_path, key):
    (tmp_path / "g.toml").write_text("[params]\nmass = 2.0\nfriction = [3, 5]\n")
    env = toy.make()
    gap = load_gap(env, str(tmp_path / "g.toml"), ["mass=1.5"])
    assert load_gap(env, "sim", []) is None and load_gap(env, None, []) is None
    assert heldout_worlds(env, None, key, 3).theta.effects.high.obs_noise.tolist() == [0, 0, 0]
    assert training_worlds(env, None, key, 3).theta.effects.high.obs_noise.tolist() == pytest.approx([0.005] * 3)
    real = heldout_worlds(env, gap, key, 3)
    assert real.theta.params[:, 0].tolist() == [1.5] * 3
    assert float(real.theta.effects.high.obs_noise[0]) == pytest.approx(0.005)


def test_pools_of_different_size_are_brought_to_one(key):
    env, fixed = toy.make(), Gap("fixed", {"mass": 2.0, "friction": 4.0}, {"latency": 0.05})
    pools = real_worlds(env, [fixed, Gap("ranges", {"mass": [3.0, 4.0]}, {})], key, 5)
    np.testing.assert_array_equal(pools.theta.params[0], [[2.0, 4.0]] * 5)
    assert pools.theta.params.shape == (2, 5, 2) and len(np.unique(pools.theta.params[1, :, 0])) == 5
    np.testing.assert_allclose(pools.theta.effects.high.latency, [[0.05] * 5, [0.0] * 5])
    assert real_worlds(env, [fixed, fixed], key, 5).theta.params.shape == (2, 1, 2)
