"""Fine-tuning of an agent that plans: what learns, what stays, and whose value shapes rewards."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sgft_jax import finetune, methods
from sgft_jax.learners import tdmpc2, tdmpc2_model
from sgft_jax.types import Normalizer, Transition

T, LENGTH = 12, 2
TINY = tdmpc2_model.Size(encoder=8, mlp=8, latent=8, encoder_layers=2, members=3)


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    monkeypatch.setitem(tdmpc2_model.SIZES, "tiny", TINY)


@functools.cache
def make(name):
    config = methods.finetune_config(
        methods.get_method(name), size="tiny", plan_samples=24, batch_size=8, replay_capacity=64, horizon=LENGTH
    )
    tuner = finetune.make_finetuner(
        methods.get_method(name), config, obs_dim=2, act_dim=2, reward=lambda *x: 0.0, terminated=lambda *x: False
    )
    compiled = {name: jax.jit(getattr(tuner, name)) for name in ("init", "observe", "act")}
    return tuner._replace(learn=jax.jit(tuner.learn, static_argnums=2), **compiled)


@pytest.fixture
def prior():
    """Of an agent whose critic has an opinion: heads are zero before they learn."""
    config = tdmpc2_model.named_config(2, 2, size="tiny", plan_samples=24, horizon=LENGTH)
    state = jax.jit(tdmpc2.make_tdmpc2(config).init)(jax.random.key(7))
    prior = tdmpc2.extract_prior(state)
    last = prior.critic["Dense_2"]
    loud = {**last, "kernel": 0.5 * jax.random.normal(jax.random.key(8), last["kernel"].shape)}
    statistics = Normalizer(jnp.array([0.1, -0.2]), jnp.array([2.0, 0.5]))
    return prior.replace(critic={**prior.critic, "Dense_2": loud}, normalizer=statistics)


def started(name, prior):
    tuner, keys = make(name), jax.random.split(jax.random.key(3), 2)
    obs = jax.random.uniform(keys[0], (T + 1, 2), minval=-1)
    action, zero = jax.random.uniform(keys[1], (T, 2), minval=-1), jnp.zeros(T)
    rows = Transition(obs[:-1], action, zero + 1, zero + 0.9, obs[1:], zero > 0, zero.astype(jnp.int32))
    return tuner, tuner.observe(tuner.init(prior, jax.random.key(0)), rows, jnp.arange(T) != 5)


def equal(a, b):
    return all(jnp.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_the_rows_of_an_episode_stay_in_order(prior):
    _, state = started("tdmpc2", prior)
    assert state.replay.size == T - 1 and int(state.replay.valid.sum()) == T - 1
    assert np.flatnonzero(state.replay.last).tolist() == [4, T - 2]  # the exploded step cuts the episode


@pytest.mark.parametrize("name", [pytest.param("tdmpc2", marks=pytest.mark.slow), "sgft-tdmpc2"])
def test_what_learns_and_what_stays(prior, name):
    tuner, state = started(name, prior)
    new, metrics = tuner.learn(state, jax.random.key(1), 2)
    moved = {part for part in ("encoder", "dynamics", "reward", "policy", "critic")
             if not equal(getattr(state.learner, part), getattr(new.learner, part))}  # fmt: skip
    everything = {"encoder", "dynamics", "reward", "policy", "critic"}
    assert moved == (everything if name == "tdmpc2" else {"dynamics", "reward", "policy"})
    assert all(jnp.isfinite(m) and m.shape == () for m in metrics.values())
    assert metrics["batch/reward_mean"] == 1.0 and new.judge is None
    assert state.learner.hyper.lr_warmup == 1000
    before, after = prior, tuner.export(new)
    assert jax.tree.map(jnp.shape, before) == jax.tree.map(jnp.shape, after)
    assert equal(before.normalizer, after.normalizer) and equal(after.policy, new.learner.policy.params)


@pytest.mark.slow
def test_the_released_code_learns_a_new_agent_from_shaped_rewards(prior):
    tuner, state = started("sgft-tdmpc2-code", prior)
    assert not equal(state.learner.dynamics.params, prior.dynamics) and equal(state.judge, prior)
    new, metrics = tuner.learn(state, jax.random.key(1), 2)
    assert equal(new.judge, prior) and not equal(new.learner.critic, state.learner.critic)
    assert abs(metrics["batch/reward_mean"] - 1.0) > 1e-3  # every raw reward is 1


def test_exploring_is_a_plan_with_noise(prior):
    tuner, state = started("tdmpc2", prior)
    obs, keys = jnp.array([0.3, -0.4]), jax.random.split(jax.random.key(2), 50)
    draw = jax.vmap(lambda key, explore: tuner.act(state, tuner.init_carry(), obs, key, explore=explore), (0, None))
    (best, plan), (noisy, same_plan) = draw(keys, False), draw(keys, True)
    assert plan.shape == (50, LENGTH, 2) and jnp.array_equal(plan, same_plan)
    assert (jnp.abs(noisy) <= 1).all() and not jnp.allclose(best, noisy)
