"""Recurrent SAC: a policy that remembers the episode."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypedDict

from envs.types import Array, Key, Policy, PyTree, UserError
from sgft_jax.algorithms.base import Algorithm, Card, NetworkEntry, Recipe, Width, learning_rate
from sgft_jax.types import Batch, Task

if TYPE_CHECKING:
    from sgft_jax.learners.recurrent import RecurrentHyper
    from sgft_jax.models.networks import Network
    from sgft_jax.presets import PretrainConfig


class _Memory(TypedDict):
    gru: Width


class _RecurrentCard(Card):
    network: NetworkEntry
    config: _Memory


def _params() -> type[Any]:
    from sgft_jax.learners.recurrent import RecurrentParams

    return RecurrentParams


def _policy(card: Mapping[str, Any], task: Task) -> Policy:
    from functools import partial

    from sgft_jax.learners import recurrent
    from sgft_jax.policies import network_of

    config = recurrent.RecurrentConfig(task.obs_dim, task.act_dim, network_of(card), card["config"]["gru"])
    return Policy(partial(recurrent.init_carry, config), partial(recurrent.policy_action, config))


def _networks(card: Mapping[str, Any], params: Any) -> Iterator[tuple[str, Network, PyTree]]:
    from sgft_jax.models import networks
    from sgft_jax.models.gru import make_gru
    from sgft_jax.policies import network_of

    memory = make_gru(card["obs_dim"], card["act_dim"], card["config"]["gru"])

    def behind(head: Network) -> Network:
        return networks.Network(lambda key: {"memory": memory.init(key), "head": head.init(key)}, head.apply)

    sizes = memory.features, card["act_dim"], network_of(card)
    yield "actor", behind(networks.make_actor(*sizes)), params.actor
    yield "critic", behind(networks.make_critic(*sizes)), params.critic


def _recipe(task: Task, config: PretrainConfig) -> Recipe:
    """Learns from whole episodes, so a batch has `batch_size` of them."""
    import functools

    import jax
    import jax.numpy as jnp

    from sgft_jax.data import memory, sequences
    from sgft_jax.learners import recurrent

    slots = {name: getattr(config, name) // config.n_envs for name in ("random_transitions", "replay_capacity")}
    for name, held in slots.items():
        if held < task.episode_length:
            raise UserError(
                f"--config.{name.replace('_', '-')} {getattr(config, name)}: recurrent policies learn from whole "
                f"episodes; {config.n_envs} environments need at least {config.n_envs * task.episode_length}"
            )
    structure = recurrent.RecurrentConfig(task.obs_dim, task.act_dim, network=config.network, gru=config.gru)
    rate = learning_rate(config)

    def hyper(steps: Array) -> RecurrentHyper:
        numbers = recurrent.RecurrentHyper(rate(steps), config.tau, config.alpha, config.entropy_per_dim)
        return jax.tree.map(jnp.float32, numbers)

    def sample(experience: PyTree, key: Key, n: int) -> Batch:
        return sequences.sample_episodes(experience, key, n, task.episode_length)

    learner = recurrent.make_recurrent(structure, hyper(jnp.int32(0)))
    return Recipe(
        learner,
        memory.windows(task, config.n_envs, sample, spare=1),  # of a full ring the oldest slot begins nothing
        hyper,
        learner.init_carry,
        functools.partial(learner.act, explore=True),
        recurrent.extract_params,
        replaced=lambda carry, action: carry._replace(action=action),
    )


ALGORITHM = Algorithm(
    "recurrent",
    _RecurrentCard,
    _params,
    _policy,
    _networks,
    _recipe,
    preset="recurrent",
    remembers=True,
    program=("gru",),
)
