"""What agents leave that act by an actor network alone."""

import functools
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array, Key, Policy, PyTree
from sgft_jax.files.disk import jsonable
from sgft_jax.models import networks
from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.networks import Network
from sgft_jax.models.normalizer import normalize
from sgft_jax.types import Normalizer

_EXPLORE_NOISE = 0.1
Head = Literal["affine", "gaussian", "deterministic"]


class ActorParams(NamedTuple):
    """actor: parameters of the network. normalizer: of the observations that it reads."""

    actor: PyTree
    normalizer: Normalizer


def make_actor_of(head: Head, obs_dim: int, act_dim: int, network: NetworkConfig) -> Network:
    """The network of an actor whose last layer says what `head` names."""
    if head == "deterministic":
        return networks.make_deterministic_actor(obs_dim, act_dim, network)
    make = networks.make_actor if head == "gaussian" else functools.partial(networks.make_affine_actor, output_gain=1.0)
    return make(obs_dim, act_dim, network)  # the gain only says where training begins


def actor_policy(obs_dim: int, act_dim: int, network: NetworkConfig, head: Head) -> Policy:
    """How such an actor acts.

    head: what its last layer says: that of `make_affine_actor`, `make_actor` or `make_deterministic_actor`. The last
    explores with noise of std 0.1, which is cut off at the bounds, so its actions have no density.
    """
    actor = make_actor_of(head, obs_dim, act_dim, network)

    def output(params: ActorParams, obs: Array) -> Array:
        return actor.apply(params.actor, normalize(params.normalizer, obs))

    def act(params: ActorParams, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        if head == "deterministic":
            return networks.add_noise(output(params, obs), jnp.where(explore, _EXPLORE_NOISE, 0.0), key), carry
        return networks.tanh_gaussian_action(output(params, obs), key, explore=explore), carry

    def log_prob(params: ActorParams, obs: Array, action: Array) -> Array:
        return networks.tanh_gaussian_log_prob(output(params, obs), networks.untanh(action))

    return Policy(lambda: (), act, log_prob=None if head == "deterministic" else log_prob)


def exported(state: PyTree) -> ActorParams:
    """Copies of the actor and the statistics of a learner's state, which may be donated afterwards."""
    return ActorParams(*jax.tree.map(jnp.copy, (state.actor.params, state.normalizer)))


def card(network: NetworkConfig, head: Head, gamma: float) -> dict[str, Any]:
    """What the card of such a policy says, see `sgft_jax.make_policy`."""
    return {"algorithm": "actor", "network": jsonable(network), "head": head, "gamma": gamma}
