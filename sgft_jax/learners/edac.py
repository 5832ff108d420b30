"""EDAC: SAC on a fixed set of data with many critics that must not agree on how to leave it.

Targets and actor use the minimum of all critics. With diversity 0 it is SAC-N, which needs more of them. Source: An et
al. 2021.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.learners import sac
from sgft_jax.learners.sac import SACConfig, SACHyper, SACState
from sgft_jax.learners.steps import Critic, Sampler
from sgft_jax.math import losses
from sgft_jax.models.config import NetworkConfig
from sgft_jax.types import Batch, Learner, Metrics

__all__ = ["EDACConfig", "alignment", "make_edac", "mean_alignment", "penalty", "update"]

NORM_MIN = 1e-10  # of a gradient; a critic that is flat points nowhere


@dataclass(frozen=True)
class EDACConfig(SACConfig):
    """The structure of an agent: that of SAC and a number. The defaults are those for HalfCheetah and Walker2d.

    diversity: weight eta of what keeps the gradients of the critics apart; 0 = SAC-N.
    """

    network: NetworkConfig = field(default_factory=lambda: NetworkConfig((256, 256, 256)))
    train_dynamics: bool = False
    critics: Annotated[int, checks.least(2)] = 10
    diversity: checks.NotNegative = 1.0


def alignment(grads: Array) -> Array:
    """Sum [] over pairs i != j of the cosine of gradients i and j, divided by members - 1. grads: [members, act_dim].

    Source: An et al. 2021.
    """
    unit = grads * jax.lax.rsqrt(jnp.sum(grads**2, axis=1, keepdims=True) + NORM_MIN**2)
    cosines = unit @ unit.T
    return (jnp.sum(cosines) - jnp.trace(cosines)) / (grads.shape[0] - 1)


def mean_alignment(critic: Critic, params: PyTree, batch: Batch) -> Array:
    """Mean [] over the rows of a batch of the `alignment` of the members' gradients in the action.

    params: of the critic, members leading. batch: what the critics read.
    """

    def gradients(obs: Array, action: Array) -> Array:
        """[members, act_dim], one backward pass of each: a Jacobian would go through all members for every one."""

        def value(member: PyTree, action: Array) -> Array:
            return critic(jax.tree.map(lambda x: x[None], member), obs, action)[0]

        return jax.vmap(jax.grad(value, argnums=1), (0, None))(params, action)

    return losses.row_mean(jax.vmap(alignment)(jax.vmap(gradients)(batch.obs, batch.action)), batch)


def penalty(config: EDACConfig, critic: Critic, params: PyTree, policy: Sampler, batch: Batch, key: Key) -> Array:
    """Diversity times `mean_alignment` [] at the data's own actions, a `sac.CriticTerm`."""
    del policy, key
    return config.diversity * mean_alignment(critic, params, batch)


init, act = sac.init, sac.act  # of a configuration that is one of SAC


def update(config: EDACConfig, state: SACState, batch: Batch, key: Key) -> tuple[SACState, Metrics]:
    """One update of SAC whose critics also pay for pointing the same way; see `sac.update`."""
    term = partial(penalty, config) if config.diversity else None
    return sac.update(config, state, batch, key, critic_term=term)


def make_edac(config: EDACConfig, hyper: SACHyper | None = None) -> Learner:
    """The functions of this module for one configuration."""
    return sac.make_sac(config, hyper)._replace(update=partial(update, config))
