"""Recurrent SAC: actor and critic have a GRU each, which reads the episode so far. For systems that hide something.

It learns from windows that begin where an episode begins, with a state of zeros, as a policy acts. Source: Ni et al.
2022, pomdp-baselines. Different here: no reward among the inputs, and all losses are taken at the same parameters, so
that one pass along the windows serves the three memories (actor, critic, target critic).
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.learners import steps
from sgft_jax.math import losses, optim
from sgft_jax.models import normalizer
from sgft_jax.models.gru import GRU, make_gru
from sgft_jax.models.networks import (
    Network,
    NetworkConfig,
    make_actor,
    make_critic,
    tanh_gaussian_action,
    tanh_gaussian_sample,
)
from sgft_jax.stacking import stack
from sgft_jax.types import Batch, Learner, Metrics, Normalizer


@dataclass(frozen=True)
class RecurrentConfig:
    """The structure of an agent.

    obs_dim, act_dim: sizes of what the environment gives and takes. network: the body behind either memory.
    gru: units of either memory.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=lambda: NetworkConfig(hidden=(256, 256)))
    gru: int = 128

    def __post_init__(self) -> None:
        checks.at_least(self, 1, "gru")


class RecurrentHyper(NamedTuple):
    """The numbers of an agent, each [].

    lr: Adam learning rate of everything. tau: target averaging rate. alpha: initial temperature.
    entropy_per_dim: target entropy / act_dim, nats.
    """

    lr: float | Array = 3e-4
    tau: float | Array = 0.005
    alpha: float | Array = 1.0
    entropy_per_dim: float | Array = -1.0


class RECURRENTParams(NamedTuple):
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


class _Parts(NamedTuple):
    """The networks and the optimiser that a configuration describes; the two memories have one shape."""

    memory: GRU
    actor: Network
    critic: Network
    optimiser: optax.GradientTransformation


def _parts(config: RecurrentConfig) -> _Parts:
    memory = make_gru(config.obs_dim, config.act_dim, config.gru)
    return _Parts(
        memory=memory,
        actor=make_actor(memory.features, config.act_dim, config.network),
        critic=make_critic(memory.features, config.act_dim, config.network),
        optimiser=optim.adam(),
    )


# --- acting -----------------------------------------------------------------------------------------------------------


def init_carry(config: RecurrentConfig) -> Carry:
    """At the start of an episode."""
    return Carry(jnp.zeros(config.gru), jnp.zeros(config.act_dim))


def act(
    config: RecurrentConfig,
    actor: PyTree,
    statistics: Normalizer,
    carry: Carry,
    obs: Array,
    key: Key,
    *,
    explore: bool | Array,
) -> tuple[Array, Carry]:
    """Action [act_dim] of the actor with these parameters. obs: [obs_dim] raw."""
    parts = _parts(config)
    obs = normalizer.normalize(statistics, obs)
    hidden, features = parts.memory.step(actor["memory"], carry.hidden, carry.action, obs)
    action = tanh_gaussian_action(parts.actor.apply(actor["head"], features), key, explore=explore)
    return action, Carry(hidden, action)


# --- one update -------------------------------------------------------------------------------------------------------


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


def _update(
    config: RecurrentConfig, parts: _Parts, state: RecurrentState, batch: Batch, key: Key
) -> tuple[RecurrentState, Metrics]:
    """Actor and critic, then target and temperature."""
    previous, obs = jax.vmap(_window, (None, 0))(state.normalizer, batch)
    rows, alpha = _rows(batch), jnp.exp(state.log_alpha.params)
    keys = jax.random.split(key, (2, *rows.reward.shape))

    def remembered(*memories: PyTree) -> list[tuple[Array, Array]]:
        """For each memory what it hands on before and after each step, [B * T, features] each."""
        stacked = stack(memories)
        windows = jax.vmap(parts.memory.along, (None, 0, 0))
        return [(_flat(x[:, :-1]), _flat(x[:, 1:])) for x in jax.vmap(windows, (0, None, None))(stacked, previous, obs)]

    def loss(actor: PyTree, critic: PyTree) -> tuple[Array, tuple[Metrics, Array]]:
        (acting, acting_next), (judging, _), (_, judging_next) = remembered(
            actor["memory"], critic["memory"], jax.lax.stop_gradient(state.target_critic["memory"])
        )

        def target(row: Batch, seen: Array, judged: Array, key: Key) -> Array:
            action, log_prob = tanh_gaussian_sample(parts.actor.apply(actor["head"], seen), key)
            next_q = parts.critic.apply(state.target_critic["head"], judged, action)
            return losses.td_target(row.reward, row.discount, next_q, log_prob, alpha=alpha)

        def follow(seen: Array, judged: Array, key: Key) -> tuple[Array, Array]:
            action, log_prob = tanh_gaussian_sample(parts.actor.apply(actor["head"], seen), key)
            q = parts.critic.apply(*jax.lax.stop_gradient((critic["head"], judged)), action)
            return losses.actor_loss(log_prob, q, alpha=alpha), log_prob

        targets = jax.vmap(target)(rows, acting_next, judging_next, keys[0])
        q = jax.vmap(parts.critic.apply, (None, 0, 0))(critic["head"], judging, rows.action)
        of_critic = losses.row_mean(jax.vmap(losses.critic_loss)(q, targets), rows)
        each, log_prob = jax.vmap(follow)(acting, judging, keys[1])
        of_actor, where = losses.row_mean(each, rows), rows.valid
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
    actor, critic = (optim.step(parts.optimiser, fit, g, hyper.lr) for fit, g in zip(learned, grads, strict=True))
    log_alpha = steps.step_temperature(
        parts.optimiser, state.log_alpha, rows, log_prob, target=hyper.entropy_per_dim * config.act_dim, rate=hyper.lr
    )
    average = optax.incremental_update(critic.params, state.target_critic, hyper.tau)
    state = state.replace(actor=actor, critic=critic, target_critic=average, log_alpha=log_alpha)
    return state, metrics | {"actor/alpha": jnp.exp(log_alpha.params)}


# --- the learner ------------------------------------------------------------------------------------------------------


def make_recurrent(config: RecurrentConfig, hyper: RecurrentHyper | None = None) -> Learner:
    """The learner of a configuration: `update` takes windows [B, T] that begin where episodes begin.

    Set the observation statistics with `state.replace(normalizer=...)`.
    """
    parts, hyper = _parts(config), hyper or RecurrentHyper()

    def init(key: Key) -> RecurrentState:
        keys = jax.random.split(key, 4)
        actor = {"memory": parts.memory.init(keys[0]), "head": parts.actor.init(keys[1])}
        critic = {"memory": parts.memory.init(keys[2]), "head": parts.critic.init(keys[3])}
        numbers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), hyper)
        return RecurrentState(
            actor=optim.start(parts.optimiser, actor),
            critic=optim.start(parts.optimiser, critic),
            target_critic=jax.tree.map(jnp.copy, critic),  # its own buffers: a donated state must not hold one twice
            log_alpha=optim.start(parts.optimiser, jnp.maximum(jnp.log(numbers.alpha), steps.LOG_ALPHA_MIN)),
            normalizer=normalizer.identity(config.obs_dim),
            hyper=numbers,
        )

    def own_act(
        state: RecurrentState,
        carry: Carry,
        obs: Array,
        key: Key,
        *,
        explore: bool | Array,
        context: Array | None = None,
    ) -> tuple[Array, Carry]:
        del context  # it reads observations and actions alone
        return act(config, state.actor.params, state.normalizer, carry, obs, key, explore=explore)

    def update(state: RecurrentState, batch: Batch, key: Key) -> tuple[RecurrentState, Metrics]:
        return _update(config, parts, state, batch, key)

    return Learner(init, lambda: init_carry(config), own_act, update)


def extract_params(state: RecurrentState) -> RECURRENTParams:
    """What a pretrained agent hands over."""
    return RECURRENTParams(state.actor.params, state.critic.params, state.normalizer)
