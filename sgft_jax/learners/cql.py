"""CQL: SAC on a fixed set of data, whose critic is pushed down where the data does not go and up where it does.

Source: Kumar et al. 2020, CQL(H) with importance-corrected samples and a fixed weight, as H2O+'s baseline runs it.
"""

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.learners import sac
from sgft_jax.learners.sac import SACConfig, SACHyper, SACState
from sgft_jax.learners.steps import Critic, Sampler
from sgft_jax.math import losses
from sgft_jax.models.config import NetworkConfig, two_layers
from sgft_jax.types import Batch, Learner, Metrics

__all__ = ["CQLConfig", "make_cql", "penalty", "soft_maximum", "update"]


@dataclass(frozen=True)
class CQLConfig(SACConfig):
    """The structure of an agent: that of SAC and two numbers. The defaults are those of the baseline of H2O+.

    conservatism: weight of the penalty, in units of return. Others use 5 or 10, with an actor's rate of 3e-5.
    samples: actions drawn from each of the uniform distribution, pi(.|s) and pi(.|s').
    """

    network: NetworkConfig = field(default_factory=two_layers)
    train_dynamics: bool = False
    entropy_in_target: bool = False
    conservatism: checks.NotNegative = 2.0
    samples: checks.Count = 10


def soft_maximum(q: Array, log_density: Array) -> Array:
    """Logarithm [members] of a sum over a of exp Q(s, a) / density(a). q: [n, members] of n drawn actions.

    log_density: [n] nats, of each action under what it was drawn from.
    """
    return jax.nn.logsumexp(jax.vmap(jnp.subtract)(q, log_density), axis=0)


def penalty(config: CQLConfig, critic: Critic, params: PyTree, policy: Sampler, batch: Batch, key: Key) -> Array:
    """Conservatism times the mean [] of soft max_a Q(s, a) - Q(s, a_data), a `sac.CriticTerm`.

    batch: [B, ...] as the critics read it.
    """
    q, draw = partial(critic, params), jax.vmap(policy, (None, 0))

    def row_penalty(row: Batch, key: Key) -> Array:
        key_uniform, key_here, key_next = jax.random.split(key, 3)
        uniform = jax.random.uniform(key_uniform, (config.samples, config.act_dim), minval=-1.0)
        flat = jnp.full(config.samples, -config.act_dim * jnp.log(2.0))  # the density of a uniform action
        here, log_here = draw(row.obs, jax.random.split(key_here, config.samples))
        following, log_following = draw(row.next_obs, jax.random.split(key_next, config.samples))
        q_drawn = jax.vmap(q, (None, 0))(row.obs, jnp.concatenate([uniform, here, following]))
        high = soft_maximum(q_drawn, jnp.concatenate([flat, log_here, log_following]))
        return jnp.sum(high - q(row.obs, row.action))

    values = jax.vmap(row_penalty)(batch, jax.random.split(key, batch.reward.shape[0]))
    return config.conservatism * losses.row_mean(values, batch)


init, act = sac.init, sac.act  # of a configuration that is one of SAC


def update(config: CQLConfig, state: SACState, batch: Batch, key: Key) -> tuple[SACState, Metrics]:
    """One update of SAC whose critic also pays the penalty; see `sac.update`."""
    return sac.update(config, state, batch, key, critic_term=partial(penalty, config))


def make_cql(config: CQLConfig, hyper: SACHyper | None = None) -> Learner:
    """The functions of this module for one configuration."""
    return sac.make_sac(config, hyper)._replace(update=partial(update, config))
