"""The learners of fine-tuning: how each starts from a prior, and what it leaves in the form of one."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sgft_jax.learners.iql import IQLConfig, IQLHyper, IQLState, make_iql
from sgft_jax.learners.sac import SACConfig, SACHyper, SACState, fine_tune_state, make_sac
from sgft_jax.methods import FinetuneConfig, Method, lr_warmup, policy_delay
from sgft_jax.models import normalizer
from sgft_jax.models.networks import fix_first_layer
from sgft_jax.transforms import append_steps_to_go
from sgft_jax.types import Array, Key, Learner, Prior, PyTree


class Agent(NamedTuple):
    """start(prior, key) -> the learner's state. networks(state) -> actor and twin critic as they act, as in a prior."""

    learner: Learner
    start: Callable[[Prior, Key], PyTree]
    networks: Callable[[PyTree], tuple[PyTree, PyTree]]


def make_agent(method: Method, config: FinetuneConfig, *, obs_dim: int, act_dim: int) -> Agent:
    """The learner that suits a method."""
    make = {"sac": _sac, "iql": _iql}[method.agent]
    return make(method, config, obs_dim, act_dim)


def _sac(method: Method, config: FinetuneConfig, obs_dim: int, act_dim: int) -> Agent:
    reset = method.reset_critic if config.reset_critic is None else config.reset_critic
    reset |= method.fresh
    told = config.horizon if method.finite_horizon else 1
    rows = config.batch_size * (2 if config.relabel_simulated else 1)  # before those that branches add
    sac = SACConfig(
        obs_dim,
        act_dim,
        extra_obs=told if told > 1 else 0,
        network=config.network,
        critic_network=config.critic_network if reset else None,
        tune_alpha=config.tune_alpha,
        train_value=False,
        train_dynamics=False,
        train_critic=config.train_critic,
        critics=config.critics,
        target_critics=config.target_critics,
        actor_mean=config.actor_mean,
        critic_baseline=method.uses_value and not reset,
        actor_batch=rows if config.actor_real_only else None,
        policy_delay=policy_delay(config, method.utd),
        max_grad_norm=config.max_grad_norm,
    )
    hyper = SACHyper(
        lr_actor=config.lr_actor,
        lr_critic=config.lr_critic,
        lr_alpha=config.lr_actor,
        tau=config.tau,
        alpha=config.alpha,
        entropy_per_dim=config.entropy_per_dim,
        actor_start=config.critic_warmup or 0,
        actor_ramp=config.actor_ramp,
        lr_warmup=0 if reset else lr_warmup(config, method.utd),
    )
    learner = make_sac(sac, hyper)

    def start(prior: Prior, key: Key) -> SACState:
        if method.fresh:
            own = jax.tree.map(jnp.copy, prior.normalizer)  # the caller may donate the state
            return learner.init(key).replace(normalizer=normalizer.pad(own, sac.extra_obs))
        return fine_tune_state(sac, hyper, prior, key, reset_critic=reset)

    def networks(state: SACState) -> tuple[PyTree, PyTree]:
        extra = append_steps_to_go(jnp.zeros(0), jnp.int32(config.horizon), told)
        twin = jax.tree.map(lambda x: x[:2], state.critic.params)
        return fix_first_layer(state.actor.params, obs_dim, extra), fix_first_layer(twin, obs_dim, extra)

    return Agent(learner, start, networks)


def _iql(method: Method, config: FinetuneConfig, obs_dim: int, act_dim: int) -> Agent:
    del method  # it always starts fresh: the simulator's agent was not trained this way
    iql = IQLConfig(obs_dim, act_dim, network=config.network, max_grad_norm=config.max_grad_norm)
    hyper = IQLHyper(
        lr_actor=config.lr_actor,
        lr_critic=config.lr_critic,
        lr_value=config.lr_critic,
        tau=config.tau,
        expectile=config.expectile,
        beta=config.beta,
        reward_scale=config.reward_scale or 1.0,
    )
    learner = make_iql(iql, hyper)

    def start(prior: Prior, key: Key) -> IQLState:
        own = jax.tree.map(jnp.copy, prior.normalizer)  # the caller may donate the state
        return learner.init(key).replace(normalizer=own)

    def networks(state: IQLState) -> tuple[PyTree, PyTree]:
        return _with_log_std(state.actor.params["mean"], state.actor.params["log_std"]), state.critic.params

    return Agent(learner, start, networks)


def _with_log_std(mean: PyTree, log_std: Array) -> PyTree:
    """A network of pre-tanh means [act_dim] as an actor's, [2, act_dim], with the same log_std [act_dim] everywhere."""
    last = max(mean, key=lambda name: (name.startswith("Dense"), name))
    kernel, bias = mean[last]["kernel"], mean[last]["bias"]
    wide = jnp.concatenate([kernel, jnp.zeros_like(kernel)], axis=1)
    return {**mean, last: {"kernel": wide, "bias": jnp.concatenate([bias, log_std])}}
