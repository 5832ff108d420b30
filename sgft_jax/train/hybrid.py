"""Learning from a fixed set of real data and an imperfect simulator.

The real system is never stepped here. Members are pairs of a simulator and a seed; they share the real rows. Source:
H2O+ (Niu et al. 2023), its released code.
"""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp

from envs.base import Env, World
from envs.rollout import Fleet
from envs.types import Array, Key, PyTree
from sgft_jax.data import replay
from sgft_jax.data.memory import transitions
from sgft_jax.train import fleet
from sgft_jax.train.fleet import FleetState, Note, Plan, RoundKeys, StartKeys
from sgft_jax.train.schedule import Schedule
from sgft_jax.types import Batch, HybridAgent, Metrics, RealData


def train(
    env: Env,
    agent: HybridAgent,
    schedule: Schedule,
    pools: World,
    real: RealData,
    keys: Key,
    *,
    gamma: float,
    state: FleetState | None = None,
    note: Note | None = None,
) -> Iterator[tuple[FleetState, Metrics]]:
    """Trains M members for `schedule.chunks` chunks each, see `fleet.train`.

    pools: [M, W] worlds of each member's simulator. real: what all share. keys: [M], what decides a
    member's draws. gamma: discount factor of simulated rows, that of the real ones. state: where an earlier run
    stopped, or None; it is consumed. note: what else to keep of simulated steps. A resumed run ends like an
    uninterrupted one.
    """
    plan = make_plan(env, agent, schedule)
    programs = fleet.make_programs(fleet.make_trainer(env, plan, gamma=gamma, note=note), keys.shape[0], shared=True)
    real = jax.tree.map(jnp.asarray, real)
    begun = programs.init(pools, real, keys) if state is None else state
    return fleet.train(plan, programs, lambda number, domains: pools, agent.keep(real), begun)


def shape_of(env: Env, agent: HybridAgent, schedule: Schedule, pools: World, real: RealData, keys: Key) -> FleetState:
    """Shapes and types of a run's state: what checkpoints are read into."""
    trainer = fleet.make_trainer(env, make_plan(env, agent, schedule), gamma=1.0)
    init = fleet.over_members(trainer.init, keys.shape[0], shared=(1,))
    return jax.eval_shape(init, pools, real, keys)


def memory(env: Env, agent: HybridAgent, schedule: Schedule, real: RealData) -> tuple[int, int]:
    """Bytes of one member's simulated rows, and of the real rows, which all members share; from the shapes alone."""
    kept = fleet.bytes_of(lambda: transitions(env).empty(schedule.buffer)) if agent.simulates else 0
    return kept, fleet.bytes_of(agent.keep, real)


def no_data(env: Env) -> RealData:
    """What stands for the real data where a method asks for none: one row of zeros."""
    return RealData(jax.tree.map(lambda x: x[None], replay.blank(env.obs_dim, env.act_dim)), jnp.ones(1, bool))


def make_plan(env: Env, agent: HybridAgent, schedule: Schedule) -> Plan:
    """How a member trains."""
    learner = agent.learner

    def explore(state: PyTree, simulators: Fleet, key: Key) -> tuple[Array, PyTree]:
        keys = jax.random.split(key, schedule.simulators)
        return jax.vmap(partial(learner.act, state, explore=True))(simulators.carry, simulators.state.obs, keys)

    def start_keys(key: Key) -> StartKeys:
        key_learner, key_fleet, key_steps, key_rounds = jax.random.split(key, 4)
        return StartKeys(key_learner, key_fleet, key_rounds, _pairs(key_steps, first) if first else None)

    def round_keys(key: Key) -> RoundKeys:
        key, key_steps, key_updates = jax.random.split(key, 3)
        updates = _pairs(key_updates, schedule.updates_per_round)
        return RoundKeys(key, _pairs(key_steps, schedule.steps_per_round), updates[:, 0], updates[:, 1])

    def batches(memory: PyTree, simulated: PyTree, keys: Key) -> Batch:
        return jax.vmap(lambda key: agent.batches.sample((memory, simulated), key))(keys)

    first = -(-agent.batches.n_sim // schedule.simulators)
    return Plan(
        learner,
        transitions(env),
        simulators=schedule.simulators if agent.simulates else 0,
        capacity=schedule.buffer,
        chunks=schedule.chunks,
        rounds=schedule.rounds_per_chunk,
        explore=explore,
        begin=lambda state, real: agent.prepare(state, real, schedule.updates_in_all),
        start_keys=start_keys,
        round_keys=round_keys,
        batches=batches,
        # An empty buffer is sampled as zeros, which nobody has lived through: all simulators have exploded.
        ready=(lambda simulated: simulated.size > 0) if agent.batches.n_sim else None,
    )


def _pairs(key: Key, n: int) -> Key:
    """[n, 2] keys."""
    return jax.vmap(jax.random.split)(jax.random.split(key, n))
