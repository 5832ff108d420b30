"""What every learner and method keeps: compiled once, one program for all seeds, resumed exactly, and it learns."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from probes import MAKERS, PROBES

from sgft_jax import finetune, methods
from sgft_jax.io import checkpoint
from sgft_jax.learners import sac, tdmpc2, tdmpc2_model
from sgft_jax.models import networks
from sgft_jax.types import Transition

PLANNERS = {"tdmpc2", "sgft-tdmpc2"}
# What takes long: the fast tests see less of it.
QUICK = {
    "tdmpc2": set(),
    "sgft-tdmpc2": set(),
    "sac, ten critics": {"reward one step later", "action decides"},
}
each_learner = pytest.mark.parametrize("name", MAKERS)


def slow_if(slow, *values):
    return pytest.param(*values, marks=[pytest.mark.slow] if slow else [])


def trained(name, probe, key, steps):
    """A state after so many updates on fresh rows of a probe, and the one before."""
    case = probes.case(name)
    batches = jax.jit(jax.vmap(lambda key: case.feed(probes.rows(PROBES[probe], key))))(jax.random.split(key, 20))
    batches = [jax.tree.map(lambda x, i=i: x[i], batches) for i in range(20)]
    state = start = case.start(key)
    for step, sub in enumerate(jax.random.split(key, steps)):
        state, _ = case.learner.update(state, batches[step % 20], sub)
    return start, state


def bits(tree):
    """Every leaf as bytes."""
    raw = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x  # noqa: E731
    return [np.asarray(raw(jnp.asarray(x))).tobytes() for x in jax.tree.leaves(tree)]


# --- learners -------------------------------------------------------------------------------------------------------


@each_learner
def test_update_compiles_once(name, key):
    """However many tests have used it before."""
    trained(name, "constant reward", key, 3)
    assert probes.case(name).traces == [1]


@pytest.mark.parametrize("name", [slow_if(name != "iql", name) for name in MAKERS])
def test_vmap_over_seeds_equals_each_alone(name, key):
    """From states with Adam moments: a first step would make rounding errors as long as any other step."""
    case, seeds = probes.case(name), jax.random.split(key, 2)
    alone = [trained(name, "state and action decide", seed, 2)[1] for seed in seeds]
    batch = case.feed(probes.rows(PROBES["time limit"], key))
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *alone)
    together, metrics = jax.jit(jax.vmap(probes.MAKERS[name]().learner.update, (0, None, 0)))(stacked, batch, seeds)
    for i in range(2):
        one = case.learner.update(alone[i], batch, seeds[i])
        chex.assert_trees_all_close(jax.tree.map(lambda x, i=i: x[i], (together, metrics)), one, rtol=1e-3, atol=1e-4)
    assert bits(jax.tree.map(lambda x: x[0], together)) != bits(jax.tree.map(lambda x: x[1], together))


@each_learner
def test_a_restored_state_goes_on_with_the_same_bits(name, key, tmp_path):
    case = probes.case(name)
    _, state = trained(name, "time limit", key, 2)
    checkpoint.save(tmp_path, 2, state, meta={})
    restored, _ = checkpoint.restore(tmp_path, jax.eval_shape(case.start, key))
    batch = case.feed(probes.rows(PROBES["time limit"], key))
    assert bits(case.learner.update(restored, batch, key)) == bits(case.learner.update(state, batch, key))


@pytest.mark.parametrize("name", [slow_if(name == "sgft-tdmpc2", name) for name in MAKERS])
def test_the_best_action_is_deterministic_and_in_bounds(name, key):
    case = probes.case(name)
    _, state = trained(name, "action decides", key, 2)
    for s in (-3.0, 0.0, 50.0):
        action, carry = case.learner.act(state, case.learner.init_carry(), probes.obs_of(s), key, explore=False)
        again, same = case.learner.act(state, case.learner.init_carry(), probes.obs_of(s), key, explore=False)
        assert bits((action, carry)) == bits((again, same)) and action.shape == (1,) and jnp.abs(action[0]) <= 1
        chex.assert_trees_all_equal_shapes_and_dtypes(carry, case.learner.init_carry())
        if name not in PLANNERS:  # a plan is a search and has a key; without noise the same key finds the same
            other = case.learner.act(state, (), probes.obs_of(s), jax.random.key(1), explore=False)[0]
            assert bits(action) == bits(other)


@pytest.mark.parametrize(
    ("name", "probe"),
    [slow_if(probe not in QUICK.get(name, PROBES), name, probe) for name in MAKERS for probe in PROBES],
)
def test_probe(name, probe, key):
    case, known = probes.case(name), PROBES[probe]
    start, state = trained(name, probe, key, case.steps)
    for s, value in known.values.items():
        if case.values is None:  # V_sim of SGFT-TDMPC-2
            assert bits((state.critic, state.encoder)) == bits((start.critic, start.encoder))
        else:
            np.testing.assert_allclose(case.values(state, probes.obs_of(s)), value, atol=0.1 * max(1, abs(value)))
    # An action that is 0.2 off costs 0.04 of reward: about what the bins of a planner's heads resolve.
    near = 0.25 if name in PLANNERS else 0.15
    for s, action in known.actions.items():
        assert case.mode(state, probes.obs_of(s))[0] == pytest.approx(action, abs=near)


# --- methods --------------------------------------------------------------------------------------------------------

T = 12
SMALL = {
    "network": networks.NetworkConfig(hidden=(8,)), "batch_size": 8, "branches": 2, "horizon": 2, "actor_ramp": 0,
    "replay_capacity": 32, "critic_warmup": 0, "size": "probe", "plan_samples": 24,
}  # fmt: skip
FAST_METHODS = {"sgft-sac"}


@pytest.fixture(autouse=True)
def _size(monkeypatch):
    monkeypatch.setitem(tdmpc2_model.SIZES, "probe", tdmpc2_model.Size(encoder=8, mlp=8, latent=8, members=2))


def episode(key, n=T):
    """n steps of a point on a line."""
    obs, action = jax.random.uniform(key, (2, n, 1), minval=-1)
    after, zero = obs + 0.1 * action, jnp.zeros(n)
    return Transition(obs, action, -jnp.abs(after[:, 0]), zero + 0.9, after, zero > 0, zero.astype(jnp.int32))


@functools.cache
def tuner(name):
    """Fine-tuning by a method, compiled, with a prior and how often `learn` was traced."""
    method, traces = methods.get_method(name), [0]
    own = {"critic_network": SMALL["network"]} if name == "rlpd" else {}
    config = methods.finetune_config(method, **SMALL, **own)
    plain = finetune.make_finetuner(
        method, config, obs_dim=1, act_dim=1, reward=lambda obs, action, after: -jnp.abs(after[0]),
        terminated=lambda obs, action, after: jnp.bool_(False),
    )  # fmt: skip

    def learn(state, key):
        traces[0] += 1
        return plain.learn(state, key, 2, episode)

    if method.agent == "tdmpc2":
        shape = tdmpc2_model.named_config(1, 1, size="probe", plan_samples=24, horizon=2)
        prior = tdmpc2.extract_prior(jax.jit(tdmpc2.make_tdmpc2(shape).init)(jax.random.key(7)))
    else:
        agent = sac.SACConfig(1, 1, network=SMALL["network"], ensemble_size=2)
        prior = sac.extract_prior(jax.jit(sac.make_sac(agent).init)(jax.random.key(7)))
    compiled = plain._replace(init=jax.jit(plain.init), learn=jax.jit(learn), act=jax.jit(plain.act))
    return compiled, prior, traces


def started(name, seed=0):
    fine, prior, _ = tuner(name)
    return fine.observe(fine.init(prior, jax.random.key(seed)), episode(jax.random.key(seed)), jnp.ones(T, bool))


each_method = pytest.mark.parametrize("name", [slow_if(name not in FAST_METHODS, name) for name in methods.METHODS])


@each_method
def test_a_method_compiles_once_and_goes_on_with_the_same_bits(name, key, tmp_path):
    fine, prior, traces = tuner(name)
    state, metrics = fine.learn(started(name), key)
    assert all(jnp.isfinite(x) and x.shape == () for x in metrics.values())
    state = fine.observe(state, episode(key), jnp.arange(T) != 5)
    checkpoint.save(tmp_path, 1, state, meta={})
    restored, _ = checkpoint.restore(tmp_path, jax.eval_shape(fine.init, prior, key))
    assert bits(fine.learn(restored, key)) == bits(fine.learn(state, key)) and traces == [1]


@each_method
def test_the_best_action_of_a_method_is_deterministic_and_in_bounds(name, key):
    fine, _, _ = tuner(name)
    state = started(name)
    for s in (-9.0, 0.3):
        obs, mode = jnp.array([s]), functools.partial(fine.act, explore=jnp.bool_(False))
        action, again = (mode(state, fine.init_carry(), obs, key)[0] for _ in range(2))
        assert bits(action) == bits(again) and action.shape == (1,) and jnp.abs(action[0]) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", methods.METHODS)
def test_a_method_over_seeds_equals_each_alone(name, key):
    fine, _, _ = tuner(name)
    keys = jax.random.split(key, 2)
    alone = [fine.learn(started(name, seed), keys[seed])[0] for seed in range(2)]  # with Adam moments
    together = jax.jit(jax.vmap(lambda state, key: fine.learn(state, key)[0]))(
        jax.tree.map(lambda *x: jnp.stack(x), *alone), keys
    )
    for i in range(2):
        one, _ = fine.learn(alone[i], keys[i])
        chex.assert_trees_all_close(jax.tree.map(lambda x, i=i: x[i], together), one, rtol=1e-3, atol=1e-3)


def test_every_agent_of_the_table_is_a_learner_of_the_contract():
    """But for plans by SAC's models: what learns there are the models of `sac`, and test_mpc.py has the plans."""
    assert {method.agent for method in methods.METHODS.values()} <= {*MAKERS, "mpc"}
