"""Impure: CSV tables, plain or compressed, whoever wrote them, and what their cells say."""

import csv
import gzip
import io
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from envs.files import decoded, read_bytes
from envs.types import UserError
from sgft_jax.files.folders import written

_LIMIT = 2**30  # bytes
_LARGEST = 2**53


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
    content = read_bytes(path, limit=_LIMIT)
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
        table = gzip.GzipFile(fileobj=io.BytesIO(content)).read(_LIMIT + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise UserError(f"{path}: is no gzip file ({str(error).lower()}); put it back as it was") from error
    if len(table) > _LIMIT:
        raise UserError(f"{path}: holds more than {_LIMIT:,} bytes, more than such a table can need")
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
