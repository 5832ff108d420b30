"""Fine-tuning of one agent on one real system: act, observe, learn. The caller owns the loop, and vmaps over seeds."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from sgft_jax import dynamics, optim, replay, sequences, tdmpc2, value
from sgft_jax.agents import make_agent
from sgft_jax.methods import FinetuneConfig, Method
from sgft_jax.networks import make_dynamics, make_value
from sgft_jax.sgft import append_steps_to_go, compose
from sgft_jax.types import Array, Imagination, Key, Metrics, Normalizer, Prior, PyTree, Transition, UserError

Simulated = Callable[[Key, int], Transition]
"""(key, n) -> n transitions of the simulator, [n, ...]."""


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
    init_carry() -> what it remembers from step to step of an episode.
    act(state, carry, obs [obs_dim], key, *, explore) -> (action [act_dim], carry); explore: [] bool, may be traced.
    observe(state, transitions [T, ...], valid [T]) -> state: keep the rows of one episode, in order.
    learn(state, key, n_updates, simulated=None, *, offline=False) -> (state, metrics averaged over the updates);
        `n_updates` is static. simulated(key, n) -> n transitions of the simulator, for methods that ask for them;
        offline: learn from these alone (static).
    export(state) -> the agent in the form of a prior: actor and critic as they act, with the whole horizon to go.
    """

    init: Callable[[Any, Key], Any]
    init_carry: Callable[[], PyTree]
    act: Callable[..., tuple[Array, PyTree]]
    observe: Callable[[Any, Transition, Array], Any]
    learn: Callable[..., tuple[Any, Metrics]]
    export: Callable[[Any], PyTree]


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
    """Fine-tuning by `method`. reward, terminated: the task as functions of one (obs, action, next_obs)."""
    if method.agent == "tdmpc2":
        return _planner(method, config, obs_dim=obs_dim, act_dim=act_dim)
    return _policy(method, config, obs_dim=obs_dim, act_dim=act_dim, reward=reward, terminated=terminated)


def _policy(
    method: Method,
    config: FinetuneConfig,
    *,
    obs_dim: int,
    act_dim: int,
    reward: Callable[[Array, Array, Array], Array],
    terminated: Callable[[Array, Array, Array], Array],
) -> Finetuner:
    """Of an agent that acts by its policy."""
    agent = make_agent(method, config, obs_dim=obs_dim, act_dim=act_dim)
    learner = agent.learner
    value_network = make_value(obs_dim, config.network)
    model_network = make_dynamics(obs_dim, act_dim, config.network)
    optimiser = optim.adam(config.max_grad_norm)
    transform = compose(*method.transforms(config.horizon, config.branches, config.branch_noise))
    told = config.horizon if method.finite_horizon else 1  # what the agent is told about the steps to go

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
            fit, metrics = dynamics.update(
                model_network, optimiser, state.dynamics, state.normalizer, real, keys[1], rate=config.lr_dynamics
            )
            state = state.replace(dynamics=fit)
        rows = real
        if simulated is not None:
            drawn = simulated(jax.random.fold_in(keys[0], 1), config.batch_size)
            rows = drawn if offline else mix(real, drawn, share(state))
        batch = transform(imagine(state, keys[2]), rows, keys[3])
        if method.uses_value and config.clip_shaped is not None:
            batch = batch._replace(reward=jnp.clip(batch.reward, -config.clip_shaped, config.clip_shaped))
        new, more = learner.update(state.learner, batch, keys[4])
        metrics |= more | {"batch/reward_mean": jnp.mean(batch.reward), "batch/reward_std": jnp.std(batch.reward)}
        return state.replace(learner=new), metrics

    def learn(
        state: FinetuneState, key: Key, n_updates: int, simulated: Simulated | None = None, *, offline: bool = False
    ) -> tuple[FinetuneState, Metrics]:
        if config.simulated_share and simulated is None:
            raise UserError(f"method {method.name} needs transitions of the simulator")
        one = lambda state, key: update(state, key, simulated, offline)  # noqa: E731
        state, metrics = jax.lax.scan(one, state, jax.random.split(key, n_updates))
        return state, jax.tree.map(jnp.mean, metrics)

    def export(state: FinetuneState) -> Prior:
        actor, critic = agent.networks(state.learner)
        return Prior(actor, critic, state.value, state.dynamics.params, state.normalizer)

    return Finetuner(init, learner.init_carry, act, observe, learn, export)


class PlannerState(struct.PyTreeNode):
    """learner: the agent; judge: the simulator's, frozen, where rewards are shaped by its value; replay."""

    learner: tdmpc2.TDMPC2State
    judge: tdmpc2.TDMPC2Prior | None
    replay: sequences.SequenceState


def _planner(method: Method, config: FinetuneConfig, *, obs_dim: int, act_dim: int) -> Finetuner:
    """Of an agent that plans: TD-MPC2, with what SGFT makes of it (section 8.4), and with what its code makes of it.

    The latter shapes every reward by the value of the simulator's agent, drawn anew each time, and learns a new agent.
    """
    structure = tdmpc2.named_config(
        obs_dim, act_dim, size=config.size, horizon=config.horizon, plan_samples=config.plan_samples,
        sgft=not config.train_critic, train_encoder=config.train_encoder,
    )  # fmt: skip
    hyper = tdmpc2.TDMPC2Hyper(lr=config.lr_critic, tau=config.tau, gamma=config.gamma)
    learner = tdmpc2.make_tdmpc2(structure, hyper)

    def init(prior: tdmpc2.TDMPC2Prior, key: Key) -> PlannerState:
        own = jax.tree.map(jnp.copy, prior)  # the caller may donate the state; the prior must survive it
        if method.fresh:
            agent = learner.init(key).replace(normalizer=own.normalizer)
        else:
            agent = tdmpc2.fine_tune_state(structure, hyper, prior, key)
        judge = jax.tree.map(jnp.copy, prior) if method.uses_value else None
        return PlannerState(agent, judge, sequences.init(replay.blank(obs_dim, act_dim), config.replay_capacity))

    def act(state: PlannerState, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        return learner.act(state.learner, carry, obs, key, explore=explore)

    def observe(state: PlannerState, transitions: Transition, valid: Array) -> PlannerState:
        return state.replace(replay=sequences.add_episode(state.replay, transitions, valid))

    def shaped(judge: tdmpc2.TDMPC2State, row: Transition, key: Key) -> Array:
        now, then = (
            tdmpc2.value_sample(structure, judge, obs, k)
            for obs, k in zip((row.obs, row.next_obs), jax.random.split(key), strict=True)
        )
        return row.reward + row.discount * then - now

    def update(state: PlannerState, inputs: tuple[sequences.Sequences, Key]) -> tuple[PlannerState, Metrics]:
        batch, key = inputs
        key_shape, key_update = jax.random.split(key)
        if state.judge is not None:
            keys = jax.random.split(key_shape, batch.valid.shape)
            judge = tdmpc2.fine_tune_state(structure, hyper, state.judge, key_shape)
            reward = jax.vmap(jax.vmap(functools.partial(shaped, judge)))(batch.rows, keys)
            batch = batch._replace(rows=batch.rows._replace(reward=reward))
        new, metrics = learner.update(state.learner, batch, key_update)
        metrics["batch/reward_mean"] = jnp.mean(batch.rows.reward, where=batch.valid)
        return state.replace(learner=new), metrics

    def learn(
        state: PlannerState, key: Key, n_updates: int, simulated: Simulated | None = None, *, offline: bool = False
    ) -> tuple[PlannerState, Metrics]:
        del simulated, offline  # planners learn from real windows alone
        key_rows, key_updates = jax.random.split(key)
        drawn = sequences.sample(state.replay, key_rows, n_updates * config.batch_size, config.horizon)
        batches = jax.tree.map(lambda x: x.reshape(n_updates, config.batch_size, *x.shape[1:]), drawn)
        state, metrics = jax.lax.scan(update, state, (batches, jax.random.split(key_updates, n_updates)))
        return state, jax.tree.map(jnp.mean, metrics)

    return Finetuner(init, learner.init_carry, act, observe, learn, lambda state: tdmpc2.extract_prior(state.learner))
