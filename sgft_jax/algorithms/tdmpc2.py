"""TD-MPC2: plans with a latent world model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict

from envs.types import Array, Key, Policy, PyTree
from sgft_jax.algorithms.base import Algorithm, Card, Recipe, Width, learning_rate
from sgft_jax.types import Batch, Task

if TYPE_CHECKING:
    from sgft_jax.learners.tdmpc2 import TDMPC2Config, TDMPC2Hyper
    from sgft_jax.models.networks import Network
    from sgft_jax.presets import PretrainConfig


class _Planner(TypedDict):
    horizon: Width
    size: str
    plan_samples: Width
    sgft: NotRequired[bool]


class _TDMPC2Card(Card):
    config: _Planner


def _params() -> type[Any]:
    from sgft_jax.learners.tdmpc2_model import TDMPC2Params

    return TDMPC2Params


def _policy(card: Mapping[str, Any], task: Task) -> Policy:
    from sgft_jax.learners.tdmpc2 import TDMPC2Hyper
    from sgft_jax.policies import tdmpc2_policy

    return tdmpc2_policy(_structure(card, task.obs_dim, task.act_dim), TDMPC2Hyper(gamma=card["gamma"]))


def _networks(card: Mapping[str, Any], params: Any) -> Iterator[tuple[str, Network, PyTree]]:
    from sgft_jax.learners import tdmpc2_model

    nets = tdmpc2_model.make_networks(_structure(card, card["obs_dim"], card["act_dim"]))
    yield from ((name, getattr(nets, name), getattr(params, name)) for name in tdmpc2_model.NETWORKS)
    if params.anchor is not None:
        yield "anchor", nets.policy, params.anchor


def _structure(card: Mapping[str, Any], obs_dim: int, act_dim: int) -> TDMPC2Config:
    from sgft_jax.learners.tdmpc2_model import named_config

    structure = {name: card["config"][name] for name in ("horizon", "size", "plan_samples")}
    return named_config(obs_dim, act_dim, **structure, sgft=card["config"].get("sgft", False))


def _recipe(task: Task, config: PretrainConfig) -> Recipe:
    """The fleet follows the policy alone: a plan costs some ten thousand evaluations of the model, the policy one."""
    import jax
    import jax.numpy as jnp

    from sgft_jax.data import memory, sequences
    from sgft_jax.learners import tdmpc2, tdmpc2_model

    size = {name: getattr(config, name) for name in ("horizon", "size", "plan_samples")}
    structure, rate = tdmpc2_model.named_config(task.obs_dim, task.act_dim, **size), learning_rate(config)

    def hyper(steps: Array) -> TDMPC2Hyper:
        numbers = tdmpc2.TDMPC2Hyper(lr=rate(steps), tau=config.tau, gamma=config.gamma)
        return jax.tree.map(jnp.float32, numbers)

    def act(agent: Any, carry: PyTree, obs: Array, key: Key) -> tuple[Array, PyTree]:
        return tdmpc2.policy_action(structure, agent, obs, key, explore=True), carry

    def sample(experience: PyTree, key: Key, n: int) -> Batch:
        return sequences.sample(experience, key, n, config.horizon)

    windows = memory.windows(task, config.n_envs, sample)
    learner = tdmpc2.make_tdmpc2(structure, hyper(jnp.int32(0)))
    return Recipe(learner, windows, hyper, lambda: (), act, tdmpc2.extract_params)


def _always(card: Mapping[str, Any]) -> bool:
    return True


ALGORITHM = Algorithm(
    "tdmpc2",
    _TDMPC2Card,
    _params,
    _policy,
    _networks,
    _recipe,
    preset="robust-tdmpc2",
    plans=_always,
)
