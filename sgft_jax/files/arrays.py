"""The one way in for numbers, from files, environments and robots: what is learned from is finite float32.

`where` names the file or the sender in errors, `name` the array, `fix` what the user can do. All raise UserError.
"""

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

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
    array = _of_kind(where, name, values, "biuf", "numbers", fix)
    _check_shape(where, name, array, shape, fix)
    with np.errstate(over="ignore"):
        cast = array.astype(np.float32)
    good = np.abs(cast) <= LARGEST  # nan is not
    if valid is not None:
        good |= ~valid.reshape(*valid.shape, *[1] * (cast.ndim - valid.ndim))
    if not good.all():
        place = tuple(int(i) for i in np.argwhere(~good)[0])
        wrong = "is too large for float32" if np.isfinite(array[place]) else "is not finite"
        raise UserError(f"{where}: {name}{_of_row(place)} {wrong}; {fix}")
    return cast


def flags(where: Path | str, name: str, values: Any, shape: Sequence[int | None], *, fix: str) -> np.ndarray:
    """[*shape] bool, from truth values or from numbers that are 0 or 1 and nothing else."""
    array = _of_kind(where, name, values, "biuf", "0 or 1", fix)
    _check_shape(where, name, array, shape, fix)
    if not (good := (array == 0) | (array == 1)).all():
        place = tuple(int(i) for i in np.argwhere(~good)[0])
        raise UserError(f"{where}: {name}{_of_row(place)} is {array[place]:g}, not 0 or 1; {fix}")
    return array.astype(bool)


def check_claim(where: Path | str, claimed: int, stored: int) -> None:
    """Raises UserError where few bytes claim to unpack to very many, before memory is taken for them."""
    if claimed > _FREE + _RATIO * stored:
        raise UserError(f"{where}: {stored:,} bytes claim to hold {claimed:,}; no real data pack so well")


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """The plain arrays of an .npz file, by name; sizes are checked before memory is taken for them."""
    if not path.is_file():
        raise UserError(f"{path}: {'is no plain file' if path.exists() else 'no such file'}")
    try:
        with zipfile.ZipFile(path) as archive:
            check_claim(path, sum(member.file_size for member in archive.infolist()), path.stat().st_size)
            return {
                member.filename.removesuffix(".npy"): _read_member(archive, member) for member in archive.infolist()
            }
    except UserError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise half a dozen types for a damaged archive
        raise UserError(f"{path}: damaged: {str(error) or type(error).__name__}") from error


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as file:
        shape, dtype = _header(file)
        if dtype.kind not in _PLAIN:
            raise ValueError(f"{member.filename} holds {dtype}, no plain numbers")
        if math.prod(shape) * dtype.itemsize > member.file_size:
            raise ValueError(f"{member.filename} is shorter than its header says")
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    return shape, dtype


def _of_kind(where: Path | str, name: str, values: Any, kinds: str, wanted: str, fix: str) -> np.ndarray:
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):  # rows of different lengths
        raise UserError(f"{where}: {name} holds rows of different lengths; {fix}") from None
    if array.dtype.kind not in kinds:
        raise UserError(f"{where}: {name} holds {array.dtype.name}, not {wanted}; {fix}")
    return array


def _check_shape(where: Path | str, name: str, array: np.ndarray, shape: Sequence[int | None], fix: str) -> None:
    fits = len(shape) == array.ndim and all(n is None or n == size for n, size in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = ", ".join("n" if n is None else str(n) for n in shape)
        raise UserError(f"{where}: {name} has shape {list(array.shape)}, not [{wanted}]; {fix}")


def _of_row(place: tuple[int, ...]) -> str:
    return f" of row {place[0]}" if place else ""
