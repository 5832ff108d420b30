"""A batch of worlds inside MuJoCo Warp, and the call from JAX that steps them. Imports Warp, which is optional.

MJX's own binding hands all of MuJoCo's data, some 500 arrays, to Warp and back at every physics step. Here the worlds
stay with Warp: JAX passes what distinguishes them and their states once per control period, as one array of floats,
and gets states back. On a GPU a physics step is one CUDA graph, captured once per number of worlds; its buffers are
the worlds' own, so it never has to be captured again.
"""

import contextlib
import dataclasses
import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp as mjw

from envs.mujoco.engines import FLUID
from envs.mujoco.processes import cores, in_parallel
from envs.types import Array, UserError

wp.config.log_level = wp.LOG_WARNING  # no report on every kernel it loads

_PROCESSES = 6  # that compile kernels: each takes some 10 s to start, and 0.5 GB of the GPU

# Lost contacts and constraints; a solver that used up its iterations is how we run it.
_LOSSES = int(mjw.OverflowType.ALL & ~(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS))


# What Warp's kernels leave out where the nominal scene has none of it, by the flag that says so.
_FLAGS = {
    "has_fluid": FLUID,
    "has_tendon_stiffness": ("tendon_stiffness", "tendon_stiffnesspoly"),
    "has_tendon_damping": ("tendon_damping", "tendon_dampingpoly"),
    "has_efm_actuator": ("actuator_gainprm", "actuator_biasprm"),
}


def as_read(fields: Mapping[str, Array]) -> dict[str, Array]:
    """The fields of models that mean anything to Warp, as it keeps them."""
    fields = dict(fields)
    if "opt.impratio" in fields:
        fields["opt.impratio_invsqrt"] = fields.pop("opt.impratio") ** -0.5
    return {name: x for name, x in fields.items() if _type(name) is not None}


def check(host: mujoco.MjModel, fields: Sequence[str]) -> None:
    """Raises UserError for a scene that Warp cannot step, or whose worlds differ in what it has once for all."""
    try:
        mjw.put_model(host)
    except (NotImplementedError, ValueError) as error:
        raise UserError(f"MuJoCo Warp cannot step it: {error}; the engine c can (--impl c)") from None
    for name in fields:
        kind = _type(name)
        if kind is not None and kind.shape[0] != "*":
            raise UserError(f"worlds that differ in '{name}' need another engine: MuJoCo Warp has one for all of them")


def _type(name: str) -> Any:
    """How Warp's model keeps that field: as an array, of shape ("*", ...) where worlds may differ; None: not at all."""
    part, _, last = name.rpartition(".")
    owner = {"": mjw.Model, "opt": mjw.Option}.get(part)
    field = None if owner is None else owner.__dataclass_fields__.get(last)
    return None if field is None else field.type


class Worlds:
    """n worlds of a scene on one device. What is in `layout` is set by `load`, everything else is the scene's.

    layout: names of fields of Warp's data or model, in the order in which they lie in a row of floats.
    """

    def __init__(
        self, host: mujoco.MjModel, layout: Sequence[str], n: int, *, contacts: int, rows: int, iterations: int
    ) -> None:
        self.model, self.graph, self.stream = mjw.put_model(host), None, None
        self.model.opt.iterations = iterations
        self.model.opt.warn_overflow = False  # messages printed from inside kernels would stall the GPU
        for flag, names in _FLAGS.items():
            if set(names) & set(layout):
                setattr(self.model, flag, True)
        self.data = mjw.make_data(host, nworld=n, naconmax=n * contacts, njmax=rows)
        self.lost = wp.zeros(n, dtype=int)
        self.places = []
        start = 0
        for name in layout:
            floats = self._own(name, n)
            self.places.append((floats, start, start + floats.shape[1]))
            start += floats.shape[1]
        # Warp leaves geoms that are fixed to the world where they were when its data were made: here none is fixed.
        self.unfixed = dataclasses.replace(self.model, body_weldid=wp.full(host.nbody, 1, dtype=int))

    def load(self, packed: wp.array) -> None:
        """packed: [n, floats] as `layout` says."""
        for floats, start, stop in self.places:
            wp.copy(floats, packed[:, start:stop])
        mjw.kinematics(self.unfixed, self.data)
        self.lost.zero_()

    def sense(self, ctrl: wp.array) -> None:
        """What sensors read under commands [n, nu]; nothing moves."""
        wp.copy(self.data.ctrl, ctrl)
        mjw.forward(self.model, self.data)

    def kernels(self) -> list[tuple[wp.Module, int | None]]:
        """The modules of the kernels of a step, and threads of a block."""
        with _noted() as modules:
            self._step()
        return list(modules)

    def step(self, ctrl: wp.array) -> None:
        """One physics step under commands [n, nu]."""
        wp.copy(self.data.ctrl, ctrl)
        if self.graph is None:
            self._step()
        else:
            wp.capture_launch(self.graph)

    def capture(self) -> None:
        """Makes a graph of the step, and in doing so steps once: everything it needs must have been loaded before."""
        # Warp compiles kernels now, which leaves a cycle of garbage that holds this call's wrapper around JAX's stream.
        # Were it collected amid a later call, Warp would forget the stream: so it is kept.
        self.stream = wp.get_stream()
        self._step()
        with wp.ScopedCapture() as capture:
            self._step()
        self.graph = capture.graph

    def unload(self, out: wp.array) -> None:
        """out: [n, nq + 2 nv + nsensordata] state, accelerations and sensors; NaN where contacts were lost."""
        data = self.data
        inputs = [data.qpos, data.qvel, data.qacc_warmstart, data.sensordata, self.lost]
        wp.launch(_unload, out.shape, inputs=inputs, outputs=[out])

    def _step(self) -> None:
        mjw.step(self.model, self.data)
        wp.launch(_note, self.lost.shape, inputs=[self.data.overflow, _LOSSES], outputs=[self.lost])

    def _own(self, name: str, n: int) -> wp.array:
        """The field of that name as floats [n, ...]; a field of the model gets room for n values of its own first."""
        array: Any = getattr(self.data, name, None)
        if array is None:
            part, _, last = name.rpartition(".")
            owner = getattr(self.model, part) if part else self.model
            shared = getattr(owner, last)
            array = wp.empty((n, *shared.shape[1:]), dtype=shared.dtype)
            setattr(owner, last, array)
        count = math.prod(array.shape[1:]) * wp.types.type_size_in_bytes(array.dtype) // 4
        return wp.array(ptr=array.ptr, shape=(n, count), dtype=float, device=array.device)


def make_call(
    host: mujoco.MjModel, layout: Sequence[str], *, move: bool, contacts: int, rows: int, iterations: int
) -> Callable[[Array, Array], Array]:
    """(packed [n, floats], controls [n, substeps, nu]) -> [n, nq + 2 nv + nsensordata], a JAX function of a batch.

    See `Worlds`. move: whether to take the steps, or to read the sensors and stay.
    """
    kept: dict[tuple[str, int], Worlds] = {}

    def run(packed: wp.array2d[float], controls: wp.array3d[float], out: wp.array2d[float]) -> None:
        n, device = packed.shape[0], packed.device
        if (key := (device.alias, n)) not in kept:
            kept[key] = worlds = Worlds(host, layout, n, contacts=contacts, rows=rows, iterations=iterations)
            if device.is_cuda and move:
                worlds.load(packed)
                worlds.capture()
        worlds = kept[key]
        worlds.load(packed)
        for i in range(controls.shape[1]):
            (worlds.step if move else worlds.sense)(controls[:, i])
        worlds.unload(out)

    call = wp.jax_callable(run, graph_mode=wp.JaxCallableGraphMode.NONE, vmap_method=None)
    states = host.nq + 2 * host.nv + host.nsensordata
    return lambda packed, controls: call(packed, controls, output_dims=(packed.shape[0], states))[0]


def compile_kernels(host: mujoco.MjModel, layout: Sequence[str], **size: int) -> None:
    """Compiles the kernels of a step in several processes, into Warp's cache, unless a note there says they have.

    Warp makes kernels as a step goes along, and would compile one module after another, each at its first launch:
    during which XLA, which waits for the step, tries no kernels of other programs either.
    """
    if not wp.is_cuda_available():
        return
    model = np.empty(mujoco.mj_sizeModel(host), np.uint8)
    mujoco.mj_saveModel(host, None, model)
    facts = repr((mujoco.__version__, wp.get_device("cuda").arch, layout, size)).encode() + model.tobytes()
    # Empty, and named so that it goes when somebody empties Warp's cache.
    note = Path(wp.config.kernel_cache_dir) / f"wp_sgft_{hashlib.sha256(facts).hexdigest()[:16]}"
    if not note.exists():
        count = min(cores(), _PROCESSES)
        tasks = [(host, layout, size, i, count) for i in range(count)]
        if in_parallel(_compile_share, tasks, keep=False) is not None:
            note.mkdir(exist_ok=True)


def _compile_share(host: mujoco.MjModel, layout: Sequence[str], size: dict[str, int], i: int, count: int) -> None:
    """What a process does of `compile_kernels`."""
    with wp.ScopedDevice("cuda") as device:
        modules = Worlds(host, layout, 1, **size).kernels()
    with ThreadPoolExecutor() as threads:
        loads = [threads.submit(wp.force_load, device, [module], block) for module, block in modules[i::count]]
    for load in loads:
        load.result()


@contextlib.contextmanager
def _noted() -> Iterator[dict[tuple[wp.Module, int | None], None]]:
    """Launches are not made, but noted: modules of kernels and threads of a block. Loops go around once."""
    modules: dict[tuple[wp.Module, int | None], None] = {}

    def launch(kernel: wp.Kernel, *_: Any, block_dim: int | None = None, **__: Any) -> None:
        modules[kernel.module, block_dim] = None

    def loop(_: wp.array, while_body: Callable[..., None], **inputs: Any) -> None:
        while_body(**inputs)

    before = wp.launch, wp.launch_tiled, wp.capture_while
    wp.launch, wp.launch_tiled, wp.capture_while = launch, launch, loop
    try:
        yield modules
    finally:
        wp.launch, wp.launch_tiled, wp.capture_while = before


@wp.kernel
def _note(overflow: wp.array[int], mask: int, lost: wp.array[int]) -> None:
    i = wp.tid()
    lost[i] = lost[i] | (overflow[i] & mask)


@wp.kernel
def _unload(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    acceleration: wp.array2d[float],
    sensors: wp.array2d[float],
    lost: wp.array[int],
    out: wp.array2d[float],
) -> None:
    i, j = wp.tid()
    nq, nv = qpos.shape[1], qvel.shape[1]
    if lost[i] != 0:
        out[i, j] = wp.nan
    elif j < nq:
        out[i, j] = qpos[i, j]
    elif j < nq + nv:
        out[i, j] = qvel[i, j - nq]
    elif j < nq + 2 * nv:
        out[i, j] = acceleration[i, j - nq - nv]
    else:
        out[i, j] = sensors[i, j - nq - 2 * nv]
