"""Fine-tuning of one agent that plans with SAC's prior: the dynamics ensemble learns, V_sim and the policy stay."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from sgft_jax.data import replay
from sgft_jax.learners import optim
from sgft_jax.methods import FinetuneConfig, Method, dynamics_warmup
from sgft_jax.models import dynamics
from sgft_jax.models.networks import add_noise, make_dynamics
from sgft_jax.planning import mpc
from sgft_jax.types import Array, Finetuner, Key, Metrics, Prior, PyTree, Simulated, Transition


class MPCState(struct.PyTreeNode):
    """prior: the simulator's, frozen but for its models; dynamics: these in training; replay."""

    prior: Prior
    dynamics: optim.Fit
    replay: replay.ReplayState


def plan_options(config: FinetuneConfig) -> dict[str, Any]:
    """Those that make an `MPCConfig` of a prior's networks and discount factor; a fine-tuned prior's card has them."""
    return {"horizon": config.horizon, "samples": config.plan_samples, "noise": config.branch_noise}


class Planned(NamedTuple):
    """init_carry() -> the plan of a step that never was. act(prior, carry, obs, key, *, explore) -> (action, carry)."""

    init_carry: Callable[[], PyTree]
    act: Callable[..., tuple[Array, PyTree]]


def make_planned(
    config: FinetuneConfig,
    *,
    obs_dim: int,
    act_dim: int,
    reward: Callable[[Array, Array, Array], Array],
    terminated: Callable[[Array, Array, Array], Array],
) -> Planned:
    """Plans on a prior of SAC (`mpc.make_act`), with `explore_noise` on what is done to explore."""
    planner = mpc.MPCConfig(obs_dim, act_dim, config.network, **plan_options(config), gamma=config.gamma)
    plan = mpc.make_act(planner, reward=reward, terminated=terminated)

    def act(prior: Prior, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        key_plan, key_noise = jax.random.split(key)
        action, carry = plan(prior, carry, obs, key_plan, explore=explore)
        return add_noise(action, jnp.where(explore, config.explore_noise, 0.0), key_noise), carry

    return Planned(lambda: mpc.init_carry(planner), act)


def make_mpc(
    method: Method,
    config: FinetuneConfig,
    *,
    obs_dim: int,
    act_dim: int,
    reward: Callable[[Array, Array, Array], Array],
    terminated: Callable[[Array, Array, Array], Array],
) -> Finetuner:
    """MPC-SGFT. reward, terminated: as for `finetune.make_finetuner`. Source: SGFT Algorithm 3."""
    plans = make_planned(config, obs_dim=obs_dim, act_dim=act_dim, reward=reward, terminated=terminated)
    model = make_dynamics(obs_dim, act_dim, config.network)
    optimiser = optim.adam(config.max_grad_norm)
    warmup = dynamics_warmup(config, method.utd)

    def init(prior: Prior, key: Key) -> MPCState:
        del key
        own = jax.tree.map(jnp.copy, prior)  # the caller may donate the state; the prior must survive it
        empty = replay.init(replay.blank(obs_dim, act_dim), config.replay_capacity)
        return MPCState(replace(own, dynamics=None), optim.start(optimiser, own.dynamics), empty)

    def export(state: MPCState) -> Prior:
        return replace(state.prior, dynamics=state.dynamics.params)

    def act(state: MPCState, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        return plans.act(export(state), carry, obs, key, explore=explore)

    def observe(state: MPCState, transitions: Transition, valid: Array) -> MPCState:
        return state.replace(replay=replay.add_batch(state.replay, transitions, valid))

    def update(state: MPCState, key: Key) -> tuple[MPCState, Metrics]:
        key_rows, key_fit = jax.random.split(key)
        rows = replay.sample(state.replay, key_rows, config.batch_size)
        rate = config.lr_dynamics * optim.risen(optim.steps_of(state.dynamics), warmup)
        fit, metrics = dynamics.update(
            model, optimiser, state.dynamics, state.prior.normalizer, rows, key_fit, rate=rate
        )
        return state.replace(dynamics=fit), metrics

    def learn(
        state: MPCState, key: Key, n_updates: int, simulated: Simulated | None = None, *, offline: bool = False
    ) -> tuple[MPCState, Metrics]:
        del simulated, offline  # the models learn from real rows alone
        state, metrics = jax.lax.scan(update, state, jax.random.split(key, n_updates))
        return state, jax.tree.map(jnp.mean, metrics)

    return Finetuner(init, plans.init_carry, act, observe, learn, export)
