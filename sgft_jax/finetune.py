"""Fine-tuning of one agent on one real system: act, observe, learn. The caller owns the loop, and vmaps over seeds."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from sgft_jax.agents import make_agent
from sgft_jax.data import replay
from sgft_jax.finetune_mpc import make_mpc, make_planned
from sgft_jax.finetune_planner import make_planner
from sgft_jax.learners import optim
from sgft_jax.methods import FinetuneConfig, Method, check_options, dynamics_warmup
from sgft_jax.models import dynamics, value
from sgft_jax.models.networks import make_dynamics, make_value
from sgft_jax.transforms import append_steps_to_go, compose, relabel
from sgft_jax.types import (
    Array,
    Finetuner,
    Imagination,
    Key,
    Metrics,
    Normalizer,
    Prior,
    PyTree,
    Simulated,
    Transition,
    UserError,
)


class FinetuneState(struct.PyTreeNode):
    """learner: the agent; dynamics: the ensemble in training; value, normalizer: frozen parts of the prior; replay."""

    learner: PyTree
    dynamics: optim.Fit
    value: PyTree
    normalizer: Normalizer
    replay: replay.ReplayState


def mix(real: Transition, simulated: Transition, share: Array | float) -> Transition:
    """The first `share` [] of the rows simulated, the others real; both [B, ...]. Source: RLPD's symmetric sampling."""
    n = real.reward.shape[0]
    first = jnp.arange(n) < jnp.round(share * n)
    return jax.tree.map(lambda s, r: jnp.where(first.reshape(-1, *[1] * (r.ndim - 1)), s, r), simulated, real)


def make_finetuner(
    method: Method,
    config: FinetuneConfig,
    *,
    obs_dim: int,
    act_dim: int,
    reward: Callable[[Array, Array, Array], Array],
    terminated: Callable[[Array, Array, Array], Array],
) -> Finetuner:
    """Fine-tuning by `method`. reward, terminated: the task as functions of one (obs, action, next_obs).

    UserError for options that the method has no use for.
    """
    check_options(method, config)
    if method.agent == "tdmpc2":
        return make_planner(method, config, obs_dim=obs_dim, act_dim=act_dim)
    if method.agent == "mpc":
        return make_mpc(method, config, obs_dim=obs_dim, act_dim=act_dim, reward=reward, terminated=terminated)
    agent = make_agent(method, config, obs_dim=obs_dim, act_dim=act_dim)
    learner = agent.learner
    value_network = make_value(obs_dim, config.network)
    model_network = make_dynamics(obs_dim, act_dim, config.network)
    optimiser = optim.adam(config.max_grad_norm)
    warmup = dynamics_warmup(config, method.utd)
    transform = compose(*method.transforms(config.horizon, config.branches, config.branch_noise))
    told = config.horizon if method.finite_horizon else 1  # what the agent is told about the steps to go
    plans = make_planned(config, obs_dim=obs_dim, act_dim=act_dim, reward=reward, terminated=terminated)

    def init(prior: Prior, key: Key) -> FinetuneState:
        own = jax.tree.map(jnp.copy, prior)  # the caller may donate the state; the prior must survive it
        return FinetuneState(
            learner=agent.start(prior, key),
            dynamics=optim.start(optimiser, own.dynamics),
            value=own.value,
            normalizer=own.normalizer,
            replay=replay.init(replay.blank(obs_dim, act_dim), config.replay_capacity),
        )

    def policy(agent: PyTree, obs: Array, k: Array, key: Key, *, explore: bool) -> Array:
        return learner.act(agent, learner.init_carry(), append_steps_to_go(obs, k, told), key, explore=explore)[0]

    def act(
        state: FinetuneState, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array
    ) -> tuple[Array, PyTree]:
        k = jnp.int32(config.horizon)
        if config.plan_rollouts:
            # A branch, not a choice between both: an evaluation has many times the steps of a rollout and plans none.
            best = lambda: (policy(state.learner, obs, k, key, explore=False), carry)  # noqa: E731
            return jax.lax.cond(explore, lambda: plans.act(export(state), carry, obs, key, explore=True), best)
        sample, mode = (policy(state.learner, obs, k, key, explore=choice) for choice in (True, False))
        return jnp.where(explore, sample, mode), carry

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

    def share(state: FinetuneState) -> Array:
        """Of the batch, from the simulator: []."""
        end = config.simulated_share if config.simulated_share_end is None else config.simulated_share_end
        passed = jnp.minimum(state.learner.step / config.simulated_anneal, 1.0)
        return config.simulated_share + (end - config.simulated_share) * passed

    def update(
        state: FinetuneState, key: Key, simulated: Simulated | None, offline: bool
    ) -> tuple[FinetuneState, Metrics]:
        keys = jax.random.split(key, 5)
        real = replay.sample(state.replay, keys[0], config.batch_size)
        metrics: Metrics = {}
        if method.uses_dynamics and config.train_dynamics:
            rate = config.lr_dynamics * optim.risen(optim.steps_of(state.dynamics), warmup)
            fit, metrics = dynamics.update(
                model_network, optimiser, state.dynamics, state.normalizer, real, keys[1], rate=rate
            )
            state = state.replace(dynamics=fit)
        imagination, rows = imagine(state, keys[2]), real
        if simulated is not None:
            drawn = simulated(jax.random.fold_in(keys[0], 1), config.batch_size)
            if config.relabel_simulated:
                relabelled = relabel(imagination, drawn, jax.random.fold_in(keys[3], 1))
                rows = jax.tree.map(lambda *x: jnp.concatenate(x), real, relabelled)
            else:
                rows = drawn if offline else mix(real, drawn, share(state))
        batch = transform(imagination, rows, keys[3])
        if method.uses_value and config.clip_shaped is not None:
            batch = batch._replace(reward=jnp.clip(batch.reward, -config.clip_shaped, config.clip_shaped))
        new, more = learner.update(state.learner, batch, keys[4])
        metrics |= more | {"batch/reward_mean": jnp.mean(batch.reward), "batch/reward_std": jnp.std(batch.reward)}
        return state.replace(learner=new), metrics

    def learn(
        state: FinetuneState, key: Key, n_updates: int, simulated: Simulated | None = None, *, offline: bool = False
    ) -> tuple[FinetuneState, Metrics]:
        if config.needs_simulation and simulated is None:
            raise UserError(f"method {method.name} needs transitions of the simulator")
        one = lambda state, key: update(state, key, simulated, offline)  # noqa: E731
        state, metrics = jax.lax.scan(one, state, jax.random.split(key, n_updates))
        return state, jax.tree.map(jnp.mean, metrics)

    def export(state: FinetuneState) -> Prior:
        actor, critic = agent.networks(state.learner)
        return Prior(actor, critic, state.value, state.dynamics.params, state.normalizer)

    init_carry = plans.init_carry if config.plan_rollouts else learner.init_carry
    return Finetuner(init, init_carry, act, observe, learn, export)
