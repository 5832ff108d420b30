"""A fleet of simulators and the updates that learn from it, as an iterator over compiled chunks.

A round steps every simulator, keeps what happened, and updates the agent. A `Plan` says what differs between
pretraining and learning from a log: how a fleet acts, what updates learn from, which keys decide what. Nothing here
prints or touches files; the caller does both. Members, such as seeds, train in one program.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env, EnvState, World
from envs.mesh import split, whole
from envs.rollout import Fleet, launch, step_fleet
from envs.types import Array, Key, PyTree, Transition
from sgft_jax.data import replay
from sgft_jax.data.memory import Memory
from sgft_jax.data.replay import ReplayState
from sgft_jax.models.networks import Precision, precision
from sgft_jax.types import Batch, Learner, Metrics

__all__ = ["FleetState"]

# explore(fleet, key) -> (actions [n, act_dim], carries [n] of the policy)
Explore = Callable[[Fleet, Key], tuple[Array, PyTree]]
# pools(number of a set of worlds, domains [M]) -> its worlds [M, W], a pool for each member
Pools = Callable[[int, PyTree], World]
# note(learner's state, before, action, after) -> what is kept of one simulated step beside its row
Note = Callable[[PyTree, EnvState, Array, EnvState], PyTree]


class FleetState(NamedTuple):
    """Everything that changes, [M, ...].

    learner: the agent. replay: experience of its simulators. fleet: these in flight. The last two are None for an agent
    that does not act in a simulator. key: decides what comes. rounds: [M] int32, rounds done. notes: `ReplayState` of
    what a `Note` says of the rows, None without one. domain: state of the `Domain` that worlds are drawn from.
    """

    learner: Any
    replay: Any
    fleet: Any
    key: Key
    rounds: Array
    notes: Any = None
    domain: Any = ()


class StartKeys(NamedTuple):
    """What decides the beginning: the agent's parameters, the fleet's episodes, and the rounds.

    steps: [n, 2] for actions and for physics of the fleet's steps before the first round; None without such steps.
    """

    learner: Key
    fleet: Key
    rounds: Key
    steps: Key | None = None


class RoundKeys(NamedTuple):
    """What decides a round. rounds: those after it. steps: [steps, 2] for actions and for physics. rows, updates: [U].

    rows: or a single key, as the plan's `batches` takes it.
    """

    rounds: Key
    steps: Key
    rows: Key
    updates: Key


class Plan(NamedTuple):
    """How one member trains.

    learner, memory: what learns, and what it keeps of its simulators. simulators: stepped together, 0 = none. capacity:
    transitions that it keeps. chunks, rounds: chunks of the run and rounds of each.
    explore(agent, fleet, key): see `Explore`.
    begin(agent, data) -> a fresh agent that knows the data it starts with.
    tune(agent, rounds []) -> the agent with the hyper-parameters of that round.
    start_keys(key), round_keys(key): which keys decide what. batches(data, replay, rows' keys) -> Batch [U, B, ...].
    ready(replay) -> [] whether there is anything to learn from; else the agent stays as it is. None: there always is.
    measure(after, rows, valid) -> Metrics of a step of the fleet; summarise([rounds, steps] of these) -> Metrics.
    precision: of the updates' matrix products.
    """

    learner: Learner
    memory: Memory
    simulators: int
    capacity: int
    chunks: int
    rounds: int
    explore: Callable[[PyTree, Fleet, Key], tuple[Array, PyTree]]
    begin: Callable[[PyTree, PyTree], PyTree]
    start_keys: Callable[[Key], StartKeys]
    round_keys: Callable[[Key], RoundKeys]
    batches: Callable[[PyTree, PyTree, Key], Batch]
    tune: Callable[[PyTree, Array], PyTree] = lambda agent, rounds: agent
    ready: Callable[[PyTree], Array] | None = None
    measure: Callable[[EnvState, Transition, Array], Metrics] = lambda after, rows, valid: {}
    summarise: Callable[[Metrics], Metrics] = lambda measured: measured
    precision: Precision = "default"

    def chunks_done(self, state: FleetState) -> int:
        """Chunks behind a state."""
        return int(jax.device_get(state.rounds)[0]) // self.rounds


# --- pure functions of one member -------------------------------------------------------------------------------------


class Collected(NamedTuple):
    """Simulators in flight, what they have experienced, and notes on it."""

    fleet: Fleet
    replay: PyTree
    notes: ReplayState | None = None


def collect(
    env: Env,
    memory: Memory,
    explore: Explore,
    pool: World,
    start: Collected,
    keys: Key,
    *,
    initial_carry: PyTree,
    gamma: float,
    note: Callable[..., PyTree] | None = None,
    measure: Callable[[EnvState, Transition, Array], Metrics] = lambda after, rows, valid: {},
) -> tuple[Collected, Metrics]:
    """Steps of all simulators, one for each of the keys [steps, 2]; the metrics are [steps].

    initial_carry: what the policy remembers when an episode begins. note(before, action, after): see `Note`.
    """

    def step(held: Collected, keys: Key) -> tuple[Collected, Metrics]:
        actions, carry = explore(held.fleet, keys[0])
        before, notes = held.fleet.state, held.notes
        fleet, rows, valid, after = step_fleet(
            env, pool, held.fleet, actions, carry, keys[1], gamma=gamma, initial_carry=initial_carry
        )
        if note is not None and notes is not None:
            notes = replay.add_batch(notes, jax.vmap(note)(before, actions, after), valid)
        kept = memory.add(held.replay, rows, valid, after.truncated | after.terminated)
        return Collected(split(fleet), spread_replay(kept), notes), measure(after, rows, valid)

    return jax.lax.scan(step, start, keys)


class Trainer(NamedTuple):
    """Training of one member as pure functions.

    init(pool, data, key) -> FleetState. data: what the plan's `begin` takes.
    chunk(pool, data, state) -> (state, metrics): `plan.rounds` rounds. data: what the plan's `batches` takes.
    renew(pool, state) -> state with new episodes in the worlds of that pool.
    """

    init: Any
    chunk: Any
    renew: Callable[[World, FleetState], FleetState]


def make_trainer(env: Env, plan: Plan, *, gamma: float, note: Note | None = None) -> Trainer:
    """Builds the pure functions. gamma: discount factor of simulated rows. note: what else to keep of their steps."""
    learner, fresh = plan.learner, plan.learner.init_carry()
    play = partial(collect, env, plan.memory, initial_carry=fresh, gamma=gamma, measure=plan.measure)

    def advance(pool: World, state: FleetState, keys: Key) -> tuple[FleetState, Metrics]:
        start, noted = Collected(state.fleet, state.replay, state.notes), note and partial(note, state.learner)
        collected, measured = play(partial(plan.explore, state.learner), pool, start, keys, note=noted)
        return state._replace(**collected._asdict()), measured

    def init(pool: World, data: PyTree, key: Key) -> FleetState:
        keys = plan.start_keys(key)
        agent = plan.begin(learner.init(keys.learner), data)
        state = FleetState(agent, None, None, keys.rounds, jnp.int32(0))
        if not plan.simulators:
            return spread(state)
        fleet = launch(env, pool, keys.fleet, plan.simulators, fresh)
        state = state._replace(fleet=fleet, replay=plan.memory.empty(plan.capacity))
        if note is not None:
            first = jax.tree.map(lambda x: x[0], fleet.state)
            example = note(agent, first, jnp.zeros(env.act_dim), first)
            state = state._replace(notes=replay.init(example, plan.capacity))
        if keys.steps is not None:
            state, _ = advance(pool, state, keys.steps)
        return spread(state)

    def renew(pool: World, state: FleetState) -> FleetState:
        key, key_fleet = jax.random.split(state.key)
        fleet = launch(env, pool, key_fleet, plan.simulators, fresh)
        return spread(state._replace(replay=plan.memory.cut(state.replay), fleet=fleet, key=key))

    def update(data: PyTree, state: FleetState, keys: RoundKeys) -> tuple[PyTree, Metrics, Array]:
        """The agent after a round's updates, their metrics, and whether there was anything to learn from []."""
        batches = plan.batches(data, state.replay, keys.rows)
        with precision(plan.precision):
            agent, metrics = jax.lax.scan(
                lambda agent, x: learner.update(agent, *x),
                plan.tune(state.learner, state.rounds),
                (batches, keys.updates),
            )
        averages, ready = {name: x.mean() for name, x in metrics.items()}, jnp.ones((), bool)
        if plan.ready:
            ready = plan.ready(state.replay)
            agent = jax.tree.map(lambda new, old: jnp.where(ready, new, old), agent, state.learner)
        return agent, averages, ready

    def one_round(pool: World, data: PyTree, state: FleetState) -> tuple[FleetState, tuple[Metrics, Metrics, Array]]:
        keys, measured = plan.round_keys(state.key), {}
        if plan.simulators:
            state, measured = advance(pool, state, keys.steps)
        agent, metrics, ready = update(data, state, keys)
        state = state._replace(learner=agent, key=keys.rounds, rounds=state.rounds + 1)
        return spread(state), (metrics, measured, ready)

    def chunk(pool: World, data: PyTree, state: FleetState) -> tuple[FleetState, Metrics]:
        state, (metrics, measured, ready) = jax.lax.scan(
            lambda state, _: one_round(pool, data, state), state, None, length=plan.rounds
        )
        # Over the rounds that have learned, nan without any
        averages = {name: jnp.where(ready.all(), x.mean(), jnp.mean(x, where=ready)) for name, x in metrics.items()}
        return state, whole(averages | plan.summarise(measured))

    return Trainer(init, chunk, renew)


def spread(state: FleetState) -> FleetState:
    """Environments and experience in pieces on the devices of a mesh, the agent whole on each of them."""
    pieces = state._replace(replay=spread_replay(state.replay), fleet=split(state.fleet), domain=whole(state.domain))
    return pieces._replace(learner=whole(state.learner), key=whole(state.key), rounds=whole(state.rounds))


def spread_replay(experience: PyTree) -> PyTree:
    """The same for experience alone: its rows in pieces, its counters whole."""
    return jax.tree.map(lambda x: split(x) if x.ndim else whole(x), experience)


# --- all members ------------------------------------------------------------------------------------------------------


def over_members(
    function: Callable[..., PyTree], members: int, *, shared: tuple[int, ...] = ()
) -> Callable[..., PyTree]:
    """`function` of one member for arguments and results with a leading axis of members.

    shared: positions of arguments without that axis, one for all members. A single member is not vmapped, because vmap
    would make a `cond` (resets, only where an episode ended) compute both of its branches at every step.
    """

    def several(*args: PyTree) -> PyTree:
        return jax.vmap(function, tuple(None if i in shared else 0 for i in range(len(args))))(*args)

    def single(*args: PyTree) -> PyTree:
        firsts = (x if i in shared else jax.tree.map(lambda leaf: leaf[0], x) for i, x in enumerate(args))
        return jax.tree.map(lambda x: x[None], function(*firsts))

    return several if members > 1 else single


def make_programs(trainer: Trainer, members: int, *, shared: bool) -> Trainer:
    """The same of that many members, jitted; chunk and renew consume the state that they change.

    shared: whether members learn from the same data, not each from its own.
    """
    several = partial(over_members, members=members, shared=(1,) if shared else ())
    return Trainer(
        init=jax.jit(several(trainer.init)),
        chunk=jax.jit(several(trainer.chunk), donate_argnums=2),
        renew=jax.jit(over_members(trainer.renew, members), donate_argnums=1),
    )


def train(
    plan: Plan,
    programs: Trainer,
    pools: Pools,
    data: PyTree,
    state: FleetState,
    *,
    refresh_every: int = 0,
    adapt: Callable[[World, FleetState], PyTree] = lambda worlds, state: state.domain,
) -> Iterator[tuple[FleetState, Metrics]]:
    """Trains from a state until all chunks are done; the state is consumed.

    pools: see `Pools`. refresh_every: chunks after which the next set is asked for, 0 = never. adapt(worlds, state) ->
    the domains [M] that it is drawn from.

    Yields the state that it starts from with no metrics, once everything is compiled, then once per chunk. Metrics are
    arrays [M]. A yielded state is valid until the next step, which donates its arrays: copy it to keep it longer.
    """
    begun, refresh_every = plan.chunks_done(state), refresh_every or plan.chunks
    number = max(begun - 1, 0) // refresh_every
    worlds = pools(number, state.domain)
    chunk = programs.chunk.lower(worlds, data, state).compile() if begun < plan.chunks else programs.chunk
    yield state, {}
    for done in range(begun, plan.chunks):
        if done // refresh_every != number:
            number = done // refresh_every
            state = state._replace(domain=adapt(worlds, state))
            worlds = pools(number, state.domain)
            state = programs.renew(worlds, state)
        state, metrics = chunk(worlds, data, state)
        yield state, metrics


def bytes_of(function: Callable[..., PyTree], *args: PyTree) -> int:
    """Bytes of what a function returns, from the shapes alone."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(function, *args)))
