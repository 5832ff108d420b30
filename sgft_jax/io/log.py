"""Impure: what a run writes while it works: metrics, evaluations, real rollouts, progress on the terminal."""

import contextlib
import json
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from sgft_jax.io.jsonfile import jsonable, write_json
from sgft_jax.types import UserError

METRICS, EVAL, SUMMARY = "metrics.jsonl", "eval.jsonl", "summary.json"
_REAL, _ROLLOUT, _SUPERSEDED = "real", "rollout-", "superseded-"


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
    lines = path.read_text().split("\n")
    for number, line in enumerate(lines[:-1], start=1):  # whatever follows the last newline was never finished
        try:
            records.append({k: _floats(v) for k, v in json.loads(line).items()})
        except (ValueError, AttributeError) as error:
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


# ---------------------------------------------------------------- real rollouts


class RealLog:
    """Real-world data is precious: every rollout is on disk in `<folder>/real/` before any learner sees it.

    One `.npz` per rollout, numbered from 0, written under a temporary name, flushed to disk and renamed. Arrays only,
    nothing is ever pickled.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder) / _REAL
        self._folder.mkdir(parents=True, exist_ok=True)

    def __len__(self) -> int:
        """Rollouts on disk; goes into the checkpoint's meta."""
        return len(self._numbered())

    def append(self, rollout: Mapping[str, Any]) -> int:
        """Store one rollout, {name: array [T, ...]}, and return its number once it is safely on disk."""
        arrays = {name: np.asarray(x) for name, x in rollout.items()}
        if unfit := [name for name, x in arrays.items() if x.dtype.kind not in "biufcSU"]:
            raise TypeError(f"a rollout holds plain numeric arrays only, not {unfit}")
        number = max(self._numbered(), default=-1) + 1
        path = self._path(number)
        temporary = path.with_suffix(".tmp")
        with open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
            file.flush()
            os.fsync(file.fileno())
        temporary.rename(path)
        _sync_folder(self._folder)
        return number

    def load(self) -> list[dict[str, np.ndarray]]:
        """All rollouts in order; raises UserError if one is missing or damaged."""
        numbers = self._numbered()
        if missing := sorted(set(range(len(numbers))) - set(numbers)):
            raise UserError(f"{self._folder}: rollout {missing[0]} is missing ({self._path(missing[0]).name})")
        return [self._load(n) for n in numbers]

    def truncate(self, count: int) -> Path | None:
        """Keep the first `count` rollouts and move later ones to `real/superseded-<k>/`, which is returned if made.

        After a resume the run collects them again; what the robot did is never deleted.
        """
        later = [n for n in self._numbered() if n >= count]
        if not later:
            if len(self) < count:
                raise UserError(f"{self._folder}: holds {len(self)} rollouts, the checkpoint remembers {count}")
            return None
        aside = self._folder / f"{_SUPERSEDED}{len(list(self._folder.glob(_SUPERSEDED + '*')))}"
        aside.mkdir()
        for number in later:
            self._path(number).rename(aside / self._path(number).name)
        _sync_folder(self._folder)
        return aside

    def _path(self, number: int) -> Path:
        return self._folder / f"{_ROLLOUT}{number:06d}.npz"

    def _numbered(self) -> list[int]:
        return sorted(int(p.stem.removeprefix(_ROLLOUT)) for p in self._folder.glob(f"{_ROLLOUT}*.npz"))

    def _load(self, number: int) -> dict[str, np.ndarray]:
        try:
            with open(self._path(number), "rb") as file, np.load(file, allow_pickle=False) as stored:
                return {name: stored[name] for name in stored.files}
        except Exception as error:  # numpy raises half a dozen types for a damaged archive
            raise UserError(f"{self._path(number)}: damaged: {error}") from error


def _sync_folder(folder: Path) -> None:
    """Make a rename in `folder` survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


# ---------------------------------------------------------------- progress


class RunProgress:
    """Progress of a long loop: a live bar with rate and time left on a terminal, one plain line per chunk elsewhere.

    with RunProgress("pretrain hammer", total=1_000_000, unit="steps", done=start) as progress:
        ...
        progress.advance(chunk, {"success": 0.4})
    """

    def __init__(
        self, title: str, *, total: int, unit: str = "steps", done: int = 0, console: Console | None = None
    ) -> None:
        self._title, self._total, self._unit, self._done = title, total, unit, done
        self._console = console or Console(soft_wrap=True)
        self._start, self._begun = done, time.monotonic()
        self._live: Progress | None = None

    def __enter__(self) -> Self:
        self._begun = time.monotonic()
        if self._console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn(f"{{task.completed:,.0f}}/{{task.total:,.0f}} {self._unit}"),
                _Rate(self._unit),
                TimeRemainingColumn(),
                TextColumn("{task.fields[info]}"),
            )
            self._live = Progress(*columns, console=self._console)
            self._live.start()
            self._live.add_task(self._title, total=self._total, completed=self._start, info="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def advance(self, amount: int, info: Mapping[str, float] | None = None) -> None:
        """Count `amount` more units; `info` is shown behind them."""
        self._done += amount
        words = "  ".join(f"{name} {value:.3g}" for name, value in (info or {}).items())
        if self._live is not None:
            self._live.update(self._live.task_ids[0], completed=self._done, info=words)
        else:
            self._console.print(self._line(words), highlight=False, markup=False)

    def say(self, message: str) -> None:
        """Print a line without breaking the bar."""
        self._console.print(message, highlight=False, markup=False)

    def _line(self, words: str) -> str:
        rate = (self._done - self._start) / max(time.monotonic() - self._begun, 1e-9)
        left = (self._total - self._done) / max(rate, 1e-9)
        share = 100 * self._done / max(self._total, 1)
        counts = f"{self._done:,}/{self._total:,} {self._unit} ({share:.0f} %)"
        return f"{self._title}: {counts}, {_rate(rate, self._unit)}, {_duration(left)} left  {words}".rstrip()


class _Rate(ProgressColumn):
    """Units per second, averaged by rich over the last chunks."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        return Text("" if not task.speed else _rate(task.speed, self._unit))


def _rate(rate: float, unit: str) -> str:
    return f"{rate:,.0f} {unit}/s" if rate >= 10 else f"{rate:.2g} {unit}/s"


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
