"""Speed of updates next to the same arithmetic by hand, and next to other libraries where they are installed.

Of SAC as pretraining uses it, of plain SAC, and of H2O+ in a hybrid run, its simulators and draws included.
"""

import importlib
import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, World
from envs.gaps import SIM
from envs.mujoco.worlds import Impl, choose_impl
from envs.rollout import real_worlds
from envs.types import Key, PyTree, Transition
from experiments.bench import bare_h2oplus, bare_sac
from experiments.bench.timing import Compiled, ahead, fastest, fastest_in_turns, measure
from sgft_jax.data import replay
from sgft_jax.learners.h2oplus import H2OPlusHyper
from sgft_jax.learners.sac import SACConfig, SACHyper, make_sac
from sgft_jax.methods import get_method
from sgft_jax.models.networks import NetworkConfig, Precision, precision
from sgft_jax.train import hybrid
from sgft_jax.train.fleet import make_programs, make_trainer, over_members
from sgft_jax.train.schedule import Schedule
from sgft_jax.types import Batch, HybridAgent, RealData

OBS_DIM, ACT_DIM, MEMBERS = 12, 3, 5  # sizes of the updates, a manipulation task's
REPLAY = 100_000  # rows that batches of plain SAC are drawn from
LIBRARIES = ("stable_baselines3", "sbx")  # on PyTorch; the same interface on JAX


class Agent(NamedTuple):
    """update(state, batch, key) -> state; init(key) -> state."""

    update: Callable[[PyTree, Transition, Key], PyTree]
    init: Callable[[Key], PyTree]


def speed(
    batch: int, seeds: int, *, width: int, updates: int, repeats: int, exact: Precision = "default"
) -> dict[str, Any]:
    """Updates of pretraining per second over all seeds: of the library, and of the hand-written one.

    gb: bytes that the compiled update reads and writes, as XLA counts them.
    """
    network = NetworkConfig(hidden=(width, width), layer_norm=True)
    keys, count = jax.random.split(jax.random.key(0), seeds), seeds * updates
    with precision(exact):
        library, bare = (
            _repeated(agent, batch, keys, updates, repeats) for agent in (_library(network), _by_hand(network, batch))
        )
    moved, per_s = _bytes(_library(network), batch, keys), count / library.seconds
    line = {"batch": batch, "seeds": seeds, "width": width, "precision": exact}
    line |= {"updates_per_s": per_s, "bare_per_s": count / bare.seconds, "updates/bare": bare.seconds / library.seconds}
    line |= {"gb_per_update": moved / 1e9, "tb_per_s": per_s * moved / 1e12}
    return line | {"compile_s": library.compile_s, "memory_mb": library.memory_mb}


def plain_speed(batch: int, *, width: int, updates: int, repeats: int) -> dict[str, Any]:
    """Updates per second of plain SAC, drawing its batches included: ours, and of libraries that are installed."""
    network = NetworkConfig(hidden=(width, width))
    learner = make_sac(SACConfig(OBS_DIM, ACT_DIM, network=network, train_dynamics=False))
    buffer = replay.add_batch(replay.init(replay.blank(OBS_DIM, ACT_DIM), REPLAY), rows(jax.random.key(0), REPLAY))

    def run(agent: PyTree, buffer: replay.ReplayState, key: Key) -> PyTree:
        def update(agent: PyTree, key: Key) -> tuple[PyTree, None]:
            key_draw, key_update = jax.random.split(key)
            return learner.update(agent, replay.sample(buffer, key_draw, batch), key_update)[0], None

        return jax.lax.scan(update, agent, jax.random.split(key, updates))[0]

    ours = measure(run, (learner.init(jax.random.key(1)), buffer, jax.random.key(2)), repeats=repeats)
    line = {"batch": batch, "width": width, "updates_per_s": updates / ours.seconds}
    for name in importable():
        train = other_sac(name, batch, width, OBS_DIM, ACT_DIM, REPLAY)
        per_s = updates / fastest(lambda train=train: train(updates), repeats=repeats)
        line |= {f"{name}_per_s": per_s, f"updates/{name}": line["updates_per_s"] / per_s}
    return line | {"compile_s": ours.compile_s}


def rows(key: Key, batch: int, obs_dim: int = OBS_DIM, act_dim: int = ACT_DIM) -> Transition:
    """A batch of made-up transitions."""
    blank = replay.blank(obs_dim, act_dim)
    obs, next_obs = jax.random.normal(key, (2, batch, obs_dim))
    full = jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), blank)
    return full._replace(obs=obs, next_obs=next_obs, discount=full.discount + 0.97)


def _library(network: NetworkConfig) -> Agent:
    """SAC as pretraining uses it."""
    learner = make_sac(SACConfig(OBS_DIM, ACT_DIM, network=network, ensemble_size=MEMBERS))
    return Agent(lambda state, batch, key: learner.update(state, Batch(*batch), key)[0], learner.init)


def _by_hand(network: NetworkConfig, batch: int) -> Agent:
    """The same in bare JAX, for batches of that size."""
    hyper = SACHyper()

    def update(state: bare_sac.Bare, rows: Transition, key: Key) -> bare_sac.Bare:
        return bare_sac.update(state, rows, bare_sac.draw(key, batch, ACT_DIM, MEMBERS), hyper)

    def init(key: Key) -> bare_sac.Bare:
        return bare_sac.init(key, network, OBS_DIM, ACT_DIM, members=MEMBERS, alpha=1.0)

    return Agent(update, init)


def _repeated(agent: Agent, batch: int, keys: Key, n: int, repeats: int) -> Compiled:
    """N updates of every seed."""

    def run(state: PyTree, key: Key) -> PyTree:
        data = rows(key, batch)
        return jax.lax.scan(lambda s, k: (agent.update(s, data, k), None), state, jax.random.split(key, n))[0]

    return measure(jax.vmap(run), (jax.jit(jax.vmap(agent.init))(keys), keys), repeats=repeats)


def _bytes(agent: Agent, batch: int, keys: Key) -> float:
    """What one update of one seed moves, by XLA's count of its compiled program for all seeds."""
    made = jax.jit(jax.vmap(agent.init))(keys)
    data = jax.vmap(lambda key: rows(key, batch))(keys)
    cost: Any = jax.jit(jax.vmap(agent.update)).lower(made, data, keys).compile().cost_analysis()
    return float(cost["bytes accessed"]) / len(keys)


# --- SAC of other libraries, on made-up experience --------------------------------------------------------------------


def importable() -> Iterator[str]:
    """Those that are here; says why one that is installed cannot be used, as when it was made for another JAX."""
    for library in LIBRARIES:
        if importlib.util.find_spec(library):
            try:
                importlib.import_module(library)
            except Exception as error:  # whatever somebody else's package stumbles over
                print(f"{library} is installed but left out: {type(error).__name__}: {error}")
            else:
                yield library


def other_sac(library: str, batch: int, width: int, obs_dim: int, act_dim: int, capacity: int) -> Callable[[int], Any]:
    """train(updates) of an agent on its library's default device, its replay full of noise; it writes no log."""
    gymnasium = importlib.import_module("gymnasium")

    class Sizes(gymnasium.Env):
        """An environment that only says how large things are."""

        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (act_dim,), np.float32)

    agent = importlib.import_module(library).SAC(
        "MlpPolicy", Sizes(), batch_size=batch, buffer_size=capacity, policy_kwargs={"net_arch": [width, width]}
    )
    agent.set_logger(importlib.import_module("stable_baselines3.common.logger").Logger(None, []))
    rng = np.random.default_rng(0)
    for _ in range(capacity):
        obs, next_obs = rng.standard_normal((2, 1, obs_dim), np.float32)
        action = rng.uniform(-1, 1, (1, act_dim)).astype(np.float32)
        agent.replay_buffer.add(obs, next_obs, action, np.zeros(1), np.zeros(1), [{}])
    return lambda updates: agent.train(gradient_steps=updates, batch_size=batch)


# --- hybrid runs ------------------------------------------------------------------------------------------------------


def hybrid_speed(task: str, impl: Impl, members: int, *, width: int, updates: int, repeats: int) -> dict[str, Any]:
    """Updates per second over all members (pairs of a seed and a gap): of a run, and of the hand-written update.

    A run steps its simulators, 25 by default, once before as many updates follow. updates/bare: of a run that learns
    from what its simulators left before. simulators_share: of a run's time, by how much that one is faster.
    """
    engine = choose_impl(impl)
    env, method = envs.make(task, engine), get_method("h2oplus", "fixed")
    agent = method.build(replace(method.config, hidden=(width, width)), env)
    schedule = Schedule(buffer=REPLAY, chunk_updates=updates)
    pools = real_worlds(env, [gaps.load(env, SIM)] * members, jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), members)
    run, compiled = _run(env, agent, schedule, pools, keys)
    idle, _ = _run(env, agent, schedule, pools, keys, simulates=False)
    bare = _hybrid_by_hand(env, method.config, width, keys, schedule.updates_per_chunk)
    run_s, idle_s, bare_s = fastest_in_turns((run, idle, bare), repeats=repeats)
    count = members * schedule.updates_per_chunk
    line = {"task": task, "impl": engine, "members": members, "width": width}
    line |= {"updates_per_s": count / run_s, "bare_per_s": count / bare_s, "run/bare": bare_s / run_s}
    line |= {"updates/bare": bare_s / idle_s, "simulators_share": 1 - idle_s / run_s}
    return line | {"compile_s": compiled.compile_s, "memory_mb": compiled.memory_mb}


def _run(
    env: Env, agent: HybridAgent, schedule: Schedule, pools: World, keys: Key, *, simulates: bool = True
) -> tuple[Callable[[], None], Compiled]:
    """(What makes one more chunk of all members, its program), without steps of the simulators where asked."""
    members, real = keys.shape[0], _recorded(env)
    plan = hybrid.make_plan(env, agent, schedule)
    programs = make_programs(make_trainer(env, plan, gamma=0.99), members, shared=True)
    state, memory = programs.init(pools, real, keys), agent.keep(real)
    trainer = make_trainer(env, plan if simulates else plan._replace(simulators=0), gamma=0.99)
    made = ahead(over_members(trainer.chunk, members, shared=(1,)), (pools, memory, state), donate=(2,))

    def chunk() -> None:
        nonlocal state
        state, _ = made.call(pools, memory, state)

    return chunk, made


def _hybrid_by_hand(env: Env, config: Any, width: int, keys: Key, updates: int) -> Callable[[], None]:
    """What makes that many updates of every member, each on the same rows."""
    n, ratio_rows = 2 * config.rows, 2 * config.ratio_rows
    sizes, hyper = (env.obs_dim, env.act_dim), H2OPlusHyper()

    def run(agent: bare_h2oplus.Bare, key: Key) -> PyTree:
        key_rows, key_ratio, key_run = jax.random.split(key, 3)
        batch, for_ratio = rows(key_rows, n, *sizes), rows(key_ratio, ratio_rows, *sizes)

        def update(agent: bare_h2oplus.Bare, key: Key) -> tuple[bare_h2oplus.Bare, None]:
            noise = bare_h2oplus.draw(key, n, ratio_rows, *sizes)
            return bare_h2oplus.update(agent, batch, for_ratio, noise, hyper), None

        return jax.lax.scan(update, agent, jax.random.split(key_run, updates))[0]

    agents = jax.jit(jax.vmap(lambda key: bare_h2oplus.init(key, (width, width), *sizes)))(keys)
    made = ahead(jax.vmap(run), (agents, keys))
    return lambda: made.call(agents, keys)


def _recorded(env: Env) -> RealData:
    """Made-up real rows, of one long episode."""
    made = rows(jax.random.key(2), REPLAY, env.obs_dim, env.act_dim)
    return RealData(made, jnp.arange(REPLAY) == REPLAY - 1)
