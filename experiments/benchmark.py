"""Measure speed, each number next to its reference from the same run: physics of whole environments against bare MJX.

`bare`: nothing but `mjx.step` on the nominal scene under random commands, the state carried along. `env`: the step that
training takes, with its own domain parameters in every world, controller, observation, reward and automatic reset.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx
from rich.console import Console
from rich.table import Table

import envs
from envs import engine_warp, physics
from envs.base import Env
from envs.rollout import Fleet, launch, step_fleet
from experiments import cli
from sgft_jax import runs
from sgft_jax.log import write_summary
from sgft_jax.types import Array, Key, PyTree, UserError

POOL = 256  # domain parameter vectors, so that a batch really differs from world to world


@dataclass(frozen=True)
class BenchmarkConfig:
    """What to measure."""

    tasks: tuple[str, ...] = ("push", "hammer", "insert")
    """Scenes."""
    worlds: tuple[int, ...] = (1024,)
    """Worlds stepped together."""
    impls: tuple[Literal["auto", "jax", "warp", "c"], ...] = ("auto",)
    """Engines of physics."""
    control_steps: int = 10
    """Control steps (of 0.2 s) per timed call."""
    repeats: int = 3
    """Timed calls; the fastest counts."""
    out: Path = Path("runs")
    """The numbers go to <out>/benchmark/summary.json."""


def main(config: BenchmarkConfig) -> list[dict[str, Any]]:
    """Measures, prints a table, writes the numbers and returns them."""
    for task in config.tasks:
        cli.choose("--tasks", task, envs.TASKS)
    for name, least in (
        ("worlds", min(config.worlds)),
        ("control-steps", config.control_steps),
        ("repeats", config.repeats),
    ):
        if least < 1:
            raise UserError(f"--{name} is {least}: must be at least 1")
    impls = [physics.choose_impl(impl) for impl in config.impls]
    lines = []
    for task in config.tasks:
        for impl in impls:
            for n in config.worlds:
                lines.append(physics_speed(task, impl, n, config))
                print("  ".join(f"{name} {_text(x)}" for name, x in lines[-1].items()), flush=True)
    folder = config.out / "benchmark"
    folder.mkdir(parents=True, exist_ok=True)
    path = write_summary(folder, {"provenance": runs.provenance(), "physics": lines})
    Console().print(table(lines))
    print(f"numbers: {path}")
    return lines


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
        data = engine_warp.room_for(blank, worlds) if impl == "warp" else blank
        data = data.replace(qpos=qpos, qvel=qvel)
        with jax.default_matmul_precision("highest"):
            data = jax.lax.scan(period, data, jax.random.split(own, control_steps))[0]
        return data.qpos, data.qvel, key

    repeat = lambda x: jnp.repeat(jnp.asarray(x)[None], worlds, axis=0)  # noqa: E731
    start = repeat(blank.qpos), repeat(blank.qvel), jax.random.split(jax.random.key(2), worlds)
    return jax.jit(jax.vmap(run), donate_argnums=0), start


def table(lines: list[dict[str, Any]]) -> Table:
    """The lines as a table; physics steps in millions per second."""
    made = Table(title="physics, million steps per second")
    for name in ("task", "engine", "worlds", "environment", "bare mjx.step", "ratio"):
        made.add_column(name, justify="left" if name in ("task", "engine") else "right")
    for line in lines:
        bare = f"{line['bare_per_s'] / 1e6:.2f}" if "bare_per_s" in line else "-"
        ratio = f"{line['env/bare']:.2f}" if "env/bare" in line else "-"
        made.add_row(line["task"], line["impl"], f"{line['worlds']:,}", f"{line['env_per_s'] / 1e6:.3f}", bare, ratio)
    return made


def _text(x: Any) -> str:
    return f"{x:.4g}" if isinstance(x, float) else str(x)


if __name__ == "__main__":
    cli.run_main(main, BenchmarkConfig, __doc__ or "")
