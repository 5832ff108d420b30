"""TD3: a deterministic actor and twin critics."""

from collections.abc import Mapping
from typing import Any

from envs.types import Array, Key, Policy, PyTree
from sgft_jax import data
from sgft_jax.algorithms.base import Algorithm, Card, Config, NetworkEntry, Networks, Recipe, scheduled
from sgft_jax.models.config import network_of
from sgft_jax.types import Task


class _TD3Card(Card):
    network: NetworkEntry


def _params() -> type[Any]:
    from sgft_jax.learners.td3 import TD3Params

    return TD3Params


def _policy(card: Mapping[str, Any], task: Task) -> Policy:
    import jax.numpy as jnp

    from sgft_jax.learners import td3
    from sgft_jax.models.networks import add_noise

    structure = td3.TD3Config(task.obs_dim, task.act_dim, network_of(card))

    def act(params: Any, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        std = jnp.where(explore, td3.TD3Hyper().explore_noise, 0.0)
        return add_noise(td3.policy_action(structure, params, obs), std, key), carry

    return Policy(lambda: (), act)


def _networks(card: Mapping[str, Any], params: Any) -> Networks:
    from sgft_jax.models import networks

    sizes = card["obs_dim"], card["act_dim"], network_of(card)
    yield "actor", networks.make_deterministic_actor(*sizes), params.actor
    yield "critic", networks.make_critic(*sizes), params.critic


def _recipe(task: Task, config: Config) -> Recipe:
    from sgft_jax.learners import td3

    hyper = scheduled(config, lambda rate: td3.TD3Hyper(rate, config.tau, config.explore_noise))
    structure = td3.TD3Config(task.obs_dim, task.act_dim, config.network, config.policy_delay)
    return Recipe(td3.make_td3(structure, hyper(0)), data.memory.transitions(task), hyper, td3.extract_params)


ALGORITHM = Algorithm("td3", _TD3Card, _params, _policy, _networks, _recipe, preset="td3")
