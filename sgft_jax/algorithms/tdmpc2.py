"""TD-MPC2: plans with a latent world model."""

from collections.abc import Mapping
from typing import Any, NotRequired, TypedDict

from envs.types import Array, Key, Policy, PyTree
from sgft_jax import data, learners
from sgft_jax.algorithms.base import Algorithm, Card, Config, Networks, Recipe, Width, scheduled
from sgft_jax.types import Batch, Task


class _Planner(TypedDict):
    horizon: Width
    size: str
    plan_samples: Width
    sgft: NotRequired[bool]


class _TDMPC2Card(Card):
    config: _Planner


def _policy(card: Mapping[str, Any], task: Task) -> Policy:
    from sgft_jax.policies import tdmpc2_policy

    hyper = learners.tdmpc2.TDMPC2Hyper(gamma=card["gamma"])
    return tdmpc2_policy(_structure(card["config"], task.obs_dim, task.act_dim), hyper)


def _networks(card: Mapping[str, Any], params: Any) -> Networks:
    from sgft_jax.learners import tdmpc2_model

    nets = tdmpc2_model.make_networks(_structure(card["config"], card["obs_dim"], card["act_dim"]))
    yield from ((name, getattr(nets, name), getattr(params, name)) for name in tdmpc2_model.NETWORKS)
    if params.anchor is not None:
        yield "anchor", nets.policy, params.anchor


def _structure(config: Mapping[str, Any], obs_dim: int, act_dim: int) -> Any:
    """The `TDMPC2Config` that a card's `config`, or the fields of one of pretraining, describe."""
    from sgft_jax.learners.tdmpc2_model import named_config

    structure = {name: config[name] for name in ("horizon", "size", "plan_samples")}
    return named_config(obs_dim, act_dim, **structure, sgft=config.get("sgft", False))


def _recipe(task: Task, config: Config) -> Recipe:
    """The fleet follows the policy alone: a plan costs some ten thousand evaluations of the model, the policy one."""
    tdmpc2, memory = learners.tdmpc2, data.memory
    structure = _structure(vars(config), task.obs_dim, task.act_dim)

    def act(agent: Any, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        return tdmpc2.policy_action(structure, agent, obs, key, explore=explore), carry

    def sample(experience: PyTree, key: Key, n: int) -> Batch:
        return data.sequences.sample(experience, key, n, config.horizon)

    hyper = scheduled(config, lambda rate: tdmpc2.TDMPC2Hyper(lr=rate, tau=config.tau, gamma=config.gamma))
    learner = tdmpc2.make_tdmpc2(structure, hyper(0))._replace(init_carry=lambda: (), act=act)
    return Recipe(learner, memory.windows(task, config.n_envs, sample), hyper, tdmpc2.extract_params)


ALGORITHM = Algorithm(
    "tdmpc2",
    _TDMPC2Card,
    lambda: learners.tdmpc2.TDMPC2Params,
    _policy,
    _networks,
    _recipe,
    preset="robust-tdmpc2",
    plans=lambda card: True,
)
