"""MuJoCo's C engine behind `jax.pure_callback`: the same steps as MJX's, on the host. Impure inside, pure outside.

On a CPU, XLA's program of an MJX step takes several times as long as C MuJoCo, and seconds to compile; see
docs/physics.md for how closely the two agree. Worlds are stepped by as many threads as there are cores.
"""

import concurrent.futures
import copy
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from sgft_jax.types import Array, PyTree

Advance = Callable[[dict[str, Array], PyTree, Array], PyTree]


class _Slot(NamedTuple):
    """What one world is stepped in. views: name of a field -> the array inside `model`."""

    model: mujoco.MjModel
    data: mujoco.MjData
    views: dict[str, np.ndarray]


def make_advance(host: mujoco.MjModel, fields: tuple[str, ...], mean_inertia: str) -> Advance:
    """(fields of one world, its state, controls [substeps, nu]) -> the state after these steps.

    fields: names that a world may set in the model, `mean_inertia` among them. The state is a NamedTuple of qpos, qvel,
    warmstart and ctrl. Under `vmap` all worlds reach the host together. States that MuJoCo would reset, because they
    explode, come back as they are: not finite.
    """
    nominal = copy.deepcopy(host)
    nominal.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    arrays = tuple(name for name in fields if name != mean_inertia)
    slots: list[_Slot] = []
    threads = concurrent.futures.ThreadPoolExecutor(os.cpu_count())

    def new_slot() -> _Slot:
        model = copy.deepcopy(nominal)
        return _Slot(model, mujoco.MjData(model), {name: getattr(model, name) for name in arrays})

    def on_host(values: dict[str, Any], state: Any, controls: Any) -> Any:
        values, state, controls = jax.tree.map(np.asarray, (values, state, controls))
        lead = state.qpos.shape[:-1]
        flat = lambda x: x.reshape(-1, *x.shape[len(lead) :])  # noqa: E731
        values, state, controls = jax.tree.map(flat, (values, state, controls))
        slots.extend(new_slot() for _ in range(len(controls) - len(slots)))
        after = jax.tree.map(np.empty_like, state)

        def run(worlds: range) -> None:
            for i in worlds:
                _enter(slots[i], {name: x[i] for name, x in values.items()}, mean_inertia)
                _steps(slots[i], jax.tree.map(lambda x, i=i: x[i], state), controls[i])
                data = slots[i].data
                after.qpos[i], after.qvel[i], after.warmstart[i] = data.qpos, data.qvel, data.qacc_warmstart
                after.ctrl[i] = controls[i, -1]

        count = min(os.cpu_count() or 1, len(controls))
        list(threads.map(run, [range(k, len(controls), count) for k in range(count)]))
        return jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), after)

    def advance(values: dict[str, Array], state: PyTree, controls: Array) -> PyTree:
        shape = jax.eval_shape(lambda: state)
        return jax.pure_callback(on_host, shape, values, state, controls, vmap_method="broadcast_all")

    return advance


def _enter(slot: _Slot, values: dict[str, np.ndarray], mean_inertia: str) -> None:
    """Make the slot's model that of one world."""
    for name, value in values.items():
        if name == mean_inertia:
            slot.model.stat.meaninertia = float(value)
        else:
            slot.views[name][...] = value


def _steps(slot: _Slot, state: Any, controls: np.ndarray) -> None:
    """All steps under `controls` [substeps, nu]; those at its end where it no longer changes in one call."""
    model, data = slot.model, slot.data
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = state.qpos, state.qvel, state.warmstart
    changes = np.flatnonzero((controls[1:] != controls[:-1]).any(axis=1))
    settled = int(changes[-1]) + 1 if changes.size else 0
    for control in controls[:settled]:
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
    data.ctrl[:] = controls[-1]
    mujoco.mj_step(model, data, len(controls) - settled)
