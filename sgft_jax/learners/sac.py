"""Soft actor-critic, with a value network and a dynamics ensemble that may be trained alongside.

Structure (shapes, which networks train) is static in `SACConfig`; every number is a leaf of the state in `SACHyper`,
so that learning rates and temperatures vmap like seeds do. Source: Haarnoja et al. 2018; SGFT Appendix C.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree, UserError
from sgft_jax import checks
from sgft_jax.math import losses, optim
from sgft_jax.models import dynamics, normalizer
from sgft_jax.models.distortion import Distortion
from sgft_jax.models.networks import (
    Network,
    NetworkConfig,
    check_params,
    make_actor,
    make_critic,
    make_dynamics,
    make_value,
    pad_first_layer,
    precision,
    tanh_gaussian_action,
    tanh_gaussian_divergence,
    tanh_gaussian_sample,
)
from sgft_jax.types import Batch, Learner, Metrics, Normalizer

LOG_ALPHA_MIN = -10.0  # dense negative rewards would drive an auto-tuned temperature to zero


@dataclass(frozen=True)
class SACConfig:
    """The structure of an agent.

    obs_dim, act_dim: sizes of what the environment gives and takes.
    context_dim: length of `Batch.context`, which actor and critic read beside the observation.
    network: body of all networks; critic_network: body of the critic alone, default the same.
    tune_alpha: follow the target entropy; False keeps the temperature at `SACHyper.alpha`.
    train_value, train_dynamics, ensemble_size: the extra networks of pretraining.
    train_critic: False keeps the critic as it is (a frozen-critic actor-critic).
    critics: members of the critic ensemble. target_critics: a target is the minimum over so many random ones of them,
        None = all (REDQ, RLPD). actor_mean: the actor follows the members' mean, not their minimum (RLPD).
    entropy_in_target: False bootstraps from Q alone.
    critic_baseline: Q(s, a) = net(s, a) - V(s) with V frozen: what a kept critic means under shaped rewards.
    actor_batch: leading rows of the batch that the actor learns from, None = all. weighted_actor: these rows count in
        the losses of actor, temperature and value as they weigh; False = alike, and weights are of TD errors alone.
    policy_delay: critic updates per update of actor and temperature. max_grad_norm: per network, None = no clipping.
    """

    obs_dim: int
    act_dim: int
    context_dim: int = 0
    network: NetworkConfig = field(default_factory=NetworkConfig)
    critic_network: NetworkConfig | None = None
    tune_alpha: bool = True
    train_value: bool = True
    train_dynamics: bool = True
    ensemble_size: int = 5
    train_critic: bool = True
    critics: int = 2
    target_critics: int | None = None
    actor_mean: bool = False
    entropy_in_target: bool = True
    critic_baseline: bool = False
    actor_batch: int | None = None
    weighted_actor: bool = True
    anchored: bool = False
    policy_delay: int = 1
    max_grad_norm: float | None = None

    def __post_init__(self) -> None:
        if self.critic_baseline and self.train_value:
            raise UserError("SAC option critic_baseline needs a frozen value network: set train_value to False")
        checks.at_least(self, 1, "policy_delay", "critics", "target_critics")
        if (self.target_critics or 1) > self.critics:
            raise checks.refusal("target_critics", self.target_critics, f"at most critics, {self.critics}")


Critic = Callable[[PyTree, Array, Array], Array]  # (params of members, obs, action) -> [members]


class CriticTerm(Protocol):
    """What is added to the critic's loss; `__call__` -> []."""

    def __call__(
        self,
        critic: Critic,
        params: PyTree,
        policy: Callable[[Array, Key], tuple[Array, Array]],
        batch: Batch,
        key: Key,
    ) -> Array:
        """params: of the critic. policy(obs, key) -> (action, log pi []). batch: what the networks read."""
        ...


class SACHyper(NamedTuple):
    """The numbers of an agent, each [].

    lr_*: Adam learning rates. tau: target averaging rate. alpha: initial (or fixed) temperature.
    entropy_per_dim: target entropy / act_dim, nats. lr_warmup: updates over which lr_critic rises linearly from 0.
    actor_start: updates before the actor moves; actor_ramp: updates over which its learning rate then rises linearly.
    anchor: weight of the divergence from the anchor in the actor's loss, in units of reward per nat.
    """

    lr_actor: float | Array = 3e-4
    lr_critic: float | Array = 3e-4
    lr_value: float | Array = 3e-4
    lr_dynamics: float | Array = 3e-4
    lr_alpha: float | Array = 3e-4
    tau: float | Array = 0.005
    alpha: float | Array = 1.0
    entropy_per_dim: float | Array = -1.0
    actor_start: float | Array = 0.0
    actor_ramp: float | Array = 0.0
    lr_warmup: float | Array = 0.0
    anchor: float | Array = 0.0


class SACParams(NamedTuple):
    """What SAC leaves for fine-tuning: parameters alone.

    actor, critic, value: networks; the critic has a leading axis of its two members.
    dynamics: the delta-dynamics ensemble, leading axis = member.
    normalizer: statistics of the random-action data; every network above reads normalised observations.
    distortion: what the real system makes of commands, None = nothing.
    system: [k] what the actor is told of the system at the end of its observation, None = what stands there.
    """

    actor: PyTree
    critic: PyTree
    value: PyTree
    dynamics: PyTree
    normalizer: Normalizer
    distortion: Distortion | None = None
    system: Array | None = None


class SACState(struct.PyTreeNode):
    """An agent in training; `value` and `dynamics` are an `optim.Fit`, or None where the configuration has no use.

    anchor: parameters of the actor that an anchored one is held to, or None.
    """

    actor: optim.Fit
    critic: optim.Fit
    target_critic: PyTree
    log_alpha: optim.Fit
    value: PyTree
    dynamics: PyTree
    normalizer: Normalizer
    hyper: SACHyper
    step: Array
    anchor: PyTree = None


class _Parts(NamedTuple):
    """The networks and the optimiser that a configuration describes."""

    actor: Network
    critic: Network
    value: Network
    dynamics: Network
    optimiser: optax.GradientTransformation
    critic_term: CriticTerm | None = None


def _parts(config: SACConfig) -> _Parts:
    inputs, act_dim, body = config.obs_dim + config.context_dim, config.act_dim, config.network
    return _Parts(
        actor=make_actor(inputs, act_dim, body),
        critic=make_critic(inputs, act_dim, config.critic_network or body, members=config.critics),
        value=make_value(config.obs_dim, body),
        dynamics=make_dynamics(config.obs_dim, act_dim, body, members=config.ensemble_size),
        optimiser=optim.adam(config.max_grad_norm),
    )


def make_sac(config: SACConfig, hyper: SACHyper | None = None, *, critic_term: CriticTerm | None = None) -> Learner:
    """The learner of a configuration. Set the observation statistics with `state.replace(normalizer=...)`.

    critic_term: what other algorithms add to the critic's loss.
    """
    parts = _parts(config)._replace(critic_term=critic_term)
    hyper = hyper or SACHyper()

    def init(key: Key) -> SACState:
        keys = jax.random.split(key, 4)
        value = parts.value.init(keys[2]) if config.train_value or config.critic_baseline else None
        model = parts.dynamics.init(keys[3]) if config.train_dynamics else None
        return _assemble(config, parts, hyper, parts.actor.init(keys[0]), parts.critic.init(keys[1]), value, model)

    def act(
        state: SACState,
        carry: tuple[()],
        obs: Array,
        key: Key,
        *,
        explore: bool | Array,
        context: Array | None = None,
    ) -> tuple[Array, tuple[()]]:
        moments = parts.actor.apply(state.actor.params, network_input(state.normalizer, obs, context))
        return tanh_gaussian_action(moments, key, explore=explore), carry

    def update(state: SACState, batch: Batch, key: Key) -> tuple[SACState, Metrics]:
        return _update(config, parts, state, batch, key)

    return Learner(init, lambda: (), act, update)


def network_input(statistics: Normalizer, obs: Array, context: Array | None) -> Array:
    """What actor and critic read [obs_dim + context_dim]: the normalised observation, then the context as it is."""
    obs = normalizer.normalize(statistics, obs)
    return obs if context is None else jnp.concatenate([obs, context])


def _assemble(
    config: SACConfig,
    parts: _Parts,
    hyper: SACHyper,
    actor: PyTree,
    critic: PyTree,
    value: PyTree | None,
    model: PyTree | None,
) -> SACState:
    """Fresh optimiser moments around given parameters."""
    hyper = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), hyper)
    fit = lambda params: None if params is None else optim.start(parts.optimiser, params)  # noqa: E731
    return SACState(
        actor=optim.start(parts.optimiser, actor),
        critic=optim.start(parts.optimiser, critic),
        target_critic=jax.tree.map(jnp.copy, critic),  # its own buffers: a donated state must not hold one twice
        log_alpha=optim.start(parts.optimiser, jnp.maximum(jnp.log(hyper.alpha), LOG_ALPHA_MIN)),
        value=fit(value),
        dynamics=fit(model),
        normalizer=normalizer.identity(config.obs_dim),
        hyper=hyper,
        step=jnp.int32(0),
    )


# --- one update ---------------------------------------------------------------------------------------------------


def _update(config: SACConfig, parts: _Parts, state: SACState, batch: Batch, key: Key) -> tuple[SACState, Metrics]:
    """Critic, target, actor, temperature, then value (on the actor's own draws) and dynamics."""
    key_target, key_actor, key_dynamics, key_members, *key_term = jax.random.split(key, 5 if parts.critic_term else 4)
    raw, read = batch, jax.vmap(network_input, (None, 0, 0))
    batch = batch._replace(
        obs=read(state.normalizer, batch.obs, batch.context),
        next_obs=read(state.normalizer, batch.next_obs, batch.next_context),
    )

    metrics: Metrics = {}
    if config.train_critic:
        members = _target_members(config, key_members)
        state, metrics = _update_critic(config, parts, state, batch, members, key_target, *key_term)
    rows = jax.tree.map(lambda x: x[: config.actor_batch], batch)
    rows = rows if config.weighted_actor else rows._replace(weight=None)
    state, q, log_prob, more = _update_actor(config, parts, state, rows, key_actor)
    metrics |= more
    if config.tune_alpha:
        state = _update_temperature(config, parts, state, rows, log_prob)
    if config.train_value:
        state, more = _update_value(config, parts, state, rows, q)
        metrics |= more
    if config.train_dynamics:
        fit, more = dynamics.update(
            parts.dynamics, parts.optimiser, state.dynamics, state.normalizer, raw, key_dynamics,
            rate=state.hyper.lr_dynamics,
        )  # fmt: skip
        state, metrics = state.replace(dynamics=fit), metrics | more
    metrics["actor/alpha"] = jnp.exp(state.log_alpha.params)
    return state.replace(step=state.step + 1), metrics


def _critic_of(config: SACConfig, parts: _Parts, state: SACState) -> Callable[[PyTree, Array, Array], Array]:
    """The critic (params, obs, action) -> [members], relative to the frozen value where a baseline is asked for."""
    if not config.critic_baseline:
        return parts.critic.apply

    def relative(params: PyTree, obs: Array, action: Array) -> Array:
        with precision("float32"):  # as in value.predict: the difference of two large numbers
            return parts.critic.apply(params, obs, action) - parts.value.apply(
                state.value.params, obs[: config.obs_dim]
            )

    return relative


def _update_critic(
    config: SACConfig,
    parts: _Parts,
    state: SACState,
    batch: Batch,
    counted: Array | slice,
    key: Key,
    key_term: Key | None = None,
) -> tuple[SACState, Metrics]:
    """counted: the members that a target is the minimum of. key_term: for the critic term, where there is one."""
    critic, alpha = _critic_of(config, parts, state), jnp.exp(state.log_alpha.params)

    def target(row: Batch, key: Key) -> Array:
        action, log_prob = tanh_gaussian_sample(parts.actor.apply(state.actor.params, row.next_obs), key)
        next_q = critic(state.target_critic, row.next_obs, action)[counted]
        price = alpha if config.entropy_in_target else 0.0
        return losses.td_target(row.reward, row.discount, next_q, log_prob, alpha=price)

    targets = jax.vmap(target)(batch, jax.random.split(key, batch.reward.shape[0]))

    def loss(params: PyTree) -> tuple[Array, Array]:
        q = jax.vmap(critic, (None, 0, 0))(params, batch.obs, batch.action)
        error = losses.row_mean(jax.vmap(losses.critic_loss)(q, targets), batch)
        if parts.critic_term is None or key_term is None:
            return error, q
        policy = lambda obs, key: tanh_gaussian_sample(parts.actor.apply(state.actor.params, obs), key)  # noqa: E731
        return error + parts.critic_term(critic, params, policy, batch, key_term), q

    (value, q), grads = jax.value_and_grad(loss, has_aux=True)(state.critic.params)
    rate = state.hyper.lr_critic * optim.warmup_factor(state.step, state.hyper.lr_warmup)
    fit = optim.step(parts.optimiser, state.critic, grads, rate)
    average = optax.incremental_update(fit.params, state.target_critic, state.hyper.tau)
    metrics = {"critic/loss": value, "critic/q_mean": jnp.mean(q), "critic/target_mean": jnp.mean(targets)}
    return state.replace(critic=fit, target_critic=average), metrics


def _target_members(config: SACConfig, key: Key) -> Array | slice:
    """Which members of the critic a target is the minimum of: the same ones for the whole batch."""
    if config.target_critics is None:
        return slice(None)
    return jax.random.permutation(key, config.critics)[: config.target_critics]


def _update_actor(
    config: SACConfig, parts: _Parts, state: SACState, rows: Batch, key: Key
) -> tuple[SACState, Array, Array, Metrics]:
    """Also returns the q [B, members] and log-probabilities [B] of the actions drawn, for value and temperature."""
    critic, alpha = _critic_of(config, parts, state), jnp.exp(state.log_alpha.params)
    keys = jax.random.split(key, rows.reward.shape[0])

    def one(params: PyTree, obs: Array, key: Key) -> tuple[Array, Array, Array]:
        action, log_prob = tanh_gaussian_sample(parts.actor.apply(params, obs), key)
        q = critic(state.critic.params, obs, action)
        followed = jnp.mean(q, keepdims=True) if config.actor_mean else q
        loss = losses.actor_loss(log_prob, followed, alpha=alpha)
        if config.anchored:
            loss += state.hyper.anchor * tanh_gaussian_divergence(
                parts.actor.apply(params, obs), parts.actor.apply(state.anchor, obs)
            )
        return loss, q, log_prob

    def loss(params: PyTree) -> tuple[Array, tuple[Array, Array]]:
        each, q, log_prob = jax.vmap(one, (None, 0, 0))(params, rows.obs, keys)
        return losses.row_mean(each, rows), (q, log_prob)

    (value, (q, log_prob)), grads = jax.value_and_grad(loss, has_aux=True)(state.actor.params)
    hyper, since = state.hyper, state.step - state.hyper.actor_start
    rate = hyper.lr_actor * optim.warmup_factor(since, hyper.actor_ramp)
    moves = (since >= 0) & _policy_turn(config, state)
    fit = optim.keep_unless(moves, optim.step(parts.optimiser, state.actor, grads, rate), state.actor)
    return state.replace(actor=fit), q, log_prob, {"actor/loss": value, "actor/entropy": -jnp.mean(log_prob)}


def _update_temperature(config: SACConfig, parts: _Parts, state: SACState, rows: Batch, log_prob: Array) -> SACState:
    target = state.hyper.entropy_per_dim * config.act_dim
    rate = state.hyper.lr_alpha
    fit = step_temperature(parts.optimiser, state.log_alpha, rows, log_prob, target=target, rate=rate)
    return state.replace(log_alpha=optim.keep_unless(_policy_turn(config, state), fit, state.log_alpha))


def step_temperature(
    optimiser: optax.GradientTransformation,
    log_alpha: optim.Fit,
    rows: Batch,
    log_prob: Array,
    *,
    target: float | Array,
    rate: float | Array,
) -> optim.Fit:
    """One step of the temperature's logarithm. log_prob: [B] of the actions drawn. target: [] entropy, nats."""

    def loss(log_alpha: Array) -> Array:
        each = jax.vmap(lambda lp: losses.temperature_loss(log_alpha, lp, target_entropy=target))(log_prob)
        return losses.row_mean(each, rows)

    fit = optim.step(optimiser, log_alpha, jax.grad(loss)(log_alpha.params), rate)
    return fit._replace(params=jnp.maximum(fit.params, LOG_ALPHA_MIN))


def _policy_turn(config: SACConfig, state: SACState) -> Array:
    """Whether this update is one of those that move actor and temperature."""
    return state.step % config.policy_delay == 0


def _update_value(config: SACConfig, parts: _Parts, state: SACState, rows: Batch, q: Array) -> tuple[SACState, Metrics]:
    obs = rows.obs[:, : config.obs_dim]

    def loss(params: PyTree) -> Array:
        values = jax.vmap(parts.value.apply, (None, 0))(params, obs)
        return losses.row_mean(jax.vmap(losses.value_loss)(values, q), rows)

    value, grads = jax.value_and_grad(loss)(state.value.params)
    fit = optim.step(parts.optimiser, state.value, grads, state.hyper.lr_value)
    return state.replace(value=fit), {"value/loss": value}


# --- between simulation and reality -----------------------------------------------------------------------------------


def extract_params(state: SACState) -> SACParams:
    """What a pretrained agent hands over. Its configuration must have trained value and dynamics."""
    if state.value is None or state.dynamics is None:
        raise UserError("a prior needs an agent trained with train_value and train_dynamics")
    networks = (state.actor, state.critic, state.value, state.dynamics)
    return SACParams(*(fit.params for fit in networks), normalizer=state.normalizer)


def state_from_prior(
    config: SACConfig, hyper: SACHyper, params: SACParams, key: Key, *, reset_critic: bool
) -> SACState:
    """An agent that starts from a prior: its actor, its fixed normaliser, fresh optimiser moments.

    reset_critic: draw a new critic from `key`, else keep the simulator's. With `config.context_dim` the kept networks
    get zero rows for the context, so that the first policy is the simulator's whatever the context holds.
    """
    parts = _parts(config)
    check_params_of_prior(config, params, critic=not reset_critic)
    params = jax.tree.map(jnp.copy, params)  # the caller may donate the state; the prior must survive it

    def pad(network: PyTree) -> PyTree:
        return pad_first_layer(network, config.obs_dim, config.context_dim)

    critic = parts.critic.init(key) if reset_critic else pad(params.critic)
    value = params.value if config.train_value or config.critic_baseline else None
    model = params.dynamics if config.train_dynamics else None
    state = _assemble(config, parts, hyper, pad(params.actor), critic, value, model)
    anchor = jax.tree.map(jnp.copy, state.actor.params) if config.anchored else None
    return state.replace(normalizer=params.normalizer, anchor=anchor)


def check_params_of_prior(config: SACConfig, params: SACParams, *, critic: bool) -> None:
    """Raise UserError where a network of the prior is not the one that `config` describes."""
    body = {"network": config.network, "critic_network": config.critic_network, "critics": config.critics}
    parts = _parts(SACConfig(config.obs_dim, config.act_dim, **body))
    owner = f"obs_dim {config.obs_dim}, act_dim {config.act_dim}, hidden {config.network.hidden}"
    for name in ("actor", "value", *(["critic"] if critic else [])):
        check_params(
            name, getattr(parts, name), getattr(params, name), f"{owner}: use the prior's own task and network"
        )
