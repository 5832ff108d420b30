"""The hand-written update is the learner's: the same parameters from the same rows and the same random numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_bare_sac import layers

from experiments.bench import bare_h2oplus
from experiments.bench.bare_sac import trained
from experiments.bench.updates import ACT_DIM, OBS_DIM, rows
from sgft_jax.learners.h2oplus import H2OPlusConfig, H2OPlusHyper, make_h2oplus
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.types import Batch

BODY, ROWS, RATIO_ROWS = NetworkConfig(hidden=(16, 16)), 8, 12
# large enough to be told from rounding; so is alpha from 1
HYPER = H2OPlusHyper(tau=0.1, alpha=1.0, value_share=0.3, lr_ratio=1e-2, lr_alpha=1e-2)


def noise_of(key):
    """The numbers that the learner draws from this key."""
    key_ratio, key_actor, key_target = jax.random.split(key, 3)

    def normal(key, n):
        return jax.random.normal(key, (n,))

    actions = [jax.vmap(lambda k: normal(k, ACT_DIM))(jax.random.split(k, ROWS)) for k in (key_target, key_actor)]
    keys = jax.vmap(lambda k: jax.random.split(k, 3))(jax.random.split(key_ratio, RATIO_ROWS))
    parts = [jax.vmap(lambda k, n=n: normal(k, n))(keys[:, i]) for i, n in enumerate((OBS_DIM, ACT_DIM, OBS_DIM))]
    return bare_h2oplus.Noise(*actions, tuple(parts))


def both_halves(key, n):
    """Rows of which the later half is the simulator's, with different rewards and actions."""
    made = rows(key, n)
    action = jax.random.uniform(key, (n, ACT_DIM), minval=-1)
    return made._replace(reward=jnp.arange(n) / 4.0, action=action)


def by_hand(state):
    """The learner's state as the reference keeps it."""
    actor = state.actor.params
    return bare_h2oplus.Bare(
        actor=trained((layers(actor["body"]), actor["scale"], actor["offset"])),
        critic=trained(layers(state.critic.params)),
        target=layers(state.target_critic),
        value=trained(layers(state.value.params)),
        log_alpha=trained(state.log_alpha.params),
        joint=trained(layers(state.ratio.joint.params)),
        pair=trained(layers(state.ratio.pair.params)),
    )


def params_of(agent):
    """What is compared: every network's parameters."""
    return [agent.target, *(fit.params for fit in agent if isinstance(fit, bare_h2oplus.Trained))]


@pytest.mark.slow
def test_it_is_the_update_of_the_library(key):
    config = H2OPlusConfig(OBS_DIM, ACT_DIM, network=BODY, ratio_network=BODY, ratio_rows=RATIO_ROWS)
    learner = make_h2oplus(config, HYPER)
    state = learner.init(key)
    bare = start = by_hand(state)
    update, other = jax.jit(learner.update), jax.jit(bare_h2oplus.update)
    for step in range(3):
        key_rows, key_ratio, key_step = jax.random.split(jax.random.fold_in(key, step), 3)
        batch, for_ratio = both_halves(key_rows, ROWS), both_halves(key_ratio, RATIO_ROWS)
        is_sim = jnp.concatenate([jnp.arange(n) >= n // 2 for n in (ROWS, RATIO_ROWS)])
        together = jax.tree.map(lambda *x: jnp.concatenate(x), batch, for_ratio)
        state, _ = update(state, Batch(*together, is_sim=is_sim), key_step)
        with jax.numpy_rank_promotion("allow"):
            bare = other(bare, batch, for_ratio, noise_of(key_step), HYPER)
    for wanted, seen, first in zip(params_of(by_hand(state)), params_of(bare), params_of(start), strict=True):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), wanted, seen)
        moved = jax.tree.map(lambda a, b: jnp.abs(a - b).max(), wanted, first)
        assert max(jax.tree.leaves(moved)) > 1e-4  # further than the tolerance, so the comparison says something
