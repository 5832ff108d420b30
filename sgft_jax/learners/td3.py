"""TD3: a deterministic actor, twin critics, noise on target actions, an actor that moves more rarely.

Structure is static in `TD3Config`; every number is a leaf of the state in `TD3Hyper`. Source: Fujimoto et al. 2018.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.learners import steps
from sgft_jax.learners.steps import Networks
from sgft_jax.math import losses, optim
from sgft_jax.models import normalizer
from sgft_jax.models.networks import NetworkConfig, add_noise, make_critic, make_deterministic_actor
from sgft_jax.types import Batch, Learner, Metrics, Normalizer

__all__ = ["TD3Config", "TD3Hyper", "TD3Params", "TD3State", "act", "extract_params", "init", "make_td3"]
__all__ += ["policy_action", "update"]


@dataclass(frozen=True)
class TD3Config(checks.Checked):
    """The structure of an agent.

    obs_dim, act_dim: sizes of what the environment gives and takes. network: body of actor and critics.
    policy_delay: critic updates per update of the actor.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=NetworkConfig)
    policy_delay: checks.Count = 2


class TD3Hyper(NamedTuple):
    """The numbers of an agent, each [].

    lr: Adam learning rate of both networks. tau: target averaging rate. explore_noise: std when it explores.
    target_noise, target_noise_max: std and bound of the noise on target actions.
    """

    lr: float | Array = 3e-4
    tau: float | Array = 0.005
    explore_noise: float | Array = 0.1
    target_noise: float | Array = 0.2
    target_noise_max: float | Array = 0.5


class TD3Params(NamedTuple):
    """What TD3 leaves. critic: with a leading axis of its two members. Both read normalised observations."""

    actor: PyTree
    critic: PyTree
    normalizer: Normalizer


class TD3State(struct.PyTreeNode):
    """An agent in training. step: [] int32 updates done."""

    actor: optim.Fit
    critic: optim.Fit
    target_actor: PyTree
    target_critic: PyTree
    normalizer: Normalizer
    hyper: TD3Hyper
    step: Array


# --- the learner ------------------------------------------------------------------------------------------------------


def _networks(config: TD3Config) -> Networks:
    sizes = config.obs_dim, config.act_dim, config.network
    return Networks(config, make_deterministic_actor(*sizes), make_critic(*sizes), optim.adam())


def init(config: TD3Config, key: Key, hyper: Any = None) -> TD3State:
    """A fresh agent. Set the observation statistics with `state.replace(normalizer=...)`."""
    parts = steps.begin(_networks(config), *jax.random.split(key))
    target = jax.tree.map(jnp.copy, parts["actor"].params)  # as that of the critic
    return TD3State(**parts, target_actor=target, hyper=optim.as_leaves(TD3Hyper, hyper))


def act(
    config: TD3Config, state: TD3State, carry: tuple[()], obs: Array, key: Key, *, explore: bool | Array
) -> tuple[Array, tuple[()]]:
    """Action [act_dim] in [-1, 1] for a raw obs [obs_dim], and the carry as it was."""
    std = jnp.where(explore, state.hyper.explore_noise, 0.0)
    return add_noise(policy_action(config, extract_params(state), obs), std, key), carry


def policy_action(config: TD3Config, params: TD3Params, obs: Array) -> Array:
    """The action [act_dim] of an agent's parameters for a raw obs [obs_dim]."""
    return _networks(config).actor.apply(params.actor, normalizer.normalize(params.normalizer, obs))


def update(config: TD3Config, state: TD3State, batch: Batch, key: Key) -> tuple[TD3State, Metrics]:
    """One step of the critic and the targets; on every `policy_delay`-th turn, one of the actor.

    batch: [B, ...] raw. metrics: [] each.
    """
    nets, hyper, rows = _networks(config), state.hyper, normalizer.normalize_rows(state.normalizer, batch)

    def target(row: Batch, key: Key) -> Array:
        action = nets.actor.apply(state.target_actor, row.next_obs)
        noise = hyper.target_noise * jax.random.normal(key, action.shape)
        action = jnp.clip(action + jnp.clip(noise, -hyper.target_noise_max, hyper.target_noise_max), -1.0, 1.0)
        next_q = nets.critic.apply(state.target_critic, row.next_obs, action)
        return losses.td_target(row.reward, row.discount, next_q, jnp.float32(0), alpha=0.0)

    def actor_loss(params: PyTree) -> tuple[Array, tuple[()]]:
        action = jax.vmap(nets.actor.apply, (None, 0))(params, rows.obs)
        q = jax.vmap(nets.critic.apply, (None, 0, 0))(state.critic.params, rows.obs, action)
        return -losses.row_mean(q[:, 0], rows), ()

    targets = jax.vmap(target)(rows, jax.random.split(key, rows.reward.shape[0]))
    critic, metrics = steps.step_critic(nets, state, rows, targets, rate=hyper.lr)
    actor, loss, _ = optim.minimise(nets.optimiser, actor_loss, state.actor, hyper.lr)
    actor = optax.tree.where(state.step % config.policy_delay == 0, actor, state.actor)
    state = state.replace(
        actor=actor,
        critic=critic,
        target_actor=optax.incremental_update(actor.params, state.target_actor, hyper.tau),
        target_critic=optax.incremental_update(critic.params, state.target_critic, hyper.tau),
        step=state.step + 1,
    )
    return state, metrics | {"actor/loss": loss}


def make_td3(config: TD3Config, hyper: Any = None) -> Learner:
    """The functions of this module for one configuration."""
    return Learner(partial(init, config, hyper=hyper), lambda: (), partial(act, config), partial(update, config))


def extract_params(state: TD3State) -> TD3Params:
    """What a pretrained agent hands over."""
    return TD3Params(state.actor.params, state.critic.params, state.normalizer)
