"""IQL: losses by hand, problems whose answers tell it from other methods. See also test_contract_learners.py."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import compiled_once

from sgft_jax.learners import iql
from sgft_jax.models import networks, normalizer
from sgft_jax.types import Batch

f = jnp.float32

# --- losses by hand -------------------------------------------------------------------------------------------------


def test_advantage_weight_by_hand_and_its_cap():
    def weight(q, beta):
        return iql.advantage_weight(f(1.0), f(q), beta=beta, max_weight=100.0)

    assert weight(2.0, 3.0) == pytest.approx(np.exp(3), rel=1e-6)
    assert weight(0.5, 3.0) == pytest.approx(np.exp(-1.5), rel=1e-6)
    assert weight(2.5, 3.0) == pytest.approx(np.exp(4.5), rel=1e-6)  # 90
    assert weight(2.6, 3.0) == 100.0  # exp(4.8) = 122
    assert weight(1000.0, 3.0) == 100.0  # exp overflows
    assert weight(1000.0, 0.0) == 1.0
    grad = jax.grad(lambda q: iql.advantage_weight(f(1.0), q, beta=3.0, max_weight=100.0))(f(1.5))
    assert grad == 0.0


def test_gaussian_log_prob_is_the_density():
    # ((1 - 0) / 1)^2 and ((0 - 0.5) / 0.5)^2: -1/2 - 1/2 - log 0.5 - log 2 pi
    moments = jnp.array([[0.0, 0.5], [0.0, np.log(0.5)]])
    expected = -1 + np.log(2) - np.log(2 * np.pi)
    assert iql.gaussian_log_prob(moments, jnp.array([1.0, 0.0])) == pytest.approx(expected, rel=1e-6)
    grid = np.linspace(-3, 3, 3001, dtype=np.float32)
    log_prob = jax.jit(jax.vmap(iql.gaussian_log_prob, (None, 0)))(jnp.array([[0.3], [-1.0]]), grid[:, None])
    density = np.exp(log_prob)
    mean, std = 0.3, np.exp(-1)
    brute = np.exp(-((grid - mean) ** 2) / (2 * std**2)) / np.sqrt(2 * np.pi * std**2)
    np.testing.assert_allclose(density, brute, rtol=1e-4, atol=1e-7)
    assert np.sum(density) * 0.002 == pytest.approx(1.0, abs=1e-4)


def test_policy_loss_by_hand():
    moments, log_2pi = jnp.array([[0.5], [0.0]]), np.log(2 * np.pi)
    # -2 * (-0.5 * 0.25 - 0.5 log 2 pi)
    assert iql.policy_loss(moments, jnp.zeros(1), f(2.0)) == pytest.approx(0.25 + log_2pi, rel=1e-6)
    for sign in (-1, 1):  # an action on the bound counts as the one just inside
        narrow = jnp.array([[sign * 0.999], [-5.0]])
        inside = iql.gaussian_log_prob(narrow, jnp.array([sign * (1 - 1e-5)]))
        on_bound = iql.gaussian_log_prob(narrow, jnp.array([sign * 1.0]))
        assert iql.policy_loss(narrow, jnp.array([sign * 1.0]), f(1.0)) == -inside != -on_bound


def test_td_target_by_hand():
    assert iql.td_target(f(2.0), f(0.9), f(10.0), reward_scale=0.5) == 10.0
    assert iql.td_target(f(2.0), f(0.0), f(10.0), reward_scale=0.5) == 1.0  # terminated
    assert jax.grad(lambda v: iql.td_target(f(2.0), f(0.9), v, reward_scale=0.5))(f(10.0)) == 0.0


def test_losses_refuse_a_batch():
    with pytest.raises(AssertionError):
        iql.advantage_weight(f(1.0), jnp.ones(3), beta=3.0, max_weight=100.0)
    with pytest.raises(AssertionError):
        iql.td_target(f(1.0), f(0.9), jnp.ones(2), reward_scale=1.0)


# --- problems with known answers ------------------------------------------------------------------------------------

NET = networks.NetworkConfig(hidden=(32,))
LEARNER = iql.make_iql(iql.IQLConfig(1, 1, network=NET))
CRITIC, VALUE, ACTOR = networks.make_critic(1, 1, NET), networks.make_value(1, NET), iql.make_gaussian_actor(1, 1, NET)
FAST = iql.IQLHyper(lr_actor=3e-3, lr_critic=1e-2, lr_value=1e-2, tau=0.1)
ROWS = 64
HALF = jnp.arange(ROWS) % 2  # two states, 0 and 1


@jax.jit
def train(batch, hyper, key):
    """The agent after 1000 updates on one batch, and the metrics of the last; compiled once for all of them."""
    state = LEARNER.init(key).replace(hyper=jax.tree.map(f, hyper))
    state, metrics = jax.lax.scan(lambda s, _: LEARNER.update(s, batch, key), state, length=1000)
    return state, jax.tree.map(lambda m: m[-1], metrics)


def rows(obs, action, reward, discount, *, next_obs=None):
    """[ROWS] numbers, or one for all, as a batch."""
    obs, action, reward, discount = (jnp.broadcast_to(f(x), ROWS) for x in (obs, action, reward, discount))
    return Batch(
        obs=obs[:, None],
        action=action[:, None],
        reward=reward,
        discount=discount,
        next_obs=(obs if next_obs is None else jnp.broadcast_to(f(next_obs), ROWS))[:, None],
    )


def two_actions():
    """One state: every fourth action is 0.5 and pays 1, the others are -0.5 and pay nothing."""
    good = jnp.arange(ROWS) % 4 == 0
    return rows(0.5, jnp.where(good, 0.5, -0.5), good, 0.0)


def q_of(state, obs, action=0.0):
    return CRITIC.apply(state.critic.params, jnp.array([obs]), jnp.array([action]))


def v_of(state, obs):
    return float(VALUE.apply(state.value.params, jnp.array([obs])))


def policy_of(state, obs):
    mean, log_std = ACTOR.apply(state.actor.params, jnp.array([obs]))
    return float(mean[0]), float(jnp.exp(log_std[0]))


@pytest.mark.heavy
@pytest.mark.parametrize(("expectile", "expected"), [(0.5, 0.25), (0.9, 0.75), (0.99, 0.97)])
def test_probe_value_goes_from_the_mean_of_the_data_to_its_best(key, expectile, expected):
    """V solves expectile * 1/4 * (1 - V) = (1 - expectile) * 3/4 * V."""
    state, _ = train(two_actions(), FAST._replace(expectile=expectile), key)
    assert v_of(state, 0.5) == pytest.approx(expected, abs=0.01)
    np.testing.assert_allclose(q_of(state, 0.5, 0.5), 1.0, atol=0.01)
    np.testing.assert_allclose(q_of(state, 0.5, -0.5), 0.0, atol=0.01)


@pytest.mark.heavy
@pytest.mark.parametrize(("beta", "max_weight", "saturated"), [(0.0, 100.0, 0.0), (3.0, 100.0, 0.0), (3.0, 4.0, 0.25)])
def test_probe_policy_is_the_weighted_gaussian_of_the_data(key, beta, max_weight, saturated):
    """Its mean and std are those of the actions, the good one counting exp(beta), or the cap, times the other's 3.

    beta = 0 clones: mean -0.25, std 0.43. beta = 3 finds the better one: mean 0.37.
    """
    hyper = FAST._replace(expectile=0.5, beta=beta, max_weight=max_weight)
    state, metrics = train(two_actions(), hyper, key)
    good, bad = min(np.exp(beta * 0.75), max_weight), 3 * np.exp(beta * -0.25)  # V = 0.25
    mean = 0.5 * (good - bad) / (good + bad)
    np.testing.assert_allclose(policy_of(state, 0.5), (mean, np.sqrt(0.25 - mean**2)), atol=0.01)
    assert metrics["actor/weight_saturated_share"] == saturated
    assert metrics["actor/advantage_mean"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.heavy
def test_probe_actions_outside_the_data_are_never_used(key):
    """State 0 leads to state 1, where a in [-1, 0] was tried and paid 4 a: the critic thinks the untried a = 1 pays 4.

    Q there is uniform in [-4, 0], whose 0.9-expectile is -4 (1 - 3/4) = -1, so Q(0) = -0.9; a maximum over all actions
    would put it at 3.6. The policy stays among the tried ones, weighted by exp(3 * 4 a).
    """
    tried = jnp.repeat(jnp.linspace(-1, 0, ROWS // 2), 2)
    batch = rows(HALF, tried, 4 * tried * HALF, jnp.where(HALF == 0, 0.9, 0.0), next_obs=1.0)
    state, _ = train(batch, FAST._replace(expectile=0.9), key)
    assert jnp.min(q_of(state, 1.0, 1.0)) > 2  # the trap is there
    assert v_of(state, 1.0) == pytest.approx(-1.0, abs=0.1)
    np.testing.assert_allclose(q_of(state, 0.0, -0.5), -0.9, atol=0.1)
    assert policy_of(state, 1.0)[0] == pytest.approx(np.average(tried, weights=np.exp(12 * tried)), abs=0.05)


# --- contract -------------------------------------------------------------------------------------------------------

CLIP = 0.05
CONFIG = iql.IQLConfig(3, 2, network=networks.NetworkConfig((8,)), max_grad_norm=CLIP)
SMALL = iql.make_iql(CONFIG, iql.IQLHyper(lr_actor=1e-2))
SMALL = compiled_once(SMALL)
SMALL_CRITIC, SMALL_VALUE = networks.make_critic(3, 2, CONFIG.network), networks.make_value(3, CONFIG.network)


@jax.jit
def batch_of(key):
    n, keys = 16, jax.random.split(key, 5)
    return Batch(
        obs=jax.random.normal(keys[0], (n, 3)),
        action=jax.random.uniform(keys[1], (n, 2), minval=-1),
        reward=jax.random.normal(keys[2], (n,)),
        discount=jnp.where(jax.random.bernoulli(keys[3], 0.2, (n,)), 0.0, 0.99),
        next_obs=jax.random.normal(keys[4], (n, 3)),
    )


def equal(a, b):
    return all(jnp.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def with_hyper(state, **numbers):
    return state.replace(hyper=state.hyper._replace(**{name: f(x) for name, x in numbers.items()}))


def with_log_std(state, log_std):
    params = {**state.actor.params, "log_std": jnp.full(2, f(log_std))}
    return state.replace(actor=state.actor._replace(params=params))


@pytest.mark.heavy
def test_every_network_moves_and_statistics_do_not(key):
    state = SMALL.init(key)
    new, metrics = SMALL.update(state, batch_of(key), key)
    for name in ("actor", "critic", "value"):
        assert not equal(getattr(state, name).params, getattr(new, name).params), name
    assert equal(state.normalizer, new.normalizer) and equal(state.hyper, new.hyper) and new.step == 1
    assert {"critic/loss", "critic/q_mean", "value/loss", "value/mean", "actor/loss"} <= set(metrics)
    assert all(jnp.shape(m) == () and jnp.isfinite(m) for m in metrics.values())
    assert equal(new, SMALL.update(state, batch_of(key), jax.random.key(1))[0])  # nothing is drawn


def test_order_of_the_update(key):
    """The value sees the old target critic, actor and critic the new value, and the actor the target critic."""
    state, batch = SMALL.init(key), batch_of(key)
    state = state.replace(target_critic=SMALL.init(jax.random.key(1)).target_critic)
    state = with_hyper(state, lr_value=0.1, reward_scale=2.0)  # a new value that is easy to tell from the old
    new, metrics = SMALL.update(state, batch, key)

    @jax.jit
    def expected():
        q = jnp.min(jax.vmap(SMALL_CRITIC.apply, (None, 0, 0))(state.target_critic, batch.obs, batch.action), axis=1)
        value = jax.vmap(SMALL_VALUE.apply, (None, 0))
        error = q - value(state.value.params, batch.obs)
        return {
            "value/loss": jnp.mean(jnp.where(error < 0, 0.3, 0.7) * error**2),
            "actor/advantage_mean": jnp.mean(q - value(new.value.params, batch.obs)),
            "critic/target_mean": jnp.mean(2 * batch.reward + batch.discount * value(new.value.params, batch.next_obs)),
        }

    for name, number in expected().items():
        assert metrics[name] == pytest.approx(float(number), rel=1e-4), name


def test_gradients_are_clipped_by_network(key):
    new, _ = SMALL.update(SMALL.init(key), batch_of(key), key)
    for name in ("actor", "critic", "value"):  # Adam's first mean is a tenth of the gradient
        mean = jax.tree.leaves(optax.tree.get(getattr(new, name).moments, "mu"))
        norm = np.linalg.norm(np.concatenate([np.ravel(x) for x in mean]))
        assert norm == pytest.approx(0.1 * CLIP, rel=1e-4), name


def test_target_critic_follows_at_rate_tau(key):
    state = with_hyper(SMALL.init(key), tau=0.25)
    assert equal(state.target_critic, state.critic.params)
    new, _ = SMALL.update(state, batch_of(key), key)
    mix = jax.tree.map(lambda t, c: 0.75 * t + 0.25 * c, state.target_critic, new.critic.params)
    chex.assert_trees_all_close(new.target_critic, mix, rtol=1e-6)


def test_observations_are_normalised_everywhere(key):
    state, batch = SMALL.init(key), batch_of(key)
    statistics = normalizer.Normalizer(jnp.array([1.0, 2, 3]), jnp.array([2.0, 1, 0.5]))
    other = state.replace(normalizer=statistics)
    to_raw = jax.vmap(lambda z: z * statistics.std + statistics.mean)
    raw = batch._replace(obs=to_raw(batch.obs), next_obs=to_raw(batch.next_obs))
    (_, plain), (_, scaled) = SMALL.update(state, batch, key), SMALL.update(other, raw, key)
    chex.assert_trees_all_close(plain, scaled, rtol=1e-4, atol=1e-5)
    actions = [SMALL.act(s, (), x.obs[0], key, explore=False)[0] for s, x in ((state, batch), (other, raw))]
    np.testing.assert_allclose(*actions, rtol=1e-4)


@pytest.mark.parametrize(("step", "factor"), [(0, 1.0), (25, 0.85355339), (50, 0.5), (100, 0.0), (130, 0.0)])
def test_the_actors_rate_falls_along_half_a_cosine(step, factor, key):
    """Of 100 updates; the rates of critic and value stay. (1 + cos(pi / 4)) / 2 = .854."""
    state, batch = SMALL.init(key), batch_of(key)
    still, metrics = SMALL.update(state, batch, key)
    assert metrics["actor/lr"] == f(1e-2)  # nothing falls unless it is told to
    falling = with_hyper(state, actor_updates=100).replace(step=jnp.int32(step))
    new, metrics = SMALL.update(falling, batch, key)
    assert metrics["actor/lr"] == pytest.approx(1e-2 * factor, abs=1e-9)
    assert equal((still.critic, still.value), (new.critic, new.value))

    def way(end):
        return jax.tree.map(jnp.subtract, end.actor.params, state.actor.params)

    chex.assert_trees_all_close(way(new), jax.tree.map(lambda x: factor * x, way(still)), atol=1e-6)


def test_reward_scale_multiplies_rewards(key):
    state, batch = SMALL.init(key), batch_of(key)
    scaled = SMALL.update(with_hyper(state, reward_scale=4.0), batch, key)[0]
    paid = SMALL.update(state, batch._replace(reward=4 * batch.reward), key)[0]
    assert equal(scaled.critic, paid.critic) and not equal(scaled.critic, SMALL.update(state, batch, key)[0].critic)


def test_log_std_stays_in_bounds_and_can_leave_them(key):
    state, batch = SMALL.init(key), batch_of(key)
    mode = jax.vmap(lambda obs: SMALL.act(state, (), obs, key, explore=False)[0])(batch.obs)
    certain = batch._replace(action=mode)  # data without spread: the density grows without bound as std shrinks

    def after(log_std, batch):
        return SMALL.update(with_log_std(state, log_std), batch, key)[0].actor.params["log_std"]

    np.testing.assert_array_equal(after(-5.0, certain), -5.0)
    np.testing.assert_array_equal(after(9.0, batch), 2.0)
    np.testing.assert_allclose(after(-5.0, batch), -5.0 + 1e-2, rtol=1e-4)  # Adam's first step has length lr


def test_act_draws_around_the_mode_within_bounds(key):
    state, obs = with_log_std(SMALL.init(key), -3.0), jnp.array([0.1, -0.2, 0.3])
    draw = jax.jit(jax.vmap(lambda s, k: SMALL.act(s, (), obs, k, explore=True)[0], (None, 0)))
    narrow, wide = (np.asarray(draw(s, jax.random.split(key, 4000))) for s in (state, with_log_std(state, 2.0)))
    mode, carry = SMALL.act(state, (), obs, key, explore=False)
    assert carry == () and equal(mode, SMALL.act(state, (), obs, jax.random.key(1), explore=False)[0])
    np.testing.assert_allclose(np.mean(narrow, axis=0), mode, atol=5e-3)
    np.testing.assert_allclose(np.std(narrow, axis=0), np.exp(-3), rtol=0.05)
    assert np.min(wide) == -1 and np.max(wide) == 1


def test_update_is_traced_once_whatever_the_numbers(key):
    """SMALL.update raises at a second trace."""
    state = SMALL.init(key)
    for step in range(3):
        state, _ = SMALL.update(state, batch_of(jax.random.fold_in(key, step)), jax.random.fold_in(key, step))
        state = with_hyper(state, beta=1.0, lr_actor=1e-4)  # from the offline phase to fine-tuning
        state = state.replace(normalizer=normalizer.Normalizer(jnp.ones(3), 2 * jnp.ones(3)))
    assert state.step == 3


def test_a_fresh_state_can_be_donated(key):
    """No leaf is another one's buffer."""
    leaves = jax.make_jaxpr(iql.make_iql(CONFIG).init)(key).jaxpr.outvars
    assert len({id(leaf) for leaf in leaves}) == len(leaves)
