"""The loop of fine-tuning: what it yields, on which systems, what it keeps, and how it goes on."""

import functools
import re

import jax
import jax.numpy as jnp
import keys
import numpy as np
import pytest
import toy_terminating
from tuners import Recorded, bits, copied, equal

import envs
from envs.rollout import Episode
from envs.types import Policy, Transition, UserError
from sgft_jax.data import replay, sources
from sgft_jax.io import checkpoint
from sgft_jax.keys import Finetuning
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train import finetuning
from sgft_jax.train.finetuner import Parts, assemble
from sgft_jax.train.options import LoopOptions
from sgft_jax.train.simulation import SimulatedRows, simulate
from sgft_jax.types import Learner, Simulation

ENV, GAMMA = toy_terminating.make(), 0.9
LENGTH = ENV.episode_length
SEEDS = jnp.array([3, 8], jnp.uint32)
PER_ROLLOUT = 3
PRIORS = jnp.array([0.0, 0.5])  # [P] params: where the toy agent starts
NUMBER = 1e-2  # of an action for each step of memory


def act(state, carry, obs, key, *, explore):
    """The steps of this episode so far, and what was learned; exploring adds noise."""
    noise = jnp.where(explore, 1e-4 * jax.random.normal(key), 0.0)
    return (NUMBER * carry + 1e-4 * jnp.tanh(state) + noise)[None], carry + 1.0


def make(initial_policy=None, simulation=None, initial_rollouts=1, guard=False):
    """Fine-tuning whose learner adds up what it sees and draws, and whose policy counts its own steps."""

    def update(state, batch, key):
        return state + 1.0 + 1e-3 * jnp.mean(batch.obs) + 1e-3 * jax.random.normal(key), {"learner/state": state}

    learner = Learner(lambda key: jnp.float32(0), lambda: jnp.float32(0), act, update)
    parts = Parts(
        learner=learner,
        start=lambda params, key: (jnp.float32(0) if params is None else params, None),
        export=lambda state: state.learner,
        policy=Policy(learner.init_carry, act, lambda params, obs: params),
        source=lambda state: sources.mixture(4, 2) if simulation else sources.real_rows(4),
        offline=sources.simulated_rows(4),
        simulation=simulation,
    )
    options = LoopOptions(utd=PER_ROLLOUT / LENGTH, initial_rollouts=initial_rollouts, replay_capacity=200, guard=guard)
    return assemble(parts, options, ENV)._replace(initial_policy=initial_policy)


FINE = make()


@functools.cache
def simulated():
    """Two systems; the members play one each."""
    pools = envs.sample_worlds(ENV, jax.random.key(0), 4)
    return Simulated(ENV, jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), pools), jnp.array([0, 1]), gamma=GAMMA)


def run(finetuner=FINE, system=None, rollouts=4, **options):
    """All that a run yields."""
    system = simulated() if system is None else system
    steps = finetuning.finetune(finetuner, system, PRIORS, SEEDS, rollouts=rollouts, **options)
    return [(copied(progress), metrics) for progress, metrics in steps]


@functools.cache
def whole():
    """(all that was played in six rollouts, what was yielded). A shorter run is their beginning."""
    system = Recorded(simulated())
    yielded = run(system=system, rollouts=6)
    return system.played, yielded


# --- keys ------------------------------------------------------------------------------------------------------------


def test_every_purpose_of_every_member_draws_from_keys_that_no_other_uses():
    """Beginning, updates before the first rollout and after two, what is played to learn and what to be judged."""
    fine = make(simulation=NEEDS)
    learn = finetuning.Updates(fine, SEEDS, finetuning.prior_of(PRIORS, SEEDS), lambda: rows_of(10))

    def whole(key):
        agent = finetuning.begin(fine._replace(init=drawn), PRIORS, SEEDS).agent
        for parts, phase in (([0], "offline"), ([1], "logged"), ([0, 1], "online")):
            agent, _ = learn(agent, parts, 1, phase)
        played = [
            finetuning._episode_keys(SEEDS, purpose, 0, 2) for purpose in (Finetuning.COLLECT, Finetuning.EVALUATE)
        ]
        played.append(finetuning._episode_keys(SEEDS, Finetuning.COLLECT, 1, 2))
        return agent, [jax.vmap(jax.vmap(jax.random.normal))(x) for x in played], jax.random.normal(key)

    def drawn(params, key):
        return fine.init(params + jax.random.normal(key), jax.random.key(77))

    assert keys.used_twice(whole) == 0


# --- what it yields -------------------------------------------------------------------------------------------------


def updates_of(played):
    """[rollouts, M] of what was played: three for a whole rollout, in proportion for a shorter one, one at least."""
    lengths = np.stack([np.asarray(episodes.valid.sum((1, 2))) for episodes, _ in played])
    return np.maximum(np.rint(PER_ROLLOUT * lengths / LENGTH), 1)


def test_the_fresh_state_comes_first_then_one_a_rollout():
    played, yielded = whole()
    assert [int(p.rollouts) for p, _ in yielded] == [0, 1, 2, 3, 4, 5, 6] and yielded[0][1] == {}
    assert {"real/return", "real/score", "real/exploded", "learner/state", "batch/reward_mean"} <= set(yielded[1][1])
    assert all(x.shape == (2,) and jnp.isfinite(x).all() for _, metrics in yielded[1:] for x in metrics.values())
    # seed 3 starts from prior 1, seed 8 from prior 0
    np.testing.assert_array_equal(yielded[0][0].agent.learner, [0.5, 0.0])
    np.testing.assert_allclose(yielded[3][0].agent.learner, np.add([0.5, 0.0], updates_of(played[:3]).sum(0)), atol=0.1)


def test_updates_and_transitions_are_those_of_the_steps_that_were_made():
    """Members differ, as their episodes end early; metrics are means over the updates of each."""
    played, yielded = whole()
    updates, valid = updates_of(played), np.stack([np.asarray(x.valid.sum((1, 2))) for x, _ in played])
    assert len(np.unique(updates)) == PER_ROLLOUT and (updates[:, 0] != updates[:, 1]).any()
    for i, (progress, metrics) in enumerate(yielded[1:], 1):
        np.testing.assert_array_equal(progress.transitions, valid[:i].sum(0))
        np.testing.assert_array_equal(metrics["updates"], updates[i - 1])
        before = yielded[i - 1][0].agent.learner
        np.testing.assert_allclose(progress.agent.learner, before + updates[i - 1], atol=0.02)
        np.testing.assert_allclose(metrics["learner/state"], before + (updates[i - 1] - 1) / 2, atol=0.02)


@pytest.mark.heavy
def test_initial_rollouts_come_together_and_each_brings_its_updates():
    system = Recorded(simulated())
    yielded = run(make(initial_rollouts=3), system, rollouts=4)
    assert [int(p.rollouts) for p, _ in yielded] == [0, 3, 4]
    updates = updates_of(system.played)[:3]
    np.testing.assert_allclose(yielded[1][0].agent.learner, np.add([0.5, 0.0], updates.sum(0)), atol=0.1)
    np.testing.assert_allclose(yielded[1][1]["updates"], updates.mean(0))


def test_a_rollout_without_a_valid_step_is_learned_nothing_from():
    """The first two have none. Then there is something in the replay again."""
    yielded = run(system=Scripted(np.zeros((3, 2)), made=[0, 0, LENGTH]), rollouts=3)
    for progress, metrics in yielded[1:3]:
        assert equal(progress.agent, yielded[0][0].agent) and metrics["updates"].tolist() == [0, 0]
        assert np.isnan(metrics["learner/state"]).all()
    last, metrics = yielded[3]
    assert metrics["updates"].tolist() == [PER_ROLLOUT] * 2 and last.transitions.tolist() == [LENGTH] * 2
    np.testing.assert_allclose(last.agent.learner, [0.5 + 3, 3.0], atol=0.1)


def test_a_log_without_a_valid_step_is_learned_nothing_from():
    log = logs_of(3, 2, updates=4)
    yielded = run(rollouts=0, logged=log._replace(valid=jnp.zeros_like(log.valid)))
    assert int(yielded[1][0].offline) == 4 and yielded[1][1]["updates"].tolist() == [0, 0]
    assert equal(yielded[1][0].agent, yielded[0][0].agent)


def test_a_resumed_run_goes_on_with_the_same_bits(tmp_path):
    _, yielded = whole()
    checkpoint.save(tmp_path, 3, yielded[3][0], meta={})
    like = jax.eval_shape(functools.partial(finetuning.begin, FINE), PRIORS, SEEDS)
    restored, _ = checkpoint.restore(tmp_path, like)
    rest = run(rollouts=6, progress=jax.tree.map(jnp.asarray, restored))
    assert [int(p.rollouts) for p, _ in rest] == [4, 5, 6]
    assert bits(rest[-1]) == bits(yielded[-1])


@pytest.mark.heavy
def test_all_methods_meet_the_same_starts():
    """World and luck follow from the seed and the rollout alone, not from who plays."""
    system = Recorded(simulated())
    run(make(initial_policy=Policy(FINE.init_carry, act, act)), system, rollouts=3)
    worlds = [[episodes.world for episodes, _ in played] for played in (whole()[0][:3], system.played)]
    assert equal(*worlds) and len(set(np.ravel(worlds[0]).tolist())) == 2


# --- memory ---------------------------------------------------------------------------------------------------------


def steps_of(episodes):
    """What the policy remembered at each valid step, episode by episode."""
    action, valid = (np.asarray(x).reshape(-1, LENGTH) for x in (episodes.transitions.action[..., 0], episodes.valid))
    return [np.round(a[v] / NUMBER).tolist() for a, v in zip(action, valid, strict=True)]


@pytest.mark.heavy
def test_the_carry_is_threaded_and_begins_anew_with_each_episode():
    played, yielded = whole()
    agent = jax.tree.map(jnp.asarray, yielded[3][0].agent)
    several = simulated().play(FINE, agent, finetuning._episode_keys(SEEDS, 3, 0, 4), explore=False)
    assert any(len(steps) > 5 for steps in steps_of(several))
    for episodes in [*(episodes for episodes, _ in played), several]:
        for steps in steps_of(episodes):
            assert steps == list(range(len(steps)))


@pytest.mark.heavy
def test_evaluation_repeats_a_fixed_series_without_exploring():
    agent = jax.tree.map(jnp.asarray, whole()[1][1][0].agent)
    system = Recorded(simulated())
    few, more, again = (finetuning.evaluate(FINE, system, agent, SEEDS, n) for n in (2, 5, 5))
    assert equal(more, again) and equal(few, jax.tree.map(lambda x: x[:, :2], more))
    assert [explore for _, explore in system.played] == [False] * 3
    other = jax.tree.map(lambda x: x[::-1], agent)
    same_starts = finetuning.evaluate(FINE, system, other, SEEDS, 5)
    assert equal(same_starts.world, more.world)


# --- what is stored -------------------------------------------------------------------------------------------------


def test_terminations_and_time_limits_are_stored_as_what_they_are():
    played, yielded = whole()
    last = yielded[-1][0]
    for m in range(2):
        rows = jax.tree.map(lambda x, m=m: np.asarray(x[m]), last.agent.replay)
        valid = [np.asarray(episodes.valid[m, 0]) for episodes, _ in played]
        held = jax.tree.map(lambda x, n=int(rows.size): x[:n], rows.data)
        assert rows.size == sum(v.sum() for v in valid)
        alarm = held.next_obs[:, 1] > 0.5
        np.testing.assert_allclose(held.discount, np.where(alarm, 0.0, GAMMA), rtol=1e-6)
        ends = np.cumsum([v.sum() for v in valid]) - 1
        assert set(np.flatnonzero(alarm)) <= set(ends) and alarm.any()
        in_time = [end for end, v in zip(ends, valid, strict=True) if v.all() and not alarm[end]]
        assert all(held.discount[end] > 0 for end in in_time)
    assert any(np.asarray(e.valid).all(-1).any() for e, _ in played)  # some episode reached its time limit


class Scripted:
    """A system whose episodes have scores and returns [rollouts, M] as written.

    made: [rollouts] steps before the physics explodes. torn: every other row is invalid.
    """

    def __init__(self, scores, returns=None, made=None, *, torn=False):
        self.scores, self.calls, self.torn = np.asarray(scores, np.float32), 0, torn
        self.returns = self.scores if returns is None else np.asarray(returns, np.float32)
        self.made = [LENGTH] * len(self.scores) if made is None else made

    def play(self, policy, states, keys, *, explore):
        assert keys.shape == (2, 1)
        score, total = (jnp.asarray(x[self.calls])[:, None] for x in (self.scores, self.returns))
        shape, no, steps = (2, 1, LENGTH), jnp.zeros((2, 1), bool), jnp.arange(LENGTH)
        valid = jnp.broadcast_to((steps < self.made[self.calls]) & ~(self.torn & (steps % 2 == 1)), shape)
        self.calls += 1
        obs = jnp.where(valid[..., None], 1.0, jnp.nan) * jnp.ones((*shape, 2))
        rows = Transition(obs, jnp.zeros((*shape, 1)), jnp.ones(shape), jnp.ones(shape), obs)
        return Episode(rows, valid, total, no, ~valid.all(-1), score, jnp.zeros((2, 1), int), jnp.zeros((*shape, 0)))


def test_rows_with_exploded_physics_are_not_stored():
    *_, (last, metrics) = run(system=Scripted(np.zeros((3, 2)), torn=True), rollouts=3)
    assert last.agent.replay.size.tolist() == [3 * LENGTH // 2] * 2
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(last.agent) if x.dtype == np.float32 and x.size > 2)
    assert np.isfinite(last.agent.learner).all() and metrics["real/exploded"].tolist() == [1, 1]


# --- the best policy by real evidence -------------------------------------------------------------------------------


def test_the_policy_of_the_best_five_rollouts_is_kept():
    """One member rises and falls, the other rises at the end."""
    rise = [0, 0, 1, 1, 1, 1, 1, 0, 0, 0, 1, 1]
    late = [0, 0, 0, 0, 0, 0, 1, 0, 1, 1, 1, 1]
    yielded = run(system=Scripted(np.stack([rise, late], 1)), rollouts=12)
    assert yielded[4][0].best.score.tolist() == [0.5, 0.0]  # of four rollouts, as there are no more
    best, played = (
        yielded[-1][0].best,
        [7 - 1, 11 - 1],
    )  # rollouts by the policies that are kept; of equal ones the first
    assert best.age.tolist() == played and best.score.tolist() == pytest.approx([1.0, 0.8])
    before = np.stack([p.agent.learner for p, _ in yielded])
    np.testing.assert_array_equal(best.params, [before[played[0], 0], before[played[1], 1]])
    assert best.count.tolist() == [12, 12]


def test_equal_scores_are_told_apart_by_returns():
    returns = np.stack([[1] * 5 + [2] * 5, [2] * 5 + [1] * 5], 1)
    best = run(system=Scripted(np.ones((10, 2)), returns), rollouts=10)[-1][0].best
    assert best.age.tolist() == [9, 4] and best.total.tolist() == [2, 2]


def test_the_best_policy_had_learned_from_what_came_before_it():
    """Six rollouts at once, by one policy that had learned from none."""
    best = run(make(initial_rollouts=6), Scripted(np.ones((6, 2))), rollouts=6)[-1][0].best
    assert best.age.tolist() == [0, 0] and best.params.tolist() == [0.5, 0.0]


def test_an_explosion_is_reported_as_the_worst_that_is_known():
    """Rewards are costs: two steps cost 2, a whole rollout 12 or 10."""
    scores = np.repeat([[-12.0], [-2.0], [-10.0]], 2, 1)
    yielded = run(system=Scripted(scores, made=[LENGTH, 2, LENGTH]), rollouts=3)
    assert [metrics["real/score"].tolist() for _, metrics in yielded[1:]] == [[-12] * 2, [-12] * 2, [-10] * 2]
    assert yielded[2][1]["real/return"].tolist() == [-12] * 2 and yielded[2][1]["real/exploded"].tolist() == [1, 1]
    assert yielded[3][0].best.score.tolist() == pytest.approx([-34 / 3] * 2)


@pytest.mark.heavy
def test_rollouts_of_an_initial_policy_are_no_evidence_for_the_agent():
    """They are played with the prior's own parameters, and they are learned from."""
    seen = []

    def constant(params, carry, obs, key, *, explore):
        return params[None], carry

    class Looking(Recorded):
        def play(self, policy, states, keys, *, explore):
            seen.append((policy is first, explore))
            return super().play(policy, states, keys, explore=explore)

    first = Policy(lambda: (), constant, lambda params, obs: params)
    system = Looking(simulated())
    yielded = run(make(first, initial_rollouts=5), system, rollouts=6)
    assert seen == [(True, True)] * 5 + [(False, True)]
    action, valid = system.played[0][0].transitions.action[..., 0], system.played[0][0].valid
    assert set(np.asarray(action)[0][np.asarray(valid)[0]]) == {0.5}
    assert set(np.asarray(action)[1][np.asarray(valid)[1]]) == {0.0}
    assert yielded[1][0].best.count.tolist() == [0, 0] and yielded[-1][0].best.count.tolist() == [1, 1]
    assert yielded[1][0].agent.replay.size.min() > 10


# --- which policy is deployed -----------------------------------------------------------------------------------------

RETURNS = np.stack([[5, 6, 9, 9, 9, 9], [5, 6, 0, 5, 6, 5]], 1)


@pytest.mark.heavy
def test_the_guard_decides_for_each_member_who_plays_next():
    """By the scores of its rollouts. One learner becomes the reference, the other is given up."""
    fine = make(guard=True)
    yielded = run(fine, Scripted(RETURNS), rollouts=6)
    flags = [(x["guard/challenger"].tolist(), x["guard/replaced"].tolist()) for _, x in yielded[1:]]
    assert flags[:3] == [([0, 0], [0, 0]), ([1, 1], [0, 0]), ([0, 0], [1, 0])]
    states = [progress.agent for progress, _ in yielded]
    acting = np.stack([jax.vmap(fine.export)(jax.tree.map(jnp.asarray, state)) for state in states])
    np.testing.assert_array_equal(acting[:2], np.tile([0.5, 0.0], (2, 1)))
    np.testing.assert_array_equal(acting[2], states[2].agent.learner)
    np.testing.assert_array_equal(acting[3], [states[2].agent.learner[0], 0.0])  # what played, before it went on
    assert states[3].agent.learner[0] != states[2].agent.learner[0]


def test_initial_rollouts_are_evidence_for_the_policy_that_made_them():
    """All four, though the learner would have been deployed after the second."""
    _, (progress, metrics) = run(make(guard=True, initial_rollouts=4), Scripted(RETURNS), rollouts=4)
    guard = progress.agent.guard
    assert guard.reference.weight.tolist() == [4, 4] and guard.reference.total.tolist() == [29, 16]
    assert guard.challenger.weight.tolist() == [0, 0] and metrics["guard/challenger"].tolist() == [1, 1]


@pytest.mark.slow
def test_a_guarded_run_that_was_stopped_goes_on_with_the_same_bits(tmp_path):
    """Reference, evidence and who is deployed are in the checkpoint."""
    fine = make(guard=True)
    whole = run(fine, rollouts=6)
    assert len({tuple(metrics["guard/challenger"].tolist()) for _, metrics in whole[1:]}) > 1
    checkpoint.save(tmp_path, 3, whole[3][0], meta={})
    restored, _ = checkpoint.restore(tmp_path, jax.eval_shape(functools.partial(finetuning.begin, fine), PRIORS, SEEDS))
    rest = run(fine, rollouts=6, progress=jax.tree.map(jnp.asarray, restored))
    assert bits(rest[-1]) == bits(whole[-1])


# --- logs to begin with -----------------------------------------------------------------------------------------------


def logs_of(*lengths, updates):
    """Episodes of these lengths, whose observations are 10 * number + step."""
    step, longest = np.arange(max(lengths), dtype=np.float32), max(lengths)
    valid = step < np.array(lengths)[:, None]
    obs = np.repeat((10.0 * np.arange(len(lengths))[:, None] + step)[..., None], 2, axis=-1).astype(np.float32)
    paid = np.ones((len(lengths), longest), np.float32)
    rows = Transition(obs, np.zeros((*paid.shape, 1), np.float32), paid, GAMMA * paid, obs + 1)
    return finetuning.Logged(jax.tree.map(jnp.asarray, rows), jnp.asarray(valid), updates)


def test_logs_are_kept_by_all_and_learned_from_before_anything_is_played(monkeypatch):
    """Seven updates in parts of five. Nobody has played yet, so no policy has evidence."""
    monkeypatch.setattr(finetuning, "OFFLINE_PART", 5)
    system = Recorded(simulated())
    yielded = run(system=system, rollouts=1, logged=logs_of(3, 2, updates=7))
    assert [(int(p.offline), int(p.rollouts)) for p, _ in yielded] == [(0, 0), (5, 0), (7, 0), (7, 1)]
    kept = yielded[2][0].agent.replay
    assert kept.size.tolist() == [5, 5] and yielded[0][0].agent.replay.size.tolist() == [0, 0]
    np.testing.assert_array_equal(kept.data.obs[:, :5, 0], [[0, 1, 2, 10, 11]] * 2)
    np.testing.assert_allclose(yielded[2][0].agent.learner, [7.5, 7.0], atol=0.1)
    assert yielded[2][0].best.count.tolist() == [0, 0] and len(system.played) == 1
    assert yielded[3][0].agent.replay.size.min() > 5


def test_logs_without_updates_are_kept_all_the_same():
    yielded = run(rollouts=1, logged=logs_of(3, updates=0))
    assert [int(p.rollouts) for p, _ in yielded] == [0, 1]
    np.testing.assert_array_equal(yielded[1][0].agent.replay.data.obs[:, :3, 0], [[0, 1, 2]] * 2)


@pytest.mark.slow
def test_a_run_with_logs_goes_on_from_anywhere_with_the_same_bits(tmp_path, monkeypatch):
    """After 6 and 12 updates on simulated rows, 6 and 8 on the logs, and a rollout: the logs are kept once."""
    monkeypatch.setattr(finetuning, "OFFLINE_PART", 6)
    fine, logged = make(simulation=NEEDS), logs_of(3, 2, updates=8)
    options = {"simulated": lambda: rows_of(10), "rollouts": 2, "logged": logged}
    whole = run(fine, **options)
    assert [int(p.offline) for p, _ in whole] == [0, 6, 12, 18, 20, 20, 20]
    for i in range(1, 6):
        state = jax.tree.map(jnp.asarray, copied(whole[i][0]))
        rest = run(fine, progress=state, **options)
        assert len(rest) == len(whole) - i - 1 and bits(rest[-1]) == bits(whole[-1]), i


@pytest.mark.parametrize(("offline", "parts"), [(0, 0), (10, 1), (12, 2), (13, 3), (22, 3), (23, 4)])
def test_parts_of_the_offline_phase_never_share_a_number(offline, parts, monkeypatch):
    """Twelve updates on simulated rows, then those on logs, in parts of ten each."""
    monkeypatch.setattr(finetuning, "OFFLINE_PART", 10)
    assert finetuning.offline_parts(make(simulation=NEEDS), offline) == parts


def test_a_log_is_no_evidence_for_the_guard():
    """What it scored is not told; what was learned from it is not deployed before the reference has played."""
    fine = make(guard=True)
    yielded = run(fine, Scripted(RETURNS), rollouts=2, logged=logs_of(3, updates=4))
    told = yielded[1][0].agent
    assert told.guard.reference.weight.tolist() == told.guard.challenger.weight.tolist() == [0, 0]
    assert told.guard.worst.tolist() == [np.inf] * 2 and told.guard.deployed.tolist() == [False] * 2
    assert told.agent.replay.size.tolist() == [3, 3] and told.agent.learner.min() > 3.5
    played = yielded[2][0].agent.guard
    assert played.reference.total.tolist() == [5, 5] and played.worst.tolist() == [5, 5]


# --- a system that is stepped from Python ---------------------------------------------------------------------------


class Robot:
    """One episode at a time: reset() and step(action), as hardware has them."""

    reset_, step_ = staticmethod(jax.jit(ENV.reset)), staticmethod(jax.jit(ENV.step))

    def __init__(self, pool):
        self.pool = pool

    def reset(self, key):
        key_world, key_start, key_steps = jax.random.split(key, 3)
        index = jax.random.randint(key_world, (), 0, envs.rollout.pool_size(self.pool))
        self.world = envs.rollout.pick(self.pool, index)
        self.state = self.reset_(self.world, key_start)
        return np.asarray(self.state.obs), index, jax.random.split(key_steps, LENGTH)

    def step(self, action, key):
        self.state = self.step_(self.world, self.state, jnp.asarray(action), key)
        return np.asarray(self.state.obs), float(self.state.reward), bool(self.state.terminated)


class Stepped:
    """A `System` of robots, one for each member."""

    def __init__(self, robots):
        self.robots = robots

    def play(self, policy, states, keys, *, explore):
        act = jax.jit(functools.partial(policy.act, explore=explore))
        each = [
            self.one(robot, act, jax.tree.map(lambda x, m=m: x[m], states), policy.init_carry(), keys[m, 0])
            for m, robot in enumerate(self.robots)
        ]
        return jax.tree.map(lambda *x: jnp.stack(x)[:, None], *each)

    @staticmethod
    def one(robot, act, state, carry, key):
        obs, index, step_keys = robot.reset(key)
        zero = Transition(np.zeros(2), np.zeros(1), 0.0, 0.0, np.zeros(2))
        rows, over = [], False
        for step_key in step_keys:
            if over:
                rows.append((zero, False))
                continue
            key_act, key_env = jax.random.split(step_key)
            action, carry = act(state, carry, obs, key_act)
            following, reward, over = robot.step(action, key_env)
            rows.append((Transition(obs, np.asarray(action), reward, GAMMA * (not over), following), True))
            obs = following
        transitions = jax.tree.map(lambda *x: jnp.asarray(np.stack(x), jnp.float32), *[row for row, _ in rows])
        total, no = transitions.reward.sum(), jnp.bool_(False)
        valid = jnp.array([ok for _, ok in rows])
        return Episode(transitions, valid, total, no, no, total, index, jnp.zeros((LENGTH + 1, 0)))


@pytest.mark.slow
def test_a_system_stepped_from_python_goes_through_the_same_loop():
    """With the same dynamics it gives the same run, whatever is played in one program or step by step."""
    fast = simulated()
    robots = [Robot(jax.tree.map(lambda x, m=m: x[m], fast.pools)) for m in range(2)]
    for (one, metrics), (other, same) in zip(whole()[1][:4], run(system=Stepped(robots), rollouts=3), strict=True):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5), one, other)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5), metrics, same)


# --- simulated data -------------------------------------------------------------------------------------------------

NEEDS = Simulation(48, 0.8, offline_updates=12)


def rows_of(n, p=2):
    """n rows for each of p priors: rewards are 100 for the first prior, 200 for the next."""
    example = replay.blank(2, 1)

    def one(i):
        rows = jax.tree.map(lambda x: jnp.full((n, *x.shape), 100.0 * (i + 1)), example)
        return replay.add_batch(replay.init(example, n), rows)

    return SimulatedRows(jax.tree.map(lambda *x: jnp.stack(x), *map(one, range(p))), jnp.ones((p, 3)))


@pytest.mark.slow
def test_the_offline_phase_comes_in_parts(monkeypatch):
    monkeypatch.setattr(finetuning, "OFFLINE_PART", 5)
    fine = make(simulation=NEEDS)
    yielded = run(fine, rollouts=1, simulated=lambda: rows_of(10))
    assert [(int(p.offline), int(p.rollouts)) for p, _ in yielded] == [(0, 0), (5, 0), (10, 0), (12, 0), (12, 1)]
    # its rows are those of each member's own prior: seed 3 has the second one's
    assert [x["batch/reward_mean"].tolist() for _, x in yielded[1:4]] == [[200.0, 100.0]] * 3
    assert "real/return" not in yielded[3][1] and "real/return" in yielded[4][1]
    rest = run(fine, rollouts=1, simulated=lambda: rows_of(10), progress=jax.tree.map(jnp.asarray, yielded[2][0]))
    assert bits(rest[-1]) == bits(yielded[-1])


def test_simulated_rows_are_asked_for_once_the_first_rollout_has_been_played():
    system, asked = Recorded(simulated()), []

    def rows():
        asked.append(len(system.played))
        return rows_of(10)

    run(make(simulation=NEEDS._replace(offline_updates=0)), system, rollouts=2, simulated=rows)
    assert asked[0] == 1


def test_methods_that_need_simulated_data_say_so():
    with pytest.raises(UserError, match="pass `simulated`"):
        run(make(simulation=NEEDS), rollouts=1)


@pytest.mark.heavy
def test_members_share_simulated_rows():
    """No array of the compiled program holds a set of rows for each member."""
    fine, n, members = make(simulation=NEEDS), 1009, 7
    seeds, simulated = jnp.arange(members, dtype=jnp.uint32), rows_of(n)
    learning = finetuning.Updates(fine, seeds, finetuning.prior_of(PRIORS, seeds), lambda: simulated)
    states = jax.eval_shape(lambda: finetuning.begin(fine, PRIORS, seeds)).agent
    member_keys = jax.random.split(jax.random.key(0), members)
    program = learning._learn.lower(states, member_keys, learning.which, 1, simulated, False, None).as_text()
    assert set(re.findall(rf"tensor<([\dx]*){n}x", program)) == {"2x"}  # two priors, no member


@pytest.mark.heavy
def test_simulate_plays_whole_episodes_with_more_and_more_random_actions():
    pool = envs.sample_worlds(ENV, jax.random.key(0), 4)
    still = Policy(lambda: (), lambda params, carry, obs, key, *, explore: (params[None], carry), lambda *_: 0.0)
    made = simulate(ENV, still, pool, PRIORS, jax.random.key(1), Simulation(600, 0.8), gamma=GAMMA)
    assert made.returns.shape == (2, 50) and (made.replay.size > 100).all()
    for p, own in enumerate(PRIORS):
        data = made.of(p).draw(jax.random.key(2), 4000)
        kept = np.isclose(data.action[:, 0], own)
        assert kept.mean() == pytest.approx(0.6, abs=0.1)  # shares rise from 0 to 0.8
        held = np.asarray(made.replay.data.action[p, :, 0])[: int(made.replay.size[p])]
        third = len(held) // 3
        assert np.isclose(held[:third], own).mean() > np.isclose(held[-third:], own).mean() + 0.3
    assert np.unique(np.asarray(data.discount)).tolist() == pytest.approx([0.0, 0.9])
    np.testing.assert_allclose(made.of(1).returns, made.returns[1])
