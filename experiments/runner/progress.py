"""Impure: what a command tells while it works: what it is doing, on stderr, and how far a loop is. Light to import.

Results are on stdout. There are no carriage returns outside a terminal.
"""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple, Self

if TYPE_CHECKING:  # commands announce their start before they draw a bar
    from rich.console import Console
    from rich.progress import Progress

_FIRST, _AGAIN, _SELDOM = 3.0, 10.0, 30.0  # s of silence: before the first words, then between two lines
_COMPILING = "/jax/core/compile/"  # how the names of the events begin that JAX reports of it


class _Phase(NamedTuple):
    """What happens now, since when (s, monotonic), and how much of it has been done, as far as that is known."""

    words: str
    begun: float
    far: float | None = None


class _Voice:
    """What this process says of its work. There is one, as there is one stderr.

    phases: the innermost last. said: what has been announced since the last loop ended. idle: what happens between two
    phases, and since when. heard: when the last line was written, s (monotonic), None before the first one.
    depths: of each thread, how deep it is in JAX's compiler; None before anybody listens. bar: the one on the terminal.
    """

    def __init__(self) -> None:
        self.phases: list[_Phase] = []
        self.said: set[str] = set()
        self.idle = _Phase("starting", time.monotonic())
        self.heard: float | None = None
        self.depths: dict[int, int] | None = None
        self.bar: Progress | None = None
        self.silent = False

    def announce(self, words: str, usual: str) -> None:
        """Says what begins, the first time. usual: how long that takes, "" where nobody knows."""
        if words not in self.said:
            self.said.add(words)
            say(f"{words} ({usual})" if usual else words)

    def still(self, cpu: float) -> None:
        """What goes on is said again after some silence. cpu: seconds of this process so far."""
        phase, now = (self.phases or [self.idle])[-1], time.monotonic()
        lasts = now - phase.begun
        if self.heard is None:
            if cpu > _FIRST or lasts > _AGAIN:
                self.announce(phase.words, "some seconds")
        elif now - self.heard > min(_SELDOM, max(_AGAIN, lasts / 2)) and (self.phases or lasts >= 1):
            more = ", compiling" if compiling() else ""
            far = "" if phase.far is None else f"{phase.far:.0%}, ".replace("%", " %")
            say(f"still {phase.words} ({far}{_duration(lasts)} so far{more})" if lasts >= 1 else phase.words)

    def listen(self) -> None:
        """Hears from JAX, once it is imported, when it compiles."""
        if self.depths is not None or "jax" not in sys.modules:
            return
        from jax import monitoring

        depths = self.depths = {}

        def count(event: str, change: int) -> None:
            if event.startswith(_COMPILING):
                thread = threading.get_ident()
                depths[thread] = max(0, depths.get(thread, 0) + change)

        monitoring.register_scalar_listener(lambda event, *_, **__: count(event, 1))
        monitoring.register_event_duration_secs_listener(lambda event, *_, **__: count(event, -1))


_VOICE = _Voice()


def say(line: str) -> None:
    """A line on stderr; nothing fails for want of a reader."""
    _VOICE.heard = time.monotonic()
    if not _VOICE.silent:
        with contextlib.suppress(OSError, ValueError):
            print(line, file=sys.stderr, flush=True)


def say_nothing() -> None:
    """For a host that is not the first: it does the same as that one, which says so."""
    _VOICE.silent = True


@contextlib.contextmanager
def doing(words: str, about: float | None = None, *, once: bool = False) -> Iterator[None]:
    """Says what happens in the `with` block: when that begins for the first time, and as `never_silent` does.

    about: s that it takes on two cores. once: so long only the first time, because what it makes is kept.
    """
    usual = [] if about is None else [f"about {about:.0f} s" if about < 100 else f"about {about / 60:.0f} min"]
    _VOICE.listen()
    _VOICE.announce(words, ", ".join([*usual, "once"] if once else usual))
    with amid(words):
        yield


@contextlib.contextmanager
def amid(words: str) -> Iterator[None]:
    """Says what goes on in the `with` block where that lasts, and nothing when it begins."""
    _VOICE.phases.append(_Phase(words, time.monotonic()))
    try:
        yield
    finally:
        _VOICE.phases.pop()
        _VOICE.idle = _Phase("working", time.monotonic())


def far(share: float) -> None:
    """How much of what happens now has been done, 0 to 1."""
    if _VOICE.phases:
        _VOICE.phases[-1] = _VOICE.phases[-1]._replace(far=share)


@contextlib.contextmanager
def never_silent() -> Iterator[None]:
    """Where the block writes nothing for long, a thread says what it is doing, and since when.

    That is after ten seconds, then more seldom, at last every half a minute.
    """
    over, cpu = threading.Event(), time.process_time()
    _VOICE.said.clear()
    _VOICE.idle, _VOICE.heard = _Phase("starting", time.monotonic()), None

    def watch() -> None:
        while not over.wait(0.5):
            _VOICE.still(time.process_time() - cpu)

    watcher = threading.Thread(target=watch, name="never silent", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()


def compiling() -> bool:
    """Whether JAX compiles now, in any thread."""
    return any((_VOICE.depths or {}).values())


def phase() -> str:
    """What happens now."""
    return _VOICE.phases[-1].words if _VOICE.phases else "working"


def leave_terminal() -> None:
    """Gives the terminal back without a bar, for a process that ends at once."""
    if _VOICE.bar is not None:
        _VOICE.bar.stop()


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
            from rich.table import Column

            wrapped = [TextColumn(f"{{task.{x}}}", table_column=Column()) for x in ("description", "fields[words]")]
            self._live = Progress(wrapped[0], BarColumn(20), wrapped[1], console=self._console)
            self._live.start()
            _VOICE.bar = self._live
            words = f"{self._counts()}, compiling"
            self._live.add_task(self._title, total=self._total, completed=self._done, words=words)
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()
        self._live = _VOICE.bar = None
        _VOICE.said.clear()  # what comes next may be another run

    def advance(self, amount: int, info: Mapping[str, float] | None = None) -> None:
        """Count `amount` more units; `info` is shown behind them, by name."""
        self._done += amount
        values = [f"{name} {value:.3g}" for name, value in (info or {}).items()]
        words = "  ".join([", ".join([self._counts(), *self._speed(amount)]), *values])
        if self._live is not None:
            self._live.update(self._live.task_ids[0], completed=self._done, words=words)
        else:
            self._console.print(f"{self._title}: {words}", highlight=False, markup=False)
        _VOICE.heard = time.monotonic()

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
