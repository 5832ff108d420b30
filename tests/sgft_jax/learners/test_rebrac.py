"""ReBRAC: targets by hand, what the penalties do, turns of actor and targets. See also test_contract_learners.py."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import compiled_once

from envs.types import UserError
from sgft_jax.learners import rebrac
from sgft_jax.models import networks
from sgft_jax.types import Batch

f = jnp.float32
NET = networks.NetworkConfig((16,), layer_norm=True)
CONFIG = rebrac.ReBRACConfig(3, 2, network=NET)
ACTOR, CRITIC = networks.make_deterministic_actor(3, 2, NET), networks.make_critic(3, 2, NET)
ROWS = 8


@pytest.fixture(scope="module")
def learner():
    made = rebrac.make_rebrac(CONFIG, rebrac.ReBRACHyper(target_noise=0.0, actor_penalty=0.3, critic_penalty=0.2))
    return compiled_once(made)


def batch_of(key):
    """Windows of two steps; the last three have no second one."""
    keys = jax.random.split(key, 4)
    obs, next_obs = (jax.random.normal(k, (ROWS, 2, 3)) for k in keys[:2])
    action = jax.random.uniform(keys[2], (ROWS, 2, 2), minval=-1)
    valid = jnp.stack([jnp.ones(ROWS, bool), jnp.arange(ROWS) < ROWS - 3], axis=1)
    reward = jax.random.normal(keys[3], (ROWS, 2))
    return Batch(obs, action, reward, jnp.full((ROWS, 2), 0.9), next_obs, valid=valid)


def equal(a, b):
    return all(jnp.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_the_target_by_hand():
    """1 + .9 (4 - .5 * 2) = 3.7; nothing follows a terminal row."""
    assert rebrac.distance(jnp.array([1.0, 0.0]), jnp.array([0.0, -1.0])) == 2.0
    target = [rebrac.td_target(f(1), f(discount), jnp.array([5.0, 4.0]), f(2), penalty=0.5) for discount in (0.9, 0.0)]
    assert target == [pytest.approx(3.7), 1.0]
    assert jax.grad(lambda q: rebrac.td_target(f(1), f(0.9), q[None], q, penalty=0.5))(f(3.0)) == 0.0


@pytest.mark.heavy
def test_one_update_by_hand(learner, key):
    """Targets from target networks and the data's next action where there is one; the actor follows the new critic."""
    batch, state = batch_of(key), learner.init(key)
    apart = jax.random.key(1)
    state = state.replace(
        target_actor=learner.init(apart).actor.params, target_critic=learner.init(apart).critic.params
    )
    new, metrics = learner.update(state, batch, key)
    rows = jax.tree.map(lambda x: x[:, 0], batch)

    def y(row, other, follows):
        action = ACTOR.apply(state.target_actor, row.next_obs)
        away = jnp.sum((action - other) ** 2) * follows
        return row.reward + 0.9 * (CRITIC.apply(state.target_critic, row.next_obs, action).min() - 0.2 * away)

    targets = jax.jit(jax.vmap(y))(rows, batch.action[:, 1], batch.valid[:, 1])
    assert metrics["critic/target_mean"] == pytest.approx(float(targets.mean()), rel=1e-4)
    action = jax.jit(jax.vmap(ACTOR.apply, (None, 0)))(state.actor.params, rows.obs)
    q = jax.jit(jax.vmap(CRITIC.apply, (None, 0, 0)))(new.critic.params, rows.obs, action)
    action, q = np.asarray(action), np.asarray(q).min(axis=1)
    away = np.sum((action - np.asarray(rows.action)) ** 2, axis=1)
    expected = 0.3 * away.mean() - q.mean() / np.abs(q).mean()
    assert metrics["actor/loss"] == pytest.approx(float(expected), rel=1e-4)
    assert metrics["actor/distance"] == pytest.approx(float(away.mean()), rel=1e-5)
    for name in ("actor", "critic"):
        mix = jax.tree.map(
            lambda t, c: 0.995 * np.asarray(t) + 0.005 * np.asarray(c),
            getattr(state, f"target_{name}"),
            getattr(new, name).params,
        )
        chex.assert_trees_all_close(getattr(new, f"target_{name}"), mix, rtol=1e-5)


@pytest.mark.heavy
def test_actor_and_targets_move_every_second_time(learner, key):
    first, _ = learner.update(learner.init(key), batch_of(key), key)
    second, _ = learner.update(first, batch_of(key), key)
    for name in ("actor", "target_actor", "target_critic"):
        assert equal(getattr(first, name), getattr(second, name)), name
    assert not equal(first.critic, second.critic) and second.step == 2


@pytest.mark.heavy
def test_noise_on_target_actions_is_bounded(learner, key):
    """A std of 100 cut at 0.5 moves an action by no more than that, and it stays in bounds."""
    asked, state = [], learner.init(key)
    zero = jax.tree.map(jnp.zeros_like, state.target_critic)  # targets are r - .9 |a' - a'_data|^2
    batch = batch_of(key)._replace(action=jnp.zeros((ROWS, 2, 2)), valid=jnp.ones((ROWS, 2), bool))
    batch = batch._replace(reward=jnp.zeros((ROWS, 2)))
    for noise in (100.0, 0.0):
        params = jax.tree.map(jnp.zeros_like, state.target_actor)
        hyper = state.hyper._replace(target_noise=f(noise), critic_penalty=f(1))
        still = state.replace(target_critic=zero, target_actor=params, hyper=hyper)
        asked.append(float(learner.update(still, batch, key)[1]["critic/target_mean"]))
    assert asked[1] == 0.0 and asked[0] == pytest.approx(-0.9 * 2 * 0.25, abs=0.02)


@pytest.mark.heavy
def test_the_actors_penalty_holds_it_to_the_data(key):
    """More action pays more; the data's is -0.3 on average."""
    config = rebrac.ReBRACConfig(1, 1, network=networks.NetworkConfig((16,)))
    learner = rebrac.make_rebrac(config, rebrac.ReBRACHyper(1e-2, 1e-2))
    action = jnp.linspace(-0.6, 0.0, 32)[:, None]
    one = jnp.ones((32, 1))
    rows = Batch(one, action, 10 + 5 * action[:, 0], jnp.zeros(32), one)
    twice = jax.tree.map(lambda x: jnp.stack([x, x], axis=1), rows)._replace(valid=jnp.ones((32, 2), bool))

    @jax.jit
    def mode(penalty):
        state = learner.init(key)
        state = state.replace(hyper=state.hyper._replace(actor_penalty=penalty))
        keys = jax.random.split(key, 600)
        state = jax.lax.scan(lambda state, key: learner.update(state, twice, key), state, keys)[0]
        return learner.act(state, (), jnp.ones(1), key, explore=False)[0][0]

    assert 0.7 < mode(0.0) < 1.0 and -0.4 < mode(50.0) < -0.2


@pytest.mark.heavy
def test_the_scale_of_q_is_a_constant_of_the_actors_loss(learner, key):
    """Q is positive everywhere, so Q / mean |Q| is 1 for any actor; the actor follows Q all the same."""
    state = learner.init(key)
    params = {**state.critic.params, "Dense_1": jax.tree.map(lambda x: x + 5.0, state.critic.params["Dense_1"])}
    new, metrics = learner.update(
        state.replace(
            hyper=state.hyper._replace(lr_critic=f(0), actor_penalty=f(0)),
            critic=state.critic._replace(params=params),
        ),
        batch_of(key),
        key,
    )
    assert metrics["actor/loss"] == pytest.approx(-1.0)
    gradient = optax.tree.norm(optax.tree.get(new.actor.moments, "mu"))  # a tenth of it
    assert gradient > 1e-3


def test_exploring_adds_noise(learner, key):
    state, obs = learner.init(key), jnp.array([0.1, -0.2, 0.3])
    mode = learner.act(state, (), obs, key, explore=False)[0]
    draw = jax.jit(jax.vmap(lambda k: learner.act(state, (), obs, k, explore=True)[0]))(jax.random.split(key, 2000))
    np.testing.assert_allclose(np.std(draw, axis=0), 0.1, rtol=0.1)
    np.testing.assert_allclose(np.mean(draw, axis=0), mode, atol=0.01)


def test_windows_are_needed(key):
    rows = jax.tree.map(lambda x: x[:, 0], batch_of(key))
    with pytest.raises(UserError, match=r"windows \[rows, 2\] with a mask, not \[8\]"):
        jax.eval_shape(lambda: rebrac.make_rebrac(CONFIG).update(rebrac.make_rebrac(CONFIG).init(key), rows, key))


def test_published_numbers():
    hyper, config = rebrac.ReBRACHyper(), rebrac.ReBRACConfig(17, 6)
    assert (hyper.lr_actor, hyper.lr_critic, hyper.target_noise, hyper.target_noise_max) == (1e-3, 1e-3, 0.2, 0.5)
    assert (config.network.hidden, config.network.layer_norm, config.policy_delay) == ((256, 256, 256), True, 2)


def test_a_fresh_state_can_be_donated(key):
    fresh = rebrac.make_rebrac(CONFIG)
    leaves = jax.make_jaxpr(fresh.init)(key).jaxpr.outvars
    assert len({id(leaf) for leaf in leaves}) == len(leaves)
