"""Ratio of dynamics: the page's numbers, known Gaussians, and faults that public implementations have had."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import make_ratio

from envs.types import UserError
from sgft_jax.models import normalizer, ratio
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.types import Batch

pytestmark = pytest.mark.heavy  # all of them compile

f = jnp.float32
SMALL = ratio.RatioConfig(2, 1, NetworkConfig((8,)))
HALF = 128


def compiled(config):
    """Its functions bound to a configuration, each of them one program."""
    return make_ratio(config)._replace(**{name: jax.jit(f) for name, f in make_ratio(config)._asdict().items()})


NOISY, QUIET = compiled(SMALL), compiled(dataclasses.replace(SMALL, noise=0.0))


def logits(p_real):
    return jnp.log(jnp.array([p_real, 1 - p_real], jnp.float32))


# --- numbers by hand ------------------------------------------------------------------------------------------------


def test_the_ratio_by_hand():
    """p(real|s,a) = .6, p(real|s,a,s') = .2: (.2 / .8) / (.6 / .4) = 1/6."""
    log_w = ratio.difference(logits(0.2), logits(0.6))
    assert log_w == pytest.approx(-1.7918, abs=1e-4) and ratio.weight(log_w) == pytest.approx(1 / 6, rel=1e-5)
    # the other way round it is above 1, and capped
    assert ratio.difference(logits(0.6), logits(0.2)) == pytest.approx(np.log(6), rel=1e-5)
    assert ratio.weight(f(np.log(6))) == 1.0


def test_the_weight_is_a_capped_constant():
    assert ratio.weight(f(-4.0)) == pytest.approx(0.0183, abs=1e-4)
    assert ratio.weight(f(500.0)) == 1.0  # exp would overflow
    assert jax.grad(ratio.weight)(f(-1.0)) == 0.0


def test_the_loss_reads_logits_once():
    """A softmax before the cross-entropy, a known fault, would give 0.37 in the place of 0.018."""
    both = jnp.array([2.0, -2.0])
    certain = np.log(1 + np.exp(-4))
    assert ratio.domain_loss(both, both, jnp.bool(False)) == pytest.approx(2 * certain, rel=1e-5)
    assert ratio.domain_loss(both, both, jnp.bool(True)) == pytest.approx(2 * (4 + certain), rel=1e-5)


def test_odd_options_are_refused():
    with pytest.raises(UserError, match="option bound is 0"):
        ratio.RatioConfig(2, 1, bound=0.0)
    with pytest.raises(UserError, match="option noise is -1"):
        ratio.RatioConfig(2, 1, noise=-1.0)


# --- known Gaussians ------------------------------------------------------------------------------------------------


def rows(key, *, shift, apart):
    """Real and simulated rows, mixed. s' = s + a / 2 + N(0, 1), `shift` further in the simulator.

    apart: how far the states of the two lie from each other, which the ratio must not see.
    """
    keys = jax.random.split(key, 3)
    is_sim = jnp.arange(2 * HALF) % 2 == 1
    s = jax.random.normal(keys[0], (2 * HALF,)) + apart * (is_sim - 0.5)
    a = jax.random.uniform(keys[1], (2 * HALF,), minval=-1)
    following = s + a / 2 + jax.random.normal(keys[2], (2 * HALF,)) + shift * is_sim
    return Batch(s[:, None], a[:, None], s, s, following[:, None], is_sim=is_sim)


@pytest.fixture(scope="module")
def learned():
    """Discriminators after 1,000 steps, and the statistics that they read with, for a shift of 1 and states 1 apart."""
    learner = make_ratio(ratio.RatioConfig(1, 1, NetworkConfig((64, 64)), noise=0.0))

    @jax.jit
    def train(key):
        def step(state, key):
            return learner.update(state, rows(key, shift=1.0, apart=1.0), key, rate=1e-3)

        return jax.lax.scan(step, learner.init(key), jax.random.split(key, 1000))

    state, metrics = train(jax.random.key(0))
    return learner, state, metrics["ratio/loss"]


def estimates(learned, s, a, noise):
    learner, state, _ = learned
    following = s + a / 2 + noise
    return jax.jit(jax.vmap(learner.log_ratio, (None, 0, 0, 0)))(
        state, *(jnp.asarray(x, jnp.float32)[:, None] for x in (s, a, following))
    )


def test_the_learned_ratio_of_two_gaussians_is_the_true_one(learned):
    """log N(e; 0, 1) - log N(e; 1, 1) = 1/2 - e, wherever s and a are: from 2.0 at e = -1.5 to -2.0 at e = 2.5."""
    e = np.tile(np.linspace(-1.0, 2.0, 13), 5)
    s = np.repeat([-1.0, -0.5, 0.0, 0.5, 1.0], 13)
    got = estimates(learned, s, 0.5 * np.cos(7 * e), e)
    true = 0.5 - e
    assert np.abs(got - true).mean() < 0.15 and np.abs(got - true).max() < 0.5
    assert np.polyfit(e, got, 1)[0] == pytest.approx(-1.0, abs=0.12)  # two softmaxes would flatten it


def test_simulated_rows_weigh_less_where_the_simulator_errs(learned):
    """Direction: P / P_sim. E_sim[min(w, 1)] = 2 Phi(-1/2) = 0.617; with the inverse, 0.87."""
    learner, state, _ = learned
    batch = rows(jax.random.key(5), shift=1.0, apart=1.0)
    log_w = jax.jit(jax.vmap(learner.log_ratio, (None, 0, 0, 0)))(state, batch.obs, batch.action, batch.next_obs)
    weights = jax.vmap(ratio.weight)(log_w)
    assert weights[1::2].mean() == pytest.approx(0.617, abs=0.06)
    assert weights[1::2].mean() < 0.75 < weights[::2].mean()
    assert jnp.abs(log_w).max() <= 4.0 and weights.min() >= np.exp(-4.0) and weights.max() <= 1.0


def test_the_loss_falls_below_chance(learned):
    """Both discriminators know nothing at 2 log 2 for each domain."""
    assert learned[2][-200:].mean() < 0.87 * 4 * np.log(2)


# --- an update ------------------------------------------------------------------------------------------------------


def small_batch(key):
    keys = jax.random.split(key, 3)
    obs, next_obs = (jax.random.normal(k, (6, 2)) for k in keys[:2])
    action = jax.random.uniform(keys[2], (6, 1), minval=-1)
    zero = jnp.zeros(6)
    return Batch(obs, action, zero, zero, next_obs, is_sim=jnp.array([0, 0, 1, 1, 1, 1], bool))


def test_both_domains_count_alike_however_many_rows_each_has(key):
    """Four copies of a simulated row weigh as much as one of them."""
    batch = jax.tree.map(lambda x: x[jnp.array([0, 1, 2, 2, 2, 2])], small_batch(key))
    state = QUIET.init(key)
    copies, alone = (
        QUIET.update(state, batch._replace(valid=jnp.arange(6) < n), key, rate=1e-3)[1]["ratio/loss"] for n in (6, 3)
    )
    assert copies == pytest.approx(float(alone), rel=1e-5)


def gradients(new):
    """Adam's first mean is a tenth of the gradient."""
    return [jax.tree.map(lambda m: 10 * m, optax.tree.get(fit.moments, "mu")) for fit in (new.joint, new.pair)]


@pytest.mark.slow
def test_the_pair_learns_from_both_losses_and_the_joint_from_its_own(key):
    state, batch = QUIET.init(key), small_batch(key)
    new, metrics = QUIET.update(state, batch, key, rate=1e-3)
    joint, pair = (ratio.make_discriminator(n, SMALL.network, bound=2.0) for n in (5, 3))

    def loss(of_joint, of_pair):
        total = 0.0
        for i in range(6):
            s, a, following = batch.obs[i], batch.action[i], batch.next_obs[i]
            d_sa = pair.apply(of_pair, s, a)
            d_sas = joint.apply(of_joint, s, a, following) + d_sa
            label, share = (1, 1 / 4) if i >= 2 else (0, 1 / 2)  # both domains count alike
            total += share * sum(optax.softmax_cross_entropy_with_integer_labels(d, label) for d in (d_sa, d_sas))
        return total

    params = state.joint.params, state.pair.params
    value, expected = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(*params)
    assert metrics["ratio/loss"] == pytest.approx(float(value), rel=1e-5)
    chex.assert_trees_all_close(gradients(new), list(expected), rtol=1e-3, atol=1e-6)


def test_noise_is_there_in_training_alone(key):
    batch, other = small_batch(key), jax.random.key(1)
    batch = batch._replace(valid=jnp.ones(6, bool))
    state = NOISY.init(key)
    steps = [NOISY.update(state, batch, k, rate=1e-3)[1]["ratio/loss"] for k in (key, other)]
    assert steps[0] != steps[1]
    steps = [QUIET.update(state, batch, k, rate=1e-3)[1]["ratio/loss"] for k in (key, other)]
    assert steps[0] == steps[1]
    row = batch.obs[0], batch.action[0], batch.next_obs[0]
    assert NOISY.log_ratio(state, *row) == QUIET.log_ratio(state, *row)


def test_every_part_of_a_row_gets_noise(key):
    """Of the variance that is asked for, and independent."""
    parts = tuple(jnp.zeros(n) for n in (3, 1, 3))
    draw = jax.jit(jax.vmap(lambda k: jnp.concatenate(ratio._with_noise(parts, k, 0.1))))
    seen = np.asarray(draw(jax.random.split(key, 4000)))
    np.testing.assert_allclose(np.cov(seen.T), 0.01 * np.eye(7), atol=1e-3)


def test_standardised_inputs(key):
    """With the statistics of the data, rows in any unit give the same step."""
    statistics = normalizer.Normalizer(jnp.array([3.0, -20.0]), jnp.array([0.1, 10.0]))
    learner, batch = NOISY, small_batch(key)._replace(valid=jnp.ones(6, bool))
    state = learner.init(key)
    to_raw = jax.vmap(lambda z: z * statistics.std + statistics.mean)
    raw = batch._replace(obs=to_raw(batch.obs), next_obs=to_raw(batch.next_obs))
    scaled, (plain, _) = state._replace(normalizer=statistics), learner.update(state, batch, key, rate=1e-3)
    new, _ = learner.update(scaled, raw, key, rate=1e-3)
    chex.assert_trees_all_close(
        (new.joint.moments, new.pair.moments), (plain.joint.moments, plain.pair.moments), atol=1e-5
    )
    chex.assert_trees_all_equal(new.normalizer, statistics)
    row = (learner.log_ratio(s, b.obs[0], b.action[0], b.next_obs[0]) for s, b in ((state, batch), (scaled, raw)))
    assert next(row) == pytest.approx(float(next(row)), abs=1e-4)


def test_invalid_rows_do_not_count_and_origin_is_needed(key):
    learner, batch = NOISY, small_batch(key)
    state, valid = learner.init(key), jnp.array([1, 0, 1, 1, 0, 1], bool)
    other = batch._replace(obs=jnp.where(valid[:, None], batch.obs, 7.0))
    one, two = (learner.update(state, b._replace(valid=valid), key, rate=1e-3) for b in (batch, other))
    chex.assert_trees_all_equal(one, two)
    with pytest.raises(UserError, match="which rows are simulated"):
        learner.update(state, batch._replace(is_sim=None), key, rate=1e-3)


def test_real_and_simulated_are_not_exchanged(key):
    """A few steps on rows that only s' tells apart: the ratio of real rows rises, that of simulated ones falls."""
    learner = NOISY
    batch = small_batch(key)._replace(valid=jnp.ones(6, bool))
    batch = batch._replace(next_obs=jnp.where(batch.is_sim[:, None], 2.0, -2.0) * jnp.ones((6, 2)))
    state = start = learner.init(key)
    for i in range(50):
        state, _ = learner.update(state, batch, jax.random.fold_in(key, i), rate=1e-2)
    each = jax.jit(jax.vmap(learner.log_ratio, (None, 0, 0, 0)))
    gained = each(state, *batch[:2], batch.next_obs) - each(start, *batch[:2], batch.next_obs)
    assert jnp.all(gained[:2] > 1) and jnp.all(gained[2:] < -1)
