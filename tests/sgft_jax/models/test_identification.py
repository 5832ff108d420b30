"""Identification in front of a learner: a point whose real commands are turned and scaled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tuners

from sgft_jax.io.priors import load_prior, save_prior
from sgft_jax.models import distortion, dynamics
from sgft_jax.models.config import network_of
from sgft_jax.models.distortion import Distortion, translated
from sgft_jax.models.networks import make_dynamics
from sgft_jax.types import Batch, Prior, SimulatedData

pytestmark = pytest.mark.heavy  # all of them compile

TURN = Distortion(0.7 * jnp.array([[0.8, -0.6], [0.6, 0.8]]), jnp.array([0.1, 0.0]), jnp.zeros(2))
N = 30


def steps(params, key, what, n=N):
    """Steps of a system that the prior's first model describes exactly, behind a distortion."""
    model = make_dynamics(2, 2, network_of(tuners.prior().card))
    member = jax.tree.map(lambda x: x[:1], params.dynamics)

    def after(obs, command):
        return dynamics.predict(model, member, params.normalizer, obs, what.meaning(command))[0]

    rows = tuners.episode(key, n)
    return rows._replace(next_obs=jax.vmap(after)(rows.obs, rows.action))


@pytest.fixture(scope="module")
def case():
    plain = tuners.build("sac", identify=True, replay_capacity=64)
    params = tuners.prior().params
    data = SimulatedData(lambda key, n: steps(params, key, distortion.none(2, 2), n), jnp.zeros(1))
    init = jax.jit(lambda params, key: plain.prepare(plain.init(params, key), data))
    fine = plain._replace(init=init, observe=jax.jit(plain.observe), act=jax.jit(plain.act))
    return tuners.Case(plain, fine, data, params, [0])


@pytest.fixture(scope="module")
def learned(case):
    """A state that has seen one real rollout."""
    state = case.fine.init(case.params, jax.random.key(0))
    return case.fine.observe(state, steps(case.params, jax.random.key(1), TURN), jnp.ones(N, bool), jnp.float32(0))


def test_one_rollout_through_the_prior_s_model_tells_the_distortion(learned):
    np.testing.assert_allclose(learned.interface.distortion.matrix, TURN.matrix, atol=0.02)
    np.testing.assert_allclose(learned.interface.distortion.bias, TURN.bias, atol=0.02)


def test_where_nothing_differs_commands_stay_as_they_are(case):
    state = case.fine.init(case.params, jax.random.key(0))
    rows = steps(case.params, jax.random.key(1), distortion.none(2, 2))
    state = case.fine.observe(state, rows, jnp.ones(N, bool), jnp.float32(0))
    np.testing.assert_array_equal(state.interface.distortion.matrix, np.eye(2))
    np.testing.assert_array_equal(state.interface.distortion.bias, 0.0)


def test_it_commands_what_stands_for_the_wish_of_the_actor_and_so_does_what_it_exports(case, learned, tmp_path):
    obs, key = jnp.array([0.3, -0.8]), jax.random.key(2)
    plain = tuners.tuner("sac").fine
    wish, _ = plain.act(plain.init(case.params, jax.random.key(0)), (), obs, key, explore=False)
    command, _ = case.fine.act(learned, (), obs, key, explore=False)
    np.testing.assert_allclose(command, learned.interface.distortion.command(wish), atol=1e-5)
    assert jnp.abs(command - wish).max() > 0.05

    card = {**tuners.prior().card, "task": "t", "obs_dim": 2, "act_dim": 2}
    save_prior(tmp_path / "p", Prior(case.fine.export(learned), card))
    params = load_prior(tmp_path / "p").params
    np.testing.assert_allclose(case.fine.policy.act(params, (), obs, key, explore=False)[0], command, atol=1e-6)


def test_it_learns_in_the_actions_of_the_simulator(case, learned):
    rows, known = Batch(*steps(case.params, jax.random.key(3), TURN)), learned.interface.distortion
    meant = translated(known, rows)
    np.testing.assert_allclose(meant.action, jax.vmap(TURN.meaning)(rows.action), atol=0.03)
    mixed = translated(known, rows._replace(is_sim=jnp.arange(N) >= 10))
    np.testing.assert_array_equal(mixed.action[10:], rows.action[10:])
    np.testing.assert_array_equal(mixed.action[:10], meant.action[:10])
    held = learned.replay.data.action[:N]
    np.testing.assert_array_equal(held, steps(case.params, jax.random.key(1), TURN).action)  # the replay keeps commands
