"""MuJoCo Warp as the engine of a scene: MJX by kernels for NVIDIA GPUs. They run on CPUs too, slowly.

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

from envs.engine_jax import Advance, with_fields
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
    lost = _set_up()
    contacts, rows = budget(host)
    nominal = _settings(mjx.put_model(host, impl="warp"))
    still, at_rest = mjx.put_model(host, impl="jax"), mjx.make_data(host, impl="jax")
    blank = mjx.make_data(host, impl="warp", naconmax=contacts, njmax=rows)

    def placed(values: dict[str, Array], qpos: Array) -> dict[str, Array]:
        """Where everything is. Warp leaves what is fixed to the world where it was when `blank` was made."""
        with jax.default_matmul_precision("highest"):
            data = mjx.kinematics(with_fields(still, values), at_rest.replace(qpos=qpos))
        return {name: getattr(data, name) for name in _POSES}

    def run(data: mjx.Data, values: dict[str, Array], state: Any, controls: Array) -> Any:
        """One world of a batch whose lists `data` holds."""
        model = with_fields(nominal, values)
        poses = placed(values, state.qpos)
        data = data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, **poses)

        def substep(carry: tuple[mjx.Data, Array], ctrl: Array) -> tuple[tuple[mjx.Data, Array], None]:
            data, overflow = carry
            data = mjx.step(model, data.replace(ctrl=ctrl))
            return (data, overflow | (data._impl.overflow & lost)), None

        (data, overflow), _ = jax.lax.scan(substep, (data, jnp.int32(0)), controls)
        qpos = jnp.where(overflow == 0, data.qpos, jnp.nan)
        return state._replace(qpos=qpos, qvel=data.qvel, warmstart=data.qacc_warmstart, ctrl=controls[-1])

    @jax.custom_batching.custom_vmap
    def batch(values: dict[str, Array], state: Any, controls: Array) -> Any:
        """Worlds [n]."""
        data = room_for(blank, len(controls))
        return jax.vmap(lambda *world: run(data, *world))(values, state, controls)

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


def budget(host: mujoco.MjModel) -> tuple[int, int]:
    """The most contacts and constraint rows that one world of this scene can have."""
    layout = mjx.make_data(host, impl="jax")._impl
    return layout.contact.dist.shape[0], layout.efc_J.shape[0]


def _set_up() -> int:
    """Silences Warp's report on every kernel it loads. Returns the bits of its overflow mask that mean lost contacts or
    constraints: all but a solver that used up its iterations, which is how we run it.
    """
    import warp
    from mujoco.mjx.third_party.mujoco_warp import OverflowType

    warp.config.log_level = warp.LOG_WARNING
    return int(OverflowType.ALL & ~(OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS))


def _settings(model: mjx.Model) -> mjx.Model:
    """Without messages printed from inside kernels, which would stall the GPU, and with more solver iterations."""
    option = model.opt
    iterations = option.iterations + _MORE_ITERATIONS
    return model.replace(opt=option.replace(iterations=iterations, _impl=option._impl.replace(warn_overflow=0)))


def room_for(data: mjx.Data, worlds: int) -> mjx.Data:
    """Data [] of one world whose shared list of contacts is long enough for that many worlds."""
    own = data._impl
    lists = {name: x for name, x in vars(own).items() if name.startswith("contact__") and x.shape[0]}
    longer = {name: jnp.broadcast_to(x[:1], (worlds * x.shape[0], *x.shape[1:])) for name, x in lists.items()}
    sizes = {name: worlds * getattr(own, name) for name in ("naconmax", "naccdmax")}
    return data.replace(_impl=own.replace(**longer, **sizes))
