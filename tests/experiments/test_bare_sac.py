"""The hand-written update is the library's: the same parameters from the same batch and the same random numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.bench import bare_sac
from experiments.bench.updates import ACT_DIM, MEMBERS, OBS_DIM, rows
from sgft_jax.learners.sac import SACConfig, SACHyper, make_sac
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.types import Batch

NETWORK, BATCH = NetworkConfig(hidden=(16, 16), layer_norm=True), 8
HYPER = SACHyper(tau=0.1, alpha=0.3)


def layers(params):
    """Flax parameters of one network (or of a stacked ensemble) as the reference keeps them."""
    made = []
    for i in range(3):
        norm = params.get(f"LayerNorm_{i}")
        dense = params[f"Dense_{i}"]
        made.append((dense["kernel"], dense["bias"], *((norm["scale"], norm["bias"]) if norm else ())))
    return made


def noise_of(key):
    """The numbers that `sgft_jax.learners.sac` draws from this key."""
    key_target, key_actor, key_dynamics = jax.random.split(key, 3)

    def normal(key):
        return jax.random.normal(key, (ACT_DIM,))

    target, actor = (jax.vmap(normal)(jax.random.split(k, BATCH)) for k in (key_target, key_actor))
    return bare_sac.Noise(target, actor, jax.random.exponential(key_dynamics, (BATCH, MEMBERS)))


@pytest.mark.slow
def test_it_is_the_update_of_the_library(key):
    learner = make_sac(SACConfig(OBS_DIM, ACT_DIM, network=NETWORK, ensemble_size=MEMBERS), HYPER)
    state = learner.init(key)
    parts = {name: bare_sac.trained(layers(getattr(state, name).params)) for name in ("actor", "critic")}
    bare = bare_sac.Bare(
        **parts,
        target=layers(state.target_critic),
        log_alpha=bare_sac.trained(state.log_alpha.params),
        dynamics=bare_sac.trained(layers(state.dynamics.params)),
    )
    update, by_hand = jax.jit(learner.update), jax.jit(bare_sac.update)
    for step in range(3):
        key_rows, key_step = jax.random.split(jax.random.fold_in(key, step))
        batch = rows(key_rows, BATCH)._replace(reward=jnp.arange(8.0), action=jnp.full((BATCH, ACT_DIM), 0.3))
        state, _ = update(state, Batch(*batch), key_step)
        with jax.numpy_rank_promotion("allow"):
            bare = by_hand(bare, batch, noise_of(key_step), HYPER)
    pairs = [(layers(getattr(state, name).params), getattr(bare, name).params) for name in (*parts, "dynamics")]
    pairs += [(layers(state.target_critic), bare.target), (state.log_alpha.params, bare.log_alpha.params)]
    for wanted, seen in pairs:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), wanted, seen)
    moved = np.abs(layers(state.actor.params)[0][0] - layers(learner.init(key).actor.params)[0][0]).max()
    assert moved > 3e-4  # further than the tolerance, so the comparison says something
