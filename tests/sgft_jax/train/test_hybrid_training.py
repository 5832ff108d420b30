"""The loop of simulators and updates, on a point mass: what is collected, how often one learns, exact resumption."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import keys
import numpy as np
import pytest
import toy

from envs import gaps
from envs.control import cartpole
from envs.rollout import real_worlds, step_fleet
from envs.types import UserError
from sgft_jax.algorithms import make_policy
from sgft_jax.data import replay
from sgft_jax.methods import FIXED_NAMES, get_method
from sgft_jax.methods.options import return_scale
from sgft_jax.train import fleet, hybrid
from sgft_jax.train.fleet import over_members
from sgft_jax.train.schedule import Schedule
from sgft_jax.types import RealData

ENV = toy.make()
SMALL = {"hidden": (16,), "rows": 8}
QUICK = {"h2oplus"}  # what the fast tests see of the methods
each_method = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in FIXED_NAMES]
)
PRESETS = [(name, preset) for name in FIXED_NAMES for preset in get_method(name, "fixed").presets]
FIXED = {"hyper", "normalizer", "spread", "lr_ratio"}  # numbers and statistics, which no update moves
BIAS = 0.2  # of odd motors
SCHEDULE = Schedule(updates=24, simulators=3, buffer=64, chunk_updates=6)  # 4 chunks of 2 rounds


def build(name="h2oplus", preset=None, **changes):
    method = get_method(name, "fixed")
    config = method.config if preset is None else method.presets[preset]
    own = {key: value for key, value in {**SMALL, "ratio_rows": 8}.items() if hasattr(config, key)}
    return method.build(dataclasses.replace(config, **own | changes), ENV)


def real_rows(n=50):
    draw = np.random.default_rng(0)
    blank = replay.blank(ENV.obs_dim, ENV.act_dim)
    rows = jax.tree.map(lambda x: draw.uniform(-1, 1, (n, *x.shape)).astype(np.float32), blank)
    return RealData(rows._replace(discount=np.full(n, 0.9, np.float32)), np.arange(n) % 10 == 9)


def pools_of(*masses, **effects):
    """[M, 1] simulators that differ in the mass, in kg."""
    found = [gaps.from_dict(ENV, f"mass-{x}", {"params": {"mass": x}, "effects": effects}) for x in masses]
    return real_worlds(ENV, found, jax.random.key(0))


def keys_of(*seeds):
    return jnp.stack([jax.random.key(seed) for seed in seeds])


def played(agent, schedule=SCHEDULE, masses=(1.0,), seeds=(0,), **given):
    """The state after every chunk."""
    pools, keys = pools_of(*masses), keys_of(*seeds)
    steps = hybrid.train(ENV, agent, schedule, pools, real_rows(), keys, gamma=0.9, **given)
    return [(jax.tree.map(jnp.copy, state), metrics) for state, metrics in steps]


def plain(state):
    """Without random keys, which numpy cannot read."""
    return state._replace(key=jax.random.key_data(state.key), fleet=None)


@functools.cache
def run_of(name):
    """An agent, and its state after every chunk. H2O+'s numbers are not its defaults, iql's rate stays."""
    changes = {"h2oplus": {"preset": "released"}, "iql": {"falling_rate": False}}
    agent = build(name, **changes.get(name, {}))
    return agent, played(agent)


@pytest.mark.slow
def test_nothing_is_learned_while_every_simulator_explodes(monkeypatch):
    """No row is kept then, and an empty buffer gives zeros."""

    def explode(env, *inputs, **options):
        broken = env._replace(step=lambda *step: env.step(*step)._replace(invalid=jnp.ones((), bool)))
        return step_fleet(broken, *inputs, **options)

    monkeypatch.setattr(fleet, "step_fleet", explode)
    (start, _), (state, metrics), *_ = played(build())
    assert int(state.replay.size[0]) == 0 and int(state.rounds[0]) == 2
    chex.assert_trees_all_equal(state.learner, start.learner)
    assert all(np.isnan(values).all() for values in metrics.values())


@pytest.mark.heavy
def test_each_round_collects_and_learns():
    (start, none), *chunks = run_of("h2oplus")[1]
    assert none == {} and len(chunks) == 4
    fill = 18  # six steps of three simulators hold a first batch of 16
    assert int(start.replay.size[0]) == fill and int(start.learner.step[0]) == 0
    for i, (state, metrics) in enumerate(chunks, 1):
        assert int(state.rounds[0]) == 2 * i and int(state.learner.step[0]) == 6 * i
        assert int(state.replay.size[0]) == min(fill + 6 * i, 64)
        assert all(np.isfinite(values).all() and values.shape == (1,) for values in metrics.values())


@pytest.mark.heavy
@each_method
def test_no_key_is_used_twice(name):
    """In filling the buffer, in rounds of steps and in updates. The learners alone: test_contract_learners.py."""
    agent, real = build(name), jax.tree.map(jnp.asarray, real_rows())
    schedule = Schedule(updates=2, simulators=2, buffer=64, chunk_updates=2)
    made = fleet.make_trainer(ENV, hybrid.make_plan(ENV, agent, schedule), gamma=0.9)
    pool = jax.tree.map(lambda x: x[0], pools_of(1.0))

    def whole(key):
        state, _ = made.chunk(pool, agent.keep(real), made.init(pool, real, key))
        return jax.random.normal(state.key)

    assert keys.used_twice(whole) == 0


@pytest.mark.slow
def test_the_released_schedule_collects_long_and_then_learns_as_often():
    schedule = Schedule(updates=20, simulators=1, steps_per_round=10, buffer=100, chunk_updates=10)
    assert (schedule.updates_per_round, schedule.rounds_per_chunk, schedule.chunks) == (10, 1, 2)
    *_, (state, _) = played(build(), schedule)
    assert int(state.replay.size[0]) == 16 + 20 and int(state.learner.step[0]) == 20


@functools.cache
def biased():
    """The first rows and notes of two members: what a push did to a heavy and a light point with odd motors."""
    agent, schedule = build("sac"), dataclasses.replace(SCHEDULE, simulators=256, buffer=512)
    pools, real = pools_of(0.5, 4.0, action_bias=BIAS), hybrid.no_data(ENV)

    def note(learner, before, action, after):
        return after.physics.ctrl

    state, _ = next(hybrid.train(ENV, agent, schedule, pools, real, keys_of(0, 0), gamma=0.9, note=note))
    held = slice(int(state.replay.size[0]))
    assert held.stop == 256
    return jax.tree.map(lambda x: np.asarray(x)[:, held], (state.replay.data, state.notes.data))


@pytest.mark.heavy
def test_the_rows_are_those_of_the_members_own_simulator():
    """What a push does to a heavy and to a light point tells which simulator a row is from."""
    rows, sent = biased()
    pushed = rows.next_obs[..., 2:] - (1 - 0.1 * 4.0) * rows.obs[..., 2:]
    gain = [np.polyfit(sent[i].ravel(), pushed[i].ravel(), 1)[0] for i in range(2)]
    np.testing.assert_allclose(gain, [0.1 * toy.FORCE / 0.5, 0.1 * toy.FORCE / 4.0], rtol=0.1)


@pytest.mark.heavy
def test_the_buffer_keeps_the_actions_as_they_were_chosen():
    """The motor gets what the gap makes of an action, and a row holds the action, as in H2O+'s simulators."""
    rows, sent = biased()
    assert np.abs(rows.action).max() <= 1 and rows.action.std() > 0.1
    np.testing.assert_allclose(sent - rows.action, BIAS, atol=1e-6)


@pytest.mark.slow
def test_the_buffer_keeps_the_actions_without_the_noise_of_the_gap():
    """Under `action_noise` the motor gets clip(a + n), and a row holds a, as in H2O+'s simulators."""
    env, noise = cartpole.make(), 0.2
    pools = real_worlds(env, [gaps.from_dict(env, "shaky", {"effects": {"action_noise": noise}})], jax.random.key(0))
    agent = get_method("sac", "fixed").build(dataclasses.replace(get_method("sac", "fixed").config, hidden=(16,)), env)
    real, schedule = hybrid.no_data(env), dataclasses.replace(SCHEDULE, simulators=32, buffer=512)

    def note(learner, before, action, after):
        return after.physics.ctrl

    state, _ = next(hybrid.train(env, agent, schedule, pools, real, keys_of(0), gamma=0.9, note=note))
    held = slice(int(state.replay.size[0]))
    action, sent = (np.asarray(x)[0, held, 0] for x in (state.replay.data.action, state.notes.data))
    far = np.abs(action) < 0.5  # from the bounds, where clipping cuts the noise
    assert held.stop == 256 and far.sum() > 60 and np.abs(sent).max() <= 1
    assert (sent - action)[far].std() == pytest.approx(noise, rel=0.25)


@pytest.mark.slow
def test_members_do_what_they_would_do_alone():
    *_, (both, _) = played(build(), masses=(0.5, 4.0), seeds=(0, 1))
    *_, (alone, _) = played(build(), masses=(4.0,), seeds=(1,))
    own = jax.tree.map(lambda x: x[1:], plain(both))
    chex.assert_trees_all_close(own.learner, plain(alone).learner, rtol=1e-3, atol=1e-4)


@pytest.mark.heavy
@each_method
def test_a_resumed_run_ends_like_an_uninterrupted_one(name):
    agent, whole = run_of(name)
    middle, end = jax.tree.map(jnp.copy, whole[2][0]), whole[-1][0]
    resumed = played(agent, state=middle)
    assert len(resumed) == 3  # where it stopped, and two chunks
    chex.assert_trees_all_equal(plain(resumed[-1][0]), plain(end))


@pytest.mark.heavy
def test_the_shapes_of_a_state_are_known_without_training():
    agent, chunks = run_of("h2oplus")
    like = hybrid.shape_of(ENV, agent, SCHEDULE, pools_of(1.0), real_rows(), keys_of(0))
    chex.assert_trees_all_equal_shapes_and_dtypes(plain_shapes(like), plain_shapes(chunks[-1][0]))


def plain_shapes(state):
    return state._replace(key=None)


@pytest.mark.slow
def test_discriminators_read_standardised_observations_only_if_asked_to():
    rows = real_rows()
    for asked, mean in ((False, np.zeros(4)), (True, rows.rows.obs.mean(0))):
        state = played(build(standardise=asked))[0][0]
        np.testing.assert_allclose(state.learner.ratio.normalizer.mean[0], mean, atol=1e-6)


@pytest.mark.slow
def test_sac_sees_no_real_row():
    def rows(sign):
        real = real_rows()
        return real._replace(rows=jax.tree.map(lambda x: sign * 1e3 * np.ones_like(x), real.rows))

    agent, pools, keys = build("sac"), pools_of(1.0), keys_of(0)
    ends = []
    for sign in (-1, 1):
        *_, (state, _) = hybrid.train(ENV, agent, SCHEDULE, pools, rows(sign), keys, gamma=0.9)
        ends.append(state.learner)
    chex.assert_trees_all_equal(*ends)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"updates": 0}, "option updates is 0: must be at least 1"),
        ({"updates_per_step": -1.0}, "option updates-per-step is -1.0: must be a positive number"),
        ({"simulators": 50, "buffer": 20}, "option buffer is 20: must be at least the rows of a round, 50"),
    ],
)
def test_bad_schedules(changes, words):
    with pytest.raises(UserError, match=words):
        Schedule(**changes)


def test_presets_are_what_they_are_called():
    """Section 3 of the paper, and the released code, which differs from it."""
    paper, released, robot = (
        get_method("h2oplus", "fixed").presets[name] for name in ("paper", "released", "released-robot")
    )
    assert (paper.value_share, paper.value_loss, paper.ratio, paper.rows) == (0.1, "iql", True, 128)
    assert (released.value_share, released.expectile) == (0.5, 0.5)
    assert (robot.value_share, robot.expectile, robot.hidden, robot.rows, robot.ratio_rows) == (
        0.1,
        0.9,
        (32, 32),
        16,
        256,
    )
    h2o = get_method("h2o", "fixed").presets
    assert (h2o["paper"].conservatism, h2o["paper"].spread_scale) == (0.01, 1.0)
    assert h2o["released"].spread_scale == pytest.approx(np.sqrt(1 / 11), abs=2e-3)  # one row in eleven is not padding
    penalties = {
        name: (own.actor_penalty, own.critic_penalty) for name, own in get_method("rebrac", "fixed").presets.items()
    }
    assert penalties == {
        "halfcheetah-medium-replay": (0.01, 0.001),
        "halfcheetah-medium": (0.001, 0.01),
        "walker2d-medium-replay": (0.05, 0.01),
        "walker2d-medium": (0.05, 0.1),
    }
    ensemble = get_method("h2oplus-edac", "fixed").config
    assert (ensemble.critics, ensemble.diversity, ensemble.value_share, ensemble.expectile) == (10, 1.0, 0.1, 0.7)
    assert get_method("cql", "fixed").config.conservatism == 2.0 and get_method("edac", "fixed").config.critics == 10


def test_presets_of_h2oplus_change_what_their_names_say_and_nothing_else():
    """The paper's tables; the backbones' own numbers are those of their authors (value scale and cut-off)."""
    presets = get_method("h2oplus", "fixed").presets
    paper = dataclasses.asdict(presets["paper"])
    assert {name: dict(dataclasses.asdict(own).items() - paper.items()) for name, own in presets.items()} == {
        "paper": {},
        "released": {"value_share": 0.5, "expectile": 0.5},
        "released-robot": {"expectile": 0.9, "hidden": (32, 32), "rows": 16},
        "no-ratio": {"ratio": False},
        "lambda-0": {"value_share": 0.0},
        "lambda-0.2": {"value_share": 0.2},
        "lambda-0.5": {"value_share": 0.5},
        "lambda-1": {"value_share": 1.0},
        "sql": {"value_loss": "sql"},
        "eql": {"value_loss": "eql", "value_alpha": 2.0},
        "xql": {"value_loss": "xql", "value_alpha": 2.0, "value_cut": 7.0},
    }
    assert (paper["value_alpha"], paper["value_cut"]) == (1.0, 5.0)


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["eql", "xql"])
def test_scale_and_cut_off_of_a_backbone_reach_its_learner(name):
    own = get_method("h2oplus", "fixed").presets[name]
    agent = build(value_loss=own.value_loss, value_alpha=own.value_alpha, value_cut=own.value_cut)
    hyper = agent.learner.init(jax.random.key(0)).hyper
    assert (hyper.value_alpha, hyper.value_cut) == (own.value_alpha, own.value_cut)


def check_learning(chunks):
    """Losses and numbers are finite, and every update has moved every part of the agent that learns."""
    (start, _), *later = chunks
    for _, metrics in later:
        assert [name for name in metrics if name.endswith("loss")]
        assert all(np.isfinite(values).all() for values in metrics.values())
    leaves = [jax.tree_util.tree_leaves_with_path(plain(state).learner) for state in (start, later[-1][0])]
    for (path, before), (_, after) in zip(*leaves, strict=True):
        fixed = FIXED & {key.name for key in path if isinstance(key, jax.tree_util.GetAttrKey)}
        assert np.isfinite(after).all() and (fixed or not np.array_equal(before, after)), jax.tree_util.keystr(path)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "preset"), PRESETS)
def test_every_preset_learns_as_it_stands(name, preset):
    """At its own sizes: the released code of H2O+ has a preset of the robot that no one can start."""
    agent = get_method(name, "fixed").build(get_method(name, "fixed").presets[preset], ENV)
    schedule = Schedule(updates=4, simulators=2, buffer=600, chunk_updates=2)
    chunks = played(agent, schedule)
    check_learning(chunks)
    assert len(chunks) == 3


@pytest.mark.heavy
def test_a_preset_that_is_no_default_learns_with_its_own_numbers():
    _, chunks = run_of("h2oplus")
    check_learning(chunks)
    hyper = chunks[-1][0].learner.hyper
    assert (float(hyper.value_share[0]), float(hyper.expectile[0])) == (0.5, 0.5)


def test_the_bytes_of_a_run_are_those_of_its_buffers_and_of_one_copy_of_the_data():
    """A row is 4 + 2 + 1 + 1 + 4 floats: 48 bytes. Two counters of 4 bytes go with each buffer."""
    assert hybrid.memory(ENV, build(), SCHEDULE, real_rows()) == (64 * 48 + 8, 50 * 48 + 8)
    assert hybrid.memory(ENV, build("iql"), SCHEDULE, real_rows())[0] == 0
    state = hybrid.shape_of(ENV, build(), SCHEDULE, pools_of(0.5, 4.0), real_rows(), keys_of(0, 0))
    assert sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state.replay)) == 2 * (64 * 48 + 8)


@pytest.mark.slow
def test_a_chunk_holds_neither_buffers_nor_data_twice():
    """What it needs beside its arguments stays the same where these are 400 times as large."""

    def beside(n):
        """Bytes of the temporaries of two members' chunk."""
        agent, schedule = build(), dataclasses.replace(SCHEDULE, buffer=n)
        inputs = pools_of(0.5, 4.0), real_rows(n), keys_of(0, 1)
        state = hybrid.shape_of(ENV, agent, schedule, *inputs)
        chunk = over_members(
            fleet.make_trainer(ENV, hybrid.make_plan(ENV, agent, schedule), gamma=0.9).chunk, 2, shared=(1,)
        )
        kept = jax.eval_shape(agent.keep, inputs[1])
        made = jax.jit(chunk, donate_argnums=2).lower(inputs[0], kept, state).compile()
        return made.memory_analysis().temp_size_in_bytes

    few, many = 100, 40_000
    assert beside(many) < beside(few) + 48 * many  # a copy of either would be as much


@pytest.mark.slow
def test_two_critics_without_diversity_are_those_of_h2oplus():
    states = [played(agent)[-1][0] for agent in (build(), build("h2oplus-edac", critics=2, diversity=0.0))]
    chex.assert_trees_all_equal(*map(plain, states))


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["iql", pytest.param("rebrac", marks=pytest.mark.slow)])
def test_offline_methods_have_no_simulator(name):
    state, _ = run_of(name)[1][-1]
    assert state.fleet is None and state.replay is None and int(state.learner.step[0]) == 24


@pytest.mark.slow
def test_the_noise_of_h2o_has_the_spread_of_the_data():
    state = played(build("h2o"))[0][0]
    np.testing.assert_allclose(state.learner.spread[0], real_rows().rows.obs.std(0), rtol=1e-4)


@pytest.mark.heavy
def test_the_rate_of_iqls_actor_falls_over_the_whole_run_if_asked_to():
    """The last chunk is whole: 20 updates make four chunks of 6. A resumed run goes on where the rate was."""
    agent, schedule = build("iql", falling_rate=True), dataclasses.replace(SCHEDULE, updates=20)
    chunks = played(agent, schedule)
    falling = 3e-4 * (0.5 + 0.5 * np.cos(np.pi * np.arange(24) / 24))
    for run, rates in ((chunks, falling), (run_of("iql")[1], np.full(24, 3e-4))):
        seen = np.array([metrics["actor/lr"][0] for _, metrics in run[1:]])
        np.testing.assert_allclose(seen, rates.reshape(4, 6).mean(1), rtol=1e-4)
    resumed = played(agent, schedule, state=chunks[2][0])
    chex.assert_trees_all_equal(plain(resumed[-1][0]), plain(chunks[-1][0]))


@pytest.mark.heavy
def test_iql_scales_rewards_to_the_span_of_the_returns():
    rows = real_rows()
    returns = rows.rows.reward.reshape(5, 10).sum(1)
    state = run_of("iql")[1][0][0]
    np.testing.assert_allclose(state.learner.hyper.reward_scale[0], 1000 / np.ptp(returns), rtol=1e-4)
    cut = RealData(rows.rows, rows.last & (np.arange(50) != 49))  # the last episode is cut off
    np.testing.assert_allclose(return_scale(jax.tree.map(jnp.asarray, cut)), 1000 / np.ptp(returns), rtol=1e-4)


def test_a_log_of_one_episode_keeps_its_rewards():
    one = RealData(real_rows().rows, np.arange(50) == 49)
    assert return_scale(jax.tree.map(jnp.asarray, one)) == 1


@pytest.mark.heavy
def test_the_scale_of_a_backbone_is_one_of_returns_that_span_1000():
    """alpha = 2 of these is 2 span / 1,000 of the returns that the critic learns."""
    agent = build(value_loss="eql", value_alpha=2.0)
    rows = real_rows()
    state = agent.prepare(jax.jit(agent.learner.init)(jax.random.key(0)), jax.tree.map(jnp.asarray, rows), 24)
    span = np.ptp(rows.rows.reward.reshape(5, 10).sum(1))
    np.testing.assert_allclose(state.hyper.value_alpha, 2 * span / 1000, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", FIXED_NAMES)
def test_an_exported_policy_acts_as_the_agent(name):
    agent = build(name)
    state = jax.tree.map(lambda x: x[0], played(agent)[-1][0].learner)
    obs, key = jnp.array([0.3, -0.2, 0.1, 0.5]), jax.random.key(3)
    own, _ = agent.learner.act(state, (), obs, key, explore=False)
    exported, _ = agent.policy.act(agent.export(state), (), obs, key, explore=False)
    np.testing.assert_allclose(exported, own, atol=1e-6)
    card = {**agent.card, "config": {}}
    again, _ = make_policy(card, ENV).act(agent.export(state), (), obs, key, explore=False)
    np.testing.assert_allclose(again, own, atol=1e-6)


@pytest.mark.slow
def test_notes_lie_beside_their_rows():
    """Also of the first batch, and after old rows were overwritten."""

    def note(learner, before, action, after):
        return before.obs, action, after.obs

    schedule = dataclasses.replace(SCHEDULE, updates=12, buffer=20)
    state, _ = played(build("sac"), schedule, note=note)[-1]
    (obs, action, next_obs), rows = state.notes.data, state.replay.data
    assert int(state.notes.position[0]) == int(state.replay.position[0]) and int(state.notes.size[0]) == 20
    for kept, own in ((obs, rows.obs), (action, rows.action), (next_obs, rows.next_obs)):
        np.testing.assert_array_equal(kept, own)
    assert np.abs(action).max() > 0
