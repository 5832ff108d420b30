"""Learning from a fixed set of real data and an imperfect simulator, as an iterator over compiled chunks.

A round steps every simulator, keeps what happened, and updates the agent on real and simulated rows. The real system is
never stepped here. It prints nothing and touches no files; the caller does both. Members are pairs of a simulator and a
seed, all in one program; they share the real rows. Source: H2O+ (Niu et al. 2023), its released code.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env, EnvState, World
from envs.rollout import Fleet, launch, step_fleet
from envs.types import Array, Key, PyTree
from sgft_jax.data import replay
from sgft_jax.data.replay import ReplayState
from sgft_jax.hybrid.schedule import Schedule
from sgft_jax.train.pretraining import over_members
from sgft_jax.types import HybridAgent, Metrics, RealData

# note(learner's state, before, action, after) -> what is kept of one simulated step beside its row
Note = Callable[[PyTree, EnvState, Array, EnvState], PyTree]
_Collected = tuple[Fleet, ReplayState, ReplayState | None]  # the simulators, their rows, notes on these


class HybridState(NamedTuple):
    """Everything that changes, [M, ...].

    learner: the agent. simulated: `ReplayState` of its own rows. fleet: its simulators in flight. The last two are None
    for an agent that does not act in a simulator. rounds: [M] int32 rounds done. notes: `ReplayState` of what a `Note`
    said of the rows, None without one.
    """

    learner: Any
    simulated: Any
    fleet: Any
    key: Key
    rounds: Array
    notes: Any = None


class Trainer(NamedTuple):
    """Training of one member as pure functions.

    init(pool, real, key) -> HybridState, with a first batch of simulated rows.
    chunk(pool, memory, state) -> (state, metrics averaged over its updates). memory: of the real rows.
    """

    init: Callable[[World, RealData, Key], HybridState]
    chunk: Callable[[World, PyTree, HybridState], tuple[HybridState, Metrics]]


def train(
    env: Env,
    agent: HybridAgent,
    schedule: Schedule,
    pools: World,
    real: RealData,
    keys: Key,
    *,
    gamma: float,
    state: HybridState | None = None,
    note: Note | None = None,
) -> Iterator[tuple[HybridState, Metrics]]:
    """Trains M members for `schedule.chunks` chunks each.

    pools: [M, W] worlds of each member's simulator. real: what all share. keys: [M], what decides a
    member's draws. gamma: discount factor of simulated rows, that of the real ones. state: where an earlier run
    stopped, or None; it is consumed. note: what else to keep of simulated steps.

    Yields the state that it starts from with no metrics, then once per chunk. Metrics are arrays [M]. A yielded state
    is valid until the next step, which donates its arrays. A resumed run ends like an uninterrupted one.
    """
    trainer, members = make_trainer(env, agent, schedule, gamma=gamma, note=note), keys.shape[0]
    real = jax.tree.map(jnp.asarray, real)
    memory = agent.keep(real)
    now: HybridState = state or jax.jit(over_members(trainer.init, members, shared=(1,)))(pools, real, keys)
    chunk = jax.jit(over_members(trainer.chunk, members, shared=(1,)), donate_argnums=2)
    yield now, {}
    for _ in range(chunks_done(now, schedule), schedule.chunks):
        now, metrics = chunk(pools, memory, now)
        yield now, metrics


def shape_of(env: Env, agent: HybridAgent, schedule: Schedule, pools: World, real: RealData, keys: Key) -> HybridState:
    """Shapes and types of a run's state: what checkpoints are read into."""
    trainer = make_trainer(env, agent, schedule, gamma=1.0)
    init = over_members(trainer.init, keys.shape[0], shared=(1,))
    return jax.eval_shape(init, pools, real, keys)


class Memory(NamedTuple):
    """Bytes of experience. buffer: of one member's simulated rows. data: of the real rows, which all members share."""

    buffer: int
    data: int


def memory(env: Env, agent: HybridAgent, schedule: Schedule, real: RealData) -> Memory:
    """What a run will keep, from the shapes of its arrays alone."""
    size = lambda f, *args: sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(f, *args)))  # noqa: E731
    return Memory(size(lambda: _buffer(env, schedule)) if agent.simulates else 0, size(agent.keep, real))


def no_data(env: Env) -> RealData:
    """What stands for the real data where a method asks for none: one row of zeros."""
    return RealData(jax.tree.map(lambda x: x[None], replay.blank(env.obs_dim, env.act_dim)), jnp.ones(1, bool))


def chunks_done(state: HybridState, schedule: Schedule) -> int:
    """Chunks behind a state."""
    return int(jax.device_get(state.rounds)[0]) // schedule.rounds_per_chunk


def make_trainer(
    env: Env, agent: HybridAgent, schedule: Schedule, *, gamma: float, note: Note | None = None
) -> Trainer:
    """Builds the pure functions."""
    learner, fresh = agent.learner, agent.learner.init_carry()
    step = functools.partial(step_fleet, env, gamma=gamma, initial_carry=fresh)

    def vector_step(
        pool: World, agent_state: PyTree, fleet: Fleet, rows: ReplayState, notes: ReplayState | None, key: Key
    ) -> _Collected:
        """One step of all simulators under the exploring policy."""
        key_act, key_step = jax.random.split(key)
        act = functools.partial(learner.act, explore=True)
        keys = jax.random.split(key_act, schedule.simulators)
        actions, carry = jax.vmap(act, (None, 0, 0, 0))(agent_state, fleet.carry, fleet.state.obs, keys)
        before = fleet.state
        fleet, new, valid, after = step(pool, fleet, actions, carry, key_step)
        if note is not None and notes is not None:
            notes = replay.add_batch(notes, jax.vmap(note, (None, 0, 0, 0))(agent_state, before, actions, after), valid)
        return fleet, replay.add_batch(rows, new, valid), notes

    def collect(pool: World, state: HybridState, key: Key, steps: int) -> HybridState:
        def one(carry: _Collected, key: Key) -> tuple[_Collected, None]:
            return vector_step(pool, state.learner, *carry, key), None

        start = state.fleet, state.simulated, state.notes
        (fleet, rows, notes), _ = jax.lax.scan(one, start, jax.random.split(key, steps))
        return state._replace(fleet=fleet, simulated=rows, notes=notes)

    def init(pool: World, real: RealData, key: Key) -> HybridState:
        key_learner, key_fleet, key_fill, key_run = jax.random.split(key, 4)
        agent_state = agent.prepare(learner.init(key_learner), real, schedule.updates_in_all)
        state = HybridState(agent_state, None, None, key_run, jnp.int32(0))
        if not agent.simulates:
            return state
        fleet = launch(env, pool, key_fleet, schedule.simulators, fresh)
        state = state._replace(fleet=fleet, simulated=_buffer(env, schedule))
        if note is not None:
            first = jax.tree.map(lambda x: x[0], fleet.state)
            example = note(agent_state, first, jnp.zeros(env.act_dim), first)
            state = state._replace(notes=replay.init(example, schedule.buffer))
        return collect(pool, state, key_fill, -(-agent.batches.n_sim // schedule.simulators))

    def update(memory: PyTree, state: HybridState, key: Key) -> tuple[PyTree, Metrics, Array]:
        """The learner after a round's updates, their metrics, and whether there was anything to learn from []."""

        def one(agent_state: PyTree, key: Key) -> tuple[PyTree, Metrics]:
            key_rows, key_update = jax.random.split(key)
            batch = agent.batches.sample((memory, state.simulated), key_rows)
            return learner.update(agent_state, batch, key_update)

        learned, metrics = jax.lax.scan(one, state.learner, jax.random.split(key, schedule.updates_per_round))
        if not agent.batches.n_sim:
            return learned, metrics, jnp.ones((), bool)
        # An empty buffer is sampled as zeros, which nobody has lived through: all simulators have exploded.
        some = state.simulated.size > 0
        return jax.tree.map(lambda new, old: jnp.where(some, new, old), learned, state.learner), metrics, some

    def one_round(pool: World, memory: PyTree, state: HybridState) -> tuple[HybridState, tuple[Metrics, Array]]:
        key, key_collect, key_update = jax.random.split(state.key, 3)
        if agent.simulates:
            state = collect(pool, state, key_collect, schedule.steps_per_round)
        trained, metrics, some = update(memory, state, key_update)
        averages = {name: x.mean() for name, x in metrics.items()}
        return state._replace(learner=trained, key=key, rounds=state.rounds + 1), (averages, some)

    def chunk(pool: World, memory: PyTree, state: HybridState) -> tuple[HybridState, Metrics]:
        rounds = schedule.rounds_per_chunk
        state, (metrics, some) = jax.lax.scan(lambda own, _: one_round(pool, memory, own), state, None, length=rounds)
        # Nan if no round has learned.
        mean = lambda x: jnp.where(some.all(), x.mean(), jnp.mean(x, where=some))  # noqa: E731
        return state, {name: mean(x) for name, x in metrics.items()}

    return Trainer(init, chunk)


def _buffer(env: Env, schedule: Schedule) -> ReplayState:
    """The empty buffer of a member's simulated rows."""
    return replay.init(replay.blank(env.obs_dim, env.act_dim), schedule.buffer)
