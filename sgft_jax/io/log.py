"""Impure: what a run writes while it works: metrics, evaluations, a summary."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from envs.files import read_text
from sgft_jax.io.jsonfile import jsonable, write_json
from sgft_jax.types import UserError

METRICS, EVAL, SUMMARY = "metrics.jsonl", "eval.jsonl", "summary.json"
_LIMIT = 2**32  # bytes of a log


class DivergedError(UserError):
    """Training has produced numbers that are not finite."""


def check_finite(metrics: Mapping[str, Any], step: int, *, unit: str, last_good: Path | None) -> None:
    """Raise DivergedError for the first training metric with a number that is not finite.

    metrics: numbers or arrays of one number per member. step: how many units (`unit`, in the plural) are behind them;
    call it after every chunk, so that nothing of an earlier one was infinite or NaN. last_good: the last checkpoint,
    saved before this step; None without one.
    """
    for name, value in metrics.items():
        bad = ~np.isfinite(np.atleast_1d(np.asarray(value, np.float64)))
        if bad.any():
            members = f" of {int(bad.sum())} of {bad.size} members" if bad.size > 1 else ""
            good = f"the last good checkpoint is {last_good}" if last_good else "there is no checkpoint from before"
            raise DivergedError(
                f"training has diverged: {name}{members} is not finite after {step:,} {unit}; {good}. Lower learning "
                "rates or clip gradients, and begin again with --overwrite"
            )


class MetricsLog:
    """Append-only `metrics.jsonl` and `eval.jsonl` of one run, mirrored to TensorBoard event files in `tensorboard/`.

    A line is {"step": ..., **values}; non-finite numbers are the strings "nan", "inf" and "-inf" (see `jsonfile`).
    Lines reach the operating system one by one, so a killed process loses none. `position()` goes into the checkpoint
    and `truncate(position)` undoes what was written after it: an interrupted and resumed run leaves the lines of an
    uninterrupted one.
    """

    def __init__(self, folder: Path, *, tensorboard: bool = True) -> None:
        self._folder = Path(folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        self._tensorboard = tensorboard
        self._writer: Any = None

    def metrics(self, step: int, values: Mapping[str, Any]) -> None:
        """Append one training record; values are numbers or arrays (one number per seed, say)."""
        self._append(METRICS, step, values, prefix="")

    def eval(self, step: int, values: Mapping[str, Any]) -> None:
        """Append one evaluation record."""
        self._append(EVAL, step, values, prefix="eval/")

    def position(self) -> dict[str, int]:
        """Bytes written so far per file, after flushing them to disk; store it in the checkpoint's meta."""
        sizes = {}
        for name in (METRICS, EVAL):
            path = self._folder / name
            if path.exists():
                with open(path, "rb") as file:
                    os.fsync(file.fileno())
            sizes[name] = path.stat().st_size if path.exists() else 0
        return sizes

    def truncate(self, position: Mapping[str, int]) -> None:
        """Cut the files back to `position` ({} = empty); raises UserError if a file is shorter than that."""
        self.close()
        for name in (METRICS, EVAL):
            path, size = self._folder / name, position.get(name, 0)
            have = path.stat().st_size if path.exists() else 0
            if have < size:
                raise UserError(f"{path}: cut or replaced: it has {have} bytes, the checkpoint remembers {size}")
            if have > size:
                os.truncate(path, size)

    def close(self) -> None:
        """Flush and close the TensorBoard writer; the log can still be appended to."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _append(self, name: str, step: int, values: Mapping[str, Any], *, prefix: str) -> None:
        record = {"step": int(step), **jsonable(values)}
        with open(self._folder / name, "a") as file:
            file.write(json.dumps(record, allow_nan=False) + "\n")
        if self._tensorboard:
            self._mirror(step, record, prefix=prefix)

    def _mirror(self, step: int, record: Mapping[str, Any], *, prefix: str) -> None:
        """Finite numbers as they are, lists as their mean."""
        if self._writer is None:
            from tensorboardX import SummaryWriter

            # Events from `purge_step` on, left by an interrupted run, are hidden by TensorBoard.
            self._writer = SummaryWriter(str(self._folder / "tensorboard"), purge_step=int(step))
        for tag, value in record.items():
            numbers = _numbers(value)
            if tag != "step" and numbers.size and np.isfinite(numbers).all():
                self._writer.add_scalar(f"{prefix}{tag}", float(numbers.mean()), int(step))


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """The records of a log, oldest first, "nan" and "inf" as floats again; a last line torn by a kill is left out."""
    path = Path(path)
    if not path.exists():
        raise UserError(f"{path}: no such file")
    records = []
    lines = read_text(path, limit=_LIMIT).split("\n")
    for number, line in enumerate(lines[:-1], start=1):  # whatever follows the last newline was never finished
        try:
            records.append({k: _floats(v) for k, v in json.loads(line).items()})
        except (ValueError, AttributeError, RecursionError) as error:
            raise UserError(f"{path}:{number}: not a JSON object") from error
    return records


def write_summary(folder: Path, values: Mapping[str, Any]) -> Path:
    """Write the run's final numbers to `summary.json` and return its path."""
    path = Path(folder) / SUMMARY
    write_json(path, values)
    return path


def _floats(value: Any) -> Any:
    if isinstance(value, list):
        return [_floats(v) for v in value]
    return float(value) if value in ("nan", "inf", "-inf") else value


def _numbers(value: Any) -> np.ndarray:
    """A number or a nest of lists of numbers as a flat array; empty if it is anything else."""
    try:
        return np.asarray(_floats(value), np.float64).reshape(-1)
    except (TypeError, ValueError):
        return np.zeros(0)
