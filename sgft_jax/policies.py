"""How parameters act and value states, and whether they are what a card describes."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from envs.types import Array, Key, Policy, PyTree, UserError
from sgft_jax import planning
from sgft_jax.learners import tdmpc2, tdmpc2_model
from sgft_jax.learners.sac import SACParams
from sgft_jax.models import dynamics, networks, value
from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.networks import Network
from sgft_jax.models.normalizer import normalize
from sgft_jax.models.system import told
from sgft_jax.types import Task

__all__ = ["mpc_policy", "sac_policy", "tdmpc2_policy"]


def check_parameters(card: Mapping[str, Any], params: Any, described: Iterable[tuple[str, Network, PyTree]]) -> None:
    """Raises UserError where parameters, or their shapes, are not of the sizes and networks that a card describes.

    Parts that a prior does not have are None; all have statistics and what acts. described: (name, network, what the
    prior has for it) of the networks by its card, see `Algorithm.networks`.
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
    for name, network, part in described:
        networks.check_params(name, network, part, "its card; take another prior")
    if odd := [path for path, x in jax.tree_util.tree_leaves_with_path(params) if x.dtype != jnp.float32]:
        raise UserError(f"{jax.tree_util.keystr(odd[0])} is not float32; take another prior")


def _offsets(params: Any, obs_dim: int, act_dim: int) -> int:
    """How many measurements a prior corrects, if whole actions then follow them in an observation; else none fit."""
    count = sum(math.prod(x.shape) for x in jax.tree.leaves(getattr(getattr(params, "distortion", None), "offset", ())))
    return count if count <= obs_dim and (obs_dim - count) % act_dim == 0 else -1


def network_of(card: Mapping[str, Any]) -> NetworkConfig:
    """The networks of a prior of SAC; raises UserError where this version knows no such network."""
    try:
        fields: dict[str, Any] = {**card["network"], "hidden": tuple(card["network"]["hidden"])}
        return NetworkConfig(**fields)
    except (TypeError, KeyError):
        raise UserError(f"this version knows no such network: {card['network']}; pretrain again") from None


def sac_policy(obs_dim: int, act_dim: int, network: NetworkConfig) -> Policy:
    """Actor, V_sim and dynamics ensemble of `SACParams`."""
    actor = networks.make_actor(obs_dim, act_dim, network)
    value_net = networks.make_value(obs_dim, network)
    model = networks.make_dynamics(obs_dim, act_dim, network)

    def act(params: SACParams, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        if params.distortion is not None:
            obs = params.distortion.seen(obs)
        if params.system is not None:
            obs = told(obs, params.system)
        action = networks.tanh_gaussian_action(
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


def mpc_policy(config: planning.MPCConfig, task: Task, *, explore_noise: float = 0.0) -> Policy:
    """The same parameters, acting by plans. explore_noise: std of the noise on what an exploring plan does."""
    if task.reward is None or task.terminated is None:
        raise UserError("plans need a task whose reward and termination are functions of observations")
    plan = planning.make_act(config, reward=task.reward, terminated=task.terminated)

    def act(params: SACParams, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        key_plan, key_noise = jax.random.split(key)
        action, carry = plan(params, carry, obs, key_plan, explore=explore)
        return networks.add_noise(action, jnp.where(explore, explore_noise, 0.0), key_noise), carry

    return sac_policy(config.obs_dim, config.act_dim, config.network)._replace(
        init_carry=lambda: planning.init_carry(config), act=act
    )


def tdmpc2_policy(config: tdmpc2.TDMPC2Config, hyper: tdmpc2.TDMPC2Hyper) -> Policy:
    """The planner and the value of `TDMPC2Params`."""
    learner = tdmpc2.make_tdmpc2(config, hyper)

    def act(params: PyTree, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        return learner.act(tdmpc2.state_from_prior(config, hyper, params), carry, obs, key, explore=explore)

    def value_of(params: PyTree, obs: Array) -> Array:
        return tdmpc2_model.value_of(config, tdmpc2.state_from_prior(config, hyper, params), obs)

    return Policy(learner.init_carry, act, value_of)
