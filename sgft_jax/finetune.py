"""Fine-tuning of one agent on one real system: act, observe, learn. The caller owns the loop, and vmaps over seeds."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from sgft_jax import dynamics, optim, replay, value
from sgft_jax.networks import NetworkConfig, fix_first_layer, make_dynamics, make_value
from sgft_jax.sac import SACConfig, SACHyper, fine_tune_state, make_sac
from sgft_jax.sgft import Method, append_steps_to_go, compose
from sgft_jax.types import Array, Imagination, Key, Learner, Metrics, Normalizer, Prior, PyTree, Transition, UserError


@dataclass(frozen=True)
class FinetuneConfig:
    """Options of fine-tuning; the defaults are the paper's where it states them (Appendix C), else argued here.

    horizon, branches: H and the model branches per sampled real state. With H = 1, the paper's, the agent never takes a
        step that costs V_sim now and pays later: on hammering, where strokes do, some seeds end up hovering. H = 4 with
        2 branches has none of these (docs/results.md). batch_size: real transitions per update.
    branch_noise: std of the noise on imagined actions. The paper draws them from the policy alone (0). On pushing, 20
        rollouts and 6,000 updates, the best of 16 actions by the critic then has r_bar -0.34 in the mean, with noise
        0.5 -0.20; by the model itself -0.15, by the truth -0.07, the policy's own -0.71.
    gamma: discount factor of imagined transitions; real ones carry theirs.
    alpha: fixed temperature. network: must be the prior's.
    critic_network: body of a new critic. LayerNorm tames extrapolation on little data (RLPD); default as the prior's.
    reset_critic: None = the method's default. A kept critic under a shaped reward is read as Q_sim(s, a) - V_sim(s),
        its exact meaning in simulation.
    critic_warmup: critic-only updates at the start. The first data are the simulator's policy's own: they do not say
        what another action would do, and on pushing an actor that learned from them lost 12 points of success before it
        gained 60. None = as many as follow the initial rollouts (0 where nobody knows how many those are); 0 = as
        printed in the paper.
    actor_ramp: updates over which the actor's learning rate then rises from 0, for the same reason.
    train_dynamics: keep fitting the ensemble, on real transitions only.
    actor_real_only: the actor learns from the real rows, the critic from all (O-11).
    lr_*: Adam learning rates. tau: target averaging rate. max_grad_norm: None = no clipping.
    clip_shaped: bound on |r_bar|. V_sim falls off a cliff where a task can be lost for good (a puck over the edge): one
        such row outweighs a thousand others in a squared error, and its sign is all a policy needs. None = as printed.
    replay_capacity: transitions; 20,000 hold 400 episodes of 50 steps, more than an hour of a real robot.
    """

    horizon: int = 1
    branches: int = 5
    branch_noise: float = 0.5
    batch_size: int = 256
    gamma: float = 0.99
    alpha: float = 0.01
    network: NetworkConfig = field(default_factory=NetworkConfig)
    critic_network: NetworkConfig | None = None
    reset_critic: bool | None = None
    critic_warmup: int | None = None
    actor_ramp: int = 1000
    train_dynamics: bool = True
    actor_real_only: bool = True
    lr_actor: float = 1e-4
    lr_critic: float = 3e-4
    lr_dynamics: float = 3e-4
    tau: float = 0.005
    max_grad_norm: float | None = None
    clip_shaped: float | None = 2.0
    replay_capacity: int = 20_000

    def __post_init__(self) -> None:
        for name in ("horizon", "branches", "batch_size", "replay_capacity"):
            if getattr(self, name) < 1:
                raise UserError(f"fine-tuning option {name} is {getattr(self, name)}: must be at least 1")


class FinetuneState(struct.PyTreeNode):
    """learner: the agent; dynamics: the ensemble in training; value, normalizer: frozen parts of the prior; replay."""

    learner: PyTree
    dynamics: optim.Fit
    value: PyTree
    normalizer: Normalizer
    replay: replay.ReplayState


class Finetuner(NamedTuple):
    """Fine-tuning of one agent as pure functions.

    init(prior, key) -> state.
    act(state, obs [obs_dim], key, *, explore) -> action [act_dim].
    observe(state, transitions [T, ...], valid [T]) -> state: fill the replay buffer.
    learn(state, key, n_updates) -> (state, metrics averaged over the updates); `n_updates` is static.
    export(state) -> the agent in the form of a prior: actor and critic as they act, with the whole horizon to go.
    """

    init: Callable[[Prior, Key], FinetuneState]
    act: Callable[..., Array]
    observe: Callable[[FinetuneState, Transition, Array], FinetuneState]
    learn: Callable[[FinetuneState, Key, int], tuple[FinetuneState, Metrics]]
    export: Callable[[FinetuneState], Prior]


def sac_agent(
    method: Method, config: FinetuneConfig, *, obs_dim: int, act_dim: int
) -> tuple[Learner, Callable[[Prior, Key], PyTree]]:
    """The SAC learner that suits a method, and how it starts from a prior."""
    reset = method.reset_critic if config.reset_critic is None else config.reset_critic
    sac = SACConfig(
        obs_dim,
        act_dim,
        extra_obs=config.horizon if method.finite_horizon and config.horizon > 1 else 0,
        network=config.network,
        critic_network=config.critic_network if reset else None,
        tune_alpha=False,
        train_value=False,
        train_dynamics=False,
        critic_baseline=method.uses_value and not reset,
        actor_batch=config.batch_size if config.actor_real_only else None,
        max_grad_norm=config.max_grad_norm,
    )
    hyper = SACHyper(
        lr_actor=config.lr_actor,
        lr_critic=config.lr_critic,
        tau=config.tau,
        alpha=config.alpha,
        actor_start=config.critic_warmup or 0,
        actor_ramp=config.actor_ramp,
    )
    return make_sac(sac, hyper), lambda prior, key: fine_tune_state(sac, hyper, prior, key, reset_critic=reset)


def make_finetuner(
    method: Method,
    config: FinetuneConfig,
    *,
    obs_dim: int,
    act_dim: int,
    reward: Callable[[Array, Array, Array], Array],
    terminated: Callable[[Array, Array, Array], Array],
) -> Finetuner:
    """SAC fine-tuning by `method`. reward, terminated: the task as functions of one (obs, action, next_obs)."""
    learner, warm_start = sac_agent(method, config, obs_dim=obs_dim, act_dim=act_dim)
    value_network = make_value(obs_dim, config.network)
    model_network = make_dynamics(obs_dim, act_dim, config.network)
    optimiser = optim.adam(config.max_grad_norm)
    transform = compose(*method.transforms(config.horizon, config.branches, config.branch_noise))
    told = config.horizon if method.finite_horizon else 1  # what the agent is told about the steps to go

    def init(prior: Prior, key: Key) -> FinetuneState:
        own = jax.tree.map(jnp.copy, prior)  # the caller may donate the state; the prior must survive it
        return FinetuneState(
            learner=warm_start(prior, key),
            dynamics=optim.start(optimiser, own.dynamics),
            value=own.value,
            normalizer=own.normalizer,
            replay=replay.init(replay.blank(obs_dim, act_dim), config.replay_capacity),
        )

    def policy(agent: PyTree, obs: Array, k: Array, key: Key, *, explore: bool) -> Array:
        return learner.act(agent, learner.init_carry(), append_steps_to_go(obs, k, told), key, explore=explore)[0]

    def act(state: FinetuneState, obs: Array, key: Key, *, explore: bool) -> Array:
        return policy(state.learner, obs, jnp.int32(config.horizon), key, explore=explore)

    def observe(state: FinetuneState, transitions: Transition, valid: Array) -> FinetuneState:
        return state.replace(replay=replay.add_batch(state.replay, transitions, valid))

    def imagine(state: FinetuneState, key: Key) -> Imagination:
        # One member for the whole batch, redrawn at each update: the same expected gradient as one per row, at a
        # fraction of the cost, and no rollout mixes two models.
        member = dynamics.draw_member(state.dynamics.params, key)
        return Imagination(
            value=lambda obs: value.predict(value_network, state.value, state.normalizer, obs),
            policy=lambda obs, k, key: policy(state.learner, obs, k, key, explore=True),
            dynamics=lambda obs, action, _: dynamics.predict(model_network, member, state.normalizer, obs, action)[0],
            reward=reward,
            terminated=terminated,
            gamma=config.gamma,
        )

    def update(state: FinetuneState, key: Key) -> tuple[FinetuneState, Metrics]:
        keys = jax.random.split(key, 5)
        real = replay.sample(state.replay, keys[0], config.batch_size)
        metrics: Metrics = {}
        if method.uses_dynamics and config.train_dynamics:
            fit, metrics = dynamics.update(
                model_network, optimiser, state.dynamics, state.normalizer, real, keys[1], rate=config.lr_dynamics
            )
            state = state.replace(dynamics=fit)
        batch = transform(imagine(state, keys[2]), real, keys[3])
        if method.uses_value and config.clip_shaped is not None:
            batch = batch._replace(reward=jnp.clip(batch.reward, -config.clip_shaped, config.clip_shaped))
        agent, more = learner.update(state.learner, batch, keys[4])
        metrics |= more | {"batch/reward_mean": jnp.mean(batch.reward), "batch/reward_std": jnp.std(batch.reward)}
        return state.replace(learner=agent), metrics

    def learn(state: FinetuneState, key: Key, n_updates: int) -> tuple[FinetuneState, Metrics]:
        state, metrics = jax.lax.scan(update, state, jax.random.split(key, n_updates))
        return state, jax.tree.map(jnp.mean, metrics)

    def export(state: FinetuneState) -> Prior:
        agent = state.learner
        extra = append_steps_to_go(jnp.zeros(0), jnp.int32(config.horizon), told)
        actor, critic = (fix_first_layer(fit.params, obs_dim, extra) for fit in (agent.actor, agent.critic))
        return Prior(actor, critic, state.value, state.dynamics.params, state.normalizer)

    return Finetuner(init, act, observe, learn, export)
