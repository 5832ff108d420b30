"""The planner on scores whose best sequence is known; plans by the models of a SAC prior: what they find in worlds that
are known exactly, and what learns.
"""

import functools
from types import SimpleNamespace
from typing import cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import untrained

from envs.types import Transition, UserError
from sgft_jax import planning
from sgft_jax.files.disk import jsonable
from sgft_jax.learners import sac
from sgft_jax.methods import sgft_mpc
from sgft_jax.models import networks
from sgft_jax.types import Normalizer, Prior, Task

CONFIG, HYPER = planning.MPPIConfig(samples=256, elites=32, iterations=10), planning.MPPIHyper()
TARGET = jnp.array([[0.6, -0.4], [-0.7, 0.2], [0.1, 0.9]])  # [H, act_dim]
NONE = jnp.zeros((0, 3, 2))


def quadratic(sequence):
    return -4 * jnp.sum((sequence - TARGET) ** 2)


def run(score, *, config=CONFIG, hyper=HYPER, proposals=NONE, previous=None, explore=False):
    """key -> (action, mean), jitted."""
    previous = jnp.zeros(proposals.shape[1:]) if previous is None else previous
    return jax.jit(lambda key: planning.plan(config, hyper, score, proposals, previous, key, explore=explore))


PLAN = run(quadratic)


@pytest.mark.heavy
def test_finds_the_optimum_of_a_quadratic(key):
    action, mean = PLAN(key)
    np.testing.assert_allclose(mean, TARGET, atol=0.06)
    np.testing.assert_allclose(action, TARGET[0], atol=0.2)  # one elite: spread 0.05


def test_actions_stay_in_the_box(key):
    best = jnp.full((3, 2), 1.5)
    action, mean = run(lambda s: -4 * jnp.sum((s - best) ** 2), explore=True)(key)
    np.testing.assert_allclose(mean, 1.0, atol=0.02)
    assert jnp.all(action <= 1.0)


def test_warm_start_is_the_last_plan_one_step_later(key):
    tight = planning.MPPIHyper(std_min=1e-6, std_max=1e-6)  # samples are the mean of the first iteration
    _, mean = run(quadratic, hyper=tight, previous=TARGET)(key)
    np.testing.assert_allclose(mean, jnp.array([[-0.7, 0.2], [0.1, 0.9], [0.0, 0.0]]), atol=1e-4)


# Two proposals alone are any good. With temperature 0.5 the second weighs exp(0.5 * -2 log 3) = 1/3 of the first, that
# is 1/4 of all: mean 0.1 (3/4 - 1/4) = 0.05, variance 0.01 - 0.05^2 = 0.0075.
PAIR = jnp.array([[[0.1]], [[-0.1]]])


def pair_score(sequence):
    a = sequence[0, 0]
    return jnp.where(a == 0.1, 3.0, jnp.where(a == -0.1, 3.0 - 2 * jnp.log(3.0), -1e6))


@pytest.mark.heavy
@pytest.mark.parametrize("explore", [False, True])
def test_weights_choice_and_noise_by_hand(key, explore):
    two = planning.MPPIConfig(samples=8, elites=2, iterations=2)
    plan = run(pair_score, config=two, proposals=PAIR, explore=explore)
    actions, means = jax.vmap(plan)(jax.random.split(key, 4000))
    np.testing.assert_allclose(means, 0.05, rtol=1e-5)
    assert actions.mean() == pytest.approx(0.05, abs=0.006)
    # exploring adds noise of the elites' own spread to the elite drawn
    assert actions.std() == pytest.approx((0.015 if explore else 0.0075) ** 0.5, rel=0.05)
    assert explore or set(actions.flatten().tolist()) == {float(np.float32(0.1)), float(np.float32(-0.1))}


@pytest.mark.heavy
def test_noise_is_that_of_the_first_step_of_a_plan(key):
    """The elites agree on the first step, so its spread is the floor, 0.05; they differ by 2 in the second one."""
    apart = jnp.array([[[0.1], [-1.0]], [[0.1], [1.0]]])

    def score(sequence):
        return jnp.where((sequence[0, 0] == 0.1) & (jnp.abs(sequence[1, 0]) == 1.0), 0.0, -1e6)

    plan = run(score, config=planning.MPPIConfig(samples=8, elites=2, iterations=2), proposals=apart, explore=True)
    actions = jax.vmap(plan)(jax.random.split(key, 1000))[0]
    assert actions.std() == pytest.approx(0.05, rel=0.1)


def test_spread_has_a_floor(key):
    one = planning.MPPIConfig(samples=8, elites=1, iterations=2)
    plan = run(pair_score, config=one, proposals=PAIR, explore=True)
    actions = jax.vmap(plan)(jax.random.split(key, 4000))[0]
    assert actions.mean() == pytest.approx(0.1, abs=0.005) and actions.std() == pytest.approx(0.05, rel=0.05)


@jax.jit
def split_score(keys, bad, other):
    """Plans where the score is `bad` for half of the first actions."""
    return jax.vmap(run(lambda s: jnp.where(s[0, 0] > 0, bad, other)))(keys)


@pytest.mark.heavy
@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf, -jnp.inf])
@pytest.mark.parametrize("other", [-100.0, -1.0, 1.0])
def test_scores_that_are_not_finite_rank_last(key, bad, other):
    """Also where all true scores are negative, so that 0 would be the best of them."""
    actions, means = split_score(jax.random.split(key, 20), bad, other)
    assert (actions[:, 0] <= 0).all() and (means[:, 0, 0] < 0).all()


def test_no_score_at_all_gives_a_finite_plan(key):
    action, mean = run(lambda s: jnp.nan * s[0, 0], proposals=TARGET[None], explore=True)(key)
    assert jnp.isfinite(action).all() and jnp.isfinite(mean).all() and (jnp.abs(action) <= 1).all()


def test_a_good_proposal_is_taken(key):
    def needle(s):
        return 50 * jnp.all(s == TARGET) - jnp.sum(s**2)

    action, mean = run(needle, proposals=TARGET[None])(key)
    np.testing.assert_allclose(action, TARGET[0])
    np.testing.assert_allclose(mean, TARGET, atol=1e-4)


@pytest.mark.heavy
def test_vmap_equals_a_loop_and_keys_decide(key):
    keys = jax.random.split(key, 2)
    both = jax.vmap(PLAN)(keys)
    for i in range(2):
        chex.assert_trees_all_close(jax.tree.map(lambda x, i=i: x[i], both), PLAN(keys[i]), atol=1e-5)
    assert jnp.array_equal(PLAN(key)[0], PLAN(key)[0]) and not jnp.array_equal(both[0][0], both[0][1])
    with jax.debug_key_reuse(True):
        run(quadratic, explore=True)(jax.random.key(3))


def test_hyperparameters_vmap(key):
    greed = jnp.array([1e-6, 100.0])

    def plan(t):
        return planning.plan(CONFIG, HYPER._replace(temperature=t), quadratic, NONE, TARGET, key, explore=False)

    error = jnp.abs(jax.jit(jax.vmap(plan))(greed)[1] - TARGET[None]).max((1, 2))
    assert error[0] != error[1]


def test_impossible_options_are_refused(key):
    for options, match in (
        ({"samples": 4, "elites": 5}, "elites is 5"),
        ({"elites": 0}, "elites is 0"),
        ({"iterations": 0}, "iterations"),
    ):
        with pytest.raises(UserError, match=match):
            planning.MPPIConfig(**options)
    with pytest.raises(UserError, match="256 proposals"):
        run(quadratic, proposals=jnp.zeros((256, 3, 2)))(key)


# --- with the models of a prior of SAC -------------------------------------------------------------------------------

NET = networks.NetworkConfig(hidden=(8,))
STILL = Normalizer(jnp.zeros(1), jnp.ones(1))


def nothing(obs, action, after):
    return 0.0 * after[0]


def never(obs, action, after):
    return jnp.bool_(False)


@pytest.fixture
def plan(monkeypatch):
    """plan(value, gains, ...) -> the planned action at `obs` in a world s' = s + gain * action, one gain per model.

    The policy's proposals are all at 0 but for the noise on them.
    """

    def found(value, gains=(1.0,), *, obs=0.0, horizon=1, reward=nothing, terminated=never, noise=0.0, gamma=1.0):
        model = networks.Network(lambda key: None, lambda gains, obs, action: gains[:, None] * action[None])
        still = networks.Network(lambda key: None, lambda params, obs: jnp.array([[0.0], [-20.0]]))
        monkeypatch.setattr(networks, "make_dynamics", lambda *_: model)
        monkeypatch.setattr(
            planning.value, "make_v_sim", lambda *_: networks.Network(lambda key: None, lambda _, s, __: value(s[0]))
        )
        monkeypatch.setattr(networks, "make_actor", lambda *_: still)
        config = planning.MPCConfig(1, 1, NET, horizon=horizon, noise=noise, gamma=gamma)
        act = planning.make_act(config, reward=reward, terminated=terminated)
        params = sac.SACParams(None, None, None, jnp.array(gains), STILL)
        keys = jax.random.split(jax.random.key(0), 20)

        def one(key):
            return act(params, planning.init_carry(config), jnp.array([obs]), key, explore=False)[0][0]

        return jax.jit(jax.vmap(one))(keys)

    return found


@pytest.mark.heavy
def test_a_plan_goes_where_value_is_highest(plan):
    np.testing.assert_allclose(plan(lambda s: -10 * (s - 0.6) ** 2), 0.6, atol=0.1)
    np.testing.assert_allclose(plan(lambda s: -10 * (s - 7.0) ** 2), 1.0, atol=0.05)  # as far as the action goes


@pytest.mark.heavy
def test_models_that_disagree_are_averaged(plan):
    """Gains g = 0.5 and 1.5: the mean of (g a - 0.6)^2 is least at 0.6 mean(g) / mean(g^2) = 0.48."""
    np.testing.assert_allclose(plan(lambda s: -40 * (s - 0.6) ** 2, (0.5, 1.5)), 0.48, atol=0.08)


@pytest.mark.heavy
def test_rewards_on_the_way_count(plan):
    np.testing.assert_allclose(
        plan(lambda s: 0.0 * s, reward=lambda obs, action, after: -10 * (after[0] + 0.4) ** 2), -0.4, atol=0.1
    )


@pytest.mark.heavy
def test_a_longer_plan_crosses_a_valley(plan):
    """Value falls before it rises: one step stays, two go through, to either side."""

    def value(s):
        return jnp.where(jnp.abs(s) > 1.5, 1.0, -(s**2))

    assert (jnp.abs(plan(value, horizon=1)) < 0.2).all()
    assert (jnp.abs(plan(value, horizon=2)) > 0.5).all()


@pytest.mark.heavy
def test_nothing_comes_after_a_termination(plan):
    """The highest value lies where the episode ends, and so counts for nothing."""

    def ends(obs, action, after):
        return after[0] > 0.5

    def goal(s):
        return 1.0 + s

    assert (plan(goal) > 0.9).all()
    held = plan(goal, terminated=ends)
    assert (held <= 0.5).all() and (held > 0.3).all()


@pytest.mark.heavy
def test_what_comes_later_is_discounted(plan):
    """0.5 for staying or 1 for going, one step later: worth less at gamma 0.4."""

    def pays(obs, action, after):
        return jnp.where(jnp.abs(after[0]) < 0.1, 0.5, 0.0)

    def value(s):
        return jnp.where(s > 0.5, 1.0, 0.0)

    assert (plan(value, reward=pays, gamma=0.9) > 0.5).all()
    assert (jnp.abs(plan(value, reward=pays, gamma=0.4)) < 0.1).all()


@pytest.mark.heavy
def test_proposals_follow_every_model(monkeypatch):
    """The policy goes up to where it believes to be and one step on; each plan's proposals follow one model.

    Policy and models read (s - 0.5) / 2, and a model's change counts in units of 2.
    """
    model = networks.Network(lambda key: None, lambda gains, obs, action: gains[:, None] * action[None])
    up = networks.Network(lambda key: None, lambda params, obs: jnp.array([[0.2 + obs[0]], [-20.0]]))
    monkeypatch.setattr(networks, "make_dynamics", lambda *_: model)
    monkeypatch.setattr(networks, "make_actor", lambda *_: up)
    monkeypatch.setattr(planning, "plan", lambda config, hyper, rate, proposals, *_, explore: proposals)
    act = planning.make_act(planning.MPCConfig(1, 1, NET, horizon=2, noise=0.0), reward=nothing, terminated=never)
    gains = jnp.array([0.0, 1.0, 2.0])
    params = sac.SACParams(None, None, None, gains, Normalizer(jnp.array([0.5]), jnp.array([2.0])))
    keys = jax.random.split(jax.random.key(0), 20)
    proposed = jax.vmap(lambda key: act(params, None, jnp.zeros(1), key, explore=False))(keys)[..., 0]
    first = np.tanh(0.2 - 0.25)
    np.testing.assert_allclose(proposed[:, :, 0], first, rtol=1e-5)
    np.testing.assert_allclose(proposed[:, :, 1], np.tile(proposed[:, :1, 1], (1, proposed.shape[1])), rtol=1e-5)
    np.testing.assert_allclose(
        np.unique(np.round(proposed[:, 0, 1], 4)), np.sort(np.tanh(-0.05 + gains * first)), atol=1e-4
    )


@pytest.mark.parametrize("options", [{"horizon": 0}, {"samples": 7}])
def test_plans_that_cannot_be(options):
    with pytest.raises(UserError, match=f"option {next(iter(options))} is"):
        planning.MPCConfig(1, 1, NET, **options)


# --- fine-tuning ------------------------------------------------------------------------------------------------------


@functools.cache
def tuner():
    task = SimpleNamespace(
        obs_dim=1, act_dim=1, episode_length=64, reward=lambda obs, action, after: -jnp.abs(after[0]), terminated=never
    )
    config = sgft_mpc.Config(plan_samples=24, batch_size=32, replay_capacity=64, lr_dynamics=1e-2)
    made = sgft_mpc.build(config, Prior(prior(), {"network": jsonable(NET), "gamma": 0.9}), cast(Task, task))
    compiled = {name: jax.jit(getattr(made, name)) for name in ("observe", "act")}
    init = jax.jit(lambda params, key: made.init(params, key))
    return made._replace(init=init, learn=jax.jit(made.learn, static_argnums=2), **compiled)


@functools.cache
def prior():
    config = sac.SACConfig(1, 1, network=NET, ensemble_size=3)
    return jax.jit(lambda key: untrained.sac_params(config, key))(jax.random.key(7))


def rows(n=64):
    """A real system in which actions work backwards."""
    obs, action = jax.random.uniform(jax.random.key(1), (2, n, 1), minval=-1)
    after = obs - 0.5 * action
    return Transition(obs, action, -jnp.abs(after[:, 0]), jnp.full(n, 0.9), after)


@pytest.mark.heavy
def test_the_models_learn_and_all_else_stays():
    state = tuner().observe(tuner().init(prior(), jax.random.key(0)), rows(), jnp.arange(64) != 5, 0.0)
    assert state.replay.size == 63
    new, metrics = tuner().learn(state, jax.random.key(2), 300)
    before, after = prior(), tuner().export(new)

    def same(a, b):
        return jax.tree.map(np.testing.assert_array_equal, a, b)

    same(before._replace(dynamics=None), after._replace(dynamics=None))
    assert metrics["dynamics/mse"].shape == ()
    assert tuner().learn(new, jax.random.key(3), 1)[1]["dynamics/mse"] < metrics["dynamics/mse"]
    model = networks.make_dynamics(1, 1, NET)
    predicted = planning.dynamics.predict(model, after.dynamics, after.normalizer, jnp.array([0.2]), jnp.array([0.8]))
    np.testing.assert_allclose(predicted, -0.2, atol=0.05)  # every member


@pytest.mark.heavy
def test_real_actions_are_spread_and_the_best_one_is_not():
    """By 0.4, which the bounds of actions cut a little, beside the 0.05 of the search."""
    state, obs = tuner().init(prior(), jax.random.key(0)), jnp.array([0.3])
    act = jax.vmap(
        lambda key, explore: tuner().act(state, tuner().init_carry(), obs, key, explore=explore)[0], (0, None)
    )
    best, spread = (act(jax.random.split(jax.random.key(5), 200), explore) for explore in (False, True))
    assert best.std() < 0.2 and 0.25 < (spread - best).std() < 0.5 and jnp.abs(spread).max() <= 1
