"""Untrained priors of the toy task on disk."""

import functools

import jax
import jax.numpy as jnp
import toy
import untrained

from sgft_jax.files.disk import jsonable
from sgft_jax.io import priors
from sgft_jax.learners.sac import SACConfig
from sgft_jax.models.config import NetworkConfig
from sgft_jax.posterior import estimator, interface
from sgft_jax.types import Normalizer, Prior

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


def save_with_estimator(folder, usual=0.0):
    """The same with an estimator that has learned nothing. usual: contradiction that is usual in simulation."""
    env = toy.make()
    entry = interface.entry_of(env)
    zeros = estimator.shaped(entry["steps"], entry["measured"], env.act_dim, len(entry["unknowns"]))
    statistics = estimator.Statistics(jnp.zeros(4), jnp.ones(4), jnp.ones(4))
    params = initial(SACConfig(4, 2, network=NETWORK, ensemble_size=2))(jax.random.key(1))
    still = Normalizer(jnp.zeros(4), jnp.ones(4))
    unlearned = zeros._replace(statistics=statistics, usual=zeros.usual + usual)
    card = {"task": "toy", "obs_dim": 4, "act_dim": 2, "gamma": 0.9, "algorithm": "sac", "network": jsonable(NETWORK)}
    whole = params._replace(normalizer=still, estimator=unlearned)
    priors.save_prior(folder, Prior(whole, card | {"estimator": entry}))
