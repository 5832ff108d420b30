"""SAC: temperature, ensembles of critics, what moves, what starts from a prior. See also test_contract_learners.py."""

import dataclasses
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import UserError
from sgft_jax.learners import sac
from sgft_jax.models import networks, normalizer
from sgft_jax.types import Batch

# Compiling is most of what takes time here: one program for each configuration, numbers are in the state.
INIT = jax.jit(sac.init, static_argnums=0)
UPDATE = jax.jit(sac.update, static_argnums=0, static_argnames="critic_term")
NET = networks.NetworkConfig(hidden=(8,))
PLAIN = sac.SACConfig(1, 1, network=NET, train_dynamics=False)
# alpha 1e-4: entropy changes the answers below by less than their tolerance
HYPER = sac.SACHyper(lr_actor=3e-3, lr_critic=1e-2, tau=0.1, alpha=1e-4)
ROWS = 128


def probe(key, *, obs=None, reward=None, discount=None):
    """One row per state and random action; reward is a function of (obs, action)."""
    key_obs, key_action = jax.random.split(key)
    obs = jnp.zeros(ROWS) if obs is None else jax.random.choice(key_obs, jnp.asarray(obs), (ROWS,))
    action = jax.random.uniform(key_action, (ROWS,), minval=-1)
    return Batch(
        obs=obs[:, None],
        action=action[:, None],
        reward=jnp.ones(ROWS) if reward is None else reward(obs, action),
        discount=jnp.zeros(ROWS) if discount is None else discount(obs),
        next_obs=obs[:, None],
    )


# --- temperature ----------------------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_temperature_finds_the_target_entropy(key):
    state = INIT(PLAIN, key, HYPER._replace(alpha=1.0, lr_alpha=1e-2, entropy_per_dim=-0.5))
    batch = probe(key, reward=lambda s, a: -((a - 0.2) ** 2))
    update = partial(sac.update, PLAIN)
    scan = jax.jit(lambda s, k: jax.lax.scan(lambda s, k: update(s, batch, k), s, jax.random.split(k, 3000)))
    _, metrics = scan(state, key)
    assert metrics["actor/entropy"][-1000:].mean() == pytest.approx(-0.5, abs=0.15)
    assert 0 < metrics["actor/alpha"][-1] < 0.2


@pytest.mark.heavy
def test_log_alpha_stops_at_minus_ten(key):
    state = INIT(PLAIN, key, HYPER._replace(alpha=0.0, lr_alpha=1.0, entropy_per_dim=-50.0))
    assert state.log_alpha.params == -10.0
    assert UPDATE(PLAIN, state, probe(key), key)[0].log_alpha.params == -10.0


# --- contract -------------------------------------------------------------------------------------------------------

FULL = sac.SACConfig(1, 1, network=networks.NetworkConfig((8,)), ensemble_size=3)
FULL_LEARNER = sac.make_sac(FULL)
FULL_LEARNER = FULL_LEARNER._replace(
    init=jax.jit(FULL_LEARNER.init),
    act=jax.jit(FULL_LEARNER.act, static_argnames="explore"),
    update=jax.jit(FULL_LEARNER.update),
)


def equal(a, b):
    return all(jnp.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.mark.heavy
def test_every_network_of_pretraining_moves_and_statistics_do_not(key):
    state = FULL_LEARNER.init(key)
    new, metrics = FULL_LEARNER.update(state, probe(key), key)
    for name in ("actor", "critic", "dynamics", "log_alpha"):
        assert not equal(getattr(state, name).params, getattr(new, name).params), name
    assert equal(state.normalizer, new.normalizer) and equal(state.hyper, new.hyper) and new.step == 1
    assert {"critic/loss", "actor/loss", "dynamics/mse", "actor/alpha"} <= set(metrics)


@pytest.mark.heavy
def test_target_critic_follows_at_rate_tau(key):
    state = FULL_LEARNER.init(key)
    state = state.replace(hyper=state.hyper._replace(tau=jnp.float32(0.25)))
    new, _ = FULL_LEARNER.update(state, probe(key), key)
    mix = jax.tree.map(lambda t, c: 0.75 * t + 0.25 * c, state.target_critic, new.critic.params)
    chex.assert_trees_all_close(new.target_critic, mix, rtol=1e-6)


@pytest.mark.heavy
def test_fixed_temperature_and_delayed_actor_keep_their_bits(key):
    config = sac.SACConfig(1, 1, network=NET, tune_alpha=False, train_dynamics=False)
    state = start = INIT(config, key, HYPER._replace(alpha=0.01, actor_start=2.0))
    assert state.value is None and state.dynamics is None
    for step in range(3):
        state, _ = UPDATE(config, state, probe(key), jax.random.fold_in(key, step))
        assert equal(start.actor, state.actor) == (step < 2)  # moments included
    assert equal(start.log_alpha, state.log_alpha)


@pytest.mark.heavy
def test_actor_ramp_scales_the_first_steps(key):
    """Adam's first step has length lr per entry, so a ramp of 4 makes it a quarter."""
    moved = []
    for ramp in (0.0, 4.0):
        state = FULL_LEARNER.init(key)
        state = state.replace(hyper=state.hyper._replace(lr_actor=jnp.float32(1e-2), actor_ramp=jnp.float32(ramp)))
        new, _ = FULL_LEARNER.update(state, probe(key), key)
        moved.append(jnp.abs(new.actor.params["Dense_1"]["bias"] - state.actor.params["Dense_1"]["bias"]).max())
    assert moved[0] == pytest.approx(1e-2, rel=1e-2) and moved[1] == pytest.approx(2.5e-3, rel=1e-2)


@pytest.mark.heavy
def test_an_anchored_actor_stays_with_the_policy_it_began_with(key):
    """The dearer it is to leave, the less far it goes; what it is held to never moves."""
    config = dataclasses.replace(FULL, tune_alpha=False, train_dynamics=False, anchored=True)
    actor = jax.vmap(networks.make_actor(1, 1, FULL.network).apply, (None, 0))

    @jax.jit
    def divergence(*params):
        now, then = (actor(p, jnp.linspace(-1.0, 1.0, 9)[:, None]) for p in params)
        return jax.vmap(networks.tanh_gaussian_divergence)(now, then).mean()

    params = sac.extract_params(FULL_LEARNER.init(key))
    batch, far = probe(key, reward=lambda s, a: 5.0 * a), []
    for price in (0.0, 10.0, 1000.0):
        hyper = HYPER._replace(anchor=price)
        state = start = sac.state_from_prior(config, hyper, params, key, reset_critic=False)
        for step in range(150):
            state, _ = UPDATE(config, state, batch, jax.random.fold_in(key, step))
        assert equal(start.anchor, state.anchor) and equal(start.anchor, params.actor)
        far.append(float(divergence(state.actor.params, state.anchor)))
    assert far[0] > 2 * far[1] > 4 * far[2] > 0


@pytest.mark.heavy
def test_policy_delay(key):
    config = dataclasses.replace(PLAIN, policy_delay=2)
    start = INIT(PLAIN, key)
    first, _ = UPDATE(config, start, probe(key), key)
    second, _ = UPDATE(config, first, probe(key), key)
    assert equal(first.actor, second.actor) and not equal(start.actor, first.actor)


def ensemble(alpha=0.5, **options):
    """Four critics that say 0, 1, 2 and 3 everywhere, as a state, and the learner."""
    config = dataclasses.replace(PLAIN, critics=4, **options)
    state = INIT(dataclasses.replace(PLAIN, critics=4), jax.random.key(0), HYPER._replace(alpha=alpha))
    said = jax.tree.map(jnp.zeros_like, state.critic.params)
    said["Dense_1"]["bias"] = jnp.arange(4.0)[:, None]
    return state.replace(critic=state.critic._replace(params=said), target_critic=said), partial(UPDATE, config)


@pytest.mark.heavy
def test_targets_are_the_minimum_of_some_members(key):
    """Of two random members of four: 0, 1 or 2, and every one of them now and then; by default of all: 0."""
    batch = probe(key, discount=lambda s: jnp.ones_like(s), reward=lambda s, a: jnp.zeros_like(s))
    two = {"target_critics": 2, "actor_mean": True}  # as below, where the actor follows the mean
    for options, expected in ((two, {0, 1, 2}), ({}, {0})):
        state, update = ensemble(alpha=1e-4, **options)
        seen = [float(update(state, batch, jax.random.key(i))[1]["critic/target_mean"]) for i in range(20)]
        assert {round(x) for x in seen} == expected and all(abs(x - round(x)) < 1e-3 for x in seen)


@pytest.mark.heavy
def test_targets_are_those_of_the_target_critic(key):
    """It says 10 to 13, the critic in training 0 to 3: 2 + 0.5 min; the actor follows the latter."""
    batch = probe(key, discount=lambda s: jnp.full_like(s, 0.5), reward=lambda s, a: jnp.full_like(s, 2.0))
    state, update = ensemble(entropy_in_target=False, alpha=1e-4)
    slow = jax.tree.map(jnp.copy, state.target_critic)
    slow["Dense_1"]["bias"] += 10.0
    kept = state.replace(target_critic=slow, hyper=state.hyper._replace(lr_critic=jnp.float32(0)))
    metrics = update(kept, batch, key)[1]
    assert metrics["critic/target_mean"] == 7.0 and metrics["critic/q_mean"] == 1.5
    assert metrics["actor/loss"] == pytest.approx(0.0, abs=1e-2)


def test_entropy_in_the_target(key):
    batch = probe(key, discount=lambda s: jnp.ones_like(s), reward=lambda s, a: jnp.zeros_like(s))
    state, update = ensemble()
    metrics = update(state, batch, key)[1]
    assert metrics["critic/target_mean"] == pytest.approx(0.5 * float(metrics["actor/entropy"]), abs=0.15)


def test_without_entropy_in_the_target(key):
    batch = probe(key, discount=lambda s: jnp.ones_like(s), reward=lambda s, a: jnp.zeros_like(s))
    state, update = ensemble(entropy_in_target=False)
    assert update(state, batch, key)[1]["critic/target_mean"] == 0.0  # the minimum of the four


@pytest.mark.heavy
def test_a_critic_term_joins_the_loss(key):
    """3 + 5 times the mean of all critics at the data's actions; it may ask the policy, too."""

    def after(slope):
        def term(critic, params, policy, batch, key):
            action, log_prob = policy(batch.obs[0], key)
            assert action.shape == (1,) and log_prob.shape == ()
            return 3.0 + slope * jnp.mean(jax.vmap(critic, (None, 0, 0))(params, batch.obs, batch.action))

        return sac.update(PLAIN, INIT(PLAIN, key), probe(key), key, critic_term=term)

    (flat, of_flat), (steep, of_steep) = map(jax.jit(after), (0.0, 5.0))
    assert not equal(flat.critic, steep.critic)
    assert of_steep["critic/q_mean"] == of_flat["critic/q_mean"] and of_flat["critic/loss"] > 3
    gained = float(of_steep["critic/loss"] - of_flat["critic/loss"])
    assert gained == pytest.approx(5 * float(of_flat["critic/q_mean"]), rel=1e-4)


def test_the_actor_follows_the_minimum_or_the_mean(key):
    for options, q in (({}, 0.0), ({"actor_mean": True, "target_critics": 2}, 1.5)):
        state, update = ensemble(**options)
        kept = state.replace(hyper=state.hyper._replace(lr_critic=jnp.float32(0)))
        metrics = update(kept, probe(key), key)[1]
        assert metrics["actor/loss"] == pytest.approx(-0.5 * float(metrics["actor/entropy"]) - q, abs=1e-4)


@pytest.mark.heavy
def test_the_temperature_waits_with_the_actor(key):
    config = dataclasses.replace(PLAIN, policy_delay=2)
    first, _ = UPDATE(config, INIT(PLAIN, key), probe(key), key)
    second, _ = UPDATE(config, first, probe(key), key)
    assert first.log_alpha.params != 0 and equal(first.log_alpha, second.log_alpha)


@pytest.mark.heavy
def test_actor_learns_from_the_leading_rows_only(key):
    update = partial(UPDATE, dataclasses.replace(PLAIN, actor_batch=4))
    state, batch = INIT(PLAIN, key), probe(key, obs=[-1.0, 1.0])
    other = batch._replace(obs=batch.obs.at[4:].add(3.0))
    # from the same critic, the actor's step does not see rows 4 and later
    kept = state.replace(hyper=state.hyper._replace(lr_critic=jnp.float32(0)))
    a, b = (update(kept, x, key)[0] for x in (batch, other))
    assert equal(a.actor, b.actor) and not equal(a.actor, state.actor)
    c = update(kept, batch._replace(obs=batch.obs.at[3].add(3.0)), key)[0]
    assert not equal(a.actor, c.actor)


@pytest.mark.heavy
def test_weights_of_the_actors_rows_may_be_left_out(key):
    """The critic still counts rows as they weigh. That an actor else does so too says test_contract_learners.py."""
    batch = probe(key, obs=[-1.0, 1.0], reward=lambda s, a: s * a)._replace(weight=jnp.ones(ROWS))
    state, update = FULL_LEARNER.init(key), partial(UPDATE, dataclasses.replace(FULL, weighted_actor=False))
    kept = state.replace(hyper=state.hyper._replace(lr_critic=jnp.float32(0)))
    half = batch._replace(weight=jnp.arange(ROWS) % 2 * 2.0)
    a, b = (update(kept, x, key)[0] for x in (batch, half))
    for part in ("actor", "log_alpha"):
        assert equal(getattr(a, part), getattr(b, part))
    assert not equal(a.critic.moments, b.critic.moments)


def test_without_discount_the_target_ignores_target_network_and_successor(key):
    state, batch = FULL_LEARNER.init(key), probe(key, reward=lambda s, a: a)
    other_state = state.replace(target_critic=jax.tree.map(lambda p: p + 1, state.target_critic))
    other_batch = batch._replace(next_obs=batch.next_obs + 5)
    a, b = (FULL_LEARNER.update(s, x, key)[0] for s, x in ((state, batch), (other_state, other_batch)))
    assert equal(a.critic, b.critic)


@pytest.mark.heavy
def test_hyperparameters_vmap(key):
    state, batch = INIT(PLAIN, key), probe(key)
    rates = jnp.array([0.0, 1e-2])

    @jax.jit
    def step(rate):
        return sac.update(PLAIN, state.replace(hyper=state.hyper._replace(lr_critic=rate)), batch, key)[0]

    new = jax.vmap(step)(rates)
    assert equal(jax.tree.map(lambda x: x[0], new.critic.params), state.critic.params)
    assert not equal(jax.tree.map(lambda x: x[1], new.critic.params), state.critic.params)


def test_keys_decide(key):
    state, batch = FULL_LEARNER.init(key), probe(key)
    other = jax.random.key(1)
    obs = jnp.zeros(1)

    def explore(key):
        return FULL_LEARNER.act(state, (), obs, key, explore=True)[0]

    assert jnp.array_equal(explore(key), explore(key)) and not jnp.array_equal(explore(key), explore(other))
    assert jnp.array_equal(*(FULL_LEARNER.act(state, (), obs, k, explore=False)[0] for k in (key, other)))
    assert equal(FULL_LEARNER.update(state, batch, key)[0], FULL_LEARNER.update(state, batch, key)[0])


# --- between simulation and reality ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def prior():
    state = INIT(sac.SACConfig(3, 2, network=NET, ensemble_size=2), jax.random.key(7))
    statistics = normalizer.Normalizer(jnp.array([1.0, 2, 3]), jnp.array([2.0, 1, 0.5]))
    params = sac.extract_params(state.replace(normalizer=statistics))
    return params._replace(value=networks.make_value(3, NET).init(jax.random.key(9)))


def tuned(prior, *, reset, extra=0, **options):
    config = sac.SACConfig(3, 2, context_dim=extra, network=NET, train_dynamics=False, **options)
    start = jax.jit(partial(sac.state_from_prior, config), static_argnames="reset_critic")
    return sac.make_sac(config), start(HYPER._replace(alpha=0.01), prior, jax.random.key(0), reset_critic=reset)


@pytest.mark.heavy
def test_fine_tuning_starts_from_the_prior(prior, key):
    _, state = tuned(prior, reset=False)
    assert equal(state.actor.params, prior.actor) and equal(state.critic.params, prior.critic)
    assert equal(state.target_critic, prior.critic) and equal(state.normalizer, prior.normalizer)
    assert jnp.exp(state.log_alpha.params) == pytest.approx(0.01)
    assert all(jnp.all(m == 0) for m in jax.tree.leaves(state.actor.moments))
    _, fresh = tuned(prior, reset=True)
    assert equal(fresh.actor.params, prior.actor) and not equal(fresh.critic.params, prior.critic)
    assert equal(fresh.target_critic, fresh.critic.params)


@pytest.mark.heavy
def test_the_first_policy_is_the_simulators_for_every_steps_to_go(prior, key):
    plain_learner, plain = tuned(prior, reset=False)
    learner, state = tuned(prior, reset=False, extra=3)
    obs, action = jnp.array([0.5, -1.0, 2.0]), jnp.array([0.1, -0.2])
    expected = plain_learner.act(plain, (), obs, key, explore=True)[0]
    z = normalizer.normalize(prior.normalizer, obs)
    q = networks.make_critic(3, 2, NET).apply(prior.critic, z, action)
    for k in range(4):
        context = jax.nn.one_hot(k - 1, 3)
        action_then = learner.act(state, (), obs, key, explore=True, context=context)[0]
        np.testing.assert_allclose(action_then, expected, rtol=1e-5)
        got = networks.make_critic(6, 2, NET).apply(state.critic.params, jnp.concatenate([z, context]), action)
        np.testing.assert_allclose(got, q, rtol=1e-5)


@pytest.mark.heavy
def test_kept_critic_under_shaping_is_the_simulators_advantage(prior, key):
    """r_bar of the simulator has mean Q_sim - V_sim: at discount 0 that critic has no error on such rewards."""
    learner, state = tuned(prior, reset=False, critic_baseline=True, tune_alpha=False)
    critic, value = networks.make_critic(3, 2, NET), networks.make_value(3, NET)
    obs, action = jax.random.normal(key, (16, 3)), jax.random.uniform(key, (16, 2))
    zs = jax.vmap(normalizer.normalize, (None, 0))(prior.normalizer, obs)
    q = jax.vmap(critic.apply, (None, 0, 0))(prior.critic, zs, action)
    v = jax.vmap(value.apply, (None, 0))(prior.value, zs)
    zero = jnp.zeros(16)
    batch = Batch(obs, action, q[:, 0] - v, zero, obs)
    new, metrics = jax.jit(learner.update)(state, batch, key)
    # only the second critic errs: mean (Q_2 - Q_1)^2
    assert metrics["critic/loss"] == pytest.approx(float(jnp.mean((q[:, 1] - q[:, 0]) ** 2)), rel=1e-4)
    assert equal(new.value, state.value)


def test_a_prior_of_another_shape_is_refused(prior):
    config = sac.SACConfig(4, 2, network=NET)
    with pytest.raises(UserError, match=r"prior actor.*\(3, 8\), expected \(4, 8\)"):
        sac.state_from_prior(config, sac.SACHyper(), prior, jax.random.key(0), reset_critic=True)
    with pytest.raises(UserError, match="train_dynamics"):
        sac.extract_params(INIT(PLAIN, jax.random.key(0)))


def test_impossible_options_are_refused():
    with pytest.raises(UserError, match="policy-delay"):
        sac.SACConfig(1, 1, policy_delay=0)
