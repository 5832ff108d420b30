"""MuJoCo Warp as the engine of a scene: kernels for NVIDIA GPUs. They run on CPUs too, slowly.

Warp steps all worlds of a batch at once and keeps the contacts of all of them in one list, whose length has to be known
before. Our scenes declare every pair of geoms that may touch: the lengths below are exact bounds, which MJX's own
static layout tells, so nothing can overflow. Should it all the same, the state comes back as NaN, like any explosion,
and no learner sees it.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from envs.mujoco.engines.mjx import Advance, put, with_fields
from sgft_jax.types import Array, PyTree, UserError

# Newton iterations beyond the scene's. After the hardest pushes on the puck, one control step in a hundred, 4 of them
# leave MuJoCo and MJX together 0.7 mm from the converged solution and Warp elsewhere, 0.9 mm from theirs; with 6 it has
# converged to a micrometre. Worlds stop once they have, so more cost little.
_MORE_ITERATIONS = 4
_POSES = ("xpos", "xquat", "xmat", "xipos", "ximat", "geom_xpos", "geom_xmat")


def make_advance(host: mujoco.MjModel) -> Advance:
    """The engine of a compiled scene; for one world, vmap over worlds. Raises UserError where Warp is not installed."""
    if not available():
        raise UserError("the engine warp needs the package warp-lang: install sgft-jax[warp]")
    from envs.mujoco.engines import warp_worlds

    contacts, rows = budget(host)
    still, at_rest = put(host)
    calls: dict[tuple[str, ...], Any] = {}

    def call(layout: tuple[str, ...]) -> Any:
        """Worlds that differ in the same fields share buffers and graphs."""
        if layout not in calls:
            size = {"contacts": contacts, "rows": rows, "iterations": iterations(host)}
            calls[layout] = warp_worlds.make_call(host, layout, **size)
        return calls[layout]

    def placed(values: dict[str, Array], qpos: Array) -> dict[str, Array]:
        """Where everything is. Warp leaves what is fixed to the world where it was when its data were made."""
        with jax.default_matmul_precision("highest"):
            data = mjx.kinematics(with_fields(still, values), at_rest.replace(qpos=qpos))
        return {name: getattr(data, name) for name in _POSES}

    @jax.custom_batching.custom_vmap
    def batch(values: dict[str, Array], state: Any, controls: Array) -> Any:
        """Worlds [n]."""
        n = len(controls)
        parts = {"qpos": state.qpos, "qvel": state.qvel, "qacc_warmstart": state.warmstart}
        parts |= jax.vmap(placed)(values, state.qpos)
        parts |= {name: x for name, x in values.items() if warp_worlds.reads(name)}
        packed = jnp.concatenate([x.reshape(n, -1) for x in parts.values()], axis=1)
        after = call(tuple(parts))(packed, controls)
        qpos, qvel, warmstart = jnp.split(after, [host.nq, host.nq + host.nv], axis=1)
        return state._replace(qpos=qpos, qvel=qvel, warmstart=warmstart, ctrl=controls[:, -1])

    @batch.def_vmap
    def _(size: int, batched: PyTree, *args: PyTree) -> tuple[Any, Any]:
        """A batch of batches is one larger batch: Warp wants all of its worlds at once."""
        spread = lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape))  # noqa: E731
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), jax.tree.map(spread, args, tuple(batched)))
        after = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), batch(*flat))
        return after, jax.tree.map(lambda _: True, after)

    def advance(values: dict[str, Array], state: PyTree, controls: Array) -> PyTree:
        alone = jax.tree.map(lambda x: x[None], (values, state, controls))
        return jax.tree.map(lambda x: x[0], batch(*alone))

    return advance


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
