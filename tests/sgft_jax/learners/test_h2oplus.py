"""H2O+: targets by hand, which rows move what and in which order. See also test_contract_learners.py."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import compiled_once, make_ratio

from envs.types import UserError
from sgft_jax.learners import edac, h2oplus
from sgft_jax.models import networks, normalizer, ratio
from sgft_jax.types import Batch

pytestmark = pytest.mark.heavy  # all of them compile

f = jnp.float32
BODY = networks.NetworkConfig((16,))
ROWS = 12
CONFIG = h2oplus.H2OPlusConfig(3, 2, network=BODY, ratio_network=BODY)
ACTOR = networks.make_affine_actor(3, 2, BODY, output_gain=0.01)
CRITIC, VALUE = networks.make_critic(3, 2, BODY), networks.make_value(3, BODY)
RATIO = make_ratio(ratio.RatioConfig(3, 2, BODY))


def compiled(config, **numbers):
    learner = h2oplus.make_h2oplus(config, h2oplus.H2OPlusHyper(**numbers))
    return compiled_once(learner)


@pytest.fixture(scope="module")
def learner():
    return compiled(CONFIG)


@pytest.fixture(scope="module")
def plain():
    """Without the ratio, at a fixed temperature."""
    return compiled(h2oplus.H2OPlusConfig(3, 2, network=BODY, ratio=False, tune_alpha=False), alpha=0.1)


def batch_of(key, rows=ROWS):
    """The odd rows are simulated; one row of each origin is terminal."""
    keys = jax.random.split(key, 4)
    obs, next_obs = (jax.random.normal(k, (rows, 3)) for k in keys[:2])
    action = jax.random.uniform(keys[2], (rows, 2), minval=-1)
    discount = jnp.where(jnp.arange(rows) < 2, 0.0, 0.9)
    return Batch(obs, action, jax.random.normal(keys[3], (rows,)), discount, next_obs, is_sim=jnp.arange(rows) % 2 == 1)


def equal(a, b):
    return all(jnp.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def with_hyper(state, **numbers):
    return state.replace(hyper=state.hyper._replace(**{name: f(x) for name, x in numbers.items()}))


def told_apart(learner, key):
    """A state whose target critic, critic and value are three different things, and far from 0."""

    def grown(tree):
        return jax.tree.map(lambda x: 3.0 * jax.random.normal(key, x.shape), tree)

    state = learner.init(key)
    value = state.value._replace(params=grown(state.value.params))
    critic = state.critic._replace(params=jax.tree.map(lambda x: x + 0.3, state.critic.params))
    return state.replace(target_critic=grown(state.target_critic), value=value, critic=critic)


def where_sim(batch, new, old):
    return jnp.where(jnp.expand_dims(batch.is_sim, tuple(range(1, new.ndim))), new, old)


# --- the target -----------------------------------------------------------------------------------------------------


def target(value_share, discount=0.9):
    numbers = (f(1.0), f(discount), f(10.0), jnp.array([9.0, 8.0]), f(-2.0))
    return h2oplus.mixed_target(*numbers, value_share=value_share, alpha=0.1)


def test_the_mixed_target_by_hand():
    """From V: 1 + .9 * 10 = 10; from Q: 1 + .9 (8 + .1 * 2) = 8.38; .1 * 10 + .9 * 8.38 = 8.542."""
    assert target(0.0) == pytest.approx(8.38, rel=1e-6) and target(1.0) == pytest.approx(10.0, rel=1e-6)
    assert target(0.1) == pytest.approx(8.542, rel=1e-6)
    assert target(0.1, discount=0.0) == 1.0  # terminal: nothing follows
    through = jax.grad(lambda v: h2oplus.mixed_target(f(1), f(0.9), v, v[None], v, value_share=0.5, alpha=0.1))
    assert through(f(3.0)) == 0.0


def test_the_target_refuses_a_batch():
    with pytest.raises(AssertionError):
        h2oplus.mixed_target(f(1), f(0.9), jnp.ones(2), jnp.ones(2), f(0), value_share=0.1, alpha=0.1)


def test_share_zero_ignores_the_value_and_share_one_the_policy(plain, key):
    """0 is SAC on both sources, 1 a bootstrap from V alone."""
    batch, other = batch_of(key), jax.random.key(1)
    state = told_apart(plain, key)
    of_v = state.replace(value=state.value._replace(params=jax.tree.map(lambda x: x + 1, state.value.params)))
    # the target critic is asked for actions of the policy, whose draws follow the key
    for share, same, different in ((0.0, of_v, state), (1.0, state, of_v)):
        one, two = (with_hyper(s, value_share=share, lr_actor=0.0) for s in (state, same))
        key_two = key if share == 0.0 else other
        assert equal(plain.update(one, batch, key)[0].critic, plain.update(two, batch, key_two)[0].critic)
        three = with_hyper(different, value_share=share)
        key_three = other if share == 0.0 else key
        assert not equal(plain.update(one, batch, key)[0].critic, plain.update(three, batch, key_three)[0].critic)


# --- one update -----------------------------------------------------------------------------------------------------


def test_every_network_moves_and_statistics_do_not(learner, key):
    state = learner.init(key)
    new, metrics = learner.update(state, batch_of(key), key)
    for name in ("actor", "critic", "value", "log_alpha"):
        assert not equal(getattr(state, name).params, getattr(new, name).params), name
    assert not equal(state.ratio.joint.params, new.ratio.joint.params)
    assert not equal(state.ratio.pair.params, new.ratio.pair.params)
    assert equal(
        (state.normalizer, state.ratio.normalizer, state.hyper), (new.normalizer, new.ratio.normalizer, new.hyper)
    )
    assert new.step == 1 and all(jnp.shape(m) == () and jnp.isfinite(m) for m in metrics.values())


def test_order_and_rows_of_the_update(learner, key):
    """All losses are those of the old networks but for the weights, which the new discriminators give."""
    batch = batch_of(key)
    state = with_hyper(told_apart(learner, key), lr_ratio=0.1, lr_value=0.1, lr_critic=0.1, lr_actor=0.1, lr_alpha=0.1)
    new, metrics = learner.update(state, batch, key)
    real, sim = np.arange(0, ROWS, 2), np.arange(1, ROWS, 2)

    q_data = jax.vmap(CRITIC.apply, (None, 0, 0))(state.target_critic, batch.obs, batch.action).min(axis=1)
    v = jax.vmap(VALUE.apply, (None, 0))(state.value.params, batch.obs)
    error = (q_data - v)[real]
    assert metrics["value/loss"] == pytest.approx(float(jnp.mean(jnp.where(error < 0, 0.3, 0.7) * error**2)), rel=1e-4)
    assert metrics["value/mean"] == pytest.approx(float(v[real].mean()), rel=1e-4)

    log_w = jax.vmap(RATIO.log_ratio, (None, 0, 0, 0))
    weights, old_weights = (
        jnp.exp(jnp.minimum(log_w(s.ratio, batch.obs, batch.action, batch.next_obs), 0)) for s in (new, state)
    )
    assert metrics["ratio/weight_sim"] == pytest.approx(float(weights[sim].mean()), rel=1e-4)
    assert metrics["ratio/weight_real"] == pytest.approx(float(weights[real].mean()), rel=1e-4)
    assert abs(weights[sim].mean() - old_weights[sim].mean()) > 1e-2

    # the policy's draws at the next states follow from the update's third key
    keys = jax.random.split(jax.random.split(key, 3)[2], ROWS)

    def y(row, key):
        action, log_prob = networks.tanh_gaussian_sample(ACTOR.apply(state.actor.params, row.next_obs), key)
        on = CRITIC.apply(state.target_critic, row.next_obs, action).min() - log_prob  # alpha begins at 1
        return row.reward + row.discount * (0.1 * VALUE.apply(state.value.params, row.next_obs) + 0.9 * on)

    targets = jax.vmap(y)(batch, keys)
    assert metrics["critic/target_mean"] == pytest.approx(float(targets.mean()), rel=1e-4)
    q = jax.vmap(CRITIC.apply, (None, 0, 0))(state.critic.params, batch.obs, batch.action)
    squared = jnp.sum((q - targets[:, None] * jnp.ones((1, 2))) ** 2, axis=1)
    assert metrics["critic/real_loss"] == pytest.approx(float(squared[real].mean()), rel=1e-4)
    assert metrics["critic/sim_loss"] == pytest.approx(float((weights * squared)[sim].mean()), rel=1e-4)
    assert metrics["critic/loss"] == pytest.approx(
        float(squared[real].mean() + (weights * squared)[sim].mean()), rel=1e-4
    )

    def of_policy(obs, key):
        action, log_prob = networks.tanh_gaussian_sample(ACTOR.apply(state.actor.params, obs), key)
        return log_prob - CRITIC.apply(state.critic.params, obs, action).min()

    each = jax.vmap(of_policy)(batch.obs, jax.random.split(jax.random.split(key, 3)[1], ROWS))
    assert metrics["actor/loss"] == pytest.approx(float(each.mean()), rel=1e-4)
    mix = jax.tree.map(lambda t, c: 0.995 * t + 0.005 * c, state.target_critic, new.critic.params)
    chex.assert_trees_all_close(new.target_critic, mix, rtol=1e-5)


def test_the_value_learns_from_real_rows_alone_and_the_actor_from_all(plain, key):
    batch, state = batch_of(key), told_apart(plain, key)
    one, _ = plain.update(state, batch, key)
    for name, moved in (("obs", ("actor", "critic")), ("action", ("critic",)), ("reward", ("critic",))):
        field = getattr(batch, name)
        two, _ = plain.update(state, batch._replace(**{name: where_sim(batch, 0.5 * field + 0.1, field)}), key)
        assert equal(one.value, two.value), name
        for part in moved:
            assert not equal(getattr(one, part), getattr(two, part)), (name, part)
    two, _ = plain.update(state, batch._replace(obs=where_sim(batch, batch.obs, batch.obs + 1)), key)
    assert not equal(one.value, two.value)


def test_without_the_ratio_simulated_errors_count_like_real_ones(plain, key):
    state, batch = told_apart(plain, key), batch_of(key)
    assert state.ratio is None
    _, metrics = plain.update(state, batch, key)
    _, swapped = plain.update(state, batch._replace(is_sim=~batch.is_sim), key)
    assert metrics["critic/sim_loss"] == pytest.approx(float(swapped["critic/real_loss"]), rel=1e-5)
    assert metrics["critic/real_loss"] == pytest.approx(float(swapped["critic/sim_loss"]), rel=1e-5)
    assert not [name for name in metrics if name.startswith("ratio/")]


def test_a_fixed_temperature_keeps_its_bits(plain, key):
    state = plain.init(key)
    new, metrics = plain.update(state, batch_of(key), key)
    assert equal(state.log_alpha, new.log_alpha) and metrics["actor/alpha"] == pytest.approx(0.1)


def test_the_temperature_compares_entropies_of_whole_actions(learner, key):
    """At first u ~ N(0, e^-1) in both dimensions: entropy 2 (1/2 log 2 pi e - 1 + E log(1 - tanh(u)^2)) = 0.61.

    Summed over dimensions it meets the target of -2, which is for the whole action.
    """
    u = np.exp(-1) * np.random.default_rng(0).normal(size=200_000)
    entropy = 2 * (0.5 * np.log(2 * np.pi * np.e) - 1 + np.log(1 - np.tanh(u) ** 2).mean())
    new, metrics = learner.update(learner.init(key), batch_of(key), key)
    assert metrics["actor/entropy"] == pytest.approx(entropy, abs=0.6)  # 12 rows, one draw of each
    # d/d log alpha of alpha (entropy - target) at alpha = 1; Adam's first mean is a tenth of it
    grad = 10 * optax.tree.get(new.log_alpha.moments, "mu")
    assert grad == pytest.approx(float(metrics["actor/entropy"]) + 2.0, rel=1e-4)
    assert new.log_alpha.params == pytest.approx(-3e-4, rel=1e-3)  # more certain than it is: the temperature falls


def test_hyperparameters_of_the_start(learner, key):
    state = learner.init(key)
    assert state.log_alpha.params == 0.0 and equal(state.target_critic, state.critic.params)
    obs, action = jax.random.normal(key, (50, 3)), jax.random.uniform(key, (50, 2))
    moments = jax.vmap(ACTOR.apply, (None, 0))(state.actor.params, obs)
    np.testing.assert_allclose(np.exp(moments[:, 1]), np.exp(-1), rtol=0.05)
    assert jnp.abs(moments[:, 0]).max() < 0.05
    assert jnp.abs(jax.vmap(CRITIC.apply, (None, 0, 0))(state.critic.params, obs, action)).max() < 0.1


def test_observations_are_normalised_everywhere(plain, key):
    statistics = normalizer.Normalizer(jnp.array([1.0, 2, 3]), jnp.array([2.0, 1, 0.5]))
    state, batch = plain.init(key), batch_of(key)
    act = jax.jit(plain.act, static_argnames="explore")
    other, to_raw = state.replace(normalizer=statistics), jax.vmap(lambda z: z * statistics.std + statistics.mean)
    raw = batch._replace(obs=to_raw(batch.obs), next_obs=to_raw(batch.next_obs))
    metrics = [plain.update(s, b, key)[1] for s, b in ((state, batch), (other, raw))]
    chex.assert_trees_all_close(*metrics, rtol=1e-4, atol=1e-5)
    actions = [act(s, (), b.obs[0], key, explore=True)[0] for s, b in ((state, batch), (other, raw))]
    np.testing.assert_allclose(*actions, rtol=1e-4)


# --- the discriminators -----------------------------------------------------------------------------------------------


def test_rows_of_the_discriminators_train_nothing_else(key):
    """The last four; and they learn at every update, from no other rows."""
    learner = compiled(h2oplus.H2OPlusConfig(3, 2, network=BODY, ratio_network=BODY, ratio_rows=4))
    batch, late = batch_of(key, ROWS + 4), jnp.arange(ROWS + 4) >= ROWS
    state = learner.init(key)
    one, _ = learner.update(state, batch, key)
    rewards, _ = learner.update(state, batch._replace(reward=jnp.where(late, 9.0, batch.reward)), key)
    assert equal(one, rewards)
    moved = batch._replace(next_obs=batch.next_obs + late[:, None])
    two, _ = learner.update(state, moved, key)
    assert not equal(one.ratio, two.ratio) and equal((one.value, one.actor), (two.value, two.actor))
    early, _ = learner.update(state, batch._replace(next_obs=batch.next_obs + ~late[:, None]), key)
    assert equal(one.ratio, early.ratio) and not equal(one.critic, early.critic)
    for i in range(3):
        one, _ = learner.update(one, batch, jax.random.fold_in(key, i))
    assert [int(optax.tree.get(fit.moments, "count")) for fit in (one.ratio.joint, one.ratio.pair)] == [4, 4]
    few = h2oplus.make_h2oplus(h2oplus.H2OPlusConfig(3, 2, network=BODY, ratio_network=BODY, ratio_rows=4))
    with pytest.raises(UserError, match="option ratio-rows is 4: must be less than the batch, 4"):
        jax.eval_shape(lambda: few.update(few.init(key), batch_of(key, 4), key))


def test_the_weights_follow_what_the_simulator_gets_wrong(learner, key):
    """Simulated rows that land elsewhere lose their weight, those that land where real ones do keep more of it."""
    seen = []
    for shift in (0.0, 4.0):
        state = with_hyper(learner.init(key), lr_ratio=1e-2)
        for i in range(60):
            batch = batch_of(jax.random.fold_in(key, i))
            batch = batch._replace(next_obs=batch.obs + 0.3 * batch.next_obs + shift * batch.is_sim[:, None])
            state, metrics = learner.update(state, batch, jax.random.fold_in(key, i))
        seen.append(float(metrics["ratio/weight_sim"]))
    assert seen[1] < 0.2 < 0.5 < seen[0]


def test_origin_is_needed(learner, key):
    with pytest.raises(UserError, match="which rows are simulated"):
        jax.eval_shape(h2oplus.make_h2oplus(CONFIG).update, learner.init(key), batch_of(key)._replace(is_sim=None), key)


# --- the ensemble -----------------------------------------------------------------------------------------------------


def test_diversity_counts_the_gradients_of_the_real_pairs_alone(key):
    """Half of their mean alignment joins the loss, and what pulls them apart moves the critics and nothing else."""
    body = {"network": BODY, "ratio": False, "tune_alpha": False, "critics": 3}
    learners = [h2oplus.make_h2oplus(h2oplus.H2OPlusConfig(3, 2, **body, diversity=d)) for d in (0.0, 0.5)]
    state, batch = learners[0].init(key), batch_of(key)
    critic = networks.make_critic(3, 2, BODY, members=3)
    (without, _), (apart, metrics) = (jax.jit(learner.update)(state, batch, key) for learner in learners)
    grads = jax.vmap(jax.jacrev(lambda o, a: critic.apply(state.critic.params, o, a), 1))(batch.obs, batch.action)
    expected = 0.5 * np.mean([edac.alignment(g) for g in grads[::2]])
    assert metrics["critic/penalty"] == pytest.approx(expected, rel=1e-4)
    total = metrics["critic/real_loss"] + metrics["critic/sim_loss"] + metrics["critic/penalty"]
    assert metrics["critic/loss"] == pytest.approx(float(total), rel=1e-5)
    assert not equal(without.critic, apart.critic)
    assert equal((without.actor, without.value), (apart.actor, apart.value))


def test_the_cut_off_is_a_number_of_the_agent(key):
    """Exponents that end at 0.5 give another value loss than those that end at 7."""
    config = h2oplus.H2OPlusConfig(3, 2, network=BODY, ratio=False, tune_alpha=False, value_loss="xql")
    learner, batch = compiled(config), batch_of(key)
    state = told_apart(learner, key)
    far, near = (learner.update(with_hyper(state, value_cut=cut), batch, key)[1]["value/loss"] for cut in (7.0, 0.5))
    assert abs(far - near) > 0.01


# --- learning -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("backbone", ["iql", "sql", "eql", "xql"])
def test_losses_fall_on_a_fixed_batch(backbone, key):
    config = h2oplus.H2OPlusConfig(
        3, 2, network=BODY, ratio_network=BODY, value_loss=backbone, tune_alpha=False, ratio_noise=0.0
    )
    numbers = {"lr_critic": 1e-2, "lr_value": 1e-2, "lr_ratio": 1e-2, "alpha": 1e-3}
    learner, batch = h2oplus.make_h2oplus(config, h2oplus.H2OPlusHyper(**numbers)), batch_of(key)
    fit = jax.jit(lambda s: jax.lax.scan(lambda s, k: learner.update(s, batch, k), s, jax.random.split(key, 600)))
    state, metrics = fit(learner.init(key))
    first, last = (jax.tree.map(lambda m, i=i: float(m[i]), metrics) for i in (0, -1))
    assert last["critic/loss"] < 0.1 * first["critic/loss"]
    assert last["ratio/loss"] < 0.6 * first["ratio/loss"]
    q = jax.vmap(CRITIC.apply, (None, 0, 0))(state.target_critic, batch.obs, batch.action).min(axis=1)[::2]
    v = jax.vmap(VALUE.apply, (None, 0))(state.value.params, batch.obs)[::2]
    np.testing.assert_allclose(v, q, atol=0.25)  # every state has one action: its V is that action's Q
    assert np.corrcoef(v, q)[0, 1] > 0.98


@pytest.mark.slow
@pytest.mark.parametrize(("with_ratio", "expected"), [(False, 0.45), (True, 0.02)])
def test_the_ratio_keeps_a_wrong_simulator_from_misleading(with_ratio, expected, key):
    """From 0 the real system goes to 1, which pays nothing, the simulator to 2, which pays 1; both end there.

    Q at 0 minimises (Q - 0)^2 + w (Q - .9)^2: .9 w / (1 + w), with w = 1 or e^-4.
    """
    s = jnp.tile(jnp.array([0.0, 0.0, 1.0, 2.0]), 8)
    is_sim = jnp.tile(jnp.array([False, True, False, True]), 8)
    following = jnp.where(s == 0, 1.0 + is_sim, s)
    action = jax.random.uniform(key, (32, 1), minval=-1)
    batch = Batch(s[:, None], action, 1.0 * (s == 2), 0.9 * (s == 0), following[:, None], is_sim=is_sim)
    config = h2oplus.H2OPlusConfig(1, 1, network=BODY, ratio_network=BODY, ratio=with_ratio, tune_alpha=False)
    numbers = h2oplus.H2OPlusHyper(lr_critic=1e-2, lr_value=1e-2, lr_ratio=1e-2, tau=0.1, alpha=1e-4)
    learner = h2oplus.make_h2oplus(config, numbers)
    fit = jax.jit(lambda s: jax.lax.scan(lambda s, k: learner.update(s, batch, k), s, jax.random.split(key, 1000))[0])
    params = fit(learner.init(key)).critic.params
    q = jax.vmap(networks.make_critic(1, 1, BODY).apply, (None, None, 0))(params, jnp.zeros(1), action)
    np.testing.assert_allclose(q.mean(axis=0), expected, atol=0.08)


def test_options_are_checked():
    with pytest.raises(UserError, match="value loss: there is no 'expectile'"):
        h2oplus.H2OPlusConfig(3, 2, value_loss="expectile")
    with pytest.raises(UserError, match="option critics is 0"):
        h2oplus.H2OPlusConfig(3, 2, critics=0)
    with pytest.raises(UserError, match="option critics is 1: must be at least 2, or diversity 0"):
        h2oplus.H2OPlusConfig(3, 2, critics=1, diversity=1.0)


# --- buffers ----------------------------------------------------------------------------------------------------------


def test_a_fresh_state_can_be_donated(key):
    """No leaf is another one's buffer."""
    leaves = jax.make_jaxpr(h2oplus.make_h2oplus(CONFIG).init)(key).jaxpr.outvars
    assert len({id(leaf) for leaf in leaves}) == len(leaves)
