"""DARC: what simulated rows are paid, in which direction, and which rows teach what."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import Transition, UserError
from sgft_jax.data import replay
from sgft_jax.learners import darc
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.types import Batch

NET = NetworkConfig((16,))
CONFIG = darc.DARCConfig(2, 1, network=NET, ratio_network=NET)
ROWS = 12
SIM = jnp.arange(ROWS) % 2 == 1


@pytest.fixture(scope="module")
def learner():
    made = darc.make_darc(CONFIG, lr_ratio=1e-2)
    return made._replace(init=jax.jit(made.init), update=jax.jit(made.update))


def batch_of(key, shift=0.0):
    """Odd rows are simulated; they land `shift` further."""
    keys = jax.random.split(key, 3)
    obs, noise = (jax.random.normal(k, (ROWS, 2)) for k in keys[:2])
    action = jax.random.uniform(keys[2], (ROWS, 1), minval=-1)
    next_obs = obs + 0.3 * noise + shift * SIM[:, None]
    return Batch(obs, action, jnp.arange(ROWS, dtype=jnp.float32), jnp.full(ROWS, 0.9), next_obs, is_sim=SIM)


def equal(a, b):
    return all(jnp.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_rewards_by_hand(key):
    batch = jax.tree.map(lambda x: x[:4], batch_of(key))
    paid = darc.paid(batch, jnp.array([0.5, -1.5, 2.0, 0.25]))
    np.testing.assert_allclose(paid.reward[1::2], [1 - 1.5, 3 + 0.25])
    assert paid.valid.tolist() == [False, True, False, True]
    some = darc.paid(batch._replace(valid=jnp.array([True, True, True, False])), jnp.zeros(4))
    assert some.valid.tolist() == [False, True, False, False]


@pytest.mark.heavy
def test_a_wrong_simulator_pays_less(learner, key):
    """The change of reward is log P / P_sim: near 0 where both agree, down to -4 where they do not."""
    seen = []
    for shift in (0.0, 4.0):
        state = learner.init(key)
        for i in range(60):
            sub = jax.random.fold_in(key, i)
            state, metrics = learner.update(state, batch_of(sub, shift), sub)
        seen.append(float(metrics["ratio/log_sim"]))
    assert -4 <= seen[1] < -2 < -1 < seen[0]


@pytest.mark.heavy
def test_the_agent_learns_from_simulated_rows_alone(learner, key):
    state, batch = learner.init(key), batch_of(key)
    one, _ = learner.update(state, batch, key)
    real, sim = (batch._replace(reward=jnp.where(mask, 9.0, batch.reward)) for mask in (~SIM, SIM))
    assert equal(one, learner.update(state, real, key)[0])
    other, _ = learner.update(state, sim, key)
    assert not equal(one.sac.critic, other.sac.critic) and equal(one.ratio, other.ratio)


@pytest.mark.slow
def test_it_trains_from_buffers(key):
    """The published 256 simulated rows, and 256 of each for the discriminators."""
    source = darc.batches()
    assert (source.n_real, source.n_sim) == (256, 512)
    small = darc.batches(4, 6)
    data = Transition(*batch_of(key)[:5])
    buffers = replay.full(data), replay.add_batch(replay.init(replay.blank(2, 1), 40), data)
    batch = small.sample(buffers, key)
    assert batch.is_sim.tolist() == [True] * 4 + [False] * 6 + [True] * 6
    learner = darc.make_darc(darc.DARCConfig(2, 1, network=NET, ratio_network=NET, ratio_rows=12))
    state, metrics = jax.jit(learner.update)(learner.init(key), batch, key)
    assert state.sac.step == 1 and all(jnp.isfinite(m) for m in metrics.values())
    with pytest.raises(UserError, match="option ratio-rows is 12: must be less than the batch, 12"):
        learner.update(state, batch_of(key), key)
