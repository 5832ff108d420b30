"""Measure speed, each number next to its reference from the same run.

physics: the step that training takes, with its own domain parameters in every world, controller, observation, reward
and automatic reset, against nothing but `mjx.step` on the nominal scene under random commands, the state carried along.
updates: SAC updates of pretraining, with all its networks, against the same update written by hand in bare JAX.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx
from rich.console import Console
from rich.table import Table

import envs
from envs import engine_warp, physics
from envs.base import Env
from envs.physics import Impl
from envs.rollout import Fleet, launch, step_fleet
from experiments import bench_updates, cli
from sgft_jax import replay, runs
from sgft_jax.log import write_summary
from sgft_jax.networks import NetworkConfig
from sgft_jax.sac import SACConfig, SACHyper, make_sac
from sgft_jax.types import Array, Key, PyTree, Transition, UserError

POOL = 256  # domain parameter vectors, so that a batch really differs from world to world
OBS_DIM, ACT_DIM, MEMBERS = 12, 3, 5  # sizes of the updates: those of hammering


@dataclass(frozen=True)
class BenchmarkConfig:
    """What to measure."""

    parts: tuple[Literal["physics", "updates"], ...] = ("physics", "updates")
    """Kinds of measurements."""
    tasks: tuple[str, ...] = ("push", "hammer", "insert")
    """Scenes."""
    worlds: tuple[int, ...] = (1024,)
    """Worlds stepped together."""
    impls: tuple[Impl, ...] = ("auto",)
    """Engines of physics."""
    control_steps: int = 10
    """Control steps (of 0.2 s) per timed call."""
    batches: tuple[int, ...] = (256,)
    """Batch sizes of the updates."""
    seeds: tuple[int, ...] = (1,)
    """Agents updated together."""
    width: int = 256
    """Units of both hidden layers of every network; critics and values have LayerNorm."""
    updates: int = 200
    """Updates per timed call."""
    repeats: int = 3
    """Timed calls; the fastest counts."""
    out: Path = Path("runs")
    """The numbers go to <out>/benchmark/summary.json."""


def main(config: BenchmarkConfig) -> dict[str, list[dict[str, Any]]]:
    """Measures, prints tables, writes the numbers and returns them by kind of measurement."""
    _check(config)
    measured = {}
    for part, measure in {"physics": _physics, "updates": _updates}.items():
        if part in config.parts:
            measured[part] = []
            for line in measure(config):
                measured[part].append(line)
                print("  ".join(f"{name} {_text(x)}" for name, x in line.items()), flush=True)
    folder = config.out / "benchmark"
    folder.mkdir(parents=True, exist_ok=True)
    path = write_summary(folder, {"provenance": runs.provenance(), **measured})
    for part, lines in measured.items():
        Console().print(table(part, lines))
    print(f"numbers: {path}")
    return measured


def _check(config: BenchmarkConfig) -> None:
    for task in config.tasks:
        cli.choose("--tasks", task, envs.TASKS)
    for name in ("worlds", "control_steps", "batches", "seeds", "width", "updates", "repeats"):
        value = getattr(config, name)
        least = min(value, default=0) if isinstance(value, tuple) else value
        if least < 1:
            raise UserError(f"--{name.replace('_', '-')} is {least}: must be at least 1")


def _physics(config: BenchmarkConfig) -> Iterator[dict[str, Any]]:
    impls = [physics.choose_impl(impl) for impl in config.impls]
    for task in config.tasks:
        for impl in impls:
            for n in config.worlds:
                yield physics_speed(task, impl, n, config)


def _updates(config: BenchmarkConfig) -> Iterator[dict[str, Any]]:
    for batch in config.batches:
        for seeds in config.seeds:
            yield update_speed(batch, seeds, config)


def physics_speed(task: str, impl: str, worlds: int, config: BenchmarkConfig) -> dict[str, Any]:
    """Physics steps per second of whole environments and, where MJX steps them, of bare `mjx.step`."""
    env, scene = envs.make(task, impl), envs.scene(task)
    host = scene.build({p.name: p.nominal for p in scene.parameters}).compile()
    steps = worlds * config.control_steps * scene.substeps
    start = time.perf_counter()
    whole = steps / fastest(*whole_env(env, worlds, config.control_steps), config.repeats)
    line = {"task": task, "impl": impl, "worlds": worlds, "env_per_s": whole}
    if impl != "c":
        bare = steps / fastest(*bare_steps(host, impl, worlds, config.control_steps, scene.substeps), config.repeats)
        line |= {"bare_per_s": bare, "env/bare": whole / bare}
    return line | {"measured_in_s": time.perf_counter() - start}


def fastest(function: Callable[[PyTree], PyTree], state: PyTree, repeats: int) -> float:
    """Seconds of the fastest call of a jitted `function` that consumes its state; compilation is not counted."""
    state = jax.block_until_ready(function(state))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        state = jax.block_until_ready(function(state))
        times.append(time.perf_counter() - start)
    return min(times)


def whole_env(env: Env, worlds: int, control_steps: int) -> tuple[Callable[[PyTree], PyTree], PyTree]:
    """(Steps of a randomised fleet under random actions, a fresh one)."""
    pool = env.sample_worlds(jax.random.key(0), POOL)

    def step(fleet: Fleet, key: Key) -> tuple[Fleet, None]:
        key_action, key_step = jax.random.split(key)
        actions = jax.random.uniform(key_action, (worlds, env.act_dim), minval=-1.0, maxval=1.0)
        return step_fleet(env, pool, fleet, actions, key_step, gamma=1.0)[0], None

    def run(state: tuple[Fleet, Key]) -> tuple[Fleet, Key]:
        fleet, key = state
        key, own = jax.random.split(key)
        return jax.lax.scan(step, fleet, jax.random.split(own, control_steps))[0], key

    fleet = jax.jit(lambda key: launch(env, pool, key, worlds))(jax.random.key(1))
    return jax.jit(run, donate_argnums=0), (fleet, jax.random.key(2))


def bare_steps(
    host: mujoco.MjModel, impl: str, worlds: int, control_steps: int, substeps: int
) -> tuple[Callable[[PyTree], PyTree], PyTree]:
    """(Steps of the nominal scene under commands drawn anew each control period, a batch at rest)."""
    model = mjx.put_model(host, impl=impl)
    contacts, rows = engine_warp.budget(host)
    room = {"naconmax": contacts, "njmax": rows} if impl == "warp" else {}
    blank = mjx.make_data(host, impl=impl, **room)

    def period(data: mjx.Data, key: Key) -> tuple[mjx.Data, None]:
        data = data.replace(ctrl=data.qpos[: host.nu] + 0.1 * jax.random.normal(key, (host.nu,)))
        return jax.lax.scan(lambda data, _: (mjx.step(model, data), None), data, length=substeps)[0], None

    def run(state: tuple[Array, Array, Key]) -> tuple[Array, Array, Key]:
        qpos, qvel, key = state
        key, own = jax.random.split(key)
        data = room_for(blank, worlds) if impl == "warp" else blank
        data = data.replace(qpos=qpos, qvel=qvel)
        with jax.default_matmul_precision("highest"):
            data = jax.lax.scan(period, data, jax.random.split(own, control_steps))[0]
        return data.qpos, data.qvel, key

    repeat = lambda x: jnp.repeat(jnp.asarray(x)[None], worlds, axis=0)  # noqa: E731
    start = repeat(blank.qpos), repeat(blank.qvel), jax.random.split(jax.random.key(2), worlds)
    return jax.jit(jax.vmap(run), donate_argnums=0), start


def room_for(data: mjx.Data, worlds: int) -> mjx.Data:
    """Data [] of one world for `impl="warp"`, its list of contacts, which all worlds share, long enough for so many."""
    own = data._impl
    lists = {name: x for name, x in vars(own).items() if name.startswith("contact__") and x.shape[0]}
    longer = {name: jnp.broadcast_to(x[:1], (worlds * x.shape[0], *x.shape[1:])) for name, x in lists.items()}
    sizes = {name: worlds * getattr(own, name) for name in ("naconmax", "naccdmax")}
    return data.replace(_impl=own.replace(**longer, **sizes))


def update_speed(batch: int, seeds: int, config: BenchmarkConfig) -> dict[str, Any]:
    """SAC updates per second over all seeds: of the library, and of the hand-written one with its cost."""
    network = NetworkConfig(hidden=(config.width, config.width), layer_norm=True)
    keys, count = jax.random.split(jax.random.key(0), seeds), seeds * config.updates
    own, bare = (
        count / fastest(*repeated(*agent, batch, keys, config.updates), config.repeats)
        for agent in (library_agent(network), bare_agent(network, batch))
    )
    flops = multiplications(network) * 2 * batch
    return {
        "batch": batch, "seeds": seeds, "width": config.width,
        "updates_per_s": own, "bare_per_s": bare, "updates/bare": own / bare,
        "gflop_per_update": flops / 1e9, "tflop_per_s": own * flops / 1e12,
    }  # fmt: skip


def rows(key: Key, batch: int) -> Transition:
    """A batch of made-up transitions."""
    blank = replay.blank(OBS_DIM, ACT_DIM)
    obs, next_obs = jax.random.normal(key, (2, batch, OBS_DIM))
    full = jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), blank)
    return full._replace(obs=obs, next_obs=next_obs, discount=full.discount + 0.97)


class Agent(NamedTuple):
    """update(state, batch, key) -> state; init(key) -> state."""

    update: Callable[[PyTree, Transition, Key], PyTree]
    init: Callable[[Key], PyTree]


def library_agent(network: NetworkConfig) -> Agent:
    """SAC as pretraining uses it."""
    learner = make_sac(SACConfig(OBS_DIM, ACT_DIM, network=network, ensemble_size=MEMBERS))
    return Agent(lambda state, batch, key: learner.update(state, batch, key)[0], learner.init)


def bare_agent(network: NetworkConfig, batch: int) -> Agent:
    """The same by hand, for batches of that size."""
    hyper = SACHyper()

    def update(state: bench_updates.Bare, rows: Transition, key: Key) -> bench_updates.Bare:
        return bench_updates.update(state, rows, bench_updates.draw(key, batch, ACT_DIM, MEMBERS), hyper)

    def init(key: Key) -> bench_updates.Bare:
        return bench_updates.init(key, network, OBS_DIM, ACT_DIM, members=MEMBERS, alpha=1.0)

    return Agent(update, init)


def repeated(
    update: Callable[[PyTree, Transition, Key], PyTree], init: Callable[[Key], PyTree], batch: int, keys: Key, n: int
) -> tuple[Callable[[PyTree], PyTree], PyTree]:
    """(n updates of every seed, agents and keys [seeds])."""

    def run(state: tuple[PyTree, Key]) -> tuple[PyTree, Key]:
        agent, key = state
        key, own = jax.random.split(key)
        data = rows(key, batch)
        return jax.lax.scan(lambda s, k: (update(s, data, k), None), agent, jax.random.split(own, n))[0], key

    return jax.jit(jax.vmap(run), donate_argnums=0), (jax.vmap(init)(keys), jnp.copy(keys))


def multiplications(network: NetworkConfig) -> int:
    """Multiplications of the matrix products that one row of a batch causes in an update, gradients included.

    A forward pass through kernels of K weights takes K, the gradient by these weights K, the gradient by the inputs of
    the layers K, less the first kernel where nobody asks for the gradient by the network's input.
    """

    def sizes(inputs: int, outputs: int) -> tuple[int, int]:
        widths = [inputs, *network.hidden, outputs]
        kernels = [n * m for n, m in pairwise(widths)]
        return sum(kernels), sum(kernels) - kernels[0]

    def trained(inputs: int, outputs: int) -> int:
        all_kernels, later = sizes(inputs, outputs)
        return 2 * all_kernels + later

    actor, critic = sizes(OBS_DIM, 2 * ACT_DIM)[0], sizes(OBS_DIM + ACT_DIM, 1)
    through = 2 * (2 * critic[0])  # twin critics forward, then back to the action
    return (
        actor + 2 * critic[0]  # targets
        + 2 * trained(OBS_DIM + ACT_DIM, 1)
        + trained(OBS_DIM, 2 * ACT_DIM) + through
        + trained(OBS_DIM, 1)
        + MEMBERS * trained(OBS_DIM + ACT_DIM, OBS_DIM)
    )  # fmt: skip


def table(part: str, lines: list[dict[str, Any]]) -> Table:
    """The lines of one kind as a table."""
    title = {"physics": "physics steps per second", "updates": "SAC updates per second"}[part]
    made = Table(title=title)
    names = list(dict.fromkeys(name for line in lines for name in line))
    for name in names:
        heading = name.replace("_", " ").replace("/", " / ")
        made.add_column(heading, justify="left" if name in ("task", "impl") else "right")
    for line in lines:
        made.add_row(*(_text(line[name]) if name in line else "-" for name in names))
    return made


def _text(x: Any) -> str:
    if isinstance(x, float):
        return f"{x:,.0f}" if x >= 1000 else f"{x:.3g}"
    return f"{x:,}" if isinstance(x, int) else str(x)


if __name__ == "__main__":
    cli.run_main(main, BenchmarkConfig, __doc__ or "")
