"""Fine-tuning of one agent that plans: TD-MPC2, what SGFT makes of it, and what SGFT's released code makes of it."""

import functools

import jax
import jax.numpy as jnp
from flax import struct

from sgft_jax.data import replay, sequences
from sgft_jax.learners import tdmpc2, tdmpc2_model
from sgft_jax.methods import FinetuneConfig, Method, lr_warmup
from sgft_jax.types import Array, Finetuner, Key, Metrics, PyTree, Simulated, Transition


class PlannerState(struct.PyTreeNode):
    """learner: the agent; judge: the simulator's, frozen, where rewards are shaped by its value; replay."""

    learner: tdmpc2.TDMPC2State
    judge: tdmpc2.TDMPC2Prior | None
    replay: sequences.SequenceState


def make_planner(method: Method, config: FinetuneConfig, *, obs_dim: int, act_dim: int) -> Finetuner:
    """TD-MPC2 by `method`: as published, as SGFT-TDMPC-2 (without `train_critic`), or as SGFT's released code.

    The latter shapes every reward by the value of the simulator's agent, drawn anew each time, and learns a new agent.
    """
    structure = tdmpc2_model.named_config(
        obs_dim, act_dim, size=config.size, horizon=config.horizon, plan_samples=config.plan_samples,
        sgft=not config.train_critic, train_encoder=config.train_encoder,
    )  # fmt: skip
    warmup = 0 if method.fresh else lr_warmup(config, method.utd)
    hyper = tdmpc2.TDMPC2Hyper(config.lr_critic, warmup, tau=config.tau, gamma=config.gamma)
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
            tdmpc2_model.value_sample(structure, judge, obs, k)
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
