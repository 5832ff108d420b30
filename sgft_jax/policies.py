"""How the parameters of a prior act and value states, for each algorithm that leaves one."""

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from envs.types import Array, Key, Policy, PyTree, UserError
from sgft_jax.learners import recurrent, tdmpc2, tdmpc2_model
from sgft_jax.learners.actor import actor_policy, make_actor_of
from sgft_jax.learners.sac import SACParams
from sgft_jax.models import dynamics, value
from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.gru import GRU, make_gru
from sgft_jax.models.networks import (
    Network,
    add_noise,
    check_params,
    make_actor,
    make_critic,
    make_dynamics,
    make_value,
    tanh_gaussian_action,
)
from sgft_jax.models.normalizer import normalize
from sgft_jax.models.system import told
from sgft_jax.planning import mpc
from sgft_jax.types import Task

__all__ = ["make_policy", "mpc_policy", "sac_policy", "tdmpc2_policy"]


def make_policy(card: Mapping[str, Any], task: Task) -> Policy:
    """How the prior with this card acts. task: its task; policies that plan ask it for rewards.

    card: `algorithm`, `gamma`, `network` (SAC, recurrent SAC, actors alone), `head` (actors alone), `config` (TD-MPC2,
    recurrent SAC), and `plan` for a prior of SAC that plans.
    """
    if card.get("algorithm", "sac") == "tdmpc2":
        return tdmpc2_policy(_structure_of(card, task.obs_dim, task.act_dim), tdmpc2.TDMPC2Hyper(gamma=card["gamma"]))
    network = network_of(card)
    if card.get("algorithm") == "actor":
        return actor_policy(task.obs_dim, task.act_dim, network, card["head"])
    if card.get("algorithm") == "recurrent":
        return recurrent_policy(recurrent.RecurrentConfig(task.obs_dim, task.act_dim, network, card["config"]["gru"]))
    if plan := card.get("plan"):
        config = mpc.MPCConfig(task.obs_dim, task.act_dim, network, **plan, gamma=card["gamma"])
        return mpc_policy(config, task)
    return sac_policy(task.obs_dim, task.act_dim, network)


def check_parameters(card: Mapping[str, Any], params: Any) -> None:
    """Raises UserError where parameters, or their shapes, are not of the sizes and networks that a card describes.

    Parts that a prior does not have are None; all have statistics and what acts.
    """
    obs_dim, act_dim, entries = card["obs_dim"], card["act_dim"], len(card.get("system", []))
    sizes = {
        "normalizer": ((obs_dim,), (obs_dim,)),
        "distortion": ((act_dim, act_dim), (act_dim,), (_offsets(params, obs_dim, act_dim),)),
        "system": (entries,),
        "scale": (),
    }
    if params.normalizer is None:
        raise UserError("not a prior: it has no observation statistics")
    if (shape := getattr(params.normalizer.mean, "shape", ())) != (obs_dim,):
        raise UserError(f"its card says obs_dim={obs_dim}, the statistics have {' x '.join(map(str, shape))}")
    for name, wanted in sizes.items():
        part = getattr(params, name, None)
        if part is not None and (shapes := jax.tree.map(lambda x: x.shape, part)) != wanted:
            raise UserError(f"{name} has the shapes {shapes}, by its card {wanted}; take another prior")
    for name, network, part in _networks_of(card, params):
        check_params(name, network, part, "its card; take another prior")
    if odd := [path for path, x in jax.tree_util.tree_leaves_with_path(params) if x.dtype != jnp.float32]:
        raise UserError(f"{jax.tree_util.keystr(odd[0])} is not float32; take another prior")


def _offsets(params: Any, obs_dim: int, act_dim: int) -> int:
    """How many measurements a prior corrects, if whole actions then follow them in an observation; else none fit."""
    count = sum(math.prod(x.shape) for x in jax.tree.leaves(getattr(getattr(params, "distortion", None), "offset", ())))
    return count if count <= obs_dim and (obs_dim - count) % act_dim == 0 else -1


def _networks_of(card: Mapping[str, Any], params: Any) -> Iterator[tuple[str, Network, PyTree]]:
    """The networks that a card describes, by name, each with what the prior has for it."""
    sizes, algorithm = (card["obs_dim"], card["act_dim"]), card.get("algorithm", "sac")
    if algorithm == "tdmpc2":
        nets = tdmpc2_model.make_networks(_structure_of(card, *sizes))
        yield from ((name, getattr(nets, name), getattr(params, name)) for name in tdmpc2_model.NETWORKS)
        if params.anchor is not None:
            yield "anchor", nets.policy, params.anchor
        return
    network = network_of(card)
    if algorithm == "actor":
        yield "actor", make_actor_of(card["head"], *sizes, network), params.actor
    elif algorithm == "recurrent":
        memory = make_gru(*sizes, card["config"]["gru"])
        actor, critic = (make(memory.features, card["act_dim"], network) for make in (make_actor, make_critic))
        yield "actor", _behind(memory, actor), params.actor
        yield "critic", _behind(memory, critic), params.critic
    else:
        yield "actor", make_actor(*sizes, network), params.actor
        if params.critic is not None:
            yield "critic", make_critic(*sizes, network, members=_members(params.critic)), params.critic
        if params.value is not None:
            yield "value", make_value(sizes[0], network), params.value
        if params.dynamics is not None:
            yield "dynamics", make_dynamics(*sizes, network, members=_members(params.dynamics)), params.dynamics


def _behind(memory: GRU, head: Network) -> Network:
    return Network(lambda key: {"memory": memory.init(key), "head": head.init(key)}, head.apply)


def _members(ensemble: PyTree) -> int:
    """How many networks an ensemble has; methods may keep fewer or more than the prior had."""
    return next(iter(jax.tree.leaves(ensemble)[0].shape), 1)


def _structure_of(card: Mapping[str, Any], obs_dim: int, act_dim: int) -> tdmpc2.TDMPC2Config:
    numbers = {name: card["config"][name] for name in ("horizon", "size", "plan_samples")}
    return tdmpc2_model.named_config(obs_dim, act_dim, **numbers, sgft=card["config"].get("sgft", False))


def network_of(card: Mapping[str, Any]) -> NetworkConfig:
    """The networks of a prior of SAC; raises UserError where this version knows no such network."""
    try:
        return NetworkConfig(**{**card["network"], "hidden": tuple(card["network"]["hidden"])})
    except (TypeError, KeyError):
        raise UserError(f"this version knows no such network: {card['network']}; pretrain again") from None


def sac_policy(obs_dim: int, act_dim: int, network: NetworkConfig) -> Policy:
    """Actor, V_sim and dynamics ensemble of `SACParams`."""
    actor = make_actor(obs_dim, act_dim, network)
    value_net = make_value(obs_dim, network)
    model = make_dynamics(obs_dim, act_dim, network)

    def act(params: SACParams, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        if params.distortion is not None:
            obs = params.distortion.seen(obs)
        if params.system is not None:
            obs = told(obs, params.system)
        action = tanh_gaussian_action(
            actor.apply(params.actor, normalize(params.normalizer, obs)), key, explore=explore
        )
        return action if params.distortion is None else params.distortion.command(action), carry

    return Policy(
        init_carry=lambda: (),
        act=act,
        value=lambda params, obs: value.predict(value_net, params.value, params.normalizer, obs),
        model_error=lambda params, obs, actions: dynamics.rollout_error(
            model, params.dynamics, params.normalizer, obs, actions
        ),
    )


def mpc_policy(config: mpc.MPCConfig, task: Task, *, explore_noise: float = 0.0) -> Policy:
    """The same parameters, acting by plans. explore_noise: std of the noise on what an exploring plan does."""
    if task.reward is None or task.terminated is None:
        raise UserError("plans need a task whose reward and termination are functions of observations")
    plan = mpc.make_act(config, reward=task.reward, terminated=task.terminated)

    def act(params: SACParams, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        key_plan, key_noise = jax.random.split(key)
        action, carry = plan(params, carry, obs, key_plan, explore=explore)
        return add_noise(action, jnp.where(explore, explore_noise, 0.0), key_noise), carry

    return sac_policy(config.obs_dim, config.act_dim, config.network)._replace(
        init_carry=lambda: mpc.init_carry(config), act=act
    )


def recurrent_policy(config: recurrent.RecurrentConfig) -> Policy:
    """The actor of `RecurrentParams`, which remembers the episode."""
    return Policy(partial(recurrent.init_carry, config), partial(recurrent.policy_action, config))


def tdmpc2_policy(config: tdmpc2.TDMPC2Config, hyper: tdmpc2.TDMPC2Hyper) -> Policy:
    """The planner and the value of `TDMPC2Params`."""
    learner = tdmpc2.make_tdmpc2(config, hyper)

    def act(params: PyTree, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        return learner.act(tdmpc2.state_from_prior(config, hyper, params), carry, obs, key, explore=explore)

    def value_of(params: PyTree, obs: Array) -> Array:
        return tdmpc2_model.value_of(config, tdmpc2.state_from_prior(config, hyper, params), obs)

    return Policy(learner.init_carry, act, value_of)
