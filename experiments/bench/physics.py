"""Speed of environments next to the speed of the bare engines under them, which repeat the same physics.

An environment's step is the one that training takes: domain parameters of its own in every world, controller,
observation, reward, automatic reset, random actions. The references start from the states the environments had and
follow the commands they gave, in the nominal scene, so all of them meet the same contacts.
"""

import functools
import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from mujoco import mjx

import envs
from envs.base import Env, World
from envs.mujoco.engines import warp as engine_warp
from envs.mujoco.processes import cores
from envs.mujoco.worlds import Impl, PhysicsState, choose_impl
from envs.rollout import Fleet, launch, step_fleet
from envs.types import Array, Key
from experiments.bench.timing import Compiled, ahead, fastest, measure

POOL = 256  # domain parameter vectors, so that a batch really differs from world to world


class Window(NamedTuple):
    """Part of an episode of n worlds. start: PhysicsState [n]. commands: [T, n, nu], one per control step."""

    start: PhysicsState
    commands: Array


def speed(task: str, impl: Impl, worlds: int, *, control_steps: int, repeats: int) -> dict[str, Any]:
    """Physics steps per second of whole environments and of the bare engines.

    env_per_s: over whole episodes; the reset at their end is timed apart and counted once an episode. bare_per_s: of
    `mjx.step` (impl jax), of MuJoCo Warp without JAX (warp), of `mujoco.rollout` on all cores (c). mjx_per_s: with
    Warp, also of `mjx.step(impl="warp")`.
    """
    began, engine = time.perf_counter(), choose_impl(impl)
    env, scene = envs.make(task, engine), envs.scene(task)
    pool = envs.sample_worlds(env, jax.random.key(0), POOL)
    reset = ahead(lambda pool, key: launch(env, pool, key, worlds, ()), (pool, jax.random.key(1)))
    fresh = reset.call(pool, jax.random.key(1))
    play = ahead(lambda *state: _play(env, *state, control_steps=control_steps), (pool, fresh, jax.random.key(2)))
    middle, _ = play.call(pool, fresh, jax.random.key(2))  # into the episode, where things touch
    arguments = (pool, middle, jax.random.key(3))
    window = Window(middle.state.physics, play.call(*arguments)[1])

    play_s = fastest(lambda: play.call(*arguments), repeats=repeats)
    reset_s = fastest(lambda: reset.call(pool, jax.random.key(1)), repeats=repeats)
    steps = worlds * control_steps * scene.substeps
    episode_s = env.episode_length / control_steps * play_s + reset_s
    line: dict[str, Any] = {"task": task, "impl": engine, "worlds": worlds}
    line["env_per_s"] = worlds * env.episode_length * scene.substeps / episode_s
    host = scene.build({p.name: p.nominal for p in scene.parameters}).compile()
    if engine == "warp":
        host.opt.iterations = engine_warp.iterations(host)  # the references solve as exactly as the environment does
    if engine != "c":
        with _nothing_collected():
            mjx_per_s = steps / _mjx_alone(host, engine, window, scene.substeps, repeats).seconds
        line |= {"mjx_per_s": mjx_per_s} if engine == "warp" else {"bare_per_s": mjx_per_s}
    if engine != "jax":
        alone = {"c": _c_alone, "warp": _warp_alone}[engine]
        line["bare_per_s"] = steps / alone(host, window, scene.substeps, repeats)
    line["env/bare"] = line["env_per_s"] / line["bare_per_s"]
    line |= {"reset_s": reset_s, "compile_s": play.compile_s, "memory_mb": play.memory_mb}
    return line | {"measured_in_s": time.perf_counter() - began}


def _play(env: Env, pool: World, fleet: Fleet, key: Key, *, control_steps: int) -> tuple[Fleet, Array]:
    """(The fleet after that many steps under random actions, its commands [T, n, nu])."""
    n = fleet.index.shape[0]

    def step(fleet: Fleet, key: Key) -> tuple[Fleet, Array]:
        key_action, key_step = jax.random.split(key)
        actions = jax.random.uniform(key_action, (n, env.act_dim), minval=-1.0, maxval=1.0)
        fleet, _, _, after = step_fleet(env, pool, fleet, actions, (), key_step, initial_carry=(), gamma=1.0)
        return fleet, after.physics.ctrl

    return jax.lax.scan(step, fleet, jax.random.split(key, control_steps))


@contextmanager
def _nothing_collected() -> Iterator[None]:
    """No garbage is collected within, all of it at the end.

    MJX's first call compiles Warp's kernels, which leaves a cycle of garbage that holds the call's wrapper around JAX's
    stream. When that is collected, Warp forgets the stream. If MJX is about to capture a graph on it just then, as its
    second call does, that fails: "unknown stream".
    """
    gc.disable()
    try:
        yield
    finally:
        gc.collect()
        gc.enable()


def _mjx_alone(host: mujoco.MjModel, impl: str, window: Window, substeps: int, repeats: int) -> Compiled:
    """`mjx.step` and nothing else."""
    model = mjx.put_model(host, impl=impl)
    if impl == "warp":
        model = model.tree_replace({"opt._impl.warn_overflow": 0})  # messages from inside kernels would slow it
    contacts, rows = engine_warp.budget(host)
    blank = mjx.make_data(host, impl=impl, **({"naconmax": contacts, "njmax": rows} if impl == "warp" else {}))
    n = window.commands.shape[1]

    def run(start: PhysicsState, commands: Array) -> tuple[Array, Array]:
        data = _room_for(blank, n) if impl == "warp" else blank
        data = data.replace(qpos=start.qpos, qvel=start.qvel, qacc_warmstart=start.warmstart)

        def period(data: mjx.Data, ctrl: Array) -> tuple[mjx.Data, None]:
            data = data.replace(ctrl=ctrl)
            return jax.lax.scan(lambda data, _: (mjx.step(model, data), None), data, length=substeps)[0], None

        with jax.default_matmul_precision("highest"):
            data = jax.lax.scan(period, data, commands)[0]
        return data.qpos, data.qvel

    return measure(jax.vmap(run, (0, 1)), (window.start, window.commands), repeats=repeats)


def _room_for(data: mjx.Data, worlds: int) -> mjx.Data:
    """Data [] of one world for `impl="warp"`, its list of contacts, which all worlds share, long enough for so many."""
    inner = data._impl
    lists = {name: x for name, x in vars(inner).items() if name.startswith("contact__") and x.shape[0]}
    longer = {name: jnp.broadcast_to(x[:1], (worlds * x.shape[0], *x.shape[1:])) for name, x in lists.items()}
    sizes = {name: worlds * getattr(inner, name) for name in ("naconmax", "naccdmax")}
    return data.replace(_impl=inner.replace(**longer, **sizes))


def _warp_alone(host: mujoco.MjModel, window: Window, substeps: int, repeats: int) -> float:
    """Seconds of MuJoCo Warp without JAX, on a GPU as one CUDA graph a step."""
    import warp as wp
    from mujoco.mjx.third_party import mujoco_warp as mjw

    (contacts, rows), n = engine_warp.budget(host), window.commands.shape[1]
    model, data = mjw.put_model(host), mjw.make_data(host, nworld=n, naconmax=n * contacts, njmax=rows)
    model.opt.warn_overflow = False
    start = [wp.array(np.asarray(x), dtype=float) for x in window.start[:3]]
    commands = [wp.array(np.asarray(x), dtype=float) for x in window.commands]
    step = functools.partial(mjw.step, model, data)
    step()
    if wp.get_device().is_cuda:
        with wp.ScopedCapture() as capture:
            step()
        graph: Any = capture.graph
        step = functools.partial(wp.capture_launch, graph)

    def run() -> None:
        for place, values in zip((data.qpos, data.qvel, data.qacc_warmstart), start, strict=True):
            wp.copy(place, values)
        for ctrl in commands:
            wp.copy(data.ctrl, ctrl)
            for _ in range(substeps):
                step()
        wp.synchronize()

    return fastest(run, repeats=repeats)


def _c_alone(host: mujoco.MjModel, window: Window, substeps: int, repeats: int) -> float:
    """Seconds of MuJoCo's own rollouts on as many threads as there are cores."""
    qpos, qvel, warmstart = (np.asarray(x, np.float64) for x in window.start[:3])
    state = np.concatenate([np.zeros((len(qpos), 1)), qpos, qvel], axis=1)  # time comes first
    control = np.repeat(np.asarray(window.commands, np.float64).swapaxes(0, 1), substeps, axis=1)
    with mujoco.rollout.Rollout(nthread=cores()) as pool:
        data = [mujoco.MjData(host) for _ in range(cores())]
        return fastest(lambda: pool.rollout(host, data, state, control, initial_warmstart=warmstart), repeats=repeats)
