"""CQL: SAC on a fixed set of data, whose critic is pushed down where the data does not go and up where it does.

Source: Kumar et al. 2020, CQL(H) with importance-corrected samples and a fixed weight, as H2O+'s baseline runs it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.learners.sac import Critic, CriticTerm, SACConfig, SACHyper, make_sac
from sgft_jax.math import losses
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.types import Batch, Learner


@dataclass(frozen=True)
class CQLConfig:
    """The structure of an agent. The defaults are those of the baseline of H2O+.

    obs_dim, act_dim: sizes of what the environment gives and takes. network: body of actor and critics.
    conservatism: weight of the penalty, in units of return. Others use 5 or 10, with an actor's rate of 3e-5.
    samples: actions drawn from each of the uniform distribution, pi(.|s) and pi(.|s').
    tune_alpha: follow the target entropy; False keeps the temperature.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=lambda: NetworkConfig((256, 256)))
    conservatism: float = 2.0
    samples: int = 10
    tune_alpha: bool = True

    def __post_init__(self) -> None:
        checks.not_negative(self, "conservatism")
        checks.at_least(self, 1, "samples")


def make_cql(config: CQLConfig, hyper: SACHyper | None = None) -> Learner:
    """The learner of a configuration; its state is a `SACState`. The entropy is not in the target."""
    structure = SACConfig(
        config.obs_dim, config.act_dim, network=config.network, tune_alpha=config.tune_alpha, train_value=False,
        train_dynamics=False, entropy_in_target=False,
    )  # fmt: skip
    return make_sac(structure, hyper, critic_term=_penalty(config))


def soft_maximum(q: Array, log_density: Array) -> Array:
    """Logarithm [members] of a sum over a of exp Q(s, a) / density(a). q: [n, members] of n drawn actions.

    log_density: [n] nats, of each action under what it was drawn from.
    """
    return jax.nn.logsumexp(jax.vmap(lambda one, density: one - density)(q, log_density), axis=0)


def _penalty(config: CQLConfig) -> CriticTerm:
    def term(
        critic: Critic,
        params: PyTree,
        policy: Callable[[Array, Key], tuple[Array, Array]],
        batch: Batch,
        key: Key,
    ) -> Array:
        q = partial(critic, params)

        def one(row: Batch, key: Key) -> Array:
            key_uniform, key_here, key_next = jax.random.split(key, 3)
            uniform = jax.random.uniform(key_uniform, (config.samples, config.act_dim), minval=-1.0)
            flat = jnp.full(config.samples, -config.act_dim * jnp.log(2.0))  # the density of a uniform action
            draw = jax.vmap(policy, (None, 0))
            here, log_here = draw(row.obs, jax.random.split(key_here, config.samples))
            following, log_following = draw(row.next_obs, jax.random.split(key_next, config.samples))
            actions = jnp.concatenate([uniform, here, following])
            of_actions = jax.vmap(q, (None, 0))(row.obs, actions)
            high = soft_maximum(of_actions, jnp.concatenate([flat, log_here, log_following]))
            return jnp.sum(high - q(row.obs, row.action))

        each = jax.vmap(one)(batch, jax.random.split(key, batch.reward.shape[0]))
        return config.conservatism * losses.row_mean(each, batch)

    return term
