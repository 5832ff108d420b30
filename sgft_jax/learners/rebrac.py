"""ReBRAC: TD3 on a fixed set of data, whose actor and critic each pay for leaving the data's actions.

It learns from windows of two consecutive steps, because the critic's penalty needs the data's next action. Structure is
static in `ReBRACConfig`; every number is a leaf of the state in `ReBRACHyper`. Source: Tarasov et al. 2023.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree, UserError
from sgft_jax import checks
from sgft_jax.learners import steps
from sgft_jax.learners.steps import Networks
from sgft_jax.math import losses, optim
from sgft_jax.models import normalizer
from sgft_jax.models.networks import NetworkConfig, add_noise, make_critic, make_deterministic_actor
from sgft_jax.types import Batch, Learner, Metrics, Normalizer

__all__ = ["ReBRACConfig", "ReBRACHyper", "ReBRACState", "act", "distance", "init", "make_rebrac", "td_target"]
__all__ += ["update"]


@dataclass(frozen=True)
class ReBRACConfig(checks.Checked):
    """The structure of an agent. The defaults are the published ones, but for LayerNorm, which is after ReLU there.

    obs_dim, act_dim: sizes of what the environment gives and takes. network: body of actor and critics.
    policy_delay: critic updates per update of actor and targets.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=lambda: NetworkConfig((256, 256, 256), layer_norm=True))
    policy_delay: checks.Count = 2


class ReBRACHyper(NamedTuple):
    """The numbers of an agent, each []. Batches are 1,024 windows.

    lr_*: Adam learning rates. tau: target averaging rate.
    actor_penalty: weight of |pi(s) - a|^2 beside Q / mean |Q|; critic_penalty: of |pi(s') - a'|^2 in targets, in units
        of return.
    target_noise, target_noise_max: std and bound of the noise on target actions. explore_noise: std when it explores.
    """

    lr_actor: float | Array = 1e-3
    lr_critic: float | Array = 1e-3
    tau: float | Array = 0.005
    actor_penalty: float | Array = 0.01
    critic_penalty: float | Array = 0.001
    target_noise: float | Array = 0.2
    target_noise_max: float | Array = 0.5
    explore_noise: float | Array = 0.1


class ReBRACState(struct.PyTreeNode):
    """An agent in training. step: [] int32 updates done. normalizer: does nothing to observations until it is set."""

    actor: optim.Fit
    critic: optim.Fit
    target_actor: PyTree
    target_critic: PyTree
    normalizer: Normalizer
    hyper: ReBRACHyper
    step: Array


# --- losses of one transition -----------------------------------------------------------------------------------------


def distance(action: Array, other: Array) -> Array:
    """Squared distance [] of two actions [act_dim]."""
    chex.assert_rank([action, other], 1)
    return jnp.sum((action - other) ** 2)


def td_target(reward: Array, discount: Array, next_q: Array, next_distance: Array, *, penalty: Array | float) -> Array:
    """Target r + discount (min_i Q_i(s', a') - penalty |a' - a'_data|^2) [], a constant. next_q: [members]."""
    chex.assert_rank([reward, discount, next_q, next_distance], [0, 0, 1, 0])
    return jax.lax.stop_gradient(reward + discount * (jnp.min(next_q) - penalty * next_distance))


# --- the learner ------------------------------------------------------------------------------------------------------


def _networks(config: ReBRACConfig) -> Networks:
    sizes = config.obs_dim, config.act_dim, config.network
    return Networks(config, make_deterministic_actor(*sizes), make_critic(*sizes), optim.adam())


def init(config: ReBRACConfig, key: Key, hyper: Any = None) -> ReBRACState:
    """A fresh agent. Set the observation statistics with `state.replace(normalizer=...)`."""
    parts = steps.begin(_networks(config), *jax.random.split(key))
    target = jax.tree.map(jnp.copy, parts["actor"].params)  # as that of the critic
    return ReBRACState(**parts, target_actor=target, hyper=optim.as_leaves(ReBRACHyper, hyper))


def act(
    config: ReBRACConfig, state: ReBRACState, carry: tuple[()], obs: Array, key: Key, *, explore: bool | Array
) -> tuple[Array, tuple[()]]:
    """Action [act_dim] in [-1, 1] for a raw obs [obs_dim], and the carry as it was."""
    action = _networks(config).actor.apply(state.actor.params, normalizer.normalize(state.normalizer, obs))
    return jnp.where(explore, add_noise(action, state.hyper.explore_noise, key), action), carry


def update(config: ReBRACConfig, state: ReBRACState, batch: Batch, key: Key) -> tuple[ReBRACState, Metrics]:
    """One step of the critic; on every `policy_delay`-th turn, one of actor and targets. metrics: [] each.

    batch: windows [B, 2, ...] of consecutive steps, raw, with a mask. A window whose second step is not valid has no
    next action: its target is without the penalty. Raises UserError for other shapes.
    """
    nets, (rows, next_action, follows) = _networks(config), _rows(batch)
    rows = normalizer.normalize_rows(state.normalizer, rows)
    state, metrics = _update_critic(nets, state, rows, next_action, follows, key)
    actor, of_actor = _step_actor(nets, state, rows)
    moved = state.replace(
        actor=actor,
        target_actor=optax.incremental_update(actor.params, state.target_actor, state.hyper.tau),
        target_critic=optax.incremental_update(state.critic.params, state.target_critic, state.hyper.tau),
    )
    state = optax.tree.where(state.step % config.policy_delay == 0, moved, state)
    return state.replace(step=state.step + 1), metrics | of_actor


def make_rebrac(config: ReBRACConfig, hyper: Any = None) -> Learner:
    """The functions of this module for one configuration: `update` takes windows [B, 2]."""
    return Learner(partial(init, config, hyper=hyper), lambda: (), partial(act, config), partial(update, config))


# --- one update -------------------------------------------------------------------------------------------------------


def _rows(batch: Batch) -> tuple[Batch, Array, Array]:
    """The first steps of windows as rows [B, ...], the actions [B, act_dim] of the second ones, and which [B] count."""
    if batch.reward.ndim != 2 or batch.reward.shape[1] != 2 or batch.valid is None:
        raise UserError(f"ReBRAC learns from windows [rows, 2] with a mask, not {list(batch.reward.shape)}")
    first = jax.tree.map(lambda x: x[:, 0], batch._replace(weight=None))
    return first._replace(weight=batch.weight), batch.action[:, 1], batch.valid[:, 1]


def _update_critic(
    nets: Networks, state: ReBRACState, rows: Batch, next_action: Array, follows: Array, key: Key
) -> tuple[ReBRACState, Metrics]:
    hyper = state.hyper

    def target(row: Batch, next_action: Array, follows: Array, key: Key) -> Array:
        action = nets.actor.apply(state.target_actor, row.next_obs)
        noise = hyper.target_noise * jax.random.normal(key, action.shape)
        action = jnp.clip(action + jnp.clip(noise, -hyper.target_noise_max, hyper.target_noise_max), -1.0, 1.0)
        next_q = nets.critic.apply(state.target_critic, row.next_obs, action)
        away = jnp.where(follows, distance(action, next_action), 0.0)
        return td_target(row.reward, row.discount, next_q, away, penalty=hyper.critic_penalty)

    targets = jax.vmap(target)(rows, next_action, follows, jax.random.split(key, rows.reward.shape[0]))
    fit, metrics = steps.step_critic(nets, state, rows, targets, rate=hyper.lr_critic)
    return state.replace(critic=fit), metrics


def _step_actor(nets: Networks, state: ReBRACState, rows: Batch) -> tuple[optim.Fit, Metrics]:
    """The actor after a step on penalty |pi(s) - a|^2 - Q / mean |Q|."""

    def loss(params: PyTree) -> tuple[Array, Array]:
        action = jax.vmap(nets.actor.apply, (None, 0))(params, rows.obs)
        q = jnp.min(jax.vmap(nets.critic.apply, (None, 0, 0))(state.critic.params, rows.obs, action), axis=1)
        scale = jax.lax.stop_gradient(1 / jnp.maximum(losses.row_mean(jnp.abs(q), rows), 1e-6))
        away = jax.vmap(distance)(action, rows.action)
        return losses.row_mean(state.hyper.actor_penalty * away - scale * q, rows), jnp.mean(away)

    fit, mean, away = optim.minimise(nets.optimiser, loss, state.actor, state.hyper.lr_actor)
    return fit, {"actor/loss": mean, "actor/distance": away}
