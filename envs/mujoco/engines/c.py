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
import threading
import warnings
from collections.abc import Callable
from operator import attrgetter
from typing import Any, NamedTuple

import jax
import mujoco
import mujoco.rollout
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from envs.mujoco.engines import Engine
from envs.mujoco.processes import cores
from envs.types import Array, PyTree


class _Slot(NamedTuple):
    """What a thread steps worlds in, one after another.

    views: name of an array -> the array inside `model`. warmstart: that inside `data`.
    """

    rollout: mujoco.rollout.Rollout
    model: mujoco.MjModel
    data: mujoco.MjData
    views: dict[str, np.ndarray]
    warmstart: np.ndarray


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
    lanes = cores()
    threads = concurrent.futures.ThreadPoolExecutor(lanes)
    lock = threading.Lock()  # XLA may run two programs at once

    def new_slot() -> _Slot:
        model = copy.deepcopy(nominal)
        views = {name: attrgetter(name)(model) for name in arrays}
        data = mujoco.MjData(model)
        return _Slot(mujoco.rollout.Rollout(nthread=0), model, data, views, data.qacc_warmstart)

    slots = [new_slot() for _ in range(lanes)]

    def on_host(values: dict[str, Any], state: Any, controls: Any, *, move: bool) -> Any:
        lead = state.qpos.shape[:-1]
        worlds = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[len(lead) :]), (values, state, controls))
        values, state, controls = worlds
        count, sensors = len(controls), np.empty((len(controls), host.nsensordata), np.float32)
        # All at once into the precision of MuJoCo, and out of it; time comes first in its states.
        moving = [np.zeros((count, 1)), state.qpos, state.qvel]
        states, warmstarts = np.concatenate(moving, axis=1), state.warmstart.astype(np.float64)
        exact = controls.astype(np.float64)

        def run(k: int) -> None:
            slot, steps = slots[k], _Steps.of(controls.shape[1], states.shape[1], host.nsensordata)
            enter = _entering(slot, values)
            for i in range(k, count, lanes):
                enter(i)
                (_steps if move else _forward)(slot, steps, states[i : i + 1], warmstarts[i : i + 1], exact[i : i + 1])
                states[i], sensors[i], warmstarts[i] = steps.states[0, -1], steps.sensors[0, -1], slot.warmstart
                if not np.isfinite(states[i]).all():
                    mujoco.mj_resetData(slot.model, slot.data)  # what explodes here reaches no other world

        with lock:
            list(threads.map(run, range(min(lanes, count))))
        qpos, qvel = np.split(states[:, 1:].astype(np.float32), [host.nq], axis=1)
        after = state._replace(qpos=qpos, qvel=qvel, warmstart=warmstarts.astype(np.float32), ctrl=controls[:, -1])
        after = after._replace(sensordata=sensors) if host.nsensordata else after
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


class _Steps(NamedTuple):
    """What the steps of one world lead to. states: [1, steps, 1 + nq + nv]. sensors: [1, steps, nsensordata]."""

    states: np.ndarray
    sensors: np.ndarray

    @classmethod
    def of(cls, steps: int, size: int, sensors: int) -> "_Steps":
        """Blank ones."""
        return cls(np.empty((1, steps, size)), np.empty((1, steps, sensors)))


def _entering(slot: _Slot, values: dict[str, np.ndarray]) -> Callable[[int], None]:
    """(i) makes the slot's model that of the i-th of these worlds."""
    arrays = [(slot.views[name], column) for name, column in values.items() if name in slot.views]
    numbers = [(name.rpartition("."), column) for name, column in values.items() if name not in slot.views]
    owners = [(getattr(slot.model, part), last, column) for (part, _, last), column in numbers]

    def enter(i: int) -> None:
        for view, column in arrays:
            view[...] = column[i]
        for owner, last, column in owners:
            setattr(owner, last, float(column[i]))

    return enter


def _forward(slot: _Slot, steps: _Steps, state: np.ndarray, warmstart: np.ndarray, controls: np.ndarray) -> None:
    """What the sensors read in that state [1, ...] under controls [1, 1, nu]; the state stays."""
    mujoco.mj_resetData(slot.model, slot.data)
    mujoco.mj_setState(slot.model, slot.data, state[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    slot.data.ctrl[:], slot.warmstart[:] = controls[0, 0], warmstart[0]
    mujoco.mj_forward(slot.model, slot.data)
    steps.states[0, -1], steps.sensors[0, -1] = state[0], slot.data.sensordata


def _steps(slot: _Slot, steps: _Steps, state: np.ndarray, warmstart: np.ndarray, controls: np.ndarray) -> None:
    """All steps under `controls` [1, steps, nu], in one call that leaves Python's lock to the other threads."""
    slot.rollout.rollout(
        [slot.model],
        [slot.data],
        state,
        controls,
        skip_checks=True,
        nstep=controls.shape[1],
        initial_warmstart=warmstart,
        state=steps.states,
        sensordata=steps.sensors,
    )
