"""Impure: reads CSV tables, whoever wrote them, and what their cells say."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from envs.files import read_text
from envs.types import UserError

_LIMIT = 2**30  # bytes
_LARGEST = 2**53


def read_csv(path: Path, *, needed: Sequence[str] = ()) -> list[dict[str, str]]:
    """The rows of a table; none if it does not exist; raises UserError where a row is cut or lacks a column needed."""
    if not path.exists():
        return []
    text = read_text(path, limit=_LIMIT)
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
