"""Impure: files and folders on disk that appear whole, JSON and CSV among them, and folders that one process writes.

Numbers that JSON does not know are written as their names; `envs.files` reads JSON. Imports no JAX.
"""

import contextlib
import csv
import dataclasses
import fcntl
import gzip
import io
import itertools
import json
import math
import os
import shutil
import weakref
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.files import decoded, read_bytes
from envs.types import UserError

# Of a folder NAME, beside it: the one that is being written, and the one that it is about to replace.
NEW, ASIDE = ".sgft-new-", ".sgft-old-"
_LOCK = ".lock"
_TABLE = 2**30  # bytes of a table at most
_LARGEST = 2**53  # that a cell counts


class InUseError(UserError):
    """Another process has the folder open."""


class Lock:
    """An exclusive lock on a folder, held until `release()`, collection or the end of the process, however it ends.

    Raises InUseError if another process, or another lock of this one, holds it.
    """

    def __init__(self, folder: Path) -> None:
        handle = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        self.release = weakref.finalize(self, os.close, handle)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise InUseError(f"{folder}: another process is writing to it") from None


def in_use(folder: Path) -> bool:
    """Whether somebody holds the lock of a folder."""
    if not (folder / _LOCK).exists():
        return False
    try:
        Lock(folder).release()
    except InUseError:
        return True
    return False


def empty(folder: Path, *, last: str = "") -> None:
    """Delete the content of a folder but its lock, the file called `last` last; links are removed, never followed."""
    for path in sorted(folder.iterdir(), key=lambda path: path.name == last):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != _LOCK:
            path.unlink()


@contextlib.contextmanager
def written(path: Path, part: Path | None = None) -> Iterator[Path]:
    """Give a path to write a file to, which then takes the place of `path`, flushed to disk.

    A process killed at any moment leaves the old file or the new one, and perhaps a part; an error leaves the old one.
    part: where to write, by default hidden beside `path`.
    """
    part = part or path.with_name(NEW + path.name)
    try:
        yield part
        sync(part)
        part.replace(path)
        sync(path.parent)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def sync(path: Path) -> None:
    """Flush a file to disk, or of a folder the names in it, so that they survive a power cut."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def part_of(folder: Path) -> Path:
    """Where `replaced` lets a folder be written."""
    real = _real(folder)
    return real.with_name(NEW + real.name)


def present(folder: Path) -> Path:
    """The folder, or what was there before, if a writer was killed while it put the new one in its place."""
    return aside if not folder.exists() and (aside := _aside_of(_real(folder))).is_dir() else folder


@contextlib.contextmanager
def replaced(folder: Path) -> Iterator[Path]:
    """Give a folder to fill, which then takes the place of `folder`, or of what that links to.

    A process killed at any moment leaves the old or the new one, see `present`; an error leaves the old one. What the
    new one lacks, such as an export that somebody has put into a policy's folder, moves over. Raises InUseError while
    another process replaces the same folder.
    """
    part, folder = part_of(folder), _real(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UserError(f"{folder}: cannot be made, something else than a folder is in its way") from None
    for path in (folder, part):
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise UserError(f"{path}: is no folder, and stands where one has to be written; move it elsewhere")
    part.mkdir(exist_ok=True)
    lock = Lock(part)
    try:
        settle(folder)
        empty(part)  # what a killed writer has left
        yield part
        if folder.exists():
            folder.rename(_aside_of(folder))
        part.rename(folder)
        (folder / _LOCK).unlink()
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    finally:
        settle(folder)
        lock.release()


def settle(folder: Path) -> None:
    """Ends what a killed writer has begun: what it had put aside is put back, or goes."""
    aside = _aside_of(folder)
    if not aside.is_dir() or aside.is_symlink():
        return
    if not folder.exists():
        aside.rename(folder)
        return
    for path in aside.iterdir():
        if path.name != _LOCK and not os.path.lexists(folder / path.name):
            path.rename(folder / path.name)
    shutil.rmtree(aside)


def _aside_of(folder: Path) -> Path:
    return folder.with_name(ASIDE + folder.name)


def _real(folder: Path) -> Path:
    """With the last part as it is on disk: no link, no dot."""
    return Path(os.path.realpath(folder)) if folder.is_symlink() or folder.name in ("", "..") else folder


# --- JSON -------------------------------------------------------------------------------------------------------------


def jsonable(value: Any) -> Any:
    """Plain JSON data: dataclasses become objects with every field spelled out, arrays lists, array scalars numbers,
    paths strings, infinities and nan their names.

    Those strings keep the file valid JSON for every reader and, unlike null, still tell divergence from a missing
    value; Python's `float` turns them back. Raises TypeError for anything else.
    """
    if isinstance(value, Mapping):
        return {str(k): jsonable(v) for k, v in value.items()}
    if hasattr(value, "_asdict"):
        return jsonable(value._asdict())
    if dataclasses.is_dataclass(value):
        return {field.name: jsonable(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, (list, tuple)):
        return [jsonable(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if hasattr(value, "dtype"):
        return jsonable(_widened(np.asarray(value)).tolist())
    raise TypeError(f"a {type(value).__name__} cannot be written as JSON")


def _widened(array: np.ndarray) -> np.ndarray:
    """float64 for what JSON would spell oddly: float32 0.1 stays 0.1 instead of becoming 0.10000000149."""
    if array.dtype == np.float32:
        return np.array([float(str(x)) for x in array.reshape(-1)]).reshape(array.shape)
    return array.astype(np.float64) if array.dtype.kind == "V" else array  # V: bfloat16


def write_json(path: Path, value: Any) -> None:
    """Write `value` under a temporary name, flush it to disk, rename it to `path`."""
    text = json.dumps(jsonable(value), indent=1, allow_nan=False) + "\n"
    with written(Path(path)) as part:
        part.write_text(text, encoding="utf-8")


def differences(old: Any, new: Any, *, name: str = "") -> list[tuple[str, Any, Any]]:
    """(dotted name, old, new) of every leaf that differs between two pieces of JSON data."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = dict.fromkeys([*old, *new])
        inner = (differences(old.get(key), new.get(key), name=f"{name}.{key}" if name else key) for key in keys)
        return list(itertools.chain.from_iterable(inner))
    return [] if old == new else [(name, old, new)]


# --- CSV --------------------------------------------------------------------------------------------------------------


def table_file(folder: Path, name: str) -> Path:
    """Where a table is or goes: <name>.csv.gz, or a plain <name>.csv that exists. Raises UserError if both exist."""
    plain, compressed = folder / f"{name}.csv", folder / f"{name}.csv.gz"
    if plain.exists() and compressed.exists():
        raise UserError(f"{plain}: {compressed.name} lies beside it; keep one of the two")
    return plain if plain.exists() else compressed


def write_csv(path: Path, names: Sequence[str], rows: Iterable[Mapping[str, str]]) -> None:
    """Writes a table with these columns, compressed if it ends in .gz. The same rows always give the same bytes."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    content = text.getvalue().encode()
    with written(path) as part:
        part.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)


def read_csv(path: Path, *, needed: Sequence[str] = ()) -> list[dict[str, str]]:
    """The rows of a table; none if it does not exist; raises UserError where a row is cut or lacks a column needed."""
    if not path.exists():
        return []
    content = read_bytes(path, limit=_TABLE)
    text = decoded(_decompressed(content, path) if path.suffix == ".gz" else content, path)
    try:
        if "\0" in text:
            raise csv.Error("a zero byte")
        rows = list(csv.DictReader(io.StringIO(text, newline="")))
    except csv.Error as error:
        raise UserError(f"{path}: is no table ({error}); put it back as it was") from error
    for i, row in enumerate(rows):
        if absent := [name for name in needed if row.get(name) is None]:
            raise UserError(f"{path}: row {i + 1} has no {absent[0]}; put the table back as it was")
        if None in row or None in row.values():
            raise UserError(f"{path}: row {i + 1} has other columns than the head; put the table back as it was")
    return rows


def _decompressed(content: bytes, path: Path) -> bytes:
    try:
        table = gzip.GzipFile(fileobj=io.BytesIO(content)).read(_TABLE + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise UserError(f"{path}: is no gzip file ({str(error).lower()}); put it back as it was") from error
    if len(table) > _TABLE:
        raise UserError(f"{path}: holds more than {_TABLE:,} bytes, more than such a table can need")
    return table


def whole(name: str, cell: Any) -> int:
    """What a cell counts, 0 or more; raises ValueError for anything else."""
    number = finite(name, cell)
    if not (0 <= number <= _LARGEST and number.is_integer()):
        raise ValueError(f"{name} is {cell}, not a whole number from 0 on")
    return int(number)


def finite(name: str, cell: Any) -> float:
    """The number in a cell; raises ValueError for anything else."""
    if not math.isfinite(number := float(cell)):
        raise ValueError(f"{name} is {cell}, not a finite number")
    return number
