"""Impure: writes and reads checkpoints and priors on disk. Orbax holds the numbers, a JSON file says what they are.

A checkpoint is `<run>/checkpoints/<step>/` with `state/` (Orbax) and `manifest.json`. It is written under a temporary
name, its manifest last, and then renamed: a process killed at any moment leaves either the previous checkpoint or a
complete new one. A prior is such a folder plus a readable `prior.json`. Nothing here ever unpickles anything.
"""

import dataclasses
import datetime
import hashlib
import importlib.metadata
import itertools
import shutil
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from sgft_jax import mesh
from sgft_jax.io.jsonfile import jsonable, read_json, write_json
from sgft_jax.learners.tdmpc2 import TDMPC2Prior
from sgft_jax.types import Normalizer, Prior, PyTree, UserError

FORMAT = 1
_CHECKPOINTS, _MANIFEST, _STATE, _CARD, _TEMPORARY = "checkpoints", "manifest.json", "state", "prior.json", ".tmp-"
_PACKAGES = ("jax", "flax", "optax", "orbax-checkpoint", "numpy")
_KINDS = {"sac": Prior, "tdmpc2": TDMPC2Prior}
_PYTHON = {"int": int, "float": float, "bool": bool}


class _Leaf(NamedTuple):
    """What the manifest says of one leaf; `kind` is one of jax, numpy, key, int, float, bool."""

    path: str
    kind: str
    shape: tuple[int, ...]
    dtype: str

    def __str__(self) -> str:
        return f"{self.path} {self.dtype}[{','.join(map(str, self.shape))}]"


# ---------------------------------------------------------------- training checkpoints


def save(folder: Path, step: int, state: PyTree, *, meta: Mapping[str, Any], keep: int = 2) -> Path:
    """Write `<folder>/checkpoints/<step>/` and return it; blocks until the files are there.

    Several hosts save together, each all of it. state: any pytree of jax or numpy arrays, typed keys and Python
    numbers. meta: JSON-able facts (`kind`, `task`, log positions, counters), handed back by `restore`. keep: complete
    checkpoints that stay, this one included. Checkpoints of a later step belong to a future that a resume has
    abandoned, and are removed too.
    """
    root = Path(folder) / _CHECKPOINTS
    temporary = root / f"{_TEMPORARY}{step}"
    if _first():
        root.mkdir(parents=True, exist_ok=True)
        for leftover in root.glob(f"{_TEMPORARY}*"):
            shutil.rmtree(leftover)
        temporary.mkdir()
    _write(temporary, state, {"step": step, "meta": dict(meta)})
    if _first():
        _swap(temporary, root / str(step))
        _prune(root, newest=step, keep=keep)
    mesh.meet()
    return root / str(step)


def latest(folder: Path, *, say: Callable[[str], None] = print) -> int | None:
    """The newest step with a complete checkpoint, or None; `say` hears of every torn one that was passed over."""
    root = Path(folder) / _CHECKPOINTS
    for step in sorted(_steps(root), reverse=True):
        try:
            _manifest(root / str(step))
        except UserError as torn:
            say(f"skipped: {torn}")
        else:
            return step
    return None


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
    where = Path(folder) / _CHECKPOINTS / str(step)
    manifest = _manifest(where)
    _check_meta(where, manifest["meta"], expect or {})
    leaves = _leaves(manifest)
    _check_leaves(where, leaves, [_describe(p, x) for p, x in jax.tree_util.tree_leaves_with_path(like)])
    return jax.tree.unflatten(jax.tree.structure(like), _read(where, manifest)), manifest["meta"]


# ---------------------------------------------------------------- priors


def save_prior(folder: Path, prior: Prior | TDMPC2Prior, card: Mapping[str, Any]) -> Path:
    """Write a prior to `folder`, replacing the one that may be there, and return the folder.

    card: readable JSON-able facts; `task`, `obs_dim` and `act_dim` are checked on loading, `algorithm` (sac, unless it
    says otherwise) tells what kind of prior it is, the rest (network configuration, gamma, observation entries, domain,
    config, provenance, metrics) is for the reader. Parameters must
    be nested dicts of arrays, so that a prior can be read without any code that describes its networks.
    Raises ValueError or TypeError otherwise.
    """
    if missing := {"task", "obs_dim", "act_dim"} - set(card):
        raise ValueError(f"the prior's card lacks {sorted(missing)}")
    tree = vars(prior) | {"normalizer": prior.normalizer._asdict()}
    if not _is_nested_dict(tree):
        raise TypeError("prior parameters must be nested dicts of arrays")
    folder = Path(folder)
    temporary = folder.with_name(f"{_TEMPORARY}{folder.name}")
    if _first():
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        write_json(temporary / _CARD, card)
    _write(temporary, tree, {})
    if _first():
        _swap(temporary, folder)
    mesh.meet()
    return folder


def load_prior(
    folder: Path, *, task: str | None = None, obs_dim: int | None = None, act_dim: int | None = None
) -> tuple[Any, dict[str, Any]]:
    """Read (prior, card) from a prior folder, or from the run folder that holds one as `prior/`.

    The prior is a `Prior` or a `TDMPC2Prior`, as the card's `algorithm` says.

    Raises UserError if it is missing, torn, or of another task or other observation or action sizes than asked for.
    """
    folder = Path(folder)
    if not (folder / _CARD).exists() and (folder / "prior" / _CARD).exists():
        folder = folder / "prior"
    manifest = _manifest(folder)
    card = read_json(folder / _CARD)
    kind = _KINDS.get(algorithm_of(card))
    if kind is None:
        raise UserError(f"{folder}: {_CARD} says algorithm={card['algorithm']!r}: choose one of {', '.join(_KINDS)}")
    asked = {"task": task, "obs_dim": obs_dim, "act_dim": act_dim}
    _check_meta(folder, card, {k: v for k, v in asked.items() if v is not None})
    tree = _nest([leaf.path for leaf in _leaves(manifest)], _read(folder, manifest))
    if set(tree.get("normalizer", {})) != {"mean", "std"}:
        raise UserError(f"{folder}: not a prior: it has no observation statistics")
    statistics = Normalizer(**tree.pop("normalizer"))
    if statistics.mean.shape != (card["obs_dim"],):
        raise UserError(f"{folder}: {_CARD} says obs_dim={card['obs_dim']}, the statistics have {len(statistics.mean)}")
    names = [field.name for field in dataclasses.fields(kind) if field.name != "normalizer"]
    return kind(**{name: tree.get(name, {}) for name in names}, normalizer=statistics), card


def digest(tree: PyTree) -> str:
    """Twelve hex digits that tell whether two trees of arrays hold the same numbers under the same names."""
    found = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        found.update(str(_describe(path, leaf)).encode())
        found.update(np.ascontiguousarray(leaf).tobytes())
    return found.hexdigest()[:12]


def algorithm_of(card: Mapping[str, Any]) -> str:
    """Which algorithm a prior is from; the first priors did not say, they were all SAC's."""
    return card.get("algorithm", "sac")


def _is_nested_dict(tree: PyTree) -> bool:
    """Whether every inner node is a dict with names free of the path separator; empty dicts count, None does not."""
    if isinstance(tree, dict):
        return all(isinstance(k, str) and "/" not in k and _is_nested_dict(v) for k, v in tree.items())
    return isinstance(tree, (jax.Array, np.ndarray))


def _nest(paths: list[str], leaves: list[Any]) -> dict[str, Any]:
    """Nested dicts from paths such as `actor/Dense_0/kernel`."""
    tree: dict[str, Any] = {}
    for path, leaf in zip(paths, leaves, strict=True):
        *parents, name = path.split("/")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[name] = leaf
    return tree


# ---------------------------------------------------------------- one tree on disk


def _write(where: Path, tree: PyTree, facts: dict[str, Any]) -> None:
    """Put the tree into `where/state/` and, last, the manifest that makes it count. `where` exists."""
    flat = jax.tree_util.tree_leaves_with_path(tree)
    leaves = [_describe(path, leaf) for path, leaf in flat]
    arrays = {_slot(i): _to_numpy(leaf) for i, (_, leaf) in enumerate(flat)}
    mesh.meet()
    # Orbax refuses arrays without elements; their shape in the manifest says all there is to say.
    if stored := {slot: x for slot, x in arrays.items() if x.size}:
        ocp.save(str((where / _STATE).absolute()), stored)
    if not _first():
        return
    impls = {_slot(i): str(jax.random.key_impl(x)) for i, (_, x) in enumerate(flat) if leaves[i].kind == "key"}
    files = {str(f.relative_to(where)): _fingerprint(f) for f in sorted(where.glob(f"{_STATE}/**/*")) if f.is_file()}
    manifest = {
        "format": FORMAT,
        **facts,
        "saved": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": {name: importlib.metadata.version(name) for name in _PACKAGES},
        "leaves": [list(leaf) for leaf in leaves],
        "key_impls": impls,
        "files": files,
    }
    write_json(where / _MANIFEST, manifest)


def _read(where: Path, manifest: dict[str, Any]) -> list[Any]:
    """The leaves in order, after every file has been compared with its checksum."""
    for name, (size, crc) in manifest["files"].items():
        if _fingerprint(where / name) != [size, crc]:
            raise UserError(f"{where}: torn: {name} is damaged (checksum differs); use another checkpoint")
    stored: dict[str, np.ndarray] = {}
    if manifest["files"]:
        try:
            stored = ocp.load(str((where / _STATE).absolute()))
        except Exception as error:
            raise UserError(f"{where}: Orbax cannot read it: {str(error).splitlines()[0]}") from error
    return [
        _from_numpy(leaf, stored.get(_slot(i)), impl=manifest["key_impls"].get(_slot(i)))
        for i, leaf in enumerate(_leaves(manifest))
    ]


def _first() -> bool:
    """Of several hosts, which save together, the first one looks after the files."""
    return jax.process_index() == 0


def _manifest(where: Path) -> dict[str, Any]:
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


def _leaves(manifest: dict[str, Any]) -> list[_Leaf]:
    return [_Leaf(path, kind, tuple(shape), dtype) for path, kind, shape, dtype in manifest["leaves"]]


def _slot(index: int) -> str:
    return f"leaf_{index:05d}"


def _describe(path: tuple[Any, ...], leaf: Any) -> _Leaf:
    name = jax.tree_util.keystr(path, simple=True, separator="/")
    if isinstance(leaf, (bool, int, float)):
        return _Leaf(name, type(leaf).__name__, (), type(leaf).__name__)
    if not hasattr(leaf, "dtype"):
        raise TypeError(f"cannot checkpoint {name}: a {type(leaf).__name__} is not an array or a number")
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return _Leaf(name, "key", tuple(leaf.shape), str(leaf.dtype))
    kind = "numpy" if isinstance(leaf, (np.ndarray, np.generic)) else "jax"
    return _Leaf(name, kind, tuple(leaf.shape), str(leaf.dtype))


def _to_numpy(leaf: Any) -> np.ndarray:
    is_key = hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)


def _from_numpy(leaf: _Leaf, stored: Any, *, impl: str | None) -> Any:
    if leaf.kind == "key":
        return jax.random.wrap_key_data(jnp.array(stored), impl=impl)
    if leaf.kind in _PYTHON:
        return _PYTHON[leaf.kind](stored)
    array = np.zeros(leaf.shape, jnp.dtype(leaf.dtype)) if stored is None else np.asarray(stored)
    return array if leaf.kind == "numpy" else jnp.array(array)


def _fingerprint(file: Path) -> list[int]:
    """[bytes, crc32] of a file, read in pieces."""
    crc = 0
    with open(file, "rb") as stream:
        while piece := stream.read(1 << 22):
            crc = zlib.crc32(piece, crc)
    return [file.stat().st_size, crc]


# ---------------------------------------------------------------- folders and comparisons


def _swap(temporary: Path, final: Path) -> None:
    """Rename `temporary` to `final`; an older `final` steps aside first and is deleted last."""
    aside = final.with_name(f"{_TEMPORARY}old-{final.name}")
    shutil.rmtree(aside, ignore_errors=True)
    if final.exists():
        final.rename(aside)
    temporary.rename(final)
    shutil.rmtree(aside, ignore_errors=True)


def _prune(root: Path, *, newest: int, keep: int) -> None:
    """Delete all but the `keep` newest complete steps up to `newest`; what goes is renamed first, lest it stay torn."""
    candidates = (s for s in sorted(_steps(root), reverse=True) if s <= newest and _is_complete(root / str(s)))
    staying = set(itertools.islice(candidates, max(keep, 1)))
    for step in set(_steps(root)) - staying:
        doomed = root / f"{_TEMPORARY}old-{step}"
        (root / str(step)).rename(doomed)
        shutil.rmtree(doomed)


def _is_complete(where: Path) -> bool:
    try:
        return bool(_manifest(where))
    except UserError:
        return False


def _steps(root: Path) -> list[int]:
    return [int(p.name) for p in root.iterdir() if p.name.isdigit() and p.is_dir()] if root.is_dir() else []


def _check_meta(where: Path, saved: Mapping[str, Any], expect: Mapping[str, Any]) -> None:
    wanted = jsonable(expect)  # the saved values have been through JSON: tuples are lists by now
    differing = [f"{k}={saved.get(k)!r} where {k}={v!r} is needed" for k, v in wanted.items() if saved.get(k) != v]
    if differing:
        raise UserError(f"{where}: does not fit: it was saved with {', '.join(differing)}")


def _check_leaves(where: Path, saved: list[_Leaf], wanted: list[_Leaf]) -> None:
    """Raise UserError naming the first leaf that differs."""
    for have, want in zip(saved, wanted, strict=False):
        if not _same(have, want):
            raise UserError(f"{where}: does not fit: it holds {have} where {want} is needed")
    if len(saved) != len(wanted):
        odd = max(saved, wanted, key=len)[min(len(saved), len(wanted))]
        counts = f"{len(saved)} arrays saved, {len(wanted)} needed"
        raise UserError(f"{where}: does not fit: {counts}, the first odd one is {odd}")


def _same(saved: _Leaf, wanted: _Leaf) -> bool:
    """Equal path, shape and dtype; a Python number also fits the abstract scalar that `jax.eval_shape` makes of it."""
    if saved.kind in _PYTHON and wanted.kind not in _PYTHON:
        return saved.path == wanted.path and wanted.shape == () and wanted.dtype.startswith(saved.kind)
    return (saved.path, saved.shape, saved.dtype) == (wanted.path, wanted.shape, wanted.dtype)
