"""MuJoCo's C engine behind a callback, as the engine of a scene. Impure inside, pure outside.

On a CPU, XLA's program of an MJX step takes two to three times as long as C MuJoCo's, and many seconds to compile. The
worlds of a batch are shared among as many threads as there are cores.

On a CPU the callback works on XLA's own buffers. `jax.pure_callback`, which serves the other platforms, first makes
JAX arrays of its arguments, and the copies wait for threads that may all be busy with programs that wait for them
(https://github.com/jax-ml/jax/issues/24255).
"""

import concurrent.futures
import copy
import functools
import os
import threading
import warnings
from operator import attrgetter
from typing import Any, NamedTuple

import jax
import mujoco
import mujoco.rollout
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from envs.mujoco.engines import Engine
from envs.types import Array, PyTree


class _Slot(NamedTuple):
    """What a thread steps worlds in, one after another. views: name of an array -> the array inside `model`."""

    rollout: mujoco.rollout.Rollout
    model: mujoco.MjModel
    data: mujoco.MjData
    views: dict[str, np.ndarray]


def make_engine(host: mujoco.MjModel, fields: tuple[str, ...]) -> Engine:
    """The engine of a compiled scene; fields: names that a world may set in the model.

    Under `vmap` all worlds reach the host together. States that MuJoCo would reset, because they explode, come back as
    they are: not finite.
    """
    mujoco.set_mju_user_warning(_warn)
    nominal = copy.deepcopy(host)
    nominal.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if {"geom_size", "geom_pos", "geom_quat", "body_ipos", "body_iquat"}.intersection(fields):
        nominal.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # its boxes are those of the nominal scene
    arrays = tuple(name for name in fields if isinstance(attrgetter(name)(nominal), np.ndarray))
    cores = os.cpu_count() or 1
    threads = concurrent.futures.ThreadPoolExecutor(cores)
    lock = threading.Lock()  # XLA may run two programs at once

    def new_slot() -> _Slot:
        model = copy.deepcopy(nominal)
        views = {name: attrgetter(name)(model) for name in arrays}
        return _Slot(mujoco.rollout.Rollout(nthread=0), model, mujoco.MjData(model), views)

    slots = [new_slot() for _ in range(cores)]

    def on_host(values: dict[str, Any], state: Any, controls: Any, *, move: bool) -> Any:
        lead = state.qpos.shape[:-1]
        worlds = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[len(lead) :]), (values, state, controls))
        values, state, controls = worlds
        after = jax.tree.map(np.empty_like, state)
        if host.nsensordata:
            after = after._replace(sensordata=np.empty((len(controls), host.nsensordata), np.float32))

        def run(k: int) -> None:
            slot = slots[k]
            for i in range(k, len(controls), cores):
                _enter(slot, {name: x[i] for name, x in values.items()})
                now = jax.tree.map(lambda x, i=i: x[i], state)
                sensed = _steps(slot, now, controls[i]) if move else _forward(slot, now, controls[i])
                after.qpos[i], after.qvel[i] = slot.data.qpos, slot.data.qvel
                after.warmstart[i], after.ctrl[i] = slot.data.qacc_warmstart, controls[i, -1]
                if host.nsensordata:
                    after.sensordata[i] = sensed

        with lock:
            list(threads.map(run, range(min(cores, len(controls)))))
        return jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), after)

    def call(values: dict[str, Array], state: PyTree, controls: Array, *, move: bool) -> PyTree:
        """A scene without sensors hands none over: a callback has no use for empty arrays."""
        sensors = jax.ShapeDtypeStruct((host.nsensordata,), np.float32) if host.nsensordata else None
        start = state._replace(sensordata=None)
        shape = jax.eval_shape(lambda: start)._replace(sensordata=sensors)
        work = functools.partial(on_host, move=move)

        def in_place(context: Any, after: Any, *args: Any) -> None:
            jax.tree.map(lambda out, x: np.copyto(np.asarray(out), x), after, work(*args))

        on_cpu = buffer_callback(in_place, shape, vmap_method="broadcast_all")
        elsewhere = functools.partial(jax.pure_callback, work, shape, vmap_method="broadcast_all")
        after = jax.lax.platform_dependent(values, start, controls, cpu=on_cpu, default=elsewhere)
        return after if host.nsensordata else after._replace(sensordata=state.sensordata)

    def sense(values: dict[str, Array], state: PyTree) -> PyTree:
        return state._replace(sensordata=call(values, state, state.ctrl[None], move=False).sensordata)

    return Engine(functools.partial(call, move=True), sense)


def _warn(message: str) -> None:
    """Instead of a log file in the working directory. The state itself shows what is unstable."""
    if "unstable" not in message:
        warnings.warn(message, RuntimeWarning, stacklevel=2)


def _enter(slot: _Slot, values: dict[str, np.ndarray]) -> None:
    """Make the slot's model that of one world."""
    for name, value in values.items():
        if name in slot.views:
            slot.views[name][...] = value
        else:
            part, _, last = name.rpartition(".")
            setattr(getattr(slot.model, part), last, float(value))


def _forward(slot: _Slot, state: Any, controls: np.ndarray) -> np.ndarray:
    """[nsensordata] what the sensors read in that state under controls [1, nu]."""
    data = slot.data
    mujoco.mj_resetData(slot.model, data)
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = state.qpos, state.qvel, state.warmstart
    data.ctrl[:] = controls[0]
    mujoco.mj_forward(slot.model, data)
    return data.sensordata


def _steps(slot: _Slot, state: Any, controls: np.ndarray) -> np.ndarray:
    """All steps under `controls` [substeps, nu], in one call that leaves Python's lock to the other threads.

    Returns [nsensordata], what the sensors read in the last one.
    """
    model, data = slot.model, slot.data
    mujoco.mj_resetData(model, data)
    start = np.concatenate([[0.0], state.qpos, state.qvel])  # time comes first
    rolled, sensed = np.empty((1, len(controls), len(start))), np.empty((1, len(controls), model.nsensordata))
    controls, warmstart = (x[None].astype(np.float64) for x in (controls, state.warmstart))
    results = {"state": rolled, "sensordata": sensed}
    steps = {"nstep": controls.shape[1], "initial_warmstart": warmstart}
    slot.rollout.rollout([model], [data], start[None], controls, skip_checks=True, **steps, **results)
    return sensed[0, -1]
