"""The guard: its rule on bandits whose success is known, and what it does to fine-tuning."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tuners
from tuners import METHODS, NET, TASK, T, bits, equal, prior

from envs.types import Transition
from sgft_jax.models import dynamics
from sgft_jax.models.distortion import turned_and_scaled
from sgft_jax.models.networks import make_dynamics
from sgft_jax.models.system import append_system
from sgft_jax.train import guard
from sgft_jax.types import Batch, SimulatedData

RUNS, ROLLOUTS = 4000, 20
OBS = jnp.array([0.3, -0.8])


# --- the rule ---------------------------------------------------------------------------------------------------------


@functools.cache
def bandit(reference, challenger):
    """Success of what is deployed and the share of runs that deploy the challenger, [ROLLOUTS + 1] each.

    challenger: its success after 0, 1, ... rollouts. What becomes the reference keeps the success that it had then.
    """

    def rollout(carry, step):
        state, champion, now = carry
        key, then = step
        success = jax.random.bernoulli(key, jnp.where(state.deployed, now, champion)).astype(jnp.float32)
        state = guard.scored(state, success)
        champion = jnp.where(state.replaced, now, champion)
        state = guard.learned(state)
        return (state, champion, then), (jnp.where(state.deployed, then, champion), state.deployed)

    def run(key):
        start = (guard.start("success"), jnp.float32(reference), jnp.float32(challenger[0]))
        steps = (jax.random.split(key, ROLLOUTS), jnp.array(challenger[1:], jnp.float32))
        return jax.lax.scan(rollout, start, steps)[1]

    success, share = (np.asarray(x).mean(0) for x in jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(0), RUNS)))
    return np.append(reference, success), np.append(0.0, share)


def constant(p):
    return (p,) * (ROLLOUTS + 1)


@pytest.mark.heavy_after_first
@pytest.mark.parametrize(("challenger", "least"), [(constant(0.8), 0.93), (constant(0.5), 0.91), (constant(0.0), 0.9)])
def test_on_a_solved_gap_next_to_nothing_is_lost(challenger, least):
    """The challenger is deployed in a fifth of the runs at most."""
    success, share = bandit(0.97, challenger)
    assert success.min() >= least and share.max() < 0.2


def test_a_challenger_that_collapses_is_given_up():
    """Without the guard it ends at 0.3."""
    success, _ = bandit(0.97, tuple(np.linspace(0.97, 0.3, ROLLOUTS + 1).tolist()))
    assert success.min() >= 0.9


def test_where_the_reference_fails_the_challenger_takes_over():
    """By the third rollout, and for good: what is deployed may also be a copy of it."""
    success, share = bandit(0.05, constant(0.9))
    assert share[1] > 0.9 and success[3:].min() >= 0.88
    _, share = bandit(0.05, constant(0.05))
    assert share[1:].mean() > 0.7  # neither works, so the one that learns goes on


def test_what_was_learned_is_held_when_it_is_lost_again():
    """A challenger that rises from 0.1 to 0.9 and falls to 0.2: a copy of what it was stays deployed."""
    rise, fall = np.linspace(0.1, 0.9, 11), np.full(10, 0.2)
    success, _ = bandit(0.05, tuple(np.concatenate([rise, fall]).tolist()))
    assert success[-1] >= 0.6


def play(state, *scores):
    """After these rollouts, a learning phase behind each."""
    for score in scores:
        state = guard.learned(guard.scored(state, jnp.float32(score)))
    return state


def test_the_rule_by_hand():
    state = play(guard.start("success"), 1, 1)
    assert not state.deployed and guard.means(state) == (1, 1)  # no shortfall, no credit
    state = play(state, 0)  # 3 of 4 with the promise; credit (3/4 + 1) / 2
    assert state.deployed and guard.means(state) == pytest.approx((0.75, 0.875))
    lost = play(state, 0)  # (2 * 0.875 + 0.8 * 0) / 2.8
    assert not lost.deployed and guard.means(lost) == pytest.approx((0.75, 0.625))
    won = play(state, 1)  # (2 * 0.875 + 0.8 * 1) / 2.8
    assert won.deployed and guard.means(won) == pytest.approx((0.75, 2.55 / 2.8))
    # 1 + 0.8 + 0.64 and so on of its rollouts and one failure more: beyond 3/4 after the fifth success
    four = play(won, 1, 1, 1)
    assert four.reference == (3, 4)
    five = guard.scored(four, jnp.float32(1))
    assert five.replaced and not four.replaced and five.reference == five.challenger
    after = guard.learned(five)
    assert not after.deployed and guard.means(after) == (1, 1)  # the copy acts, until it fails


@pytest.mark.parametrize(("successes", "brings_back"), [(6, True), (4, False)])
def test_one_failure_after_many_successes_brings_a_good_reference_back(successes, brings_back):
    """Of 7 and one failure, 0.875; of 5 and one failure, 0.83. The challenger never failed."""
    state = play(guard.start("success"), *[1] * successes, 0)
    state = state._replace(challenger=guard.Evidence(jnp.float32(4), jnp.float32(4)))
    assert state.deployed and bool(play(state, 0).deployed) != brings_back


def test_returns_need_no_scale():
    """Moved and stretched, they lead to the same decisions; a challenger that falls far is given up at once."""
    returns = np.random.default_rng(0).normal(50.0, 5.0, 30)

    def deployed(scores):
        state, found = guard.start("return"), []
        for score in scores:
            state = play(state, score)
            found.append(bool(state.deployed))
        return found

    assert deployed(returns) == deployed(8.0 * returns - 1024.0) and len(set(deployed(returns))) == 2
    state = play(guard.start("return"), 50, 52)
    assert state.deployed  # half way from 51 to 52 is more than 51
    assert not play(state, 20).deployed and play(state, 51).deployed


def trials(scores, rollouts=30):
    """Which rollouts are played by what learns, or a copy of it. scores(whether so, i) -> score, what a part scored."""
    state, copied, flags = guard.start("return"), False, []
    for i in range(rollouts):
        flags.append(copied or bool(state.deployed))
        state = guard.scored(state, *map(jnp.float32, scores(flags[-1], i)))
        copied |= bool(state.replaced)
        state = guard.learned(state)
    return flags, state


def whole(i):
    return -12.0 + 0.1 * (-1) ** i, np.inf


BOOM = (-np.inf, -2.0)  # an explosion after two steps


def test_a_challenger_that_explodes_is_tried_and_given_up():
    """Rewards are costs, so that a part costs less than the whole; the worst score known is close to the others."""
    flags, state = trials(lambda learns, i: BOOM if learns else whole(i))
    assert any(flags) and sum(flags) <= 5 and state.worst > -12.2
    mended, _ = trials(lambda learns, i: (-10, np.inf) if learns and i > 9 else BOOM if learns else whole(i))
    assert sum(mended[10:]) > 10


@pytest.mark.parametrize("part", [-2.0, 3.0])
def test_where_the_reference_explodes_the_challenger_takes_over(part):
    """Also where nothing whole has ever been scored; and for good, if it is whole."""
    flags, state = trials(lambda learns, i: whole(i) if learns else (-np.inf, part), 8)
    assert flags == [False] + [True] * 7 and all(np.isfinite(guard.means(state)))
    flags, _ = trials(lambda learns, i: (-np.inf, part), 8)
    assert flags == [False] + [True] * 7  # neither works, so the one that learns goes on


def test_what_an_explosion_had_earned_is_known_too():
    """Rewards of either sign."""
    state = play(guard.start("return"), 10, 12)
    assert state.deployed
    lost = guard.learned(guard.scored(state, -jnp.inf, jnp.float32(-50)))
    assert lost.worst == -50 and not lost.deployed
    np.testing.assert_allclose(guard.means(lost), (11, 11 + (2 * 0.5 - 0.8 * 61) / 2.8), rtol=1e-6)


# --- around a finetuner -----------------------------------------------------------------------------------------------


def finish(case, state, score, seed=0):
    """A rollout with this score, and what is learned from it."""
    rows = tuners.episode(jax.random.key(seed))
    state = case.fine.observe(state, rows, jnp.ones(T, bool), jnp.float32(score))
    return case.fine.learn(state, jax.random.key(seed), 2)


def action(case, state, obs=OBS):
    return case.fine.act(state, case.fine.init_carry(), obs, jax.random.key(0), explore=jnp.bool_(False))[0]


@pytest.mark.parametrize("name", tuners.slow_but({"sac"}, ["sac", "sgft-mpc"]))
def test_failures_deploy_what_learned_and_a_failure_of_that_brings_the_reference_back(name):
    case, bare = tuners.tuner(name, guard=True), tuners.tuner(name)
    state = case.fine.init(case.params, jax.random.key(0))
    first = case.fine.export(state)
    state, metrics = finish(case, state, 1)
    assert metrics["guard/challenger"] == 0 and equal(case.fine.export(state), first)
    assert not equal(bare.fine.export(state.agent), first)  # it learned
    state, metrics = finish(case, state, 0)
    assert metrics["guard/challenger"] == 1 and metrics["guard/replaced"] == 0
    own = bare.fine.export(state.agent)
    assert equal(case.fine.export(state), own) and not equal(own, first)
    np.testing.assert_allclose(action(case, state), action(bare, state.agent), rtol=1e-4, atol=1e-6)
    back, metrics = finish(case, state, 0)
    assert metrics["guard/challenger"] == 0 and equal(case.fine.export(back), first)
    assert {"guard/expected_reference", "guard/expected_challenger"} <= set(metrics)


@pytest.mark.parametrize("identify", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_challenger_that_proves_itself_becomes_the_reference_as_it_played(identify):
    """Identification changes the policy as soon as the rollout is known, before anything learns."""
    case, bare = (tuners.tuner("sac", identify=identify, **guarded) for guarded in ({"guard": True}, {}))
    state = case.fine.init(case.params, jax.random.key(0))
    for seed in range(2):  # two failures, the second of the challenger
        state, _ = finish(case, state, 0, seed)
    state = state._replace(guard=state.guard._replace(deployed=jnp.bool_(True)))
    for seed in range(2, 9):
        played = bare.fine.export(state.agent)
        state, metrics = finish(case, state, 1, seed)
        if metrics["guard/replaced"]:
            break
    assert equal(state.reference, played) and not equal(bare.fine.export(state.agent), played)


TURN = turned_and_scaled(jnp.float32(0.6), jnp.log(jnp.array([0.7, 0.5])), jnp.array([0.1, 0.0]), jnp.zeros(2))
WIND = jnp.array([0.8])  # the last entry of what `sysid` observes; no real system tells it


def wander(obs, key):
    return jax.random.uniform(key, (2,), minval=-1)


def changed(name, obs, action):
    """The next observation in the simulator, as the prior's models have it."""
    params, first = prior().params, slice(1 if name == "guarded" else None)  # of the ensemble, as the methods ask it
    models = jax.tree.map(lambda x: x[first], params.dynamics)
    return dynamics.predict(make_dynamics(2, 2, NET), models, params.normalizer, obs, action).mean(0)


def steps(name, key, n, choose, *, real):
    """Rows of the simulator, or of a real system where commands are turned (`guarded`) or a wind blows (`sysid`)."""
    key_obs, key_action = jax.random.split(key)
    obs = jax.random.uniform(key_obs, (n, 2), minval=-1)
    if name == "sysid" and real:
        obs = obs.at[:, 1].set(0.0)
    action = jax.vmap(choose)(obs, jax.random.split(key_action, n))
    if not real:
        after = jax.vmap(functools.partial(changed, name))(obs, action)
    elif name == "guarded":
        after = jax.vmap(lambda obs, action: changed(name, obs, TURN.meaning(action)))(obs, action)
    else:
        after = (
            jax.vmap(lambda obs, action: changed(name, append_system(obs, WIND), action))(obs, action).at[:, 1].set(0.0)
        )
    return Transition(obs, action, -jnp.linalg.norm(after, axis=1), jnp.full(n, 0.9), after)


@functools.cache
def identifying(name):
    """Functions of the method behind a guard: init(), export(state), learned(state), act(params, obs) and
    rollout(state, key, score) -> (state, metrics), which plays what is deployed, observes and learns.
    """
    task = TASK if name == "guarded" else TASK._replace(measured_dim=1, sensor_errors=(0.0,))
    room = {"replay_capacity": 64} if name == "guarded" else {"rows": 64}
    fine, bare = (tuners.build(name, task, guard=flag, **room) for flag in (True, False))
    data = SimulatedData(lambda key, n: Batch(*steps(name, key, n, wander, real=False)), jnp.zeros(1))

    def rollout(state, key, score):
        def act(obs, key):
            return fine.act(state, (), obs, key, explore=jnp.bool_(True))[0]

        state = fine.observe(state, steps(name, key, T, act, real=True), jnp.ones(T, bool), score)
        return fine.learn(state, key, 2, data)

    def deployed(params, obs):
        return fine.policy.act(params, (), obs, jax.random.key(0), explore=jnp.bool_(False))[0]

    start = jax.jit(lambda params: fine.prepare(fine.init(params, jax.random.key(0)), data))
    return SimpleNamespace(
        init=functools.partial(start, prior().params),
        export=fine.export,
        learned=lambda state: bare.export(state.agent),
        act=jax.jit(deployed),
        rollout=jax.jit(rollout),
    )


@pytest.mark.parametrize("name", ["guarded", "sysid"])
@pytest.mark.parametrize("right", ["identified", "simulator's"])
def test_the_guard_judges_what_identification_makes_of_the_policy(name, right):
    """Rollouts succeed with the policy that knows the system, or with the simulator's. Either ends up deployed."""
    fine, params = identifying(name), prior().params
    obs = OBS if name == "guarded" else OBS.at[1].set(0.0)
    knowing = params._replace(**({"distortion": TURN} if name == "guarded" else {"system": WIND}))
    ways = np.stack([fine.act(policy, obs) for policy in (params, knowing)])
    assert np.linalg.norm(ways[0] - ways[1]) > 0.2
    state, scores, flags = fine.init(), [], []
    for key in jax.random.split(jax.random.key(1), 4):
        deployed = np.asarray(fine.act(fine.export(state), obs))
        nearest = np.argmin(np.linalg.norm(ways - deployed, axis=1))
        scores.append(float(nearest == (right == "identified")))
        state, metrics = fine.rollout(state, key, jnp.float32(scores[-1]))
        flags.append((int(metrics["guard/challenger"]), int(metrics["guard/replaced"])))
    np.testing.assert_allclose(fine.act(fine.learned(state), obs), ways[1], atol=0.05)
    if right == "identified":
        assert scores == [0, 1, 1, 1] and flags[:3] == [(1, 0), (1, 0), (0, 1)]
    else:
        assert scores == [1] * 4 and flags == [(0, 0)] * 4
        assert equal(fine.export(state), fine.export(fine.init()))


@pytest.mark.heavy
@pytest.mark.parametrize(
    "name",
    tuners.slow_but(
        {"iql"},
        [n for n, m in METHODS.items() if n != "sac" and hasattr(m.config, "guard")],
    ),
)
def test_the_first_reference_is_the_simulators_policy(name):
    """Also where the agent starts from nothing."""
    case, kind = tuners.tuner(name, guard=True), METHODS[name].prior
    state = case.fine.init(case.params, jax.random.key(1))
    played = case.plain.initial_policy or tuners.tuner(name).plain.policy
    params = prior(kind).params
    obs = OBS.at[-1].set(0.0) if METHODS[name].sees_system else OBS  # no real system tells which one it is
    expected, _ = jax.jit(played.act)(params, played.init_carry(), obs, jax.random.key(0), explore=jnp.bool_(False))
    np.testing.assert_allclose(action(case, state, obs), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.heavy
def test_without_a_prior_it_is_the_first_policy():
    plain = METHODS["sac"].build(tuners.configure("sac", guard=True), None, tuners.TASK)
    state = jax.jit(lambda key: plain.init(None, key))(jax.random.key(0))
    assert equal(state.reference.actor, state.agent.learner.actor.params)


@pytest.mark.heavy
def test_learning_offline_decides_nothing():
    case = tuners.tuner("iql", guard=True)
    state = case.fine.init(case.params, jax.random.key(0))
    after, metrics = case.fine.learn(state, jax.random.key(1), 2, offline=True)
    assert bits(after.guard) == bits(state.guard) and not any(name.startswith("guard/") for name in metrics)


def test_a_fresh_state_has_buffers_of_its_own():
    case = tuners.tuner("sac", guard=True)
    state = case.plain.init(case.params, jax.random.key(0))
    buffers = [x.unsafe_buffer_pointer() for x in jax.tree.leaves((state, case.params)) if x.size]
    assert len(buffers) == len(set(buffers))
