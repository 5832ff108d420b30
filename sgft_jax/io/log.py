"""Impure: what a run leaves on disk while it works: metrics, evaluations and a summary."""

import contextlib
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.files import checked, kind_of, parse_json, read_text
from envs.types import UserError
from sgft_jax.files.disk import jsonable, sync, write_json

METRICS, EVAL, SUMMARY = "metrics.jsonl", "eval.jsonl", "summary.json"
_LIMIT = 2**30  # bytes of a log
_FIX = "put back the file that the run has written"


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
            advice = "Lower learning rates or clip gradients, and begin again with --overwrite"
            where = f"{name}{members} is not finite after {step:,} {unit}"
            raise DivergedError(f"training has diverged: {where}; {good}. {advice}")


class MetricsLog:
    """Append-only `metrics.jsonl` and `eval.jsonl` of one run, mirrored to TensorBoard event files in `tensorboard/`.

    A line is {"step": ..., **values}; non-finite numbers are the strings "nan", "inf" and "-inf" (see `disk`).
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
                sync(path)
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


def read_jsonl(path: Path, needed: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    """The records of a log, oldest first, "nan" and "inf" as floats again; a last line torn by a kill is left out.

    needed: see `check_records`. Raises UserError for a file that is no log.
    """
    lines = read_text(path, limit=_LIMIT).split("\n")
    # Whatever follows the last newline was never finished.
    records = [_record(f"{path}:{number}", line) for number, line in enumerate(lines[:-1], start=1)]
    if needed is not None:
        check_records(path, records, needed)
    return records


def check_records(path: Path, records: Sequence[Mapping[str, Any]], needed: Mapping[str, Any]) -> None:
    """Raises UserError unless there are records, and each has these keys with values of these types.

    Lists under these keys, which have a number for each seed, are of one length in all records.
    """
    if not records:
        raise UserError(f"{path}: holds no record; {_FIX}")
    kind, lengths = kind_of(needed), set()
    for number, record in enumerate(records, start=1):
        checked(f"{path}:{number}", record, kind, _FIX)
        lengths |= {len(record[name]) for name in needed if isinstance(record[name], list)}
    if len(lengths) > 1 or 0 in lengths:
        raise UserError(f"{path}: its records are of {' or '.join(map(str, sorted(lengths)))} seeds; {_FIX}")


def write_summary(folder: Path, values: Mapping[str, Any]) -> Path:
    """Write the run's final numbers to `summary.json` and return its path."""
    path = Path(folder) / SUMMARY
    write_json(path, values)
    return path


def _record(where: str, line: str) -> dict[str, Any]:
    record = parse_json(line, where)
    if not isinstance(record, dict):
        raise UserError(f"{where}: is no JSON object; {_FIX}")
    return {key: _floats(value) for key, value in record.items()}


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


# --- time -------------------------------------------------------------------------------------------------------------


class Clock:
    """Wall-clock seconds per phase; what a checkpoint remembers of an earlier start counts too."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, phase: str) -> Iterator[None]:
        """Count the time inside the `with` block, which must wait for its own results."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[phase] = self.seconds.get(phase, 0.0) + time.perf_counter() - begun

    def record(self) -> dict[str, float]:
        """{"time/<phase>_s": seconds}."""
        return {f"time/{phase}_s": round(seconds, 3) for phase, seconds in self.seconds.items()}
