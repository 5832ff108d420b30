"""An actor alone: what methods of fixed data leave. Pretraining makes none."""

from collections.abc import Mapping
from typing import Any, Literal

from envs.types import Policy
from sgft_jax.algorithms.base import Algorithm, Card, NetworkEntry, Networks
from sgft_jax.models.config import network_of
from sgft_jax.types import Task


class _ActorCard(Card):
    network: NetworkEntry
    head: Literal["affine", "gaussian", "deterministic"]


def _params() -> type[Any]:
    from sgft_jax.policies import ActorParams

    return ActorParams


def _policy(card: Mapping[str, Any], task: Task) -> Policy:
    from sgft_jax.policies import actor_policy

    return actor_policy(task.obs_dim, task.act_dim, network_of(card), card["head"])


def _networks(card: Mapping[str, Any], params: Any) -> Networks:
    from sgft_jax.policies import make_actor_of

    yield "actor", make_actor_of(card["head"], card["obs_dim"], card["act_dim"], network_of(card)), params.actor


ALGORITHM = Algorithm("actor", _ActorCard, _params, _policy, _networks)
