"""Impure: writes small JSON files, atomically and without the numbers that JSON does not know; `envs.files` reads."""

import dataclasses
import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sgft_jax.files.folders import written


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
