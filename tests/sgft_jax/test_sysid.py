"""The method that fits the system: a point whose commands are scaled and turned, told to a policy that knows them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
import tuners
import untrained

import envs
from envs.base import Varying
from envs.observations import concealed, with_system
from envs.rollout import play_episode
from envs.types import Transition, UserError
from sgft_jax import api
from sgft_jax.algorithms import make_policy
from sgft_jax.files.disk import jsonable
from sgft_jax.io.priors import load_prior, save_prior, variant
from sgft_jax.learners import sac
from sgft_jax.methods import get_method
from sgft_jax.models import dynamics, system
from sgft_jax.models.config import network_of
from sgft_jax.models.networks import make_dynamics
from sgft_jax.presets import PretrainConfig
from sgft_jax.train import finetuning
from sgft_jax.train.pretraining import prior_card
from sgft_jax.types import Normalizer, Prior, SimulatedData

pytestmark = pytest.mark.heavy  # all of them compile

SYSTEM = (Varying("action_scale", 0, 0.5, 1.5), Varying("action_rotation", 0, -0.5, 0.5))
ENV = with_system(toy.make(), SYSTEM)
TRUE = jnp.array([-0.4, 0.6])  # scale 0.8 along x, 0.3 rad
N, K = 20, len(SYSTEM)


@pytest.fixture(scope="module")
def prior():
    """Untrained: what its models make of the system decides what real steps look like here."""
    config = PretrainConfig(network=tuners.NET, ensemble_size=2, sees_system=True)
    structure = sac.SACConfig(ENV.obs_dim, 2, network=config.network, ensemble_size=2)
    params = tuners.shaken(jax.jit(lambda key: untrained.sac_params(structure, key))(jax.random.key(7)))
    statistics = Normalizer(jnp.zeros(ENV.obs_dim), jnp.ones(ENV.obs_dim))
    return Prior(params._replace(normalizer=statistics), prior_card(ENV, config))


def steps(prior, key, told, n=N, noise=0.0):
    """Rows of a system that the prior's models describe, where nothing but `told` says which."""
    key_obs, key_action, key_system, key_noise = jax.random.split(key, 4)
    measured, action = (jax.random.uniform(k, (n, d), minval=-1) for k, d in ((key_obs, 4), (key_action, 2)))
    here = jnp.tile(TRUE, (n, 1)) if not told else jax.random.uniform(key_system, (n, K), minval=-1)
    model = make_dynamics(ENV.obs_dim, 2, network_of(prior.card))

    def after(obs, action):
        return dynamics.predict(model, prior.params.dynamics, prior.params.normalizer, obs, action).mean(axis=0)

    obs = jnp.concatenate([measured, here], axis=1)
    next_obs = jax.vmap(after)(obs, action) + noise * jax.random.normal(key_noise, obs.shape)

    def silent(obs):
        return obs if told else obs.at[:, -K:].set(0.0)

    return Transition(silent(obs), action, jnp.zeros(n), jnp.ones(n), silent(next_obs))


def torn(rows, value):
    """The same rows, and as many that do not count."""
    return jax.tree.map(lambda x: jnp.concatenate([x, value + x]), rows), jnp.arange(2 * N) < N


@pytest.fixture(scope="module", params=["map", "dropo"])
def found(request, prior):
    """The finetuner, its state before and after one rollout, and the simulated data that it asks for."""
    method = get_method("sysid")
    fine = method.build(method.config(fit=request.param), prior, ENV)
    data = SimulatedData(lambda key, n: steps(prior, key, told=True, n=n, noise=0.003), jnp.zeros(1))
    state = jax.jit(lambda params, key: fine.prepare(fine.init(params, key), data))(prior.params, jax.random.key(0))
    rows = steps(prior, jax.random.key(1), told=False, noise=0.003)
    observe = jax.jit(fine.observe)
    return fine._replace(observe=observe), state, observe(state, *torn(rows, 0.0), jnp.float32(0.0)), data


def test_one_rollout_tells_the_system(found):
    _, before, after, _ = found
    np.testing.assert_array_equal(before.learner[1].mean, 0.0)
    np.testing.assert_allclose(after.learner[1].mean, TRUE, atol=0.1)


def test_rows_that_do_not_count_change_nothing(found, prior):
    fine, before, after, _ = found
    rows = steps(prior, jax.random.key(1), told=False, noise=0.003)
    state = fine.observe(before, *torn(rows, 9.0), jnp.float32(0.0))
    np.testing.assert_allclose(state.learner[1].mean, after.learner[1].mean, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("fit", ["map", "dropo"])
def test_the_simulator_tells_the_system_too(prior, fit, key):
    """Of steps with noise, played in the task itself; the prior's models, which know nothing, are not asked."""
    method = get_method("sysid")
    fine = method.build(method.config(fit=fit, through="simulator"), prior, ENV)

    def wander(carry, obs, key):
        return jax.random.uniform(key, (2,), minval=-1.0), carry

    def play(env, n, effects):
        nominal = {p.name: p.nominal for p in env.parameters}
        pool = envs.sample_worlds(env, key, n, params=nominal, effects=effects)
        rows = jax.vmap(lambda key: play_episode(env, pool, wander, (), key, gamma=0.9))(jax.random.split(key, n))
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (rows.transitions, rows.valid))

    known, _ = play(ENV, 32, {v.name: [v.low, v.high] for v in SYSTEM})
    real = play(concealed(ENV), 1, {"action_scale": [0.8, 1.0], "action_rotation": 0.3})

    def draw(key, n):
        return jax.tree.map(lambda x: x[jax.random.randint(key, (n,), 0, len(x))], known)

    state = jax.jit(lambda: fine.prepare(fine.init(prior.params, key), SimulatedData(draw, jnp.zeros(1))))()
    state = jax.jit(fine.observe)(state, *real, jnp.float32(0))
    np.testing.assert_allclose(state.learner[1].mean, TRUE, atol=0.1)
    with pytest.raises(UserError, match="use models"):
        method.build(method.config(through="simulator"), prior, ENV._replace(simulator=None))


def test_it_acts_as_if_the_system_were_told_and_so_does_what_it_exports(found, prior, tmp_path, key):
    fine, _, after, _ = found
    obs = jnp.concatenate([jnp.array([0.3, -0.8, 0.1, 0.0]), jnp.zeros(K)])
    policy = make_policy(prior.card, ENV)
    wish, _ = policy.act(prior.params, (), system.append_system(obs, after.learner[1].mean), key, explore=False)
    blind, _ = policy.act(prior.params, (), obs, key, explore=False)
    action, _ = fine.act(after, (), obs, key, explore=False)
    np.testing.assert_allclose(action, wish, atol=1e-6)
    assert jnp.abs(action - blind).max() > 1e-3
    saved = load_prior(save_prior(tmp_path / "policy", Prior(fine.export(after), prior.card)))
    np.testing.assert_allclose(policy.act(saved.params, (), obs, key, explore=False)[0], wish, atol=1e-6)
    acting = api.ActingPolicy(saved, ENV).act(obs[:-K])
    np.testing.assert_allclose(acting, wish, atol=1e-5)


def test_metrics_tell_what_was_found_in_raw_units(found, key):
    fine, _, after, data = found
    _, metrics = fine.learn(after, key, fine.updates_per_rollout, data)
    assert metrics["system/action_scale_0"] == pytest.approx(0.8, abs=0.06)
    assert metrics["system/action_rotation_0"] == pytest.approx(0.3, abs=0.06)


def test_the_card_says_what_is_told(prior):
    card = jsonable(prior.card)
    assert variant(card) == {"previous_actions": 0, "system": SYSTEM, "sparse": False}


def test_other_methods_refuse_such_a_prior_and_this_one_every_other(prior):
    api.check_prior(prior, get_method("sysid"), ENV)
    with pytest.raises(UserError, match="sac needs a prior that was not told the system"):
        api.check_prior(prior, get_method("sac"), ENV)
    plain = dataclasses.replace(prior, card={**prior.card, "system": []})
    with pytest.raises(UserError, match="--preset informed"):
        api.check_prior(plain, get_method("sysid"), ENV)


@pytest.mark.slow
def test_nothing_of_the_true_system_reaches_the_method(prior):
    """The whole way from Python."""
    gap = envs.gaps.from_dict(ENV, "off", {"effects": {"action_scale": 0.7}})
    setup = api.setup(ENV, gap, prior, method="sysid")
    progress, _ = list(finetuning.finetune(*setup, rollouts=2))[-1]
    np.testing.assert_array_equal(progress.agent.replay.data.obs[..., -K:], 0.0)
    assert jnp.isfinite(progress.agent.learner[1].mean).all()
