"""The iterator of pretraining: fleets that reset, worlds that are renewed, resuming, what it leaves."""

import functools
from dataclasses import replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import keys
import numpy as np
import pytest
import toy
import toy_terminating
import tuners
from flax import struct

import envs
from envs.types import UserError
from sgft_jax.algorithms import make_policy, recipe_of
from sgft_jax.data import replay
from sgft_jax.keys import seed_keys
from sgft_jax.learners import tdmpc2_model
from sgft_jax.models import normalizer
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.presets import PRESETS, PretrainConfig
from sgft_jax.train import pretraining
from sgft_jax.train.fleet import over_members
from sgft_jax.train.pretraining import pretrain, priors_of
from sgft_jax.types import Learner

N, STEPS, LENGTH = 16, 30, toy_terminating.LENGTH
LOOP = {"n_envs": N, "chunk_steps": STEPS, "env_steps": 2 * N * STEPS, "worlds": 4, "random_transitions": LENGTH * N}
LEARNING = {"replay_capacity": 4 * N * STEPS, "batch_size": 8, "updates_per_step": 1, "gamma": 0.9}
VALUE = {"value_episodes": 8, "value_updates": 40}
NETWORKS = {"ensemble_size": 1, "size": tuners.TINY, "horizon": 2, "plan_samples": 8, "gru": 4}
CONFIG = PretrainConfig(**LOOP, **LEARNING, **VALUE, **NETWORKS, network=NetworkConfig(hidden=(8,)))


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    monkeypatch.setitem(tdmpc2_model.SIZES, tuners.TINY, tdmpc2_model.Size(8, 8, 8, 2, 2))


class Agent(struct.PyTreeNode):
    """An agent that learns nothing."""

    normalizer: Any
    hyper: Any


def counting(task, config, **parts):
    """Actions are the age of the episode, as far as the carry tells. parts: of the learner, instead of its own."""
    learner = Learner(
        init=lambda key: Agent(normalizer.identity(task.obs_dim), jnp.float32(0)),
        init_carry=lambda: jnp.float32(0),
        act=lambda agent, carry, obs, key, *, explore: (jnp.full(task.act_dim, carry), carry + 1),
        update=lambda agent, batch, key: (agent, {"batch/reward": batch.reward.mean()}),
    )
    sac = recipe_of(task, config)
    return sac._replace(
        learner=learner._replace(**parts),
        hyper=lambda steps: jnp.float32(0),
        extract=lambda agent: agent.normalizer,
    )


def played(state, chunk):
    """The stored rows [STEPS, N] of a chunk of a single member."""
    rows = slice(chunk * STEPS * N, (chunk + 1) * STEPS * N)
    return jax.tree.map(lambda x: np.asarray(x[0, rows]).reshape(STEPS, N, *x.shape[2:]), state.replay.data)


@functools.cache
def counted(*risks, refresh_every=0, resumed=None):
    """Trains the counting agent on risks by number of the set: [(state, metrics)] at the start and after every chunk.

    resumed: go on after that many chunks of a run without an interruption.
    """
    env, config = toy_terminating.make(), replace(CONFIG, refresh_every=refresh_every)

    def pools(number, domains):
        pool = envs.sample_worlds(env, jax.random.key(number), 4, params={"risk": risks[number]})
        return jax.tree.map(lambda x: x[None], pool)

    state = None
    if resumed is not None:
        state = jax.tree.map(jnp.copy, counted(*risks, refresh_every=refresh_every)[resumed][0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pretraining, "recipe_of", counting)
        return [jax.tree.map(jnp.copy, found) for found in pretrain(env, config, [3], pools=pools, state=state)]


@pytest.mark.heavy
def test_episodes_end_and_begin_anew_with_their_carry():
    _, (state, metrics), _ = counted(0.2)
    rows = played(state, 0)
    alarm, age = rows.next_obs[..., 1] > 0.5, rows.action[..., 0]
    over = alarm | (age == LENGTH - 1)
    np.testing.assert_allclose(rows.discount, 0.9 * (1 - alarm), rtol=1e-6)
    assert alarm.any(axis=0).all() and (over & ~alarm).any(), "episodes end both ways"
    assert (rows.obs[0] == 0).all() and (age[0] == 0).all()
    np.testing.assert_allclose(rows.obs[1:], np.where(over[:-1, :, None], 0, rows.next_obs[:-1]))
    np.testing.assert_array_equal(age[1:], np.where(over[:-1], 0, age[:-1] + 1))
    np.testing.assert_array_equal(state.fleet.carry[0], state.fleet.state.time[0])
    assert metrics["train/terminated"][0] == pytest.approx(alarm.sum() / over.sum())
    assert metrics["train/exploded"][0] == metrics["train/success"][0] == 0


@pytest.mark.heavy
@pytest.mark.parametrize("algorithm", tuners.slow_but({"sac"}, ["sac", "recurrent", "tdmpc2"]))
def test_no_key_is_used_twice(algorithm):
    """In random experience, the first state, a chunk of two steps and new worlds."""
    env = toy_terminating.make()
    loop = {"n_envs": 2, "chunk_steps": 2, "random_transitions": 2 * LENGTH, "random_ladder": 0.5}
    config = replace(CONFIG, algorithm=algorithm, **loop, replay_capacity=80, batch_size=4, updates_per_step=2)
    trainer, pool = pretraining.make_trainer(env, config), envs.sample_worlds(env, jax.random.key(0), 2)

    def whole(key):
        key_random, key_start = jax.random.split(key)
        random = pretraining.random_experience(env, config, pool, key_random)
        state, _ = trainer.chunk(pool, random, trainer.init(pool, random, key_start))
        return jax.random.normal(trainer.renew(pool, state).key)

    assert keys.used_twice(whole) == 0


@pytest.mark.heavy
def test_a_policy_remembers_the_random_action_that_replaced_its_choice(monkeypatch):
    """Its choice is always 0.5; what it hands on is the action that was stored, or 0 at the start of an episode."""

    def chosen(agent, carry, obs, key, *, explore):
        return jnp.full(1, 0.5), jnp.float32(0.5)

    def recipe(task, config):
        return counting(task, config, act=chosen)._replace(replaced=lambda carry, action: action[0])

    monkeypatch.setattr(pretraining, "recipe_of", recipe)
    config = replace(CONFIG, chunk_steps=5, env_steps=5 * N, random_ladder=1.0)
    *_, (state, _) = pretrain(toy_terminating.make(), config, [3])
    done = state.replay.data.action[0, 4 * N : 5 * N, 0]
    remembered, goes_on = state.fleet.carry[0], state.fleet.state.time[0] > 0
    np.testing.assert_array_equal(remembered, jnp.where(goes_on, done, 0.0))
    assert goes_on.any() and (done[goes_on] == 0.5).any() and (done[goes_on] != 0.5).any()


@pytest.mark.heavy
def test_statistics_are_those_of_the_steps_that_did_not_explode(monkeypatch):
    """Half of the random steps explode, and leave the end of their buffer empty."""
    monkeypatch.setattr(pretraining, "recipe_of", counting)
    env = toy_terminating.make()
    pool, step = envs.sample_worlds(env, jax.random.key(0), 4, params={"risk": 0.0}), env.step
    env = env._replace(step=lambda *now: step(*now)._replace(invalid=now[2][0] > 0))
    trainer = pretraining.make_trainer(env, CONFIG)
    random = jax.jit(functools.partial(pretraining.random_experience, env, CONFIG))(pool, jax.random.key(1))
    held, rows = int(random.size), len(random.data.reward)
    assert 0.4 * rows < held < 0.6 * rows
    statistics = jax.jit(trainer.init)(pool, random, jax.random.key(2)).learner.normalizer
    seen = np.asarray(random.data.obs)[:held, 0]
    assert statistics.mean[0] == pytest.approx(seen.mean(), rel=1e-4)
    assert statistics.std[0] == pytest.approx(seen.std(), rel=1e-4)
    assert seen.mean() < -0.02
    plain = pretraining.make_trainer(env, replace(CONFIG, normalize=False))
    left = jax.jit(plain.init)(pool, random, jax.random.key(2)).learner.normalizer
    assert left.mean[0] == 0.0 and left.std[0] == 1.0


@pytest.mark.heavy
def test_new_worlds_begin_new_episodes():
    """Nothing ends the first set's episodes but time, everything those of the second."""
    state, metrics = counted(0.0, 1.0, refresh_every=1)[-1]
    first, second = played(state, 0), played(state, 1)
    assert (first.discount > 0).all() and (second.discount == 0).all()
    assert (second.obs[0] == 0).all() and (second.action == 0).all() and first.action.max() == LENGTH - 1
    assert metrics["train/terminated"][0] == 1


@pytest.mark.slow
def test_a_set_that_is_not_due_is_never_asked_for():
    """There is no second set in either case, and nothing else differs."""
    never, late = (counted(0.2, refresh_every=every)[-1][0] for every in (0, 2))
    equal(never, late)


def test_a_resumed_fleet_plays_on_with_the_same_bits():
    """After one of two chunks, where new worlds are due. With agents that learn: below."""
    whole, resumed = counted(0.2, 0.5, refresh_every=1), counted(0.2, 0.5, refresh_every=1, resumed=1)
    assert len(whole) == 3 and len(resumed) == 2
    equal(resumed[-1][0], whole[-1][0])
    assert (played(whole[-1][0], 0).next_obs != played(whole[-1][0], 1).next_obs).any()


@pytest.mark.parametrize(
    ("algorithm", "refresh_every"),
    [
        pytest.param("sac", 0, marks=pytest.mark.slow),
        pytest.param("sac", 1, marks=pytest.mark.slow),
        pytest.param("tdmpc2", 0, marks=pytest.mark.slow),
        pytest.param("tdmpc2", 1, marks=pytest.mark.slow),
        pytest.param("recurrent", 0, marks=pytest.mark.slow),
        pytest.param("recurrent", 1, marks=pytest.mark.slow),
    ],
)
def test_resumed_is_bit_for_bit_uninterrupted(algorithm, refresh_every):
    env, config = (
        toy_terminating.make(),
        replace(CONFIG, algorithm=algorithm, refresh_every=refresh_every, random_ladder=0.5),
    )
    seeds = [3, 4]
    states = [jax.tree.map(jnp.copy, state) for state, _ in pretrain(env, config, seeds)]
    assert [pretraining.make_plan(env, config).chunks_done(state) for state in states] == [0, 1, 2]
    _, (end, metrics) = pretrain(env, config, seeds, state=jax.tree.map(jnp.copy, states[1]))
    equal(end, states[2])
    assert all(np.isfinite(x).all() and x.shape == (2,) for x in metrics.values())
    first, other = end.replay.data.action
    assert (first != other).any(), "seeds differ"
    if algorithm == "recurrent":  # it remembers what was done, also where a random action replaced its own
        done = end.replay.data.action[:, (2 * STEPS - 1) * N : 2 * STEPS * N]
        goes_on = end.fleet.state.time > 0
        np.testing.assert_array_equal(end.fleet.carry.action, jnp.where(goes_on[..., None], done, 0.0))
        assert goes_on.any()

    prior, _ = priors_of(env, config, end)
    assert prior.card["task"] == "toy_terminating" and prior.card["gamma"] == 0.9
    policy = make_policy(prior.card, env)
    action, _ = policy.act(prior.params, policy.init_carry(), jnp.zeros(2), jax.random.key(0), explore=False)
    assert action.shape == (1,) and np.isfinite(action).all()


def equal(one, other):
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(one), jax.tree.leaves(other), strict=True):
        a, b = (jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x for x in (a, b))
        np.testing.assert_array_equal(a, b, err_msg=jax.tree_util.keystr(path))


@pytest.mark.slow
def test_random_actions_grow_along_the_fleet(key, monkeypatch):
    """A policy always says 2: the first environment obeys, the last acts at random, the middle one does both."""

    def always(agent, carry, obs, key, *, explore):
        return jnp.full(2, 2.0), carry

    monkeypatch.setattr(pretraining, "recipe_of", functools.partial(counting, act=always))
    config = replace(CONFIG, n_envs=3, chunk_steps=60, env_steps=180, random_ladder=1.0)
    *_, (state, _) = pretrain(toy.make(), config, [0])
    obeyed = (state.replay.data.action[0, : 3 * 60].reshape(60, 3, 2) > 1).all(-1).mean(0)
    assert obeyed[0] == 1 and obeyed[2] == 0 and 0.25 < obeyed[1] < 0.75


def shapes_of_random(env, config):
    """Of what one member collects under random actions."""
    worlds = jax.tree.map(lambda x: x[None], envs.sample_worlds(env, jax.random.key(0), 1))
    return pretraining.make_programs(env, config, 1).collect.eval_shape(worlds, jax.random.split(jax.random.key(0), 1))


@pytest.mark.parametrize("preset", PRESETS)
def test_random_actions_that_would_take_hours_come_from_more_simulators(preset, monkeypatch):
    """25 million transitions are 3,125 steps of 8,000 simulators. Those of other presets are too few for that."""
    config, env, launched, launch = PRESETS[preset], toy.make(), [], pretraining.launch
    monkeypatch.setattr(pretraining, "launch", lambda *args: launched.append(args[3]) or launch(*args))
    kept = shapes_of_random(env, config)
    assert launched == [8_000 if preset == "paper" else config.n_envs]
    assert jax.tree.leaves(kept)[0].shape[1] in (config.random_transitions, config.random_transitions + launched[0])


def test_a_ring_of_time_slots_keeps_to_the_simulators_of_training():
    config = replace(CONFIG, algorithm="tdmpc2", n_envs=2, random_transitions=2 * 4_000)
    assert shapes_of_random(toy.make(), config).n_envs == 2


@pytest.mark.parametrize("algorithm", ["sac", "tdmpc2", "recurrent"])
def test_the_learning_rate_falls_linearly_to_its_end(algorithm):
    config = replace(PRESETS["cpu"], algorithm=algorithm, size="1M", n_envs=10, env_steps=1000, lr=1e-3, lr_end=0.1)
    recipe = recipe_of(toy.make(), config)
    rate = {"sac": "lr_critic", "tdmpc2": "lr", "recurrent": "lr"}[algorithm]
    rates = [float(getattr(recipe.hyper(jnp.int32(steps)), rate)) for steps in (0, 50, 100, 120)]
    np.testing.assert_allclose(rates, [1e-3, 5.5e-4, 1e-4, 1e-4], rtol=1e-5)


@pytest.mark.parametrize("members", [1, 3])
def test_over_members_is_a_loop(members):
    x, y = jnp.arange(3.0)[:members], jnp.arange(6.0).reshape(3, 2)[:members]
    twice, sums = over_members(lambda x, y: (2 * x, y.sum()), members)(x, y)
    assert twice.tolist() == [0, 2, 4][:members] and sums.tolist() == [1, 5, 9][:members]  # 0 + 1, 2 + 3, 4 + 5


def test_a_single_member_keeps_its_conditions():
    def branch(x):
        return jax.lax.cond(x > 0, jnp.sin, jnp.cos, x)

    one, two = (str(jax.make_jaxpr(over_members(branch, n))(jnp.ones(n))) for n in (1, 2))
    assert "cond[" in one and "cond[" not in two


def test_memory_counts_what_is_kept_and_drawn():
    """A row of the toy task: two observations of 4 numbers, 2 of the action, reward and discount, 4 bytes each."""
    row = sum(x.nbytes for x in jax.tree.leaves(replay.blank(4, 2)))
    assert row == 4 * (4 + 4 + 2 + 1 + 1)
    found = pretraining.memory(
        toy.make(), replace(CONFIG, random_transitions=100, replay_capacity=10**9, batch_size=50)
    )
    assert found["random_transitions"] == 100 * row + 8 and found["replay_capacity"] == 10**9 * row + 8  # two counters
    networks = CONFIG.ensemble_size + 3
    activations = 2 * networks * 50 * sum(CONFIG.network.hidden) * 4
    assert found["batch_size"] == 2 * 50 * CONFIG.updates_per_step * row + activations
    length = 20 + 12  # 0.9^12 < 30 %
    assert found["value_episodes"] == 4 * CONFIG.value_episodes * length * (2 * 4 + 4)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"replay_capacity": 9}, "option replay-capacity is 9: must be at least n-envs = 16"),
        ({"refresh_every": -1}, "option refresh-every is -1: must be at least 0"),
        ({"gamma": 2.0}, "option gamma is 2.0: must be at least 0 and less than 1"),
        ({"lr": float("nan")}, "option lr is nan: must be a positive number"),
        ({"gru": 0}, "option gru is 0: must be at least 1"),
        ({"algorithm": "recurrent", "sees_system": True}, "sees-system is True: must be off for a prior of recurrent"),
        ({"network": NetworkConfig(blind=2)}, "network.blind is 2: must be 0: blind-actor sets it"),
        ({"blind_actor": True}, "blind-actor is True: must be off where sees-system is off"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, words):
    with pytest.raises(UserError, match=words):
        replace(CONFIG, **changes)


def test_recurrent_policies_need_room_for_whole_episodes():
    config = replace(CONFIG, algorithm="recurrent", random_transitions=(LENGTH - 1) * N)
    with pytest.raises(UserError, match=r"--config\.random-transitions 176: .* 16 environments need at least 192"):
        pretraining.make_trainer(toy_terminating.make(), config)


def test_keys_depend_on_seed_and_purpose_alone():
    keys = jax.random.key_data(seed_keys([0, 1, 2], 5))
    np.testing.assert_array_equal(keys[1:], jax.random.key_data(seed_keys([1, 2], 5)))
    assert len(np.unique(np.concatenate([keys, jax.random.key_data(seed_keys([0, 1, 2], 6))]), axis=0)) == 6


@pytest.mark.heavy
def test_a_domain_widens_with_every_set_of_worlds_and_a_resumed_run_ends_alike(monkeypatch):
    monkeypatch.setattr(pretraining, "success_in", lambda env, config, pool, *rest: pool.theta.params[:, 0] < 2.0)
    config = replace(CONFIG, doraemon=True, refresh_every=1, env_steps=3 * N * STEPS, n_envs=N, worlds=64)
    env, seeds = toy.make(), [3, 4]

    def states(state=None):
        return [jax.tree.map(jnp.copy, reached) for reached, _ in pretrain(env, config, seeds, state=state)]

    straight = states()
    widths = [np.asarray(reached.domain.a) for reached in straight]
    assert (widths[0] == widths[1]).all(), "the first set is that of the beginning"
    assert (widths[2] < widths[1]).all() and (widths[3] < widths[2]).all(), "of every seed, every number"
    chex.assert_trees_all_equal(states(jax.tree.map(jnp.copy, straight[2]))[-1].domain, straight[-1].domain)


def test_a_domain_that_widens_needs_new_worlds():
    with pytest.raises(UserError, match="off where refresh-every is 0"):
        replace(CONFIG, doraemon=True)
