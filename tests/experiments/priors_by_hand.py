"""Untrained priors of the toy task on disk."""

import functools

import jax
import untrained

from sgft_jax.files.disk import jsonable
from sgft_jax.io import priors
from sgft_jax.learners.sac import SACConfig
from sgft_jax.models.config import NetworkConfig
from sgft_jax.types import Prior

NETWORK = NetworkConfig(hidden=(8,))


@functools.cache
def initial(config):
    """key -> the parameters of an untrained prior, in one program."""
    return jax.jit(lambda key: untrained.sac_params(config, key))


def save_prior(folder, seed, **changes):
    """An untrained prior of the toy task; returns its parameters. changes: of its card."""
    config = SACConfig(changes.get("obs_dim", 4), changes.get("act_dim", 2), network=NETWORK, ensemble_size=2)
    params = initial(config)(jax.random.key(seed))
    card = {"task": "toy", "obs_dim": 4, "act_dim": 2, "network": jsonable(NETWORK), "gamma": 0.9}
    priors.save_prior(folder, Prior(params, {**card, "ensemble_size": 2, "seed": seed, **changes}))
    return params
