"""Parameters of priors of SAC that have learned nothing."""

import jax

from sgft_jax.learners import sac
from sgft_jax.models.networks import make_value


def sac_params(config, key):
    """Those of a fresh agent, with a V_sim of observations alone."""
    value = make_value(config.obs_dim, config.network).init(jax.random.split(key, 4)[2])
    return sac.extract_params(sac.make_sac(config).init(key))._replace(value=value)
