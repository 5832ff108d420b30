"""MuJoCo Warp as the engine of a scene: kernels for NVIDIA GPUs. They run on CPUs too, slowly.

Warp steps all worlds of a batch at once and keeps the contacts of all of them in one list, whose length has to be known
before. Our scenes declare every pair of geoms that may touch: the lengths below are exact bounds, which MJX's own
static layout tells, so nothing can overflow. Should it all the same, the state comes back as NaN, like any explosion,
and no learner sees it.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.mujoco.engines import Engine, check_features
from envs.mujoco.engines.mjx import mjx, put
from envs.types import Array, PyTree, UserError

# Newton iterations beyond the scene's. After the hardest pushes on the puck, one control step in a hundred, 4 of them
# leave MuJoCo and MJX together 0.7 mm from the converged solution and Warp elsewhere, 0.9 mm from theirs; with 6 it has
# converged to a micrometre. Worlds stop once they have, so more cost little.
_MORE_ITERATIONS = 4
_STATE = ("qpos", "qvel", "qacc_warmstart")


def make_engine(host: mujoco.MjModel, fields: tuple[str, ...] = ()) -> Engine:
    """The engine of a compiled scene. fields: names that a world may set in the model.

    Raises UserError where Warp is not installed, and for what it cannot step.
    """
    if not available():
        raise UserError("the engine warp needs the package warp-lang: install sgft-jax[warp]")
    from envs.mujoco.engines import warp_worlds

    check_features("warp", host)
    warp_worlds.check(host, fields)
    contacts, rows = budget(host)
    ends = np.cumsum([host.nq, host.nv, host.nv])

    size = {"contacts": contacts, "rows": rows, "iterations": iterations(host)}

    @functools.cache
    def call(layout: tuple[str, ...], move: bool) -> Any:
        """Worlds that differ in the same fields share buffers and graphs."""
        return warp_worlds.make_call(host, layout, move=move, **size)

    def prepare() -> None:
        layout = (*_STATE, *warp_worlds.as_read(dict.fromkeys(fields, jnp.ones(1))))
        warp_worlds.compile_kernels(host, layout, **size)

    def batch(values: dict[str, Array], state: Any, controls: Array, *, move: bool) -> Any:
        """Worlds [n] after steps under controls [n, steps, nu], or, unless they move, what their sensors read."""
        n = len(controls)
        parts = dict(zip(_STATE, (state.qpos, state.qvel, state.warmstart), strict=True))
        parts |= warp_worlds.as_read(values)
        packed = jnp.concatenate([x.reshape(n, -1) for x in parts.values()], axis=1)
        qpos, qvel, warmstart, sensordata = jnp.split(call(tuple(parts), move)(packed, controls), ends, axis=1)
        return type(state)(qpos, qvel, warmstart, controls[:, -1], sensordata)

    def of_one(move: bool) -> Callable[[dict[str, Array], PyTree, Array], PyTree]:
        together = jax.custom_batching.custom_vmap(functools.partial(batch, move=move))

        @together.def_vmap
        def _(size: int, batched: PyTree, *args: PyTree) -> tuple[Any, Any]:
            """A batch of batches is one larger batch: Warp wants all of its worlds at once."""

            def flat(x: Array, is_batched: bool) -> Array:
                spread = x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
                return spread.reshape(size * spread.shape[1], *spread.shape[2:])

            after = together(*jax.tree.map(flat, args, tuple(batched)))
            after = jax.tree.map(lambda x: x.reshape(size, len(x) // size, *x.shape[1:]), after)
            return after, jax.tree.map(lambda _: True, after)

        def alone(*args: PyTree) -> PyTree:
            return jax.tree.map(lambda x: x[0], together(*jax.tree.map(lambda x: x[None], args)))

        return alone

    moved, sensed = of_one(True), of_one(False)

    def sense(values: dict[str, Array], state: PyTree) -> PyTree:
        return state._replace(sensordata=sensed(values, state, state.ctrl[None]).sensordata)

    return Engine(moved, sense, prepare)


def available() -> bool:
    """Whether MuJoCo Warp can be used here."""
    return mjx.warp.WARP_INSTALLED


def iterations(host: mujoco.MjModel) -> int:
    """How often Warp's solver may iterate in this scene."""
    return host.opt.iterations + _MORE_ITERATIONS


def budget(host: mujoco.MjModel) -> tuple[int, int]:
    """The most contacts and constraint rows that one world of this scene can have."""
    layout = put(host)[1]._impl
    return layout.contact.dist.shape[0], layout.efc_J.shape[0]
