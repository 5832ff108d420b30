"""The generic finetuner on a point that moves in a plane: what moves, what is frozen, what a learner gets to see."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tuners
from jax.flatten_util import ravel_pytree
from tuners import METHODS, NET, TASK, T, compiled, equal, prior, started, tuner

from envs.types import Policy, UserError
from sgft_jax import transforms
from sgft_jax.algorithms import make_policy
from sgft_jax.data import sources
from sgft_jax.learners import sac, tdmpc2_model
from sgft_jax.models import dynamics, networks, normalizer
from sgft_jax.train import finetuner
from sgft_jax.train.finetuner import Parts, assemble
from sgft_jax.train.options import LoopOptions
from sgft_jax.transforms import compose, stateless
from sgft_jax.types import Learner, Transform

OBS = jnp.array([0.3, -0.4])


def act(case, state, obs=OBS, explore=False):
    """At the start of an episode."""
    return case.fine.act(state, case.fine.init_carry(), obs, jax.random.key(0), explore=jnp.bool_(explore))[0]


# --- what moves and what stays --------------------------------------------------------------------------------------


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("name", "moves"),
    [
        pytest.param("sac", {"actor", "critic"}, marks=pytest.mark.slow),
        pytest.param("sgft", {"actor", "critic"}, marks=pytest.mark.slow),
        pytest.param("sgft-sac", {"actor", "critic", "models"}, marks=pytest.mark.slow),
        ("frozen-critic", {"actor"}),
        ("sgft-mpc", {"models"}),
    ],
)
def test_what_moves_and_what_is_frozen(name, moves):
    case = tuner(name)
    state = started(case)
    new, metrics = case.fine.learn(state, jax.random.key(1), 2)
    fits = () if name == "sgft-mpc" else ("actor", "critic")
    before, after = ({part: getattr(s.learner, part) for part in fits} | {"models": s.models} for s in (state, new))
    assert {part for part in before if not equal(before[part], after[part])} == moves
    assert equal(state.frozen, new.frozen) and equal(state.replay, new.replay)
    assert equal(new.frozen.value, case.params.value) and equal(new.frozen.normalizer, case.params.normalizer)
    assert "critic" in moves or "critic/loss" not in metrics
    assert all(jnp.isfinite(m) and m.shape == () for m in metrics.values())


# Rows, rows with simulated ones beside them, windows, models alone, a fit
@pytest.mark.heavy
@pytest.mark.parametrize("name", tuners.slow_but({"sac", "sgft-mpc"}, ["sac", "rlpd", "tdmpc2", "sgft-mpc", "sysid"]))
def test_nothing_is_learned_from_an_empty_replay(name):
    """The first rollout has no valid step. What an empty replay gives are zeros."""
    case = tuner(name)
    state = case.fine.init(case.params, jax.random.key(0))
    torn = jax.tree.map(jnp.zeros_like, tuners.episode(jax.random.key(0)))
    state = case.fine.observe(state, torn, jnp.zeros(T, bool), jnp.float32(0))
    new, metrics = case.fine.learn(state, jax.random.key(1), 2)
    assert equal(new, state) and metrics["updates"] == 0 and jnp.isnan(metrics["batch/reward_mean"])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(case.fine.export(new)))


@pytest.mark.slow
def test_what_learns_from_simulated_rows_needs_no_real_ones():
    case = tuner("iql")
    state = case.fine.init(case.params, jax.random.key(0))
    new, metrics = case.fine.learn(state, jax.random.key(1), 2, offline=True)
    assert metrics["updates"] == 2 and not equal(new.learner, state.learner)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tdmpc2", "sgft-tdmpc2"])
def test_what_moves_in_a_planner(name):
    case = tuner(name)
    state = started(case)
    new, _ = case.fine.learn(state, jax.random.key(1), 2)
    parts = tdmpc2_model.NETWORKS
    moved = {part for part in parts if not equal(getattr(state.learner, part), getattr(new.learner, part))}
    assert moved == (set(parts) if name == "tdmpc2" else {"dynamics", "reward", "policy"})
    assert jax.tree.map(jnp.shape, case.fine.export(new).policy) == jax.tree.map(jnp.shape, case.params.policy)


@pytest.mark.slow
def test_the_released_code_learns_a_new_agent_from_shaped_rewards():
    case = tuner("sgft-tdmpc2-code")
    state = started(case)
    assert not equal(state.learner.dynamics.params, case.params.dynamics) and equal(state.frozen, case.params)
    new, metrics = case.fine.learn(state, jax.random.key(1), 2)
    assert equal(new.frozen, case.params) and not equal(new.learner.critic, state.learner.critic)
    plain = tuner("tdmpc2")
    raw = plain.fine.learn(started(plain), jax.random.key(1), 2)[1]["batch/reward_mean"]  # of the same draws
    assert abs(metrics["batch/reward_mean"] - raw) > 1e-3


@pytest.mark.slow
def test_frozen_models_and_a_warm_up_keep_their_bits():
    case = tuner("sgft-sac", train_dynamics=False, critic_warmup=2, reset_critic=True)
    state = started(case)
    assert state.models is None and equal(state.frozen.dynamics, case.params.dynamics)
    warm, _ = case.fine.learn(state, jax.random.key(1), 2)
    assert equal(state.learner.actor, warm.learner.actor) and not equal(state.learner.critic, warm.learner.critic)
    moved, _ = case.fine.learn(warm, jax.random.key(2), 2)
    assert not equal(warm.learner.actor, moved.learner.actor)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "models"), [("sgft-sac", 4), ("sgft-sac", 2), ("sgft-mpc", 2)])
def test_learning_rates_of_the_simulators_networks_rise_from_zero(name, models):
    """Adam's first step has the rate's length, so with a warm-up of 4 it is a quarter; models may have their own."""
    moved = {}
    parts = [(lambda s: s.models, models)] + [(lambda s: s.learner.critic, 4)] * (name == "sgft-sac")
    for warmup in (0, 4):
        own = {"lr_warmup": warmup} if name == "sgft-sac" else {}
        case = tuner(name, dynamics_warmup=models if warmup else 0, **own)
        state = started(case)
        new, _ = case.fine.learn(state, jax.random.key(1), 1)
        flat = [[ravel_pytree(part(s).params)[0] for part, _ in parts] for s in (state, new)]
        moved[warmup] = [after - before for before, after in zip(*flat, strict=True)]
    for at_once, slowly, (_, n) in zip(moved[0], moved[4], parts, strict=True):
        assert jnp.abs(at_once).max() == pytest.approx(3e-4, rel=1e-2)
        np.testing.assert_allclose(slowly, at_once / n, atol=1e-7)


# --- from the prior to the agent ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", tuners.slow_but({"sac", "sgft-sac"}, ["sac", "sgft-sac", "rlpd", "iql", "sgft-mpc", "sgft-tdmpc2-code"])
)
def test_a_fresh_state_has_buffers_of_its_own(name):
    """Whoever gets it may donate it, and the prior survives."""
    case = tuner(name)
    state = case.plain.init(case.params, jax.random.key(0))
    buffers = [x.unsafe_buffer_pointer() for x in jax.tree.leaves((state, case.params)) if x.size]
    assert len(buffers) == len(set(buffers))


@pytest.mark.parametrize(("name", "horizon"), [("sgft", 1), ("sgft", 3), ("sac", None)])
def test_the_first_action_is_the_simulators(name, horizon):
    case = tuner(name, **({} if horizon is None else {"horizon": horizon}))
    z = normalizer.normalize(case.params.normalizer, OBS)
    moments = networks.make_actor(2, 2, NET).apply(case.params.actor, z)
    got = act(case, case.fine.init(case.params, jax.random.key(1)))
    np.testing.assert_allclose(got, jnp.tanh(moments[0]), rtol=1e-4)


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("name", tuners.slow_but({"sac", "iql"}, METHODS))
def test_a_method_says_whether_it_begins_as_the_simulators_policy(name):
    case = tuner(name)
    acts = make_policy(prior(METHODS[name].prior).card, TASK)
    told = OBS.at[-1].set(0.0) if METHODS[name].sees_system else OBS  # it has not found out yet which system this is
    expected, _ = acts.act(case.params, acts.init_carry(), told, jax.random.key(0), explore=False)
    got = act(case, case.fine.init(case.params, jax.random.key(1)))
    assert np.allclose(got, expected, rtol=1e-3, atol=1e-4) == METHODS[name].zero_shot


@pytest.mark.parametrize("name", ["rlpd", "iql"])
def test_a_fresh_agent_takes_the_statistics_alone(name):
    case = tuner(name)
    state = case.fine.init(case.params, jax.random.key(0))
    assert equal(state.learner.normalizer, case.params.normalizer)
    own = state.learner.actor.params
    own = own["mean"] if name == "iql" else own
    assert not equal(own["Dense_0"]["kernel"], case.params.actor["Dense_0"]["kernel"])


NO_PRIOR = [name for name, method in METHODS.items() if not method.needs_prior]


@pytest.mark.heavy
@pytest.mark.parametrize("name", tuners.slow_but({"sac"}, NO_PRIOR))
def test_methods_that_need_no_prior_start_without_one(name, monkeypatch):
    """With networks of their own; made small here."""
    from sgft_jax.train import options

    small = {"hidden": [8], "layer_norm": False, "actor_layer_norm": False, "activation": "relu"}
    monkeypatch.setitem(options._WITHOUT_PRIOR, "network", small)
    monkeypatch.setitem(tdmpc2_model.SIZES, "5M", tdmpc2_model.SIZES["tiny"])
    plain = METHODS[name].build(tuners.configure(name), None, TASK)
    assert plain.simulation is None and plain.initial_policy is None
    state = plain.observe(
        plain.init(None, jax.random.key(0)), tuners.episode(jax.random.key(1)), jnp.ones(T, bool), jnp.float32(0)
    )
    new, metrics = jax.jit(lambda state: plain.learn(state, jax.random.key(2), 2))(state)
    assert all(jnp.isfinite(x) for x in metrics.values()) and not equal(state.learner, new.learner)


# --- what a learner gets to see -------------------------------------------------------------------------------------


@pytest.fixture
def seen(monkeypatch):
    """The last configuration of SAC and the last batch that its update was given."""
    prior()  # made before: it is of another agent
    found, make = {}, sac.make_sac

    def spy(config, hyper=None):
        learner = make(config, hyper)
        found["config"] = config
        return learner._replace(update=lambda s, b, k: (found.update(batch=b), learner.update(s, b, k))[1])

    monkeypatch.setattr(sac, "make_sac", spy)
    return found


def test_horizon_one_learner_sees_the_papers_batch(seen):
    """256 real rows become 1536, nothing bootstraps, and the actor reads the 256."""
    plain = tuners.build("sgft-sac", horizon=1, branches=5, batch_size=256)
    state = plain.init(prior().params, jax.random.key(0))
    jax.eval_shape(lambda state: plain.learn(state, jax.random.key(0), 1, None), state)
    assert seen["batch"].obs.shape == (1536, 2) and seen["config"].actor_batch == 256
    assert seen["batch"].context is None and seen["config"].context_dim == 0


def test_longer_horizons_tell_the_steps_to_go(seen):
    plain = tuners.build("sgft-sac", horizon=3)
    state = plain.init(prior().params, jax.random.key(0))
    jax.eval_shape(lambda state: plain.learn(state, jax.random.key(0), 1, None), state)
    rows = 8 * (1 + 2 * 3)
    assert seen["batch"].context.shape == (rows, 3) == seen["batch"].next_context.shape
    assert seen["config"].context_dim == 3


@pytest.mark.heavy_after_first
@pytest.mark.parametrize(
    ("name", "others", "parts"),
    [
        pytest.param("mbpo", {}, {"shape": False, "shorten": False}, marks=pytest.mark.slow),
        ("sgft-sac", {"clip_shaped": None}, {"shape": True, "shorten": True}),
        pytest.param(
            "sgft-sac",
            {"clip_shaped": None, "reset_critic": True, "horizon": 1},
            {"shape": True, "shorten": True},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "pbrs-branch",
            {"clip_shaped": None, "reset_critic": False},
            {"shape": True, "shorten": False},
            marks=pytest.mark.slow,
        ),
        ("pbrs-branch", {"clip_shaped": None, "reset_critic": True}, {"shape": True, "shorten": False}),
    ],
)
def test_parts_that_are_a_method_begin_as_it_does_and_see_its_batch(name, others, parts, monkeypatch):
    """The same structure, numbers and networks to begin with, and the same rows, rewards, discounts and contexts."""
    prior()  # made before: it is of another agent
    make, configs, seen = sac.make_sac, [], []

    def idle(config, hyper=None):
        def keep(state, batch, key):
            configs.append(config)
            jax.debug.callback(lambda *given: seen.append(given), state, batch)
            return state, {}

        return make(config, hyper)._replace(update=keep)

    def one_key(*transforms):  # a clip without a bound would shift the keys of the others
        def apply(imagination, rows, key):
            for transform in transforms:
                rows = transform.apply((), imagination, rows, key)
            return rows

        return stateless(apply)

    monkeypatch.setattr(sac, "make_sac", idle)
    monkeypatch.setattr(finetuner, "compose", one_key)
    shared = {key: value for key, value in others.items() if key != "clip_shaped"}
    for method, options in ((name, others), ("sgft-parts", shared | parts)):
        plain = tuners.build(method, train_dynamics=False, **options)
        state = plain.init(prior().params, jax.random.key(0))
        state = plain.observe(state, tuners.episode(jax.random.key(1)), jnp.ones(T, bool), jnp.float32(0))
        jax.jit(lambda state, plain=plain: plain.learn(state, jax.random.key(1), 1, None)[0])(state)
        jax.effects_barrier()
    (learner, batch), (own_learner, own_batch) = seen
    assert len(set(configs)) == 1 and equal(learner, own_learner)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6), batch, own_batch)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("name", "bound"), [("sgft", 0.01), ("sgft", None), pytest.param("pbrs", 0.01, marks=pytest.mark.slow)]
)
def test_shaped_rewards_are_bounded_where_asked(name, bound):
    case = tuner(name, clip_shaped=bound)
    _, metrics = case.fine.learn(started(case), jax.random.key(1), 2)
    assert (metrics["batch/reward_std"] <= 0.011) == (bound is not None)


@pytest.mark.slow
def test_the_simulators_transitions_as_the_models_have_them(seen):
    """After the real rows come as many relabelled ones; branches begin at both, and the actor learns from both."""
    plain = tuners.build("sgft-relabel", clip_shaped=None, train_dynamics=False)
    data = tuners.simulated().of(0)
    far = data._replace(draw=lambda key, n: (rows := data.draw(key, n))._replace(obs=rows.obs + 5.0))
    state = plain.init(prior().params, jax.random.key(0))
    state = plain.observe(state, tuners.episode(jax.random.key(1)), jnp.ones(T, bool), jnp.float32(0))
    with jax.disable_jit():
        plain.learn(state, jax.random.key(1), 1, far)
    batch, n, horizon = seen["batch"], 8, 2
    assert seen["config"].actor_batch == 2 * n and batch.reward.shape == (2 * n * (1 + 2 * horizon),)
    starts = np.asarray(batch.obs)
    assert (starts[:n] < 1.1).all() and (starts[n : 2 * n] > 3.9).all()
    assert batch.is_sim[: 2 * n].tolist() == [False] * n + [True] * n
    first = starts[2 * n :].reshape(2 * n, 2, horizon, 2)[:, :, 0]
    np.testing.assert_allclose(first, np.repeat(starts[: 2 * n, None], 2, axis=1))
    assert jnp.abs(batch.reward).max() < 50  # of the models and the task, not the 100 of the simulator
    model, params = networks.make_dynamics(2, 2, NET), prior().params
    each = jax.vmap(lambda o, a: dynamics.predict(model, params.dynamics, params.normalizer, o, a))
    predicted = each(batch.obs[n : 2 * n], batch.action[n : 2 * n])
    gap = np.abs(np.asarray(predicted) - np.asarray(batch.next_obs[n : 2 * n, None])).max(-1).min(1)
    assert gap.max() < 1e-4  # what one of the members says


@pytest.mark.heavy
def test_imagined_steps_follow_every_model(monkeypatch):
    """An update draws one. The second of two moves a point by 1,000, so the mean reward tells which it was."""
    params, make = prior().params, sac.make_sac

    def still(*options):
        return make(*options)._replace(update=lambda state, batch, key: (state, {}))

    monkeypatch.setattr(sac, "make_sac", still)  # nothing that takes long to compile
    plain = tuners.build("mbpo", horizon=1, train_dynamics=False)
    far = jax.tree.map(jnp.copy, params.dynamics)
    far["Dense_1"]["bias"] = far["Dense_1"]["bias"].at[1].add(1000.0)
    state = plain.init(params._replace(dynamics=far), jax.random.key(0))
    state = plain.observe(state, tuners.episode(jax.random.key(1)), jnp.ones(T, bool), jnp.float32(0))
    learn = jax.jit(jax.vmap(lambda key: plain.learn(state, key, 1)[1]["batch/reward_mean"]))
    went_far = np.asarray(learn(jax.random.split(jax.random.key(2), 20)) < -100)
    assert 0.2 < went_far.mean() < 0.8


@pytest.mark.slow
def test_models_learn_from_real_rows_alone():
    """The simulated rows of sgft-relabel, however odd, do not move the models."""
    case, data = tuner("sgft-relabel"), tuners.simulated().of(0)
    odd = data._replace(draw=lambda key, n: (rows := data.draw(key, n))._replace(next_obs=rows.next_obs + 9.0))
    state = started(case)
    fits = [jax.jit(lambda s, d=d: case.plain.learn(s, jax.random.key(1), 1, d)[0].models)(state) for d in (data, odd)]
    assert equal(*fits) and not equal(fits[0], state.models)


@pytest.mark.heavy
def test_the_share_of_simulated_rows_falls_with_the_updates():
    case = tuner("sac-online", simulated_share=0.5, simulated_share_end=0.0, simulated_anneal=4)
    _, metrics = case.fine.learn(started(case), jax.random.key(1), 8)
    # of 8 rows 4, 3, 2, 1, 0, ... are simulated: 10 of 64, and the real rewards are about -0.8
    assert metrics["batch/reward_mean"] == pytest.approx(100 * 10 / 64 - 0.8 * 54 / 64, abs=0.3)


@pytest.mark.heavy
def test_offline_means_simulated_rows_alone():
    case = tuner("iql")
    state = case.fine.init(case.params, jax.random.key(0))  # nothing real yet
    _, metrics = case.fine.learn(state, jax.random.key(1), 2, offline=True)
    assert metrics["batch/reward_mean"] == 100
    with pytest.raises(UserError, match="learns from transitions of the simulator"):
        case.plain.learn(state, jax.random.key(1), 1, None)


# --- a method of one's own ------------------------------------------------------------------------------------------


def counting(transform):
    """Fine-tuning with a transform, whose learner counts its updates."""

    learner = Learner(
        init=lambda key: jnp.float32(0),
        init_carry=lambda: (),
        act=lambda state, carry, obs, key, *, explore: (jnp.zeros(2), carry),
        update=lambda state, batch, key: (state + 1.0, {}),
    )
    parts = Parts(
        learner=learner,
        start=lambda params, key: (learner.init(key), None),
        act=learner.act,
        export=lambda state: state.learner,
        policy=Policy(learner.init_carry, learner.act, lambda params, obs: params),
        source=lambda state: sources.real_rows(4),
        transform=transform,
    )
    return assemble(parts, LoopOptions(utd=0.25, initial_rollouts=1, replay_capacity=40), TASK)


def test_a_transform_that_learns_keeps_its_state():
    """It counts the updates that it saw, before each batch; the batches carry its count."""
    count = Transform(
        init=lambda params, key: jnp.float32(0),
        apply=lambda state, imagination, batch, key: batch._replace(reward=jnp.full_like(batch.reward, state)),
        update=lambda state, batch, key: (state + 1.0, {"transform/seen": state}),
    )
    case = compiled(counting(compose(stateless(lambda imagination, batch, key: batch), count)), None)
    state = started(case)
    for calls, mean in ((1, 2.0), (2, 5.0)):  # updates 1 to 3, then 4 to 6
        state, metrics = case.fine.learn(state, jax.random.key(calls), 3)
        assert state.transform == ((), 3.0 * calls) and metrics["batch/reward_mean"] == mean
        assert metrics["transform/seen"] == mean - 1.0


def test_updates_stop_at_their_limit():
    """With the keys of the first ones; metrics are means over those that were made."""
    add = Transform(
        init=lambda params, key: jnp.float32(0),
        apply=lambda state, imagination, batch, key: batch,
        update=lambda state, batch, key: (state + jax.random.uniform(key), {"transform/seen": state}),
    )
    plain = counting(compose(add))
    learn, state = jax.jit(plain.learn, static_argnums=2), started(compiled(plain, None))
    for limit in (0, 2, 3):
        new, metrics = learn(state, jax.random.key(1), 3, limit=jnp.int32(limit))
        same, means = learn(state, jax.random.key(1), 3)
        assert metrics["updates"] == limit and equal(new.replay, state.replay)
        assert (float(new.transform[0]) == float(same.transform[0])) == (limit == 3)
    np.testing.assert_allclose(metrics["transform/seen"], means["transform/seen"], rtol=1e-6)
    two, metrics = learn(state, jax.random.key(1), 3, limit=jnp.int32(2))
    one, _ = learn(state, jax.random.key(1), 3, limit=jnp.int32(1))
    np.testing.assert_allclose(metrics["transform/seen"], one.transform[0] / 2, rtol=1e-6)
    assert 0 < two.transform[0] < same.transform[0]


def test_transforms_learn_from_the_batch_as_it_was_sampled():
    look = Transform(
        init=lambda params, key: (),
        apply=lambda state, imagination, batch, key: batch._replace(reward=batch.reward + 50.0),
        update=lambda state, batch, key: (state, {"transform/reward": jnp.mean(batch.reward)}),
    )
    case = compiled(counting(compose(look, look)), None)
    _, metrics = case.fine.learn(started(case), jax.random.key(0), 3)
    assert metrics["transform/reward"] < 1 < 99 < metrics["batch/reward_mean"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sgft-relabel", "guarded"])
def test_the_ratio_weighs_what_the_critic_learns(name, monkeypatch):
    """Other weights give another critic, and the same models and discriminators; these learn too."""
    ends = []
    for w in (1.0, 0.25):
        monkeypatch.setattr(transforms.ratio, "weight", lambda log_w, w=w: jnp.full_like(log_w, w))
        case = compiled(tuners.build(name, ratio=True, **{"guard": False} if name == "guarded" else {}), prior().params)
        ends.append(case.fine.learn(started(case), jax.random.key(1), 1)[0])
    one, other = ends
    assert not equal(one.learner.critic, other.learner.critic)
    assert equal((one.models, one.transform), (other.models, other.transform))
    assert not equal(one.transform, case.fine.init(prior().params, jax.random.key(0)).transform)


def test_means_of_a_batch_leave_invalid_rows_out():
    def tear(imagination, batch, key):
        return batch._replace(valid=jnp.arange(4) < 2, reward=jnp.array([1.0, 3.0, 1e9, 1e9]))

    case = compiled(counting(compose(stateless(tear))), None)
    _, metrics = case.fine.learn(started(case), jax.random.key(0), 1)
    assert metrics["batch/reward_mean"] == 2.0 and metrics["batch/reward_std"] == 1.0


@pytest.mark.parametrize("missing", ["reward", "terminated"])
def test_methods_that_imagine_need_functions_of_the_task(missing):
    task = TASK._replace(**{missing: None})
    plain = METHODS["mbpo"].build(tuners.configure("mbpo"), prior(), task)
    with pytest.raises(UserError, match=f"need a task with `{missing}` as a function"):
        plain.learn(plain.init(prior().params, jax.random.key(0)), jax.random.key(0), 1, None)
    METHODS["sac"].build(tuners.configure("sac"), prior(), task)
    with pytest.raises(UserError, match="plans need a task"):
        METHODS["sgft-mpc"].build(tuners.configure("sgft-mpc"), prior(), task)
