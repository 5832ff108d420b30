"""Recurrent SAC: a policy that remembers the episode."""

from collections.abc import Mapping
from functools import partial
from typing import Any, TypedDict

from envs.types import Key, Policy, PyTree, UserError
from sgft_jax import data, learners
from sgft_jax.algorithms.base import Algorithm, Card, Config, NetworkEntry, Networks, Recipe, Width, scheduled
from sgft_jax.models.config import network_of
from sgft_jax.types import Batch, Task


class _Memory(TypedDict):
    gru: Width


class _RecurrentCard(Card):
    network: NetworkEntry
    config: _Memory


def _policy(card: Mapping[str, Any], task: Task) -> Policy:
    recurrent, sizes = learners.recurrent, (task.obs_dim, task.act_dim)
    config = recurrent.RecurrentConfig(*sizes, network_of(card), card["config"]["gru"])
    return Policy(partial(recurrent.init_carry, config), partial(recurrent.policy_action, config))


def _networks(card: Mapping[str, Any], params: Any) -> Networks:
    from sgft_jax.models import networks
    from sgft_jax.models.gru import make_gru

    memory = make_gru(card["obs_dim"], card["act_dim"], card["config"]["gru"])

    def behind(head: networks.Network) -> networks.Network:
        return networks.Network(lambda key: {"memory": memory.init(key), "head": head.init(key)}, head.apply)

    sizes = memory.features, card["act_dim"], network_of(card)
    yield "actor", behind(networks.make_actor(*sizes)), params.actor
    yield "critic", behind(networks.make_critic(*sizes)), params.critic


def _recipe(task: Task, config: Config) -> Recipe:
    """Learns from whole episodes, so a batch has `batch_size` of them."""
    recurrent, memory = learners.recurrent, data.memory
    slots = {name: getattr(config, name) // config.n_envs for name in ("random_transitions", "replay_capacity")}
    for name, held in slots.items():
        if held < task.episode_length:
            raise UserError(
                f"--config.{name.replace('_', '-')} {getattr(config, name)}: recurrent policies learn from whole "
                f"episodes; {config.n_envs} environments need at least {config.n_envs * task.episode_length}"
            )
    structure = recurrent.RecurrentConfig(task.obs_dim, task.act_dim, network=config.network, gru=config.gru)

    def sample(experience: PyTree, key: Key, n: int) -> Batch:
        return data.sequences.sample_episodes(experience, key, n, task.episode_length)

    numbers = config.tau, config.alpha, config.entropy_per_dim
    hyper = scheduled(config, lambda rate: recurrent.RecurrentHyper(rate, *numbers))
    episodes = memory.windows(task, config.n_envs, sample, spare=1)  # of a full ring the oldest slot begins nothing
    learner = recurrent.make_recurrent(structure, hyper(0))
    return Recipe(
        learner, episodes, hyper, recurrent.extract_params, lambda carry, action: carry._replace(action=action)
    )


ALGORITHM = Algorithm(
    "recurrent",
    _RecurrentCard,
    lambda: learners.recurrent.RecurrentParams,
    _policy,
    _networks,
    _recipe,
    preset="recurrent",
    remembers=True,
    program=("gru",),
)
