"""EDAC: SAC on a fixed set of data with many critics that must not agree on how to leave it.

Targets and actor use the minimum of all critics. With diversity 0 it is SAC-N, which needs more of them. Source: An et
al. 2021.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.learners.sac import Critic, CriticTerm, SACConfig, SACHyper, make_sac
from sgft_jax.math import losses
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.types import Batch, Learner

NORM_MIN = 1e-10  # of a gradient; a critic that is flat points nowhere


@dataclass(frozen=True)
class EDACConfig:
    """The structure of an agent. The defaults are those published for HalfCheetah and Walker2d.

    obs_dim, act_dim: sizes of what the environment gives and takes. network: body of actor and critics.
    critics: how many. diversity: weight eta of what keeps their gradients apart; 0 = SAC-N.
    tune_alpha: follow the target entropy; False keeps the temperature.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=lambda: NetworkConfig((256, 256, 256)))
    critics: int = 10
    diversity: float = 1.0
    tune_alpha: bool = True

    def __post_init__(self) -> None:
        checks.at_least(self, 2, "critics")
        checks.not_negative(self, "diversity")


def make_edac(config: EDACConfig, hyper: SACHyper | None = None) -> Learner:
    """The learner of a configuration; its state is a `SACState`."""
    structure = SACConfig(
        config.obs_dim, config.act_dim, network=config.network, critics=config.critics, tune_alpha=config.tune_alpha,
        train_value=False, train_dynamics=False,
    )  # fmt: skip
    return make_sac(structure, hyper, critic_term=_diversity(config) if config.diversity else None)


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


def _diversity(config: EDACConfig) -> CriticTerm:
    def term(
        critic: Critic,
        params: PyTree,
        policy: Callable[[Array, Key], tuple[Array, Array]],
        batch: Batch,
        key: Key,
    ) -> Array:
        del policy, key  # it looks at the data's own actions
        return config.diversity * mean_alignment(critic, params, batch)

    return term
