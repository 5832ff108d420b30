"""Impure: writes and reads the states of runs. Orbax holds the numbers, a JSON file says what they are.

A checkpoint is `<run>/checkpoints/<step>/` with `state/` (Orbax) and `manifest.json`. It is written under a temporary
name, its manifest last, and then renamed: a process killed at any moment leaves either the previous checkpoint or a
complete new one, see `disk`. Nothing here ever unpickles anything.

The steps are not Orbax's own `training.Checkpointer`. Of 0.12.8 it offers a step with a damaged file as the latest,
keeps the later steps that a resume from an earlier one has abandoned, and refuses arrays without elements.
"""

import contextlib
import datetime
import importlib.metadata
import math
import os
import re
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from envs import files, mesh
from envs.files import Count
from envs.types import PyTree, UserError
from sgft_jax.files import disk
from sgft_jax.files.arrays import damage
from sgft_jax.files.disk import jsonable, write_json

FORMAT = 1  # of checkpoints and priors, see docs/design.md
MANIFEST = "manifest.json"
_CHECKPOINTS, _STATE = "checkpoints", "state"
_MARK = "commit_success.txt"
_HIDDEN = re.compile(rf"{os.sep}\.")  # files that file managers and network disks leave
_FIX = "put back what was written, or take another one"
_PACKAGES = ("jax", "flax", "optax", "orbax-checkpoint", "numpy")


class _Manifest(TypedDict):
    """What `write_tree` writes, beside the facts."""

    leaves: list[tuple[str, Literal["key", "jax"], list[Count], str]]
    key_impls: dict[str, str]
    files: dict[str, tuple[Count, Count]]


class Leaf(NamedTuple):
    """What the manifest says of one array; `kind` is "key" for typed keys, which are stored as their data."""

    path: str
    kind: str
    shape: tuple[int, ...]
    dtype: str

    def __str__(self) -> str:
        return f"{self.path} {self.dtype}[{','.join(map(str, self.shape))}]"


# --- checkpoints of a run ---------------------------------------------------------------------------------------------


def save(folder: Path, step: int, state: PyTree, *, meta: Mapping[str, Any], keep: int = 2) -> Path:
    """Write `<folder>/checkpoints/<step>/` and return it; blocks until the files are there.

    Several hosts save together, each all of it. state: any pytree of arrays and typed keys. meta: JSON-able facts
    (`kind`, `task`, log positions, counters), handed back by `restore`. keep: complete checkpoints that stay, this one
    included. Checkpoints of a later step belong to a future that a resume has abandoned, and are removed too.
    """
    root = Path(folder) / _CHECKPOINTS
    with replaced(root / str(step)) as temporary:
        write_tree(temporary, state, {"step": step, "meta": dict(meta)})
    if first_host():
        _prune(root, newest=step, keep=keep)
    mesh.meet()
    return root / str(step)


def copied(tree: PyTree) -> PyTree:
    """The same arrays in the host's memory, to `save` while the originals are donated: JAX keeps what NumPy sees."""
    return jax.tree.map(lambda x: x.copy() if _is_key(x) else np.asarray(x), tree)


def latest(folder: Path, *, whole: bool = False, say: Callable[[str], None] = print) -> int | None:
    """The newest step with a complete checkpoint, or None without any; `say` hears of every one that was passed over.

    whole: to go on from it; its files are read and compared with their checksums, and a UserError says where all are
    damaged.
    """
    root = Path(folder) / _CHECKPOINTS
    for step in sorted(steps := _steps(root), reverse=True):
        try:
            manifest = read_manifest(path(folder, step))
            if whole:
                check_files(path(folder, step), manifest)
        except UserError as torn:
            say(f"skipped: {torn}")
        else:
            return step
    if steps and whole:
        raise UserError(f"{root}: holds nothing whole; remove it, then --resume begins again with what else is on disk")
    return None


def path(folder: Path, step: int) -> Path:
    """Where the checkpoint of a step is."""
    return disk.present(Path(folder) / _CHECKPOINTS / str(step))


def restore(
    folder: Path,
    like: PyTree,
    *,
    step: int | None = None,
    checked: bool = False,
    expect: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = print,
) -> tuple[PyTree, dict[str, Any]]:
    """Read a checkpoint into the structure of `like` and return (state, meta); step None is the newest whole one.

    like: a state, or `jax.eval_shape` of the function that makes one. checked: its files have just been compared with
    their checksums, see `latest`. expect: entries that the saved meta must have.
    Raises UserError if the checkpoint is missing, torn, or of another task, kind or shape.
    """
    if step is None:
        step, checked = latest(folder, whole=True, say=say), True
        if step is None:
            raise UserError(f"{folder}: holds no complete checkpoint to restore")
    where = path(folder, step)
    manifest = read_manifest(where)
    meta = files.checked(where / MANIFEST, manifest, {"meta": dict}, _FIX)["meta"]
    check_facts(where, meta, expect or {})
    _check_leaves(where, leaves_of(manifest), [describe(p, x) for p, x in jax.tree_util.tree_leaves_with_path(like)])
    if not checked:
        check_files(where, manifest)
    return jax.tree.unflatten(jax.tree.structure(like), read_leaves(where, manifest)), meta


def check_facts(where: Path, saved: Mapping[str, Any], expect: Mapping[str, Any]) -> None:
    """Raise UserError where saved facts are not those that are needed."""
    wanted = jsonable(expect)  # the saved values have been through JSON: tuples are lists by now
    differing = [f"{k}={saved.get(k)!r} where {k}={v!r} is needed" for k, v in wanted.items() if saved.get(k) != v]
    if differing:
        raise UserError(f"{where}: does not fit: it was saved with {', '.join(differing)}")


def _check_leaves(where: Path, saved: list[Leaf], wanted: list[Leaf]) -> None:
    """Raise UserError naming the first array that differs."""
    for have, want in zip(saved, wanted, strict=False):
        if (have.path, have.shape, have.dtype) != (want.path, want.shape, want.dtype):
            raise UserError(f"{where}: does not fit: it holds {have} where {want} is needed")
    if len(saved) != len(wanted):
        odd = max(saved, wanted, key=len)[min(len(saved), len(wanted))]
        counts = f"{len(saved)} arrays saved, {len(wanted)} needed"
        raise UserError(f"{where}: does not fit: {counts}, the first odd one is {odd}")


def _prune(root: Path, *, newest: int, keep: int) -> None:
    """Delete all but the `keep` newest complete steps up to `newest`; a kill leaves none half deleted."""
    for leftover in root.glob(f"{disk.NEW}*"):  # nobody else writes here
        shutil.rmtree(leftover)
    for step in (steps := _steps(root)):
        disk.settle(root / str(step))
    complete = [step for step in sorted(steps, reverse=True) if step <= newest and _is_complete(root / str(step))]
    for step in steps - set(complete[: max(keep, 1)]):
        doomed = disk.part_of(root / str(step))
        (root / str(step)).rename(doomed)
        shutil.rmtree(doomed)


def _is_complete(where: Path) -> bool:
    with contextlib.suppress(UserError):
        return bool(read_manifest(where))
    return False


def _steps(root: Path) -> set[int]:
    """The steps of all folders, those included that a killed writer has put aside."""
    paths = [path for path in root.iterdir() if path.is_dir()] if root.is_dir() else []
    names = {path.name.removeprefix(disk.ASIDE) for path in paths}
    return {int(name) for name in names if name.isdecimal()}


# --- one tree in one folder -------------------------------------------------------------------------------------------


@contextlib.contextmanager
def replaced(folder: Path) -> Iterator[Path]:
    """Give a folder to fill, which then takes the place of `folder`: on the first host, where all write."""
    with disk.replaced(folder) if first_host() else contextlib.nullcontext(disk.part_of(folder)) as part:
        yield part


def write_tree(where: Path, tree: PyTree, facts: Mapping[str, Any]) -> None:
    """Put a tree into `where/state/` and, last, the manifest that makes it count. `where` exists."""
    flat = jax.tree_util.tree_leaves_with_path(tree)
    leaves = [describe(path, leaf) for path, leaf in flat]
    arrays = {_slot(i): np.asarray(jax.random.key_data(x) if _is_key(x) else x) for i, (_, x) in enumerate(flat)}
    mesh.meet()
    # Orbax refuses arrays without elements; their shape in the manifest says all there is to say.
    if stored := {slot: x for slot, x in arrays.items() if x.size}:
        ocp.save(str((where / _STATE).absolute()), stored)
    if not first_host():
        return
    # Orbax's own mark of completeness names the folders of this machine; ours is the manifest.
    (where / _STATE / _MARK).unlink(missing_ok=True)
    manifest = {
        "format": FORMAT,
        **facts,
        "saved": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": {name: importlib.metadata.version(name) for name in _PACKAGES},
        "leaves": [list(leaf) for leaf in leaves],
        "key_impls": {_slot(i): str(jax.random.key_impl(x)) for i, (_, x) in enumerate(flat) if _is_key(x)},
        "files": {name: _fingerprint(where / name) for name in _files_of(where)},
    }
    write_json(where / MANIFEST, manifest)


def read_manifest(where: Path) -> dict[str, Any]:
    """Read and check the manifest and that every file it lists is there in full size; raises UserError."""
    if not where.is_dir():
        raise UserError(f"{where}: no such folder")
    if not (where / MANIFEST).is_file():
        raise UserError(f"{where}: not a complete checkpoint: {MANIFEST} is missing")
    try:
        manifest = files.read_object(where / MANIFEST, {"format": int}, _FIX)
    except UserError:
        raise UserError(f"{where}: torn: {MANIFEST} is not readable") from None
    if manifest["format"] != FORMAT:
        formats = f"written in format {manifest['format']}, this version reads format {FORMAT} alone"
        raise UserError(f"{where}: {formats}; begin again, or use the version that wrote it")
    files.checked(where / MANIFEST, manifest, _Manifest, _FIX)
    for name, (size, _) in manifest["files"].items():
        file = where / name
        if os.path.realpath(file) != f"{os.path.realpath(where)}{os.sep}{name}":
            raise UserError(f"{where}: {MANIFEST} names {name}, which is not in that folder")
        if not file.is_file():
            raise UserError(f"{where}: torn: {name} is missing")
        if file.stat().st_size != size:
            raise UserError(f"{where}: torn: {name} has {file.stat().st_size} bytes, expected {size}")
    if odd := [name for name in _files_of(where) if name not in manifest["files"] and not _HIDDEN.search(name)]:
        raise UserError(f"{where}: {MANIFEST} has no checksum of {odd[0]}")
    return manifest


def check_files(where: Path, manifest: Mapping[str, Any]) -> None:
    """Raise UserError where a file differs from its checksum."""
    for name, (size, crc) in manifest["files"].items():
        if _fingerprint(where / name) != [size, crc]:
            raise UserError(f"{where}: damaged: {name} (checksum differs)")


def read_leaves(where: Path, manifest: Mapping[str, Any]) -> list[Any]:
    """The arrays in order. What is stored must be what the manifest says, which is known before numbers are read."""
    impls, leaves = manifest["key_impls"], leaves_of(manifest)
    wanted = {_slot(i): _stored(where, leaf, impls.get(_slot(i))) for i, leaf in enumerate(leaves)}
    stored = _load(where, {slot: array for slot, array in wanted.items() if array.size})
    return [_from_numpy(leaf, stored.get(_slot(i)), impls.get(_slot(i))) for i, leaf in enumerate(leaves)]


def _stored(where: Path, leaf: Leaf, impl: str | None) -> jax.ShapeDtypeStruct:
    """What stands on disk for an array, keys as their data; raises UserError for a kind that JAX does not know."""
    with contextlib.suppress(TypeError, ValueError):
        if leaf.kind == "key":
            keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0, impl=impl), leaf.shape))
            if impl is not None and str(keys.dtype) == leaf.dtype:
                return jax.eval_shape(jax.random.key_data, keys)
        else:
            dtype = jnp.dtype(leaf.dtype)
            kept = str(jax.dtypes.canonicalize_dtype(dtype)) == leaf.dtype
            if kept and (jnp.issubdtype(dtype, jnp.number) or dtype.kind == "b"):
                return jax.ShapeDtypeStruct(leaf.shape, dtype)
    raise UserError(f"{where}: {MANIFEST} lists {leaf}, which this version does not know")


def _load(where: Path, wanted: Mapping[str, jax.ShapeDtypeStruct]) -> dict[str, np.ndarray]:
    """The arrays that Orbax has stored; raises UserError, before memory is taken, where they are not those wanted."""
    if not wanted:
        return {}
    expected = {slot: (array.shape, str(array.dtype)) for slot, array in wanted.items()}
    with damage(where / _STATE, _FIX):
        state = str((where / _STATE).absolute())
        stored = {slot: _claim(about) for slot, about in ocp.metadata(state).metadata.items()}
        if odd := sorted(slot for slot in {*expected, *stored} if stored.get(slot) != expected.get(slot)):
            differing = f"{odd[0]}: {expected.get(odd[0])} and {stored.get(odd[0])}"
            raise UserError(f"{where}: {MANIFEST} and {_STATE} differ in {differing}")
        return ocp.load(state)


def _claim(about: Any) -> tuple[tuple[int, ...], str] | None:
    """Shape and type of a stored array; None where its pieces are larger than the whole."""
    pieces = about.storage_metadata.chunk_shape
    return None if math.prod(pieces) > math.prod(about.shape) else (tuple(about.shape), str(about.dtype))


def leaves_of(manifest: Mapping[str, Any]) -> list[Leaf]:
    """What a manifest says of its arrays, in order."""
    return [Leaf(path, kind, tuple(shape), dtype) for path, kind, shape, dtype in manifest["leaves"]]


def describe(path: tuple[Any, ...], leaf: Any) -> Leaf:
    """An array of a tree; raises TypeError for anything that JAX could not hand back as it is."""
    name = jax.tree_util.keystr(path, simple=True, separator="/")
    if not hasattr(leaf, "dtype"):
        raise TypeError(f"cannot checkpoint {name}: a {type(leaf).__name__} is not an array")
    if _is_key(leaf):
        return Leaf(name, "key", tuple(leaf.shape), str(leaf.dtype))
    if jax.dtypes.canonicalize_dtype(leaf.dtype) != leaf.dtype:
        raise TypeError(f"cannot checkpoint {name}: JAX does not keep {leaf.dtype}")
    return Leaf(name, "jax", tuple(leaf.shape), str(leaf.dtype))


def first_host() -> bool:
    """Of several hosts, which save together, the first one looks after the files."""
    return jax.process_index() == 0


def _files_of(where: Path) -> list[str]:
    """The files that hold the arrays, by their names in the folder."""
    return [str(file.relative_to(where)) for file in sorted(where.glob(f"{_STATE}/**/*")) if file.is_file()]


def _slot(index: int) -> str:
    return f"leaf_{index:05d}"


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _from_numpy(leaf: Leaf, stored: Any, impl: str | None) -> jax.Array:
    if leaf.kind == "key":
        return jax.random.wrap_key_data(jnp.array(stored), impl=impl)
    return jnp.zeros(leaf.shape, jnp.dtype(leaf.dtype)) if stored is None else jnp.array(np.asarray(stored))


def _fingerprint(file: Path) -> list[int]:
    """[bytes, crc32] of a file, read in pieces."""
    crc = 0
    with open(file, "rb") as stream:
        while piece := stream.read(1 << 22):
            crc = zlib.crc32(piece, crc)
    return [file.stat().st_size, crc]
