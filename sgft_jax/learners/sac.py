"""Soft actor-critic, with a dynamics ensemble that may be trained alongside.

Structure (shapes, which networks train) is static in `SACConfig`; every number is a leaf of the state in `SACHyper`,
so that learning rates and temperatures vmap like seeds do. Source: Haarnoja et al. 2018; SGFT Appendix C.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from envs.types import Array, Key, PyTree, UserError
from sgft_jax import checks
from sgft_jax.learners import steps
from sgft_jax.learners.steps import Critic, Networks, Sampler
from sgft_jax.math import optim
from sgft_jax.models import dynamics, networks, normalizer
from sgft_jax.models.distortion import Distortion
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.models.value import make_v_sim
from sgft_jax.types import Batch, Learner, Metrics, Normalizer

__all__ = ["SACConfig", "SACHyper", "SACParams", "SACState", "act", "extract_params"]
__all__ += ["init", "make_sac", "network_input", "state_from_prior", "update"]


@dataclass(frozen=True)
class SACConfig(checks.Checked):
    """The structure of an agent.

    obs_dim, act_dim: sizes of what the environment gives and takes.
    network: body of all networks; critic_network: body of the critic alone, default the same.
    context_dim: length of `Batch.context`, which actor and critic read beside the observation.
    tune_alpha: follow the target entropy; False keeps the temperature at `SACHyper.alpha`.
    train_dynamics, ensemble_size: the extra networks of pretraining.
    train_critic: False keeps the critic as it is (a frozen-critic actor-critic).
    critics: members of the critic ensemble. target_critics: a target is the minimum over so many random ones of them,
        None = all (REDQ, RLPD). actor_mean: the actor follows the members' mean, not their minimum (RLPD).
    entropy_in_target: False bootstraps from Q alone.
    critic_baseline: Q(s, a) = net(s, a) - V(s) with V frozen: what a kept critic means under shaped rewards.
    actor_batch: leading rows of the batch that the actor learns from, None = all. weighted_actor: these rows count in
        the losses of actor and temperature as they weigh; False = alike, and weights are of TD errors alone.
    policy_delay: critic updates per update of actor and temperature. max_grad_norm: per network, None = no clipping.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=NetworkConfig)
    critic_network: NetworkConfig | None = None
    context_dim: int = 0
    tune_alpha: bool = True
    train_dynamics: bool = True
    ensemble_size: int = 5
    train_critic: bool = True
    critics: checks.Count = 2
    target_critics: checks.Count | None = None
    actor_mean: bool = False
    entropy_in_target: bool = True
    critic_baseline: bool = False
    actor_batch: int | None = None
    weighted_actor: bool = True
    anchored: bool = False
    policy_delay: checks.Count = 1
    max_grad_norm: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.target_critics or 1) > self.critics:
            raise checks.refusal("target_critics", self.target_critics, f"at most critics, {self.critics}")

    @classmethod
    def chosen(cls, options: Any, **others: Any) -> "SACConfig":
        """An actor and a critic, whose structure a method's options choose: they have its fields as their own."""
        names = (
            *("critic_network", "tune_alpha", "train_critic", "critics", "target_critics", "actor_mean"),
            *("actor_batch", "weighted_actor", "policy_delay", "max_grad_norm"),
        )
        choices = {name: getattr(options, name) for name in names} | others
        return cls(train_dynamics=False, **choices)


# What is added to the critic's loss: (critic, its params, policy, batch as the networks read it, key) -> []
CriticTerm = Callable[[Critic, PyTree, Sampler, Batch, Key], Array]


class SACHyper(NamedTuple):
    """The numbers of an agent, each [].

    lr_*: Adam learning rates. tau: target averaging rate. alpha: initial (or fixed) temperature.
    entropy_per_dim: target entropy / act_dim, nats. lr_warmup: updates over which lr_critic rises linearly from 0.
    actor_start: updates before the actor moves; actor_ramp: updates over which its learning rate then rises linearly.
    anchor: weight of the divergence from the anchor in the actor's loss, in units of reward per nat.
    """

    lr_actor: float | Array = 3e-4
    lr_critic: float | Array = 3e-4
    lr_dynamics: float | Array = 3e-4
    lr_alpha: float | Array = 3e-4
    tau: float | Array = 0.005
    alpha: float | Array = 1.0
    entropy_per_dim: float | Array = -1.0
    actor_start: float | Array = 0.0
    actor_ramp: float | Array = 0.0
    lr_warmup: float | Array = 0.0
    anchor: float | Array = 0.0

    @classmethod
    def chosen(cls, options: Any, **others: float) -> "SACHyper":
        """The numbers that a method's options choose; they have its fields as their own."""
        names = ("lr_actor", "lr_critic", "lr_alpha", "tau", "alpha", "entropy_per_dim", "actor_ramp")
        return cls(**{name: getattr(options, name) for name in names}, **others)


class SACParams(NamedTuple):
    """What SAC leaves for fine-tuning: parameters alone.

    actor, critic: networks; the critic has a leading axis of its two members.
    value: of `models.value.make_v_sim`, or None before its stage, `train.value_fit`.
    dynamics: the delta-dynamics ensemble, leading axis = member.
    normalizer: statistics of the random-action data; every network above reads normalised observations.
    distortion: what the real system makes of commands, None = nothing.
    system: [k] what the actor is told of the system at the end of its observation, None = what stands there.
    estimator: which system makes which rollouts, `posterior.estimator.Estimator`, or None.
    """

    actor: PyTree
    critic: PyTree
    value: PyTree
    dynamics: PyTree
    normalizer: Normalizer
    distortion: Distortion | None = None
    system: Array | None = None
    estimator: PyTree = None


class SACState(struct.PyTreeNode):
    """An agent in training; `dynamics` is an `optim.Fit`, or None where the configuration has no use.

    value: parameters of V_sim, which never learns, for a critic that is relative to it; else None.
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


def _networks(config: SACConfig) -> Networks:
    inputs, act_dim, body = config.obs_dim + config.context_dim, config.act_dim, config.network
    return Networks(
        config=config,
        actor=networks.make_actor(inputs, act_dim, body),
        critic=networks.make_critic(inputs, act_dim, config.critic_network or body, members=config.critics),
        value=make_v_sim(config.obs_dim, body),
        dynamics=networks.make_dynamics(config.obs_dim, act_dim, body, members=config.ensemble_size),
        optimiser=optim.adam(config.max_grad_norm),
    )


def init(config: SACConfig, key: Key, hyper: SACHyper | None = None) -> SACState:
    """A fresh agent. Set the observation statistics with `state.replace(normalizer=...)`."""
    nets, keys = _networks(config), jax.random.split(key, 4)
    value = nets.value.init(keys[2]) if config.critic_baseline else None
    model = nets.dynamics.init(keys[3]) if config.train_dynamics else None
    return _assemble(nets, hyper or SACHyper(), nets.actor.init(keys[0]), nets.critic.init(keys[1]), value, model)


def act(
    config: SACConfig,
    state: SACState,
    carry: tuple[()],
    obs: Array,
    key: Key,
    *,
    explore: bool | Array,
    context: Array | None = None,
) -> tuple[Array, tuple[()]]:
    """Action [act_dim] in [-1, 1], and the carry as it was. obs: [obs_dim] raw. context: [context_dim]."""
    moments = _networks(config).actor.apply(state.actor.params, network_input(state.normalizer, obs, context))
    return networks.tanh_gaussian_action(moments, key, explore=explore), carry


def update(
    config: SACConfig, state: SACState, batch: Batch, key: Key, *, critic_term: CriticTerm | None = None
) -> tuple[SACState, Metrics]:
    """One step of critic, target, actor, temperature, then of dynamics.

    batch: [B, ...] raw. critic_term: what other algorithms add to the critic's loss. metrics: [] each.
    """
    key_target, key_actor, key_dynamics, key_members, *key_term = jax.random.split(key, 5 if critic_term else 4)
    nets, raw, read = _relative(_networks(config), state), batch, jax.vmap(network_input, (None, 0, 0))
    batch = batch._replace(
        obs=read(state.normalizer, batch.obs, batch.context),
        next_obs=read(state.normalizer, batch.next_obs, batch.next_context),
    )

    metrics: Metrics = {}
    if config.train_critic:
        policy = partial(steps.sample, nets, state)
        term = critic_term and (lambda params: critic_term(nets.critic.apply, params, policy, batch, *key_term))
        state, metrics = _update_critic(nets, state, batch, (key_target, key_members), term)
    rows = jax.tree.map(lambda x: x[: config.actor_batch], batch)
    rows = rows if config.weighted_actor else rows._replace(weight=None)
    state, log_prob, of_actor = _update_actor(nets, state, rows, key_actor)
    metrics |= of_actor
    if config.tune_alpha:
        state = _update_temperature(nets, state, rows, log_prob)
    if config.train_dynamics:
        step = partial(dynamics.update, nets.dynamics, nets.optimiser, rate=state.hyper.lr_dynamics)
        fit, of_models = step(state.dynamics, state.normalizer, raw, key_dynamics)
        state, metrics = state.replace(dynamics=fit), metrics | of_models
    metrics["actor/alpha"] = jnp.exp(state.log_alpha.params)
    return state.replace(step=state.step + 1), metrics


def make_sac(config: SACConfig, hyper: SACHyper | None = None) -> Learner:
    """The functions of this module for one configuration."""
    return Learner(partial(init, config, hyper=hyper), lambda: (), partial(act, config), partial(update, config))


def network_input(statistics: Normalizer, obs: Array, context: Array | None) -> Array:
    """What actor and critic read [obs_dim + context_dim]: the normalised observation, then the context as it is."""
    obs = normalizer.normalize(statistics, obs)
    return obs if context is None else jnp.concatenate([obs, context])


def _assemble(
    nets: Networks, hyper: SACHyper, actor: PyTree, critic: PyTree, value: PyTree | None, model: PyTree | None
) -> SACState:
    """Fresh optimiser moments around given parameters."""
    hyper = optim.as_leaves(SACHyper, hyper)
    start = partial(optim.start, nets.optimiser)
    return SACState(
        actor=start(actor),
        critic=start(critic),
        target_critic=jax.tree.map(jnp.copy, critic),  # its own buffers: a donated state must not hold one twice
        log_alpha=start(jnp.maximum(jnp.log(hyper.alpha), steps.LOG_ALPHA_MIN)),
        value=value,
        dynamics=model and start(model),
        normalizer=normalizer.identity(nets.config.obs_dim),
        hyper=hyper,
        step=jnp.int32(0),
    )


# --- one update -------------------------------------------------------------------------------------------------------


def _relative(nets: Networks, state: SACState) -> Networks:
    """The networks, of which the critic is relative to the frozen value where a baseline is asked for."""
    if not nets.config.critic_baseline:
        return nets

    def relative(params: PyTree, obs: Array, action: Array) -> Array:
        with networks.precision("float32"):  # as in value.predict: the difference of two large numbers
            value = nets.value.apply(state.value, obs[: nets.config.obs_dim])
            return nets.critic.apply(params, obs, action) - value

    return nets._replace(critic=nets.critic._replace(apply=relative))


def _update_critic(
    nets: Networks, state: SACState, batch: Batch, keys: tuple[Key, Key], term: Callable[[PyTree], Array] | None
) -> tuple[SACState, Metrics]:
    """keys: of next actions, and of the members that targets are the minimum of. term: of the parameters."""
    config, members = nets.config, slice(None)
    if config.target_critics is not None:  # the same ones for the whole batch
        members = jax.random.permutation(keys[1], config.critics)[: config.target_critics]
    alpha = jnp.exp(state.log_alpha.params) if config.entropy_in_target else 0.0
    targets = steps.soft_targets(nets, state, batch, keys[0], alpha=alpha, members=members)
    rate = state.hyper.lr_critic * optim.warmup_factor(state.step, state.hyper.lr_warmup)
    fit, metrics = steps.step_critic(nets, state, batch, targets, rate=rate, term=term)
    average = optax.incremental_update(fit.params, state.target_critic, state.hyper.tau)
    return state.replace(critic=fit, target_critic=average), metrics


def _update_actor(nets: Networks, state: SACState, rows: Batch, key: Key) -> tuple[SACState, Array, Metrics]:
    """Also returns the log-probabilities [B] of the actions drawn, for the temperature."""
    config, hyper, since = nets.config, state.hyper, state.step - state.hyper.actor_start

    def divergence(params: PyTree, obs: Array) -> Array:
        anchor = nets.actor.apply(state.anchor, obs)
        return hyper.anchor * networks.tanh_gaussian_divergence(nets.actor.apply(params, obs), anchor)

    rate = hyper.lr_actor * optim.warmup_factor(since, hyper.actor_ramp)
    mean, penalty = config.actor_mean, divergence if config.anchored else None
    fit, log_prob, metrics = steps.step_actor(nets, state, rows, key, rate=rate, mean=mean, penalty=penalty)
    fit = optax.tree.where((since >= 0) & _policy_turn(config, state), fit, state.actor)
    return state.replace(actor=fit), log_prob, metrics


def _update_temperature(nets: Networks, state: SACState, rows: Batch, log_prob: Array) -> SACState:
    target, rate = state.hyper.entropy_per_dim * nets.config.act_dim, state.hyper.lr_alpha
    fit = steps.step_temperature(nets, state, rows, log_prob, target=target, rate=rate)
    return state.replace(log_alpha=optax.tree.where(_policy_turn(nets.config, state), fit, state.log_alpha))


def _policy_turn(config: SACConfig, state: SACState) -> Array:
    """Whether this update is one of those that move actor and temperature."""
    return state.step % config.policy_delay == 0


# --- between simulation and reality -----------------------------------------------------------------------------------


def extract_params(state: SACState) -> SACParams:
    """What a pretrained agent hands over. Its configuration must have trained dynamics; V_sim is fitted later."""
    if state.dynamics is None:
        raise UserError("a prior needs an agent trained with train_dynamics")
    actor, critic, models = (fit.params for fit in (state.actor, state.critic, state.dynamics))
    return SACParams(actor, critic, None, models, state.normalizer)


def state_from_prior(
    config: SACConfig, hyper: SACHyper, params: SACParams, key: Key, *, reset_critic: bool
) -> SACState:
    """An agent that starts from a prior: its actor, its fixed normaliser, fresh optimiser moments.

    reset_critic: draw a new critic from `key`, else keep the simulator's. With `config.context_dim` the kept networks
    get zero rows for the context, so that the first policy is the simulator's whatever the context holds. Raises
    UserError where a network of the prior is not the one that `config` describes.
    """
    nets, of_prior = _networks(config), _networks(replace(config, context_dim=0))
    owner = f"obs_dim {config.obs_dim}, act_dim {config.act_dim}, hidden {config.network.hidden}: use the prior's own"
    for name in ("actor", *([] if reset_critic else ["critic"])):
        networks.check_params(name, getattr(of_prior, name), getattr(params, name), f"{owner} task and network")
    params = jax.tree.map(jnp.copy, params)  # the caller may donate the state; the prior must survive it

    def pad(network: PyTree) -> PyTree:
        return networks.pad_first_layer(network, config.obs_dim, config.context_dim)

    critic = nets.critic.init(key) if reset_critic else pad(params.critic)
    value = params.value if config.critic_baseline else None
    model = params.dynamics if config.train_dynamics else None
    state = _assemble(nets, hyper, pad(params.actor), critic, value, model)
    anchor = jax.tree.map(jnp.copy, state.actor.params) if config.anchored else None
    return state.replace(normalizer=params.normalizer, anchor=anchor)
