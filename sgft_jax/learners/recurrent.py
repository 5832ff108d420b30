"""Recurrent SAC: actor and critic have a GRU each, which reads the episode so far. For systems that hide something.

It learns from windows that begin where an episode begins, with a state of zeros, as a policy acts. Source: Ni et al.
2022, pomdp-baselines. Different here: no reward among the inputs, and all losses are taken at the same parameters, so
that one pass along the windows serves the three memories (actor, critic, target critic).
"""

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.learners import steps
from sgft_jax.learners.steps import Networks
from sgft_jax.math import losses, optim
from sgft_jax.models import networks, normalizer
from sgft_jax.models.gru import make_gru
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.stacking import stack
from sgft_jax.types import Batch, Learner, Metrics, Normalizer

__all__ = ["Carry", "RecurrentConfig", "RecurrentHyper", "RecurrentParams", "RecurrentState", "act", "extract_params"]
__all__ += ["init", "init_carry", "make_recurrent", "policy_action", "update"]


@dataclass(frozen=True)
class RecurrentConfig(checks.Checked):
    """The structure of an agent.

    obs_dim, act_dim: sizes of what the environment gives and takes. network: the body behind either memory.
    gru: units of either memory.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=lambda: NetworkConfig(hidden=(256, 256)))
    gru: checks.Count = 128


class RecurrentHyper(NamedTuple):
    """The numbers of an agent, each [].

    lr: Adam learning rate of everything. tau: target averaging rate. alpha: initial temperature.
    entropy_per_dim: target entropy / act_dim, nats.
    """

    lr: float | Array = 3e-4
    tau: float | Array = 0.005
    alpha: float | Array = 1.0
    entropy_per_dim: float | Array = -1.0


class RecurrentParams(NamedTuple):
    """What recurrent SAC leaves.

    actor, critic: {"memory": of the GRU, "head": of the body}; the critic's head has a leading axis of two members.
    normalizer: statistics of the random-action data; every network above reads normalised observations.
    """

    actor: PyTree
    critic: PyTree
    normalizer: Normalizer


class RecurrentState(struct.PyTreeNode):
    """An agent in training."""

    actor: optim.Fit
    critic: optim.Fit
    target_critic: PyTree
    log_alpha: optim.Fit
    normalizer: Normalizer
    hyper: RecurrentHyper


class Carry(NamedTuple):
    """What the policy remembers of an episode: `hidden` [gru], and the `action` [act_dim] before, 0 at the start."""

    hidden: Array
    action: Array


# --- the learner ------------------------------------------------------------------------------------------------------


def _networks(config: RecurrentConfig) -> Networks:
    """The memories of actor and critic have one shape."""
    memory = make_gru(config.obs_dim, config.act_dim, config.gru)
    sizes = memory.features, config.act_dim, config.network
    actor, critic = networks.make_actor(*sizes), networks.make_critic(*sizes)
    return Networks(config, actor, critic, optim.adam(), memory=memory)


def init(config: RecurrentConfig, key: Key, hyper: RecurrentHyper | None = None) -> RecurrentState:
    """A fresh agent. Set the observation statistics with `state.replace(normalizer=...)`."""
    nets, numbers, keys = _networks(config), optim.as_leaves(RecurrentHyper, hyper), jax.random.split(key, 4)
    actor = {"memory": nets.memory.init(keys[0]), "head": nets.actor.init(keys[1])}
    critic = {"memory": nets.memory.init(keys[2]), "head": nets.critic.init(keys[3])}
    return RecurrentState(
        actor=optim.start(nets.optimiser, actor),
        critic=optim.start(nets.optimiser, critic),
        target_critic=jax.tree.map(jnp.copy, critic),  # its own buffers: a donated state must not hold one twice
        log_alpha=optim.start(nets.optimiser, jnp.maximum(jnp.log(numbers.alpha), steps.LOG_ALPHA_MIN)),
        normalizer=normalizer.identity(config.obs_dim),
        hyper=numbers,
    )


def init_carry(config: RecurrentConfig) -> Carry:
    """At the start of an episode."""
    return Carry(jnp.zeros(config.gru), jnp.zeros(config.act_dim))


def act(
    config: RecurrentConfig, state: RecurrentState, carry: Carry, obs: Array, key: Key, *, explore: bool | Array
) -> tuple[Array, Carry]:
    """Action [act_dim] in [-1, 1] for a raw obs [obs_dim], and what the policy remembers from then on."""
    return policy_action(config, extract_params(state), carry, obs, key, explore=explore)


def policy_action(
    config: RecurrentConfig, params: RecurrentParams, carry: Carry, obs: Array, key: Key, *, explore: bool | Array
) -> tuple[Array, Carry]:
    """The same of an agent's parameters alone."""
    nets, obs = _networks(config), normalizer.normalize(params.normalizer, obs)
    hidden, features = nets.memory.step(params.actor["memory"], carry.hidden, carry.action, obs)
    action = networks.tanh_gaussian_action(nets.actor.apply(params.actor["head"], features), key, explore=explore)
    return action, Carry(hidden, action)


def update(config: RecurrentConfig, state: RecurrentState, batch: Batch, key: Key) -> tuple[RecurrentState, Metrics]:
    """One step of actor and critic, then of target and temperature. metrics: [] each.

    batch: windows [B, T, ...] raw, which begin where episodes begin.
    """
    nets = _networks(config)
    previous, obs = jax.vmap(_window, (None, 0))(state.normalizer, batch)
    rows, alpha = _rows(batch), jnp.exp(state.log_alpha.params)
    keys = jax.random.split(key, (2, *rows.reward.shape))

    def remembered(*memories: PyTree) -> list[tuple[Array, Array]]:
        """For each memory what it hands on before and after each step, [B * T, features] each."""
        stacked = stack(memories)
        windows = jax.vmap(nets.memory.along, (None, 0, 0))
        return [(_flat(x[:, :-1]), _flat(x[:, 1:])) for x in jax.vmap(windows, (0, None, None))(stacked, previous, obs)]

    def loss(actor: PyTree, critic: PyTree) -> tuple[Array, tuple[Metrics, Array]]:
        (acting, acting_next), (judging, _), (_, judging_next) = remembered(
            actor["memory"], critic["memory"], jax.lax.stop_gradient(state.target_critic["memory"])
        )

        def target(row: Batch, seen: Array, judged: Array, key: Key) -> Array:
            action, log_prob = networks.tanh_gaussian_sample(nets.actor.apply(actor["head"], seen), key)
            next_q = nets.critic.apply(state.target_critic["head"], judged, action)
            return losses.td_target(row.reward, row.discount, next_q, log_prob, alpha=alpha)

        def follow(seen: Array, judged: Array, key: Key) -> tuple[Array, Array]:
            action, log_prob = networks.tanh_gaussian_sample(nets.actor.apply(actor["head"], seen), key)
            q = nets.critic.apply(*jax.lax.stop_gradient((critic["head"], judged)), action)
            return losses.actor_loss(log_prob, q, alpha=alpha), log_prob

        targets = jax.vmap(target)(rows, acting_next, judging_next, keys[0])
        q = jax.vmap(nets.critic.apply, (None, 0, 0))(critic["head"], judging, rows.action)
        of_critic = losses.row_mean(jax.vmap(losses.critic_loss)(q, targets), rows)
        values, log_prob = jax.vmap(follow)(acting, judging, keys[1])
        of_actor, where = losses.row_mean(values, rows), rows.valid
        metrics = {
            "critic/loss": of_critic,
            "critic/q_mean": jnp.mean(q.mean(axis=1), where=where),
            "critic/target_mean": jnp.mean(targets, where=where),
            "actor/loss": of_actor,
            "actor/entropy": -jnp.mean(log_prob, where=where),
        }
        return of_critic + of_actor, (metrics, log_prob)  # no parameter is in both

    learned, hyper = (state.actor, state.critic), state.hyper
    grads, (metrics, log_prob) = jax.grad(loss, (0, 1), has_aux=True)(*(fit.params for fit in learned))
    actor, critic = (optim.step(nets.optimiser, fit, g, hyper.lr) for fit, g in zip(learned, grads, strict=True))
    log_alpha = steps.step_temperature(
        nets, state, rows, log_prob, target=hyper.entropy_per_dim * config.act_dim, rate=hyper.lr
    )
    average = optax.incremental_update(critic.params, state.target_critic, hyper.tau)
    state = state.replace(actor=actor, critic=critic, target_critic=average, log_alpha=log_alpha)
    return state, metrics | {"actor/alpha": jnp.exp(log_alpha.params)}


def make_recurrent(config: RecurrentConfig, hyper: RecurrentHyper | None = None) -> Learner:
    """The functions of this module for one configuration: `update` takes windows [B, T]."""
    start, first = partial(init, config, hyper=hyper), partial(init_carry, config)
    return Learner(start, first, partial(act, config), partial(update, config))


def extract_params(state: RecurrentState) -> RecurrentParams:
    """What a pretrained agent hands over."""
    return RecurrentParams(state.actor.params, state.critic.params, state.normalizer)


# --- windows ----------------------------------------------------------------------------------------------------------


def _window(statistics: Normalizer, window: Batch) -> tuple[Array, Array]:
    """What memories read of a window of T steps: previous actions [T + 1, act_dim], observations [T + 1, obs_dim]."""
    obs = jnp.concatenate([window.obs[:1], window.next_obs])
    previous = jnp.concatenate([jnp.zeros_like(window.action[:1]), window.action])
    return previous, jax.vmap(normalizer.normalize, (None, 0))(statistics, obs)


def _rows(batch: Batch) -> Batch:
    """The steps [B * T] of windows [B, T], one after another."""
    shape = batch.reward.shape
    valid = jnp.ones(shape, bool) if batch.valid is None else batch.valid
    weight = None if batch.weight is None else jnp.broadcast_to(batch.weight[:, None], shape)
    return jax.tree.map(_flat, batch._replace(valid=valid, weight=weight))


def _flat(x: Array) -> Array:
    return x.reshape(-1, *x.shape[2:])
