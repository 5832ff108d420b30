"""Impure: what a run tells while it works: metrics, evaluations and a summary on disk, progress on the terminal."""

import contextlib
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from envs.files import checked, kind_of, parse_json, read_text
from envs.types import UserError
from sgft_jax.files.disk import jsonable, sync, write_json

if TYPE_CHECKING:  # commands name the files of a run before they draw a bar
    from rich.console import Console
    from rich.progress import Progress

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


# --- on the terminal --------------------------------------------------------------------------------------------------


class RunProgress:
    """Progress of a long loop: a live bar with rate and time left on a terminal, one plain line per chunk elsewhere.

    The first chunk compiles what the others run again, so the rate counts from its end and there is none before.

    with RunProgress("pretrain hammer", total=1_000_000, unit="steps", done=start) as progress:
        ...
        progress.advance(chunk, {"success": 0.4})
    """

    def __init__(
        self, title: str, *, total: int, unit: str = "steps", done: int = 0, console: "Console | None" = None
    ) -> None:
        from rich.console import Console

        self._title, self._total, self._unit, self._done = title, total, unit, done
        self._console = console or Console(soft_wrap=True)
        self._first: tuple[int, float] | None = None  # units and time at the end of the first chunk
        self._live: Progress | None = None

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[words]}"))
            self._live = Progress(*columns, console=self._console)
            self._live.start()
            words = f"{self._counts()}, compiling"
            self._live.add_task(self._title, total=self._total, completed=self._done, words=words)
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()
        self._live = None

    def advance(self, amount: int, info: Mapping[str, float] | None = None) -> None:
        """Count `amount` more units; `info` is shown behind them, by name."""
        self._done += amount
        values = [f"{name} {value:.3g}" for name, value in (info or {}).items()]
        words = "  ".join([", ".join([self._counts(), *self._speed(amount)]), *values])
        if self._live is not None:
            self._live.update(self._live.task_ids[0], completed=self._done, words=words)
        else:
            self._console.print(f"{self._title}: {words}", highlight=False, markup=False)

    def _counts(self) -> str:
        return f"{self._done:,}/{self._total:,} {self._unit} ({100 * self._done / max(self._total, 1):.0f} %)"

    def _speed(self, amount: int) -> list[str]:
        """Rate and time left, as soon as they can be known. A chunk of no units, such as an evaluation, is not one."""
        now = time.monotonic()
        if self._first is None:
            self._first = (self._done, now) if amount else None
            return []
        done, begun = self._first
        rate = (self._done - done) / max(now - begun, 1e-9)
        speed = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
        return [f"{speed} {self._unit}/s", f"{_duration((self._total - self._done) / max(rate, 1e-9))} left"]


def _duration(seconds: float) -> str:
    """H:MM:SS."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}"


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
