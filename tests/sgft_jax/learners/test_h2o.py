"""H2O: who is pushed down and how far, by hand; the sign of the gap; what moves what. See test_contract_learners.py."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import compiled_once, make_ratio

from envs.types import UserError
from sgft_jax.learners import h2o
from sgft_jax.models import networks, ratio
from sgft_jax.types import Batch

pytestmark = pytest.mark.heavy  # all of them compile

BODY = networks.NetworkConfig((16,))
ROWS = 12
SIM = jnp.arange(ROWS) % 2 == 1
CONFIG = h2o.H2OConfig(3, 2, network=BODY, ratio_network=BODY, tune_alpha=False)
CRITIC = networks.make_critic(3, 2, BODY)
ACTOR = networks.make_affine_actor(3, 2, BODY, output_gain=0.01)
RATIO = make_ratio(ratio.RatioConfig(3, 2, BODY))


@pytest.fixture(scope="module")
def learner():
    made = h2o.make_h2o(CONFIG, h2o.H2OHyper(lr_ratio=1e-2, alpha=0.5))
    return compiled_once(made)


def batch_of(key, shift=0.0):
    """Odd rows are simulated; they land `shift` further."""
    keys = jax.random.split(key, 4)
    obs, noise = (jax.random.normal(k, (ROWS, 3)) for k in keys[:2])
    action = jax.random.uniform(keys[2], (ROWS, 2), minval=-1)
    next_obs = obs + 0.3 * noise + shift * SIM[:, None]
    return Batch(obs, action, jax.random.normal(keys[3], (ROWS,)), jnp.full(ROWS, 0.9), next_obs, is_sim=SIM)


def rows(is_sim, **fields):
    """A batch that says where its rows come from and nothing else."""
    n = len(is_sim)
    return Batch(*(jnp.zeros(s) for s in ((n, 1), (n, 1), n, n, (n, 1))), is_sim=jnp.array(is_sim), **fields)


def equal(a, b):
    return all(jnp.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@jax.jit
def values(state, batch):
    """Of both critics at the data's actions, [ROWS, 2]."""
    return jax.vmap(CRITIC.apply, (None, 0, 0))(state.critic.params, batch.obs, batch.action)


# --- the penalty ----------------------------------------------------------------------------------------------------


def shares(gaps, is_sim, **fields):
    return np.exp(h2o.log_shares(jnp.array(gaps, jnp.float32), rows(is_sim, **fields)))


def test_shares_by_hand():
    """In proportion to the gaps of simulated rows; a pair that looks more real than simulated is left alone."""
    np.testing.assert_allclose(shares([1.0, 3.0, 9.0], [True, True, False]), [0.25, 0.75, 0], atol=1e-6)
    np.testing.assert_allclose(shares([1.0, -2.0, 3.0], [True, True, True]), [0.25, 0, 0.75], atol=1e-6)
    np.testing.assert_allclose(shares([-1.0, -2.0, 3.0], [True, True, False]), [0.5, 0.5, 0], atol=1e-6)
    weighted = shares([1.0, 3.0, 1.0], [True] * 3, weight=jnp.array([2.0, 1.0, 0.0]))
    np.testing.assert_allclose(weighted, [0.4, 0.6, 0], atol=1e-6)
    valid = shares([1.0, 3.0, 4.0], [True] * 3, valid=jnp.array([True, True, False]))
    np.testing.assert_allclose(valid, [0.25, 0.75, 0], atol=1e-6)


def test_the_penalty_by_hand():
    """log(.25 e^1 + .75 e^2) - (3 + 5) / 2 for one critic, log(.25 + .75) - 0 for the other."""
    batch = rows([True, True, False, False])
    q = jnp.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [5.0, 0.0]])
    log_shares = h2o.log_shares(jnp.array([1.0, 3.0, 7.0, 7.0]), batch)
    expected = np.log(0.25 * np.e + 0.75 * np.e**2) - 4
    assert h2o.penalty(q, log_shares, batch) == pytest.approx(expected, rel=1e-5)
    push = jax.grad(lambda q: h2o.penalty(q, log_shares, batch))(q)
    low, high = 0.25 * np.e, 0.75 * np.e**2  # simulated pairs go down, real ones up
    np.testing.assert_allclose(push[:, 0], [low / (low + high), high / (low + high), -0.5, -0.5], rtol=1e-5)


def test_the_penalty_is_cut_off():
    batch = rows([True, False])
    for q, expected in ((5000.0, 1000.0), (-5000.0, -1000.0)):
        assert h2o.penalty(jnp.array([[q], [0.0]]), jnp.array([0.0, -1e30]), batch) == expected


@pytest.mark.slow
def test_the_gap_grows_with_the_simulators_error(learner, key):
    """Its sign is that of KL(P_sim || P): the inverse, a known fault, would fall."""
    seen = []
    for shift in (0.0, 4.0):
        state = learner.init(key).replace(spread=jnp.full(3, 0.1, jnp.float32))
        for i in range(60):
            sub = jax.random.fold_in(key, i)
            state, metrics = learner.update(state, batch_of(sub, shift), sub)
        seen.append(float(metrics["ratio/gap_sim"]))
    assert seen[0] < 1 < 2 < seen[1] <= 4


# --- one update -----------------------------------------------------------------------------------------------------


def test_order_and_rows_of_the_update(learner, key):
    """Losses are those of the old networks, gaps and weights those of the new discriminators; no entropy in targets."""
    batch = batch_of(key)
    state = learner.init(key)
    apart = jax.tree.map(lambda x: 3.0 * jax.random.normal(key, x.shape), state.target_critic)
    state = state.replace(target_critic=apart)
    new, metrics = learner.update(state, batch, key)
    real, sim = ~np.asarray(SIM), np.asarray(SIM)
    log_w = jax.jit(jax.vmap(RATIO.log_ratio, (None, 0, 0, 0)))(new.ratio, batch.obs, batch.action, batch.next_obs)
    assert metrics["ratio/gap_sim"] == pytest.approx(float(-log_w[sim].mean()), rel=1e-4)  # the spread is 0

    def y(row, key):
        action, _ = networks.tanh_gaussian_sample(ACTOR.apply(state.actor.params, row.next_obs), key)
        return row.reward + row.discount * CRITIC.apply(apart, row.next_obs, action).min()

    targets = jax.jit(jax.vmap(y))(batch, jax.random.split(jax.random.split(key, 4)[3], ROWS))
    q = values(state, batch)
    squared = np.sum((np.asarray(q) - np.asarray(targets)[:, None]) ** 2, axis=1)
    weights = np.exp(np.minimum(log_w, 0))
    assert metrics["critic/target_mean"] == pytest.approx(float(targets.mean()), rel=1e-4)
    assert metrics["critic/real_loss"] == pytest.approx(float(squared[real].mean()), rel=1e-4)
    assert metrics["critic/sim_loss"] == pytest.approx(float((weights * squared)[sim].mean()), rel=1e-4)
    expected = 0.01 * jax.jit(lambda q, gaps: h2o.penalty(q, h2o.log_shares(gaps, batch), batch))(q, -log_w)
    assert metrics["critic/penalty"] == pytest.approx(float(expected), rel=1e-3, abs=1e-6)
    total = sum(float(metrics[f"critic/{part}"]) for part in ("real_loss", "sim_loss", "penalty"))
    assert metrics["critic/loss"] == pytest.approx(total, rel=1e-5)
    assert equal(state.log_alpha, new.log_alpha) and new.step == 1


def test_both_discriminators_learn_once_in_every_update(learner, key):
    """ODRL's H2O lets them learn at every tenth step alone, even where the real data are a file."""
    state = learner.init(key)
    for i in range(1, 4):
        before, (state, _) = state, learner.update(state, batch_of(jax.random.fold_in(key, i)), key)
        for old, new in ((before.ratio.joint, state.ratio.joint), (before.ratio.pair, state.ratio.pair)):
            assert int(optax.tree.get(new.moments, "count")) == i and not equal(old.params, new.params)


def test_the_spread_is_noise_on_successors(learner, key):
    """In raw units, times its scale; it changes the gaps and nothing of the discriminators."""
    batch, state = batch_of(key), learner.init(key)
    scaled = state.replace(spread=jnp.ones(3), hyper=state.hyper._replace(spread_scale=jnp.float32(0.3)))
    several = [
        learner.update(s, batch, key) for s in (state, state.replace(spread=jnp.full(3, 0.3, jnp.float32)), scaled)
    ]
    gaps = [float(metrics["ratio/gap_sim"]) for _, metrics in several]
    assert gaps[0] != gaps[1] == pytest.approx(gaps[2], rel=1e-5)
    assert equal(several[0][0].ratio, several[1][0].ratio)


def test_simulated_pairs_fall_and_real_ones_rise(learner, key):
    """With a heavy penalty and nothing else to learn."""
    heavy = {"conservatism": jnp.float32(10.0), "lr_critic": jnp.float32(1e-2), "lr_ratio": jnp.float32(3e-4)}
    batch = batch_of(key)
    batch = batch._replace(reward=0.0 * batch.reward, discount=0.0 * batch.discount)  # the types stay as they were
    state = learner.init(key)
    state = state.replace(hyper=state.hyper._replace(**heavy))
    for i in range(100):
        state, _ = learner.update(state, batch, jax.random.fold_in(key, i))
    q = values(state, batch).mean(axis=1)
    assert q[~SIM].mean() > q[SIM].mean() + 1


def test_options():
    assert (h2o.H2OHyper().conservatism, h2o.H2OHyper().spread_scale) == (0.01, 1.0)
    config = h2o.H2OConfig(17, 6)
    assert (config.successors, config.network.hidden, config.ratio_noise) == (10, (256, 256), 0.1)
    with pytest.raises(UserError, match="option successors is 0"):
        h2o.H2OConfig(1, 1, successors=0)


def test_a_fresh_state_can_be_donated(key):
    fresh = h2o.make_h2o(CONFIG)
    leaves = jax.make_jaxpr(fresh.init)(key).jaxpr.outvars
    assert len({id(leaf) for leaf in leaves}) == len(leaves)
