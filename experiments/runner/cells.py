"""Runs on disk as the cells of a grid: how far each has got, and doing what is missing, for any command that runs."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, TypedDict

from envs.files import Count
from envs.types import UserError
from sgft_jax.files.folders import InUseError, in_use
from sgft_jax.io.log import SUMMARY
from sgft_jax.io.runs import CONFIG, check_same, read_own


class Kind(NamedTuple):
    """A command whose runs are cells of a grid; `args`: its arguments, a frozen dataclass with the field `resume`.

    name: `kind` in the `config.json` of its runs. systems: the field of `args` that holds a tuple of systems; a cell
    has one, and one call may run several. run(args): runs them, raises UserError where it cannot. folder(args),
    config(args), title(args): a cell's run folder, its stored configuration, its name. volatile: see `check_same`.
    finished(args, summary): whether a run with this `summary.json` is complete.
    """

    name: str
    systems: str
    run: Callable[[Any], object]
    folder: Callable[[Any], Path]
    config: Callable[[Any], Mapping[str, Any]]
    title: Callable[[Any], str]
    volatile: tuple[str, ...]
    finished: Callable[[Any, Mapping[str, Any]], bool]


class _Final(TypedDict):
    rollouts: Count


class _Summary(TypedDict, total=False):
    final: _Final


class Limits(Protocol):
    """Options of a command that works through cells.

    together: cells that differ in their systems alone share a program. minutes: begin none after so many, None for no
    limit. dry: only list them.
    """

    @property
    def together(self) -> bool: ...  # noqa: D102
    @property
    def minutes(self) -> float | None: ...  # noqa: D102
    @property
    def dry(self) -> bool: ...  # noqa: D102


class Cell(NamedTuple):
    """One run, on one system. state: of its folder; done: the step of its last checkpoint, where it would go on."""

    kind: Kind
    args: Any
    state: Literal["missing", "unfinished", "finished"]
    done: int

    def __str__(self) -> str:
        return self.kind.title(self.args)

    @property
    def folder(self) -> Path:
        """Where it is on disk."""
        return self.kind.folder(self.args)

    @property
    def system(self) -> tuple[str, ...]:
        """The one system, as the arguments hold it."""
        return getattr(self.args, self.kind.systems)


def look_up(kind: Kind, args: Any) -> Cell:
    """How far the run with these arguments, of one system, has got."""
    folder = kind.folder(args)
    if not (folder / CONFIG).exists():
        return Cell(kind, args, "missing", 0)
    summary = read_own(folder / SUMMARY, _Summary)
    done = bool(summary) and kind.finished(args, summary)
    from sgft_jax.io import checkpoint

    last = checkpoint.latest(folder, say=lambda _: None) or 0
    return Cell(kind, args, "finished" if done else "unfinished", last)


def check_begun(cells: Iterable[Cell]) -> None:
    """Raises UserError if a run on disk was made with other options than its cell has now."""
    for cell in cells:
        if cell.state != "missing":
            check_same(cell.folder, cell.kind.name, cell.kind.config(cell.args), cell.kind.volatile)


def complete(cells: Sequence[Cell], limits: Limits, *, started: float | None = None) -> list[str]:
    """Lists the cells, then runs those that are missing, in order; returns a line for each that could not run.

    Several processes may work on one grid: each skips cells that another has finished or is running.
    started: `time.monotonic` from which the minutes count, default now.
    """
    started, failed = time.monotonic() if started is None else started, []
    for cell in cells:
        print(f"{cell.state:10} {cell}" + (f", step {cell.done}" if cell.done else ""))
    if limits.dry:
        return []
    for batch in _batches(cells, together=limits.together):
        if limits.minutes is not None and time.monotonic() - started > 60 * limits.minutes:
            print(f"stopped after {limits.minutes:g} minutes; the same command goes on")
            break
        now = [look_up(cell.kind, cell.args) for cell in batch]  # others may have got further since
        theirs = [cell for cell in now if in_use(cell.folder)]
        for cell in theirs:
            _leave(cell)
        for group in _batches([cell for cell in now if cell not in theirs], together=limits.together):
            failed += _run(group)
    return failed


def _leave(cell: Cell) -> None:
    print(f"left to another process: {cell}")


def _with(cell: Cell, systems: tuple[str, ...], **changes: Any) -> Any:
    """The arguments of a cell for other systems."""
    return replace(cell.args, **{cell.kind.systems: systems}, **changes)


def _batches(cells: Sequence[Cell], *, together: bool) -> list[list[Cell]]:
    """The cells that are not finished, in their order; those that one call can do follow their first one."""
    batches: dict[Any, list[Cell]] = {}
    for cell in [cell for cell in cells if cell.state != "finished"]:
        key = _with(cell, ()) if together else cell.args
        batches.setdefault((key, cell.state, cell.done), []).append(cell)
    return list(batches.values())


def _run(batch: Sequence[Cell]) -> list[str]:
    """Runs cells that differ in their systems alone; returns a line for each that could not run."""
    print(f"--- {', '.join(map(str, batch))}")
    first = batch[0]
    systems = tuple(system for cell in batch for system in cell.system)
    try:
        first.kind.run(_with(first, systems, resume=first.state == "unfinished"))
    except UserError as error:
        if len(batch) > 1:
            print(f"error: {error}")
            # The others may have what one of them lacks; how far each has got is looked up again.
            return [line for cell in batch for line in _run([look_up(cell.kind, cell.args)])]
        if isinstance(error, InUseError):
            _leave(first)
            return []
        print(f"error: {error}")
        return [f"{first}: {error}"]
    return []
