"""The one way in for numbers, from files, environments and robots: what is learned from is finite float32.

`where` names the file or the sender in errors, `name` the array, `fix` what the user can do. All raise UserError.
"""

import math
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from envs.types import UserError

LARGEST = 1e18  # of what is learned from: squares of larger ones are beyond float32, as `robot_client` has it
_FREE = 64 * 2**20  # bytes that anything may unpack to
_RATIO = 200  # packed data of real experiments stay below
_PLAIN = "biufSU"  # kinds of numbers and texts; nothing that would have to be unpickled


def numbers(
    where: Path | str, name: str, values: Any, shape: Sequence[int | None], *, fix: str, valid: np.ndarray | None = None
) -> np.ndarray:
    """[*shape] float32, every number finite and at most `LARGEST` in size. shape: None where any length will do.

    valid: bool, of the first axes: the rows that count; default: all. Like all others, whole numbers beyond 2^24 are
    rounded to what float32 can hold.
    """
    array = _array(where, name, values, "numbers", shape, fix)
    with np.errstate(over="ignore"):
        cast = array.astype(np.float32)
    good = np.abs(cast) <= LARGEST  # nan is not
    if valid is not None:
        good |= ~valid.reshape(*valid.shape, *[1] * (cast.ndim - valid.ndim))
    if len(odd := np.argwhere(~good)):
        place = tuple(odd[0])
        wrong = "is too large for float32" if np.isfinite(array[place]) else "is not finite"
        raise UserError(f"{where}: {name}{_of_row(place)} {wrong}; {fix}")
    return cast


def flags(where: Path | str, name: str, values: Any, shape: Sequence[int | None], *, fix: str) -> np.ndarray:
    """[*shape] bool, from truth values or from numbers that are 0 or 1 and nothing else."""
    array = _array(where, name, values, "0 or 1", shape, fix)
    if len(odd := np.argwhere((array != 0) & (array != 1))):
        place = tuple(odd[0])
        raise UserError(f"{where}: {name}{_of_row(place)} is {array[place]:g}, not 0 or 1; {fix}")
    return array.astype(bool)


def check_claim(where: Path | str, claimed: int, stored: int) -> None:
    """Raises UserError where few bytes claim to unpack to very many, before memory is taken for them."""
    if claimed > _FREE + _RATIO * stored:
        raise UserError(f"{where}: {stored:,} bytes claim to hold {claimed:,}; no real data pack so well")


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """The plain arrays of an .npz file, by name; sizes are checked before memory is taken for them."""
    check_plain(path)
    with damage(path, "put back what was written"), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        check_claim(path, sum(member.file_size for member in members), path.stat().st_size)
        return {member.filename.removesuffix(".npy"): _read_member(archive, member) for member in members}


def check_plain(path: Path) -> None:
    """Raises UserError for what is no plain file."""
    if not path.is_file():
        raise UserError(f"{path}: {'is no plain file' if path.exists() else 'no such file'}")


@contextmanager
def damage(path: Path, fix: str = "supply a whole file") -> Iterator[None]:
    """Around a library that reads a file; raises UserError for the dozen types that it may raise for a damaged one."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].strip("'\"")
        raise UserError(f"{path}: damaged or cut off ({reason}); {fix}") from error


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        if dtype.kind not in _PLAIN:
            raise ValueError(f"{member.filename} holds {dtype}, no plain numbers")
        if math.prod(shape) * dtype.itemsize > member.file_size:
            raise ValueError(f"{member.filename} is shorter than its header says")
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _array(where: Path | str, name: str, values: Any, wanted: str, shape: Sequence[int | None], fix: str) -> np.ndarray:
    """Numbers or truth values of a shape, in the type that they came in."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):  # rows of different lengths
        raise UserError(f"{where}: {name} holds rows of different lengths; {fix}") from None
    if array.dtype.kind not in "biuf":
        raise UserError(f"{where}: {name} holds {array.dtype.name}, not {wanted}; {fix}")
    if len(shape) != array.ndim or any(n not in (None, size) for n, size in zip(shape, array.shape, strict=True)):
        sizes = ", ".join("n" if n is None else str(n) for n in shape)
        raise UserError(f"{where}: {name} has shape {list(array.shape)}, not [{sizes}]; {fix}")
    return array


def _of_row(place: tuple[int, ...]) -> str:
    return f" of row {place[0]}" if place else ""
