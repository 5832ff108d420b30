"""How parameters act and value states: those of SAC by their actor or by plans, TD-MPC2's, actors alone."""

import functools
from typing import Literal, NamedTuple

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
from sgft_jax.models.system import append_system
from sgft_jax.types import Normalizer, Task

__all__ = ["mpc_policy", "sac_policy", "tdmpc2_policy"]

_EXPLORE_NOISE = 0.1
Head = Literal["affine", "gaussian", "deterministic"]


def sac_policy(obs_dim: int, act_dim: int, network: NetworkConfig) -> Policy:
    """Actor, V_sim and dynamics ensemble of `SACParams`."""
    actor = networks.make_actor(obs_dim, act_dim, network)
    value_net = value.make_v_sim(obs_dim, network)
    model = networks.make_dynamics(obs_dim, act_dim, network)

    def act(params: SACParams, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        if params.distortion is not None:
            obs = params.distortion.seen(obs)
        if params.system is not None:
            obs = append_system(obs, params.system)
        action = networks.tanh_gaussian_action(
            actor.apply(params.actor, normalize(params.normalizer, obs)), key, explore=explore
        )
        return action if params.distortion is None else params.distortion.command(action), carry

    return Policy(
        init_carry=lambda: (),
        act=act,
        value=lambda params, obs, system=None: value.predict(value_net, params.value, params.normalizer, obs, system),
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


# --- actors alone, which methods of fixed data leave ------------------------------------------------------------------


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


def actor_params(state: PyTree) -> ActorParams:
    """Copies of the actor and the statistics of a learner's state, which may be donated afterwards."""
    return ActorParams(*jax.tree.map(jnp.copy, (state.actor.params, state.normalizer)))
