"""Speed of a hybrid run, simulators and draws included, next to the update of H2O+ written by hand and nothing else."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

import envs
from envs import gaps
from envs.base import Env, World
from envs.gaps import SIM
from envs.mujoco.worlds import Impl, choose_impl
from envs.pools import real_worlds
from envs.types import Key, PyTree
from experiments.bench import bare_h2oplus
from experiments.bench.timing import Compiled, ahead, fastest_in_turns
from experiments.bench.updates import REPLAY, rows
from sgft_jax.learners.h2oplus import H2OPlusHyper
from sgft_jax.methods import get_method
from sgft_jax.train import hybrid
from sgft_jax.train.fleet import make_programs, make_trainer, over_members
from sgft_jax.train.schedule import Schedule
from sgft_jax.types import HybridAgent, RealData

METHOD = "h2oplus"


def speed(task: str, impl: Impl, members: int, *, width: int, updates: int, repeats: int) -> dict[str, Any]:
    """Updates per second over all members (pairs of a seed and a gap): of a run, and of the hand-written update.

    A run steps its simulators, 25 by default, once before as many updates follow. updates/bare: of a run that learns
    from what its simulators left before. simulators_share: of a run's time, by how much that one is faster.
    """
    engine = choose_impl(impl)
    env, method = envs.make(task, engine), get_method(METHOD, "fixed")
    agent = method.build(replace(method.config, hidden=(width, width)), env)
    schedule = Schedule(buffer=REPLAY, chunk_updates=updates)
    pools = real_worlds(env, [gaps.load(env, SIM)] * members, jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), members)
    run, compiled = _run(env, agent, schedule, pools, keys)
    idle, _ = _run(env, agent, schedule, pools, keys, simulates=False)
    bare = _by_hand(env, method.config, width, keys, schedule.updates_per_chunk)
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
    state, memory = programs.begin(pools, real, keys), agent.keep(real)
    trainer = make_trainer(env, plan if simulates else plan._replace(simulators=0), gamma=0.99)
    made = ahead(over_members(trainer.chunk, members, shared=(1,)), (pools, memory, state), donate=(2,))

    def chunk() -> None:
        nonlocal state
        state, _ = made.call(pools, memory, state)

    return chunk, made


def _by_hand(env: Env, config: Any, width: int, keys: Key, updates: int) -> Callable[[], None]:
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
