"""The transforms: telescoping, brute-force H-step targets, branches, relabelled rows, weights, composition."""

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import UserError
from sgft_jax import transforms as sgft
from sgft_jax.math import losses
from sgft_jax.models import ratio
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.types import Batch, Imagination, Normalizer

GAMMA = 0.9


def imagination(**changes):
    """A world on a line: the action moves the state, V(s) = s^2 / 10, the episode ends beyond 3."""
    line = Imagination(
        value=lambda obs: obs[0] ** 2 / 10,
        policy=lambda obs, context, key: jnp.ones(1),
        dynamics=lambda obs, action, key: obs + action,
        reward=lambda obs, action, next_obs: -next_obs[0],
        terminated=lambda obs, action, next_obs: next_obs[0] > 3,
        gamma=GAMMA,
    )
    return line._replace(**changes)


def told(k, horizon):
    """Contexts [n, horizon] that say k [n] steps are left."""
    return jax.vmap(sgft.steps_to_go, (0, None))(jnp.asarray(k), horizon)


def left(context):
    """What contexts say [n]."""
    return (context @ jnp.arange(1.0, context.shape[1] + 1)).astype(int)


def run(transform, imagination, batch, key):
    """A transform that does not learn, applied to a batch."""
    return jax.jit(lambda batch, key: transform.apply(transform.init(None, key), imagination, batch, key))(batch, key)


def batch_of(obs, next_obs, reward, discount=None, steps_to_go=None, horizon=3):
    """steps_to_go: [n] of a segment of `horizon` steps that the rows belong to already."""
    n = len(reward)
    context = None if steps_to_go is None else told(steps_to_go, horizon)
    return Batch(
        obs=jnp.asarray(obs, jnp.float32).reshape(n, -1),
        action=jnp.zeros((n, 1)),
        reward=jnp.asarray(reward, jnp.float32),
        discount=jnp.full(n, GAMMA) if discount is None else jnp.asarray(discount, jnp.float32),
        next_obs=jnp.asarray(next_obs, jnp.float32).reshape(n, -1),
        context=context,
        next_context=context,
    )


# --- shape ------------------------------------------------------------------------------------------------------------


def test_shaped_reward_by_hand(key):
    # 1 + 0.9 * 0.4 - 0.1 = 1.26; terminated: 1 + 0 - 0.1 = 0.9
    out = run(sgft.shape, imagination(), batch_of([1, 1], [2, 2], [1, 1], [GAMMA, 0]), key)
    np.testing.assert_allclose(out.reward, [1.26, 0.9], rtol=1e-6)
    assert out.discount.tolist() == pytest.approx([GAMMA, 0])  # shaping alone shortens nothing


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("horizon", [1, 2, 5, 40])
@pytest.mark.parametrize("seed", range(3))
def test_shaped_rewards_telescope(horizon, seed):
    """sum gamma^t r_bar_t = sum gamma^t r_t + gamma^H V(s_H) - V(s_0) for any trajectory."""
    keys = jax.random.split(jax.random.key(seed), 2)
    states, rewards = jax.random.normal(keys[0], (horizon + 1,)), jax.random.normal(keys[1], (horizon,))
    shaped = run(sgft.shape, imagination(), batch_of(states[:-1], states[1:], rewards), keys[0]).reward
    powers = GAMMA ** jnp.arange(horizon)
    potential = GAMMA**horizon * states[-1] ** 2 / 10 - states[0] ** 2 / 10
    np.testing.assert_allclose(jnp.sum(powers * shaped), jnp.sum(powers * rewards) + potential, atol=1e-5)


def test_expected_shaped_reward_is_zero_where_the_value_is_exact():
    """The TD identity: under the simulator's dynamics and policy, E[r + gamma V(s') - V(s)] = 0 in every state."""
    rng = np.random.default_rng(0)
    chain = rng.dirichlet(np.ones(4), size=4)  # p(s' | s) under the policy
    rewards = rng.normal(size=4)  # of arriving
    v = jnp.asarray(np.linalg.solve(np.eye(4) - GAMMA * chain, chain @ rewards), jnp.float32)
    tabular = imagination(value=lambda obs: v[obs[0].astype(int)])
    s, s_next = (x.ravel() for x in np.meshgrid(np.arange(4), np.arange(4), indexing="ij"))
    shaped = run(sgft.shape, tabular, batch_of(s, s_next, rewards[s_next]), jax.random.key(0)).reward
    np.testing.assert_allclose((chain * np.asarray(shaped).reshape(4, 4)).sum(axis=1), 0, atol=1e-5)


# --- shorten ----------------------------------------------------------------------------------------------------------


def test_horizon_one_target_is_the_shaped_reward_to_the_bit(key):
    raw = batch_of(jax.random.normal(key, (64,)), jax.random.normal(key, (64,)) + 1, jnp.linspace(-1, 1, 64))
    shaped = run(sgft.shape, imagination(), raw, key)
    short = run(sgft.shorten(1), imagination(), shaped, key)
    next_q = 1e3 * jax.random.normal(key, (64, 2))
    target = jax.vmap(lambda r, d, q: losses.td_target(r, d, q, jnp.float32(7), alpha=0.5))
    assert jnp.array_equal(target(short.reward, short.discount, next_q), shaped.reward)
    assert short.context is None and jnp.array_equal(short.next_obs, raw.next_obs)


def test_shorten_tells_the_steps_to_go(key):
    out = run(sgft.shorten(3), imagination(), batch_of([7, 7, 7], [8, 8, 8], [0, 0, 0], steps_to_go=[3, 2, 1]), key)
    assert out.context.tolist() == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    assert out.next_context.tolist() == [[0, 1, 0], [1, 0, 0], [0, 0, 0]]
    assert out.obs[:, 0].tolist() == [7, 7, 7] and out.next_obs[:, 0].tolist() == [8, 8, 8]
    assert out.discount.tolist() == pytest.approx([GAMMA, GAMMA, 0])


@pytest.mark.heavy
def test_shorten_draws_missing_steps_to_go_uniformly(key):
    n = 6000
    raw = batch_of(np.zeros(n), np.zeros(n), np.zeros(n), steps_to_go=[0] * (n - 1) + [2])
    out = run(sgft.shorten(3), imagination(), raw, key)
    counts = jnp.bincount(left(out.context), length=5)
    assert counts[0] == 0 and counts[4] == 0 and left(out.context)[-1] == 2
    assert jnp.all(jnp.abs(counts[1:4] - 2000) < 190)  # 5 standard deviations: sqrt(6000 * 1/3 * 2/3) = 37
    assert jnp.array_equal(out.discount == 0, left(out.context) == 1)


def test_shorten_keeps_termination(key):
    out = run(sgft.shorten(3), imagination(), batch_of([1], [2], [0], discount=[0], steps_to_go=[3]), key)
    assert out.discount[0] == 0


@pytest.mark.parametrize("horizon", [1, 2, 3])
def test_targets_equal_brute_force_on_a_tabular_problem(horizon):
    """Iterating the transformed targets gives the best H-step plan: Q_k = r_bar + gamma 1{k>1} max Q_{k-1}."""
    states, actions = 4, 2
    rng = np.random.default_rng(horizon)
    successor = rng.integers(states, size=(states, actions))
    reward = rng.normal(size=states).astype(np.float32)  # of arriving
    v = rng.normal(size=states).astype(np.float32)

    def plan_return(s, plan):
        total, start = 0.0, s
        for t, a in enumerate(plan):
            s = successor[s, a]
            total += GAMMA**t * reward[s]
        return total + GAMMA ** len(plan) * v[s] - v[start]

    best = [max(plan_return(s, p) for p in itertools.product(range(actions), repeat=horizon)) for s in range(states)]

    tabular = imagination(value=lambda obs: jnp.asarray(v)[obs[0].astype(int)])
    rows = list(itertools.product(range(states), range(actions), range(1, horizon + 1)))
    s, a, k = np.array(rows).T
    raw = batch_of(s, successor[s, a], reward[successor[s, a]], steps_to_go=k, horizon=horizon)
    transform = sgft.compose(sgft.shape, sgft.shorten(horizon))
    batch = jax.tree.map(np.asarray, run(transform, tabular, raw, jax.random.key(0)))

    def read(obs, context, i):
        """State and steps to go of row i as a learner sees them."""
        return int(obs[i, 0]), (1 if horizon == 1 else int(context[i] @ np.arange(1, horizon + 1)))

    q = np.zeros((states, horizon + 1, actions))
    for _ in range(horizon):
        for i, action in enumerate(a):
            best_next = q[read(batch.next_obs, batch.next_context, i)].max()
            q[(*read(batch.obs, batch.context, i), action)] = batch.reward[i] + batch.discount[i] * best_next
    np.testing.assert_allclose(q[:, horizon].max(axis=1), best, atol=1e-5)


# --- branch -----------------------------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_branches_follow_the_real_rows(key):
    raw = batch_of([0, 10], [0.5, 10.5], [5, 6])
    line = imagination(terminated=lambda obs, action, next_obs: jnp.bool_(False))
    out = run(sgft.branch(2, 3), line, raw, key)
    assert out.reward.shape == (2 + 2 * 3 * 2,) and jnp.array_equal(out.obs[:2], raw.obs)
    assert out.obs[2:, 0].tolist() == [0, 1] * 3 + [10, 11] * 3
    assert out.next_obs[2:, 0].tolist() == [1, 2] * 3 + [11, 12] * 3
    assert out.reward[2:].tolist() == [-1, -2] * 3 + [-11, -12] * 3
    assert left(out.context).tolist() == [0, 0] + [2, 1] * 6
    assert left(out.next_context).tolist() == [0, 0] + [1, 0] * 6
    assert jnp.all(out.discount == jnp.float32(GAMMA))
    endless = run(sgft.branch(2, 3, segments=False), line, raw, key)
    assert endless.context is None and jnp.array_equal(endless.obs, out.obs)


def test_after_an_imagined_termination_the_terminal_row_repeats(key):
    # 2 -> 3 goes on, 3 -> 4 terminates, two steps remain
    out = jax.tree.map(lambda x: x[1:], run(sgft.branch(4, 1), imagination(), batch_of([2], [2], [0]), key))
    assert out.obs[:, 0].tolist() == [2, 3, 3, 3] and out.next_obs[:, 0].tolist() == [3, 4, 4, 4]
    assert out.discount.tolist() == pytest.approx([GAMMA, 0, 0, 0])
    assert left(out.context).tolist() == [4, 3, 3, 3] and out.reward.tolist() == [-3, -4, -4, -4]


def test_branches_draw_their_own_actions_and_know_the_steps_to_go(key):
    noisy = imagination(
        policy=lambda obs, context, key: (left(context[None]) + 0.1 * jax.random.uniform(key, (1,))) / 10,
        terminated=lambda obs, action, next_obs: jnp.bool_(False),
    )
    out = run(sgft.branch(3, 4), noisy, batch_of([0, 0], [0, 0], [0, 0]), key)
    imagined = out.action[2:, 0]
    assert len(set(imagined.tolist())) == 24
    assert jnp.array_equal(jnp.floor(10 * imagined), jnp.tile(jnp.array([3.0, 2.0, 1.0]), 8))


@pytest.mark.slow
def test_branch_noise_spreads_the_imagined_actions_within_their_range(key):
    rest, zeros = imagination(policy=lambda obs, context, key: jnp.zeros(1)), np.zeros(40)
    quiet, spread, wide = (
        run(sgft.branch(1, 50, noise=noise), rest, batch_of(zeros, zeros, zeros), key).action[40:, 0]
        for noise in (0, 0.3, 5)
    )
    assert jnp.all(quiet == 0)
    assert abs(spread.std() - 0.3) < 0.02 and abs(spread.mean()) < 0.02  # 2,000 draws
    assert jnp.abs(wide).max() == 1.0 and 0.7 < (jnp.abs(wide) == 1.0).mean() < 0.95


def test_relabelled_rows_say_what_the_models_expect(key):
    raw = batch_of([0, 1, 2.5], [9, 9, 9], [7, 7, 7])._replace(action=jnp.array([[0.5], [0.5], [1.0]]))
    out = run(sgft.relabel(1), imagination(), raw, key)
    assert out.obs[:, 0].tolist() == [0, 1, 2.5] and out.next_obs[:, 0].tolist() == [9, 1.5, 3.5]
    assert out.reward.tolist() == [7, -1.5, -3.5]
    assert out.discount.tolist() == pytest.approx([GAMMA, GAMMA, 0])  # the last one terminates


def test_clip_bounds_rewards_alone(key):
    raw = batch_of([0, 0, 0], [1, 1, 1], [-5, 0.3, 5])
    out = run(sgft.clip(2.0), imagination(), raw, key)
    assert out.reward.tolist() == pytest.approx([-2, 0.3, 2])
    assert all(jnp.array_equal(x, y) for x, y in zip(out._replace(reward=None), raw, strict=True) if x is not None)


@pytest.mark.parametrize("make", [sgft.shape, sgft.clip(1.0), sgft.branch(2, 1), sgft.shorten(1), sgft.relabel(1)])
def test_other_fields_of_a_row_go_with_it(make, key):
    """Branches keep the weight, origin and validity of the row they begin at."""
    raw = batch_of([0, 1], [1, 2], [0, 0])
    raw = raw._replace(weight=jnp.array([0.5, 1.5]), is_sim=jnp.array([False, True]), valid=jnp.array([True, False]))
    out = run(make, imagination(), raw, key)
    origin = np.resize([0, 1], 2).tolist() + ([0, 0, 1, 1] if out.reward.shape[0] > 2 else [])
    for name in ("weight", "is_sim", "valid"):
        np.testing.assert_array_equal(getattr(out, name), np.asarray(getattr(raw, name))[origin])


# --- weights ----------------------------------------------------------------------------------------------------------


def tilted(transform, state, *, joint, pair):
    """Discriminators that say the same of every row: [2] logits given (s, a), and what s' adds to them."""

    def last(fit, logits):
        return fit._replace(
            params=jax.tree.map(jnp.zeros_like, fit.params)
            | {
                "Dense_1": {
                    "kernel": jnp.zeros_like(fit.params["Dense_1"]["kernel"]),
                    "bias": jnp.arctanh(jnp.asarray(logits) / 2),
                }
            }
        )

    return state._replace(joint=last(state.joint, joint), pair=last(state.pair, pair))


def test_weights_by_hand(key):
    """The joint adds log-odds of -1.5 for real, so w = exp(-1.5) = 0.2231 whatever the pair says; of +1.5: capped."""
    weigh = sgft.weigh(ratio.RatioConfig(1, 1, NetworkConfig((4,))))
    raw = batch_of([0, 1, 2], [1, 2, 3], [0, 0, 0])._replace(is_sim=jnp.array([False, True, True]))
    start = jax.jit(lambda key: weigh.init(None, key))(key)
    apply = jax.jit(lambda state: weigh.apply(state, None, raw, key))
    for joint, w in (([-0.5, 1.0], np.exp(-1.5)), ([1.0, -0.5], 1.0)):
        out = apply(tilted(weigh, start, joint=joint, pair=[1.2, -0.3]))
        np.testing.assert_allclose(out.weight, [1, w, w], rtol=1e-5)
        jax.tree.map(np.testing.assert_array_equal, out._replace(weight=None), raw)


@pytest.mark.slow
def test_weights_of_two_gaussians_are_the_ratio_of_their_dynamics(key):
    """s' = s + a / 2 + e with e from N(0, 1), one further in the simulator: w = min(exp(1/2 - e), 1).

    States lie around 100; the statistics of the prior bring them near 0. The domains also differ in states, which w
    ignores.
    """
    weigh = sgft.weigh(ratio.RatioConfig(1, 1, NetworkConfig((32, 32)), noise=0.0))
    prior = SimpleNamespace(normalizer=Normalizer(jnp.array([100.0]), jnp.array([2.0])))

    def rows(key):
        keys, is_sim = jax.random.split(key, 3), jnp.arange(512) % 2 == 1
        s = 100 + jax.random.normal(keys[0], (512,)) + is_sim - 0.5
        a = jax.random.uniform(keys[1], (512,), minval=-1)
        after = s + a / 2 + jax.random.normal(keys[2], (512,)) + is_sim
        return Batch(s[:, None], a[:, None], s, s, after[:, None], is_sim=is_sim)

    def step(state, key):
        return weigh.update(state, rows(key), key)

    state = weigh.init(prior, key)
    state, metrics = jax.jit(lambda state, keys: jax.lax.scan(step, state, keys))(state, jax.random.split(key, 2500))
    assert metrics["ratio/loss"][-200:].mean() < 0.9 * 4 * np.log(2) and state.normalizer is not None
    batch = rows(jax.random.key(9))
    weight = weigh.apply(state, None, batch, key).weight
    e = (batch.next_obs - batch.obs - batch.action / 2)[1::2, 0]
    np.testing.assert_array_equal(weight[::2], 1.0)
    assert jnp.abs(weight[1::2] - jnp.minimum(jnp.exp(0.5 - e), 1)).mean() < 0.08


def test_weights_need_to_know_which_rows_are_simulated(key):
    weigh = sgft.weigh(ratio.RatioConfig(1, 1, NetworkConfig((4,))))
    with pytest.raises(UserError, match="which rows are simulated"):
        run(weigh, imagination(), batch_of([0], [1], [0]), key)


# --- composition ------------------------------------------------------------------------------------------------------


def test_composition_runs_left_to_right_with_separate_keys_and_states(key):
    seen = []

    def note(name):
        def apply(state, imagination, batch, key):
            seen.append((name, state, key))
            return batch

        def learn(state, batch, key):
            return (state + name, {f"seen/{name}": key})

        return sgft.Transform(lambda params, key: name + params, apply, learn)

    both = sgft.compose(note("a"), note("b"))
    assert both.init("-prior", key) == ("a-prior", "b-prior")
    raw = batch_of([0], [0], [0])
    assert both.apply(("x", "y"), imagination(), raw, key) is raw
    assert [(name, state) for name, state, _ in seen] == [("a", "x"), ("b", "y")] and seen[0][2] != seen[1][2]
    state, metrics = both.update(("x", "y"), raw, key)
    assert state == ("xa", "yb") and metrics["seen/a"] != metrics["seen/b"]
    assert sgft.compose().apply((), imagination(), raw, key) is raw and sgft.compose().init(None, key) == ()
