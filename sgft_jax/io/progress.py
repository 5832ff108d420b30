"""Impure: progress of long loops on the terminal, and where their time goes."""

import contextlib
import time
from collections.abc import Iterator, Mapping
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn


class RunProgress:
    """Progress of a long loop: a live bar with rate and time left on a terminal, one plain line per chunk elsewhere.

    The first chunk compiles what the others run again, so the rate counts from its end and there is none before.

    with RunProgress("pretrain hammer", total=1_000_000, unit="steps", done=start) as progress:
        ...
        progress.advance(chunk, {"success": 0.4})
    """

    def __init__(
        self, title: str, *, total: int, unit: str = "steps", done: int = 0, console: Console | None = None
    ) -> None:
        self._title, self._total, self._unit, self._done = title, total, unit, done
        self._console = console or Console(soft_wrap=True)
        self._first: tuple[int, float] | None = None  # units and time at the end of the first chunk
        self._live: Progress | None = None

    def __enter__(self) -> Self:
        if self._console.is_terminal:
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
        return [_rate(rate, self._unit), f"{_duration((self._total - self._done) / max(rate, 1e-9))} left"]


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
