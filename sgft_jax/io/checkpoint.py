"""Impure: writes and reads the states of runs. Orbax holds the numbers, a JSON file says what they are.

A checkpoint is `<run>/checkpoints/<step>/` with `state/` (Orbax) and `manifest.json`. It is written under a temporary
name, its manifest last, and then renamed: a process killed at any moment leaves either the previous checkpoint or a
complete new one. Nothing here ever unpickles anything.

The steps are not Orbax's own `training.Checkpointer`. Of 0.12.8 it offers a step with a damaged file as the latest,
keeps the later steps that a resume from an earlier one has abandoned, and refuses arrays without elements.
"""

import contextlib
import datetime
import importlib.metadata
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from envs.files import read_json
from sgft_jax import mesh
from sgft_jax.io.jsonfile import jsonable, write_json
from sgft_jax.types import PyTree, UserError

FORMAT = 1
_CHECKPOINTS, _MANIFEST, _STATE, _TEMPORARY = "checkpoints", "manifest.json", "state", ".tmp-"
_MARK = "commit_success.txt"
_PACKAGES = ("jax", "flax", "optax", "orbax-checkpoint", "numpy")


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


def latest(folder: Path, *, say: Callable[[str], None] = print) -> int | None:
    """The newest step with a complete checkpoint, or None; `say` hears of every torn one that was passed over."""
    root = Path(folder) / _CHECKPOINTS
    for step in sorted(_steps(root), reverse=True):
        try:
            read_manifest(root / str(step))
        except UserError as torn:
            say(f"skipped: {torn}")
        else:
            return step
    return None


def path(folder: Path, step: int) -> Path:
    """Where the checkpoint of a step is."""
    return Path(folder) / _CHECKPOINTS / str(step)


def restore(
    folder: Path,
    like: PyTree,
    *,
    step: int | None = None,
    expect: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = print,
) -> tuple[PyTree, dict[str, Any]]:
    """Read a checkpoint into the structure of `like` and return (state, meta); step None is the newest complete one.

    like: a state, or `jax.eval_shape` of the function that makes one. expect: entries that the saved meta must have.
    Raises UserError if the checkpoint is missing, torn, or of another task, kind or shape.
    """
    if step is None:
        step = latest(folder, say=say)
        if step is None:
            raise UserError(f"{folder}: holds no complete checkpoint to restore")
    where = path(folder, step)
    manifest = read_manifest(where)
    check_facts(where, manifest["meta"], expect or {})
    _check_leaves(where, leaves_of(manifest), [describe(p, x) for p, x in jax.tree_util.tree_leaves_with_path(like)])
    return jax.tree.unflatten(jax.tree.structure(like), read_leaves(where, manifest)), manifest["meta"]


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
    steps = _steps(root)
    complete = [step for step in sorted(steps, reverse=True) if step <= newest and _is_complete(root / str(step))]
    for step in set(steps) - set(complete[: max(keep, 1)]):
        doomed = root / f"{_TEMPORARY}old-{step}"
        (root / str(step)).rename(doomed)
        shutil.rmtree(doomed)


def _is_complete(where: Path) -> bool:
    try:
        return bool(read_manifest(where))
    except UserError:
        return False


def _steps(root: Path) -> list[int]:
    return [int(p.name) for p in root.iterdir() if p.name.isdigit() and p.is_dir()] if root.is_dir() else []


# --- one tree in one folder -------------------------------------------------------------------------------------------


@contextlib.contextmanager
def replaced(folder: Path) -> Iterator[Path]:
    """Give a folder to fill, which then takes the place of `folder`."""
    temporary, aside = (folder.with_name(f"{_TEMPORARY}{word}{folder.name}") for word in ("", "old-"))
    if first_host():
        folder.parent.mkdir(parents=True, exist_ok=True)
        for leftover in folder.parent.glob(f"{_TEMPORARY}*"):
            shutil.rmtree(leftover)
        temporary.mkdir()
    yield temporary
    if first_host():
        if folder.exists():
            folder.rename(aside)
        temporary.rename(folder)
        shutil.rmtree(aside, ignore_errors=True)


def write_tree(where: Path, tree: PyTree, facts: Mapping[str, Any]) -> None:
    """Put a tree into `where/state/` and, last, the manifest that makes it count. `where` exists."""
    flat = jax.tree_util.tree_leaves_with_path(tree)
    leaves = [describe(path, leaf) for path, leaf in flat]
    arrays = {_slot(i): _to_numpy(leaf) for i, (_, leaf) in enumerate(flat)}
    mesh.meet()
    # Orbax refuses arrays without elements; their shape in the manifest says all there is to say.
    if stored := {slot: x for slot, x in arrays.items() if x.size}:
        ocp.save(str((where / _STATE).absolute()), stored)
    if not first_host():
        return
    # Orbax's own mark of completeness names the folders of this machine; ours is the manifest.
    (where / _STATE / _MARK).unlink(missing_ok=True)
    files = [file for file in sorted(where.glob(f"{_STATE}/**/*")) if file.is_file()]
    manifest = {
        "format": FORMAT,
        **facts,
        "saved": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": {name: importlib.metadata.version(name) for name in _PACKAGES},
        "leaves": [list(leaf) for leaf in leaves],
        "key_impls": {_slot(i): str(jax.random.key_impl(x)) for i, (_, x) in enumerate(flat) if _is_key(x)},
        "files": {str(file.relative_to(where)): _fingerprint(file) for file in files},
    }
    write_json(where / _MANIFEST, manifest)


def read_manifest(where: Path) -> dict[str, Any]:
    """Read and check the manifest and that every file it lists is there in full size; raises UserError."""
    if not where.is_dir():
        raise UserError(f"{where}: no such folder")
    if not (where / _MANIFEST).is_file():
        raise UserError(f"{where}: not a complete checkpoint: {_MANIFEST} is missing")
    try:
        manifest = read_json(where / _MANIFEST)
        found = manifest["format"]
    except (UserError, KeyError, TypeError):
        raise UserError(f"{where}: torn: {_MANIFEST} is not readable") from None
    if found != FORMAT:
        raise UserError(f"{where}: written in format {found}, this version reads format {FORMAT}")
    for file, (size, _) in manifest["files"].items():
        if not (where / file).is_file():
            raise UserError(f"{where}: torn: {file} is missing")
        if (where / file).stat().st_size != size:
            raise UserError(f"{where}: torn: {file} has {(where / file).stat().st_size} bytes, expected {size}")
    return manifest


def read_leaves(where: Path, manifest: Mapping[str, Any]) -> list[Any]:
    """The arrays in order, after every file has been compared with its checksum."""
    for name, (size, crc) in manifest["files"].items():
        if _fingerprint(where / name) != [size, crc]:
            raise UserError(f"{where}: torn: {name} is damaged (checksum differs); use another checkpoint")
    stored: dict[str, np.ndarray] = {}
    if manifest["files"]:
        try:
            stored = ocp.load(str((where / _STATE).absolute()))
        except Exception as error:
            raise UserError(f"{where}: Orbax cannot read it: {str(error).splitlines()[0]}") from error
    impls = manifest["key_impls"]
    return [_from_numpy(leaf, stored.get(_slot(i)), impls.get(_slot(i))) for i, leaf in enumerate(leaves_of(manifest))]


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


def _slot(index: int) -> str:
    return f"leaf_{index:05d}"


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_numpy(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


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
