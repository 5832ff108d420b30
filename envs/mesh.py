"""Work spread over devices by JAX's own sharding.

Programs are written as for one device. Whoever runs them on several activates a mesh (`use`), and the marks below,
which do nothing without one, say what is cut into pieces: `split` an axis that XLA may partition, `split_vmap` a batch
whose function XLA cannot look into (physics by kernels or callbacks) or need not (independent seeds). Random numbers
follow from keys alone, so results do not depend on the mesh, but for the order of floating-point sums.
"""

import contextlib
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, PartitionSpec

from envs.types import Array, PyTree, UserError

DATA = "data"  # the mesh's only axis


def check_jax() -> None:
    """Raises UserError where JAX is set to compute otherwise than this project can, before anything slow."""
    if jax.config.jax_enable_x64:
        raise UserError("JAX_ENABLE_X64 is on (jax_enable_x64), and everything here is float32; switch it off")
    try:
        jax.local_devices()
    except (RuntimeError, AssertionError) as error:  # JAX asserts, without words, that there is a plugin for cuda
        reason = (str(error) or "no such device, or no plugin for it").splitlines()[0]
        chosen = jax.config.jax_platforms
        raise UserError(f"JAX_PLATFORMS={chosen}: {reason}; unset it, or set it to cpu") from error


def devices(wanted: int | None, sizes: Mapping[str, int]) -> int:
    """How many devices `wanted` means: None is one, or all if there are several hosts, 0 all there are.

    sizes: what will be cut into as many equal pieces, by the name of the option. Raises UserError if there are fewer
    devices, if a size is not a multiple of their number, or if some of several hosts would have nothing to do.
    """
    check_jax()
    count, hosts = jax.device_count(), jax.process_count()
    n = (1 if hosts == 1 else count) if wanted is None else wanted or count
    if not 1 <= n <= count:
        raise UserError(f"--devices {n}: JAX sees {count} {jax.default_backend()} device(s)")
    if hosts > 1 and n < count:
        raise UserError(f"--devices {n}: {hosts} hosts work with all their {count} devices; leave it out")
    for name, size in sizes.items():
        if size % n:
            raise UserError(f"{name} is {size}: not a multiple of the {n} devices; change it or --devices")
    return n


def use(n: int) -> contextlib.AbstractContextManager:
    """The first n devices, for what is traced and run in a `with` block; n = 1 leaves everything as it is."""
    if n == 1:
        return contextlib.nullcontext()
    if jax.default_backend() == "gpu":
        # Shardy of jaxlib 0.11.2 crashes (a segmentation fault, before it partitions) on programs that step
        # environments, for GPUs alone; its predecessor GSPMD compiles them.
        jax.config.update("jax_use_shardy_partitioner", False)
    mesh = jax.make_mesh((n,), (DATA,), axis_types=(AxisType.Auto,), devices=jax.devices()[:n])
    return jax.set_mesh(mesh)


def pieces() -> int:
    """The number of pieces that the marks cut into: 1 without a mesh, and inside a piece."""
    mesh = jax.sharding.get_abstract_mesh()
    return 1 if mesh.empty or DATA in mesh.manual_axes else mesh.shape[DATA]


def split(tree: PyTree, axis: int = 0) -> PyTree:
    """The same values, that axis of every leaf cut into one piece per device."""
    return _constrain(tree, PartitionSpec(*[None] * axis, DATA))


def whole(tree: PyTree) -> PyTree:
    """The same values, all of them on every device."""
    return _constrain(tree, PartitionSpec())


def local(tree: PyTree) -> PyTree:
    """Whole copies of arrays that the devices of several hosts may share, on this host alone; every host must ask."""
    if jax.process_count() == 1:
        return tree
    return jax.tree.map(_copy, jax.jit(whole)(tree))


def meet() -> None:
    """Waits for the other hosts, if there are any."""
    multihost_utils.sync_global_devices("meet")


def split_vmap[R](function: Callable[..., R], in_axes: int | tuple[int | None, ...] = 0) -> Callable[..., R]:
    """`jax.vmap` over leading axes (0; None = shared), each device doing its piece of the batch alone.

    A batch that cannot be cut into equal pieces is done by every device as a whole.
    """
    batched = jax.vmap(function, in_axes)

    def run(*args: PyTree) -> R:
        axes = in_axes if isinstance(in_axes, tuple) else (in_axes,) * len(args)
        leaves: list[Array] = jax.tree.leaves([arg for arg, axis in zip(args, axes, strict=True) if axis == 0])
        n = pieces()
        if n == 1 or leaves[0].shape[0] % n:
            return batched(*args)
        specs = tuple(PartitionSpec() if axis is None else PartitionSpec(DATA) for axis in axes)
        return jax.shard_map(batched, in_specs=specs, out_specs=PartitionSpec(DATA), check_vma=False)(*args)

    return run


def set_rows(data: PyTree, rows: Array, batch: PyTree) -> PyTree:
    """`data` with `batch` [n, ...] in its rows [n]; rows beyond the end are dropped.

    Each device writes what falls into its own piece.
    """
    n, length = pieces(), jax.tree.leaves(data)[0].shape[0]
    if n == 1 or length % n:
        return _set_rows(data, rows, batch)

    def set_local(data: PyTree, rows: Array, batch: PyTree) -> PyTree:
        local_rows = rows - jax.lax.axis_index(DATA) * (length // n)
        mine = (local_rows >= 0) & (local_rows < length // n)
        return _set_rows(data, jnp.where(mine, local_rows, length // n), batch)

    specs = PartitionSpec(DATA), PartitionSpec(), PartitionSpec()
    return jax.shard_map(set_local, in_specs=specs, out_specs=PartitionSpec(DATA), check_vma=False)(data, rows, batch)


def running_count(mask: Array) -> Array:
    """[n] int32: how many entries of `mask` [n] bool are true up to each, itself included.

    Every device counts all of them. A count cut into pieces is compiled for GPUs to loops with a turn for each of a
    device's entries, which took 100 ms at 4,096 environments, twice the rest of their step (docs/performance.md).
    """
    return whole(jnp.cumsum(whole(mask), dtype=jnp.int32))


def _set_rows(data: PyTree, rows: Array, batch: PyTree) -> PyTree:
    return jax.tree.map(lambda d, x: d.at[rows].set(x.astype(d.dtype), mode="drop"), data, batch)


def _copy(x: Array) -> Array:
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_copy(jax.random.key_data(x)), impl=jax.random.key_impl(x))
    return jnp.asarray(np.asarray(x))


def _constrain(tree: PyTree, spec: PartitionSpec) -> PyTree:
    return tree if pieces() == 1 else jax.lax.with_sharding_constraint(tree, spec)
