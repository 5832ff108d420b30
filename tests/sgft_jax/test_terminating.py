"""Every method where episodes end early: pretraining, fine-tuning and evaluation, judged by the rows that are kept.

Whatever acts counts the steps of its episode in its carry and says the count in a second action, which moves nothing.
So every row tells how old its episode was.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_terminating
import tuners
from tuners import METHODS, NET, Recorded, copied

import envs
from envs.base import Entry
from envs.rollout import Episode
from envs.types import UserError
from sgft_jax.algorithms import make_policy, recipe_of
from sgft_jax.presets import PretrainConfig
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train import finetuning, pretraining
from sgft_jax.train.guard import Guarded
from sgft_jax.train.simulation import simulate
from sgft_jax.types import Finetuner

# In the fast tests the parts stand for this: fleets in test_pretraining.py, what is stored in test_train.py, functions
# that a task lacks in test_finetuner.py.
pytestmark = pytest.mark.slow
BASE = toy_terminating.make()
ENV = BASE._replace(action=(*BASE.action, Entry("count", "episodes", 1)))
LENGTH, GAMMA = ENV.episode_length, np.float32(0.9)
M = 8  # members; each evaluates one episode, by the program that also plays the real ones
N, STEPS = 8, 30  # environments and steps of pretraining
LOOP = {"n_envs": N, "chunk_steps": STEPS, "env_steps": N * STEPS, "worlds": 4, "random_transitions": LENGTH * N}
LEARNING = {"replay_capacity": N * STEPS, "batch_size": 8, "updates_per_step": 1, "gamma": 0.9}
NETWORKS = {"network": NET, "ensemble_size": 2, "size": tuners.TINY, "horizon": 2, "plan_samples": 24, "gru": 4}
CONFIG = PretrainConfig(**LOOP, **LEARNING, **NETWORKS, value_episodes=16, value_updates=40)

each_method = pytest.mark.parametrize("name", METHODS)
each_algorithm = pytest.mark.parametrize("algorithm", ["sac", "tdmpc2", "recurrent"])


def counting(part):
    """A learner, policy or finetuner whose carry also counts the steps of the episode, as its last action tells."""

    def act(state, carry, *given, **options):
        own, steps = carry
        action, own = part.act(state, own, *given, **options)
        return action.at[-1].set(steps / LENGTH), (own, steps + 1.0)

    return part._replace(init_carry=lambda: (part.init_carry(), jnp.float32(0)), act=act)


class Pretrained(NamedTuple):
    """state: at the end, of two seeds. metrics: of the last chunk. priors: one for each seed. params: theirs, [2]."""

    state: Any
    metrics: Any
    priors: Any
    params: Any


@functools.cache
def pretrained(algorithm):
    config = dataclasses.replace(CONFIG, algorithm=algorithm)

    def recipe(*given):
        recipe = recipe_of(*given)
        return recipe._replace(learner=counting(recipe.learner))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pretraining, "recipe_of", recipe)
        *_, (state, metrics) = pretraining.pretrain(ENV, config, [0, 1])
        priors = pretraining.priors_of(ENV, config, state)
    return Pretrained(state, metrics, priors, jax.tree.map(lambda *x: jnp.stack(x), *[p.params for p in priors]))


def start_of(name):
    """The two priors of a method and their params [2]: pretrained here, but for TD-MPC2 itself.

    Its prior is untrained, because pretraining one takes as long as all else that is fast here.
    """
    if name == "tdmpc2":
        own = tuners.prior("tdmpc2")
        return [own] * 2, jax.tree.map(lambda x: jnp.stack([x, x]), own.params)
    made = pretrained(METHODS[name].prior)
    return made.priors, made.params


class Run(NamedTuple):
    """fine: the method. simulated: its simulated rows, or None. played: the real episodes [M, 1], rollout by rollout.

    yielded: what fine-tuning yielded. evaluated: episodes [M, 1] at the end.
    """

    fine: Finetuner
    simulated: Any
    played: list[Episode]
    yielded: list[Any]
    evaluated: Episode


@functools.cache
def finetuned(name):
    """Members on two real systems and from two priors, for two rollouts."""
    priors, params = start_of(name)
    fine = counting(METHODS[name].build(tuners.configure(name), priors[0], ENV))
    if fine.initial_policy is not None:
        fine = fine._replace(initial_policy=counting(fine.initial_policy))
    pools = envs.sample_worlds(ENV, jax.random.key(0), 4)
    rows = None
    if fine.simulation is not None:
        policy = make_policy(priors[0].card, ENV)
        rows = simulate(ENV, policy, pools, params, jax.random.key(1), fine.simulation, gamma=GAMMA)
    stacked, seeds = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), pools), jnp.arange(M, dtype=jnp.uint32)
    system = Recorded(Simulated(ENV, stacked, seeds // (M // 2), gamma=GAMMA))
    steps = finetuning.finetune(fine, system, params, seeds, rows and (lambda: rows), rollouts=2)
    yielded = [(copied(progress), metrics) for progress, metrics in steps]
    agent = jax.tree.map(jnp.asarray, yielded[-1][0].agent)
    return Run(fine, rows, [x for x, _ in system.played], yielded, finetuning.evaluate(fine, system, agent, seeds, 1))


def replay_of(run):
    """Of all members at the end, behind a guard or not."""
    agent = run.yielded[-1][0].agent
    return (agent.agent if isinstance(agent, Guarded) else agent).replay


def alarmed(rows):
    return np.asarray(rows.next_obs[..., 1] > 0.5)


def ends_of(rows):
    """[n] bool, the last steps of episodes, after a check of n consecutive rows of one environment.

    The first row begins an episode. An episode ends by an alarm, with discount 0, or by its length, with discount
    gamma; the next one begins at the start, with a fresh carry.
    """
    age, alarm = np.round(np.asarray(rows.action[:, -1]) * LENGTH), alarmed(rows)
    over = alarm | (age == LENGTH - 1)
    np.testing.assert_array_equal(rows.discount, np.where(alarm, 0, GAMMA))
    np.testing.assert_array_equal(age, np.append(0, np.where(over, 0, age + 1)[:-1]))
    starts = np.append(np.zeros((1, 2)), np.where(over[:, None], 0, rows.next_obs)[:-1], axis=0)
    np.testing.assert_array_equal(rows.obs, starts)
    return over


def finite(tree):
    return all(np.isfinite(x).all() for x in jax.tree.leaves(tree))


# --- pretraining ------------------------------------------------------------------------------------------------------


@each_algorithm
def test_a_fleet_begins_new_episodes_and_keeps_how_they_ended(algorithm):
    made = pretrained(algorithm)
    rows = jax.tree.map(
        lambda x: np.asarray(x)[:, : STEPS * N].reshape(2, STEPS, N, *x.shape[2:]), made.state.replay.data
    )
    for m in range(2):
        own = jax.tree.map(lambda x, m=m: x[m], rows)
        over = np.stack([ends_of(jax.tree.map(lambda x, i=i: x[:, i], own)) for i in range(N)], axis=1)
        alarm = alarmed(own)
        assert alarm.any(axis=0).all() and (over & ~alarm).any()  # episodes end both ways
        assert made.metrics["train/terminated"][m] == pytest.approx(alarm.sum() / over.sum())
        if algorithm != "sac":  # windows must not cross the end of an episode
            np.testing.assert_array_equal(made.state.replay.last[m, : STEPS * N].reshape(STEPS, N), over)
    np.testing.assert_array_equal(made.state.fleet.carry[1], made.state.fleet.state.time)
    assert finite(made.metrics) and finite(made.params)


# --- fine-tuning ------------------------------------------------------------------------------------------------------


@each_method
def test_rows_up_to_the_end_of_an_episode_are_stored_and_no_others(name):
    run = finetuned(name)
    assert [int(progress.rollouts) for progress, _ in run.yielded if progress.rollouts] == [1, 2]
    how = []
    for m in range(M):
        played = [(episodes.transitions, episodes.valid) for episodes in run.played]
        rows, valid = jax.tree.map(lambda *x, m=m: np.concatenate([y[m, 0] for y in x]), *played)
        memory = jax.tree.map(lambda x, m=m: x[m], replay_of(run))
        held = jax.tree.map(lambda x, n=int(memory.size): x[:n], memory.data)
        assert memory.size == valid.sum()
        jax.tree.map(lambda x, y, v=valid: np.testing.assert_array_equal(x, y[v]), held, rows)
        over = ends_of(held)
        np.testing.assert_array_equal(np.flatnonzero(over), np.cumsum([v[m, 0].sum() for _, v in played]) - 1)
        if hasattr(memory, "last"):
            np.testing.assert_array_equal(memory.last[: len(over)], over)
        how += alarmed(held)[over].tolist()
    assert set(how) == {False, True}  # one episode at least reaches its time limit


@each_method
def test_whatever_is_learned_there_is_finite(name):
    run = finetuned(name)
    progress = run.yielded[-1][0]
    learned = [metrics for _, metrics in run.yielded[1:]]
    assert all(x.shape == (M,) for metrics in learned for x in metrics.values()) and finite(learned)
    params = jax.vmap(run.fine.export)(progress.agent)
    assert finite(params) and finite(replay_of(run).data)
    same = tuners.equal(params, jax.vmap(run.fine.export)(run.yielded[0][0].agent))
    assert same == (name in {"sysid", "recurrent"})  # no system is told here, and nothing learned
    for rollout, played in enumerate(run.played):
        np.testing.assert_allclose(run.yielded[rollout - 2][1]["real/return"], played.total_reward[:, 0])


@each_method
def test_evaluated_episodes_are_as_long_as_they_last(name):
    run = finetuned(name)
    rows, valid = jax.tree.map(lambda x: np.asarray(x[:, 0]), (run.evaluated.transitions, run.evaluated.valid))
    lengths = valid.sum(1)
    assert len(np.unique(lengths)) > M // 3
    for m, n in enumerate(lengths):
        over = ends_of(jax.tree.map(lambda x, m=m, n=n: x[m, :n], rows))
        assert valid[m, :n].all() and np.flatnonzero(over).tolist() == [n - 1]
    assert all((x[~valid] == 0).all() for x in jax.tree.leaves(rows))
    earned = np.sum(1 + rows.next_obs[..., 0], axis=1, where=valid)
    np.testing.assert_allclose(run.evaluated.score[:, 0], earned, rtol=1e-5)


@pytest.mark.parametrize("name", ["iql", "rlpd", "sac-online", "sgft-relabel"])
def test_simulated_rows_end_where_their_episodes_do(name):
    held = finetuned(name).simulated.replay
    for p in range(2):
        rows = jax.tree.map(lambda x, p=p: np.asarray(x[p, : int(held.size[p])]), held.data)
        np.testing.assert_array_equal(rows.discount, np.where(alarmed(rows), 0, GAMMA))
        begins = np.flatnonzero(np.append(True, (rows.obs[1:] != rows.next_obs[:-1]).any(axis=1)))
        assert len(begins) == 2 and (rows.obs[begins] == 0).all()  # two episodes have room for the 24 transitions
        ends = np.append(begins[1:], len(rows.reward)) - 1
        assert set(ends[ends - begins < LENGTH - 1]) <= set(np.flatnonzero(alarmed(rows))) <= set(ends)


# --- tasks that do not say how they are rewarded or end ---------------------------------------------------------------

# These ask for the reward and the end of transitions that never were.
IMAGINE = {"sgft-sac", "sgft-relabel", "sgft-mpc", "sgft-parts", "mbpo", "pbrs-branch"}


@pytest.mark.parametrize("missing", ["reward", "terminated"])
@each_method
def test_a_method_does_without_functions_of_observations_or_refuses_in_one_line(name, missing):
    prior = start_of(name)[0][0]
    task = ENV._replace(**{missing: None})

    def learn(key, data):
        fine = METHODS[name].build(tuners.configure(name), prior, task)
        state = fine.prepare(fine.init(prior.params, key), data)
        return fine.learn(state, key, 1, data)[1]

    rows = finetuned(name).simulated
    data = None if rows is None else rows.of(jnp.int32(0))

    def trace():
        return jax.eval_shape(lambda key: learn(key, data), jax.random.key(0))

    if name not in IMAGINE:
        assert all(x.shape == () for x in trace().values())
        return
    with pytest.raises(UserError, match=missing[:8]) as refused:
        trace()
    assert "\n" not in str(refused.value)
