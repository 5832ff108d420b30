"""Runs on disk as the cells of a grid: how far each has got, and doing what is missing, for any command that runs.

Then the grid of fine-tuning runs, with its options and cells.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypedDict

import envs
from envs import extend, gaps
from envs.files import Count
from envs.types import UserError
from experiments.runner.finetune_args import (
    FinetuneArgs,
    arguments,
    finetune,
    label,
    resolved,
    run_folder,
    with_settings,
)
from experiments.runner.options import Impl, Out, at_least_one, check_task, each_once, not_negative, seed_list
from sgft_jax.files.disk import InUseError, in_use, jsonable
from sgft_jax.io.log import SUMMARY
from sgft_jax.io.runs import CONFIG, check_folder, check_same, read_own
from sgft_jax.methods import NAMES, get_method


class Kind(NamedTuple):
    """A command whose runs are cells of a grid; `args`: its arguments, a frozen dataclass with `resume` and `volatile`.

    name: `kind` in the `config.json` of its runs. systems: the field of `args` that holds a tuple of systems; a cell
    has one, and one call may run several. run(args): runs them, raises UserError where it cannot. folder(args),
    config(args), title(args): a cell's run folder, its stored configuration, its name.
    finished(args, summary): whether a run with this `summary.json` is complete.
    """

    name: str
    systems: str
    run: Callable[[Any], object]
    folder: Callable[[Any], Path]
    config: Callable[[Any], Mapping[str, Any]]
    title: Callable[[Any], str]
    finished: Callable[[Any, Mapping[str, Any]], bool]


class _Final(TypedDict):
    rollouts: Count


class _Summary(TypedDict, total=False):
    final: _Final


@dataclass(frozen=True)
class WorkArgs:
    """Options of a command that works through cells."""

    together: bool = True
    """Step the systems of cells that differ in nothing else together; --no-together: one after another, in less memory
    but more time."""
    minutes: float | None = None
    """Begin no new run after so many minutes."""
    dry: bool = False
    """Only list the runs and what is missing."""
    impl: Impl = "auto"
    out: Out = Path("runs")


class Cell(NamedTuple):
    """One run, on one system. state: of its folder; done: the step of its last checkpoint, where it would go on."""

    kind: Kind
    args: Any
    state: Literal["missing", "unfinished", "finished"]
    done: int

    def __str__(self) -> str:
        return self.kind.title(self.args)

    def now(self) -> "Cell":
        """The same cell as it is on disk by now."""
        return look_up(self.kind, self.args)

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
    from sgft_jax.io import checkpoint

    last = checkpoint.latest(folder, say=lambda _: None) or 0
    return Cell(kind, args, "finished" if summary and kind.finished(args, summary) else "unfinished", last)


def check_begun(cells: Iterable[Cell]) -> None:
    """Raises UserError if a run on disk was made with other options than its cell has now."""
    for cell in cells:
        if cell.state != "missing":
            check_same(cell.folder, cell.kind.name, cell.kind.config(cell.args), cell.args.volatile)


def work(cells: Sequence[Cell], args: WorkArgs, show: Callable[[list[Cell]], None] = lambda cells: None) -> None:
    """Completes the cells, then shows them as they are by then, and in the end raises UserError for those that failed.

    show: is not called where cells are only listed.
    """
    failed = complete(cells, args)
    if not args.dry:
        show([cell.now() for cell in cells])
    refuse(failed, "cells")


def refuse(failed: Sequence[str], noun: str) -> None:
    """Raises UserError if some could not run. failed: as `complete` returns it."""
    if failed:
        raise UserError(f"{len(failed)} of the {noun} did not run: {'; '.join(failed)}")


def complete(cells: Sequence[Cell], args: WorkArgs, *, started: float | None = None) -> list[str]:
    """Lists the cells, then runs those that are missing, in order; returns a line for each that could not run.

    Several processes may work on one grid: each skips cells that another has finished or is running.
    started: `time.monotonic` from which the minutes count, default now.
    """
    started, failed = time.monotonic() if started is None else started, []
    for cell in cells:
        print(f"{cell.state:10} {cell}" + (f", step {cell.done}" if cell.done else ""))
    for batch in [] if args.dry else _batches(cells, args):
        if args.minutes is not None and time.monotonic() - started > 60 * args.minutes:
            print(f"stopped after {args.minutes:g} minutes; the same command goes on")
            break
        now = [cell.now() for cell in batch]  # others may have got further since
        taken = [cell for cell in now if in_use(cell.folder)]
        for cell in taken:
            print(f"left to another process: {cell}")
        for group in _batches([cell for cell in now if cell not in taken], args):
            failed += _run(group)
    return failed


def _with(cell: Cell, systems: tuple[str, ...], **changes: Any) -> Any:
    """The arguments of a cell for other systems."""
    return replace(cell.args, **{cell.kind.systems: systems}, **changes)


def _batches(cells: Sequence[Cell], args: WorkArgs) -> list[list[Cell]]:
    """The cells that are not finished, in their order; those that one call can do follow their first one."""
    batches: dict[Any, list[Cell]] = {}
    for cell in [cell for cell in cells if cell.state != "finished"]:
        key = _with(cell, ()) if args.together else cell.args
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
        if len(batch) == 1 and isinstance(error, InUseError):
            print(f"left to another process: {first}")
            return []
        print(f"error: {error}")
        if len(batch) == 1:
            return [f"{first}: {error}"]
        # The others may have what one of them lacks; how far each has got is looked up again.
        return [line for cell in batch for line in _run([cell.now()])]
    return []


# --- fine-tuning ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Systems:
    """What the cells are of."""

    tasks: tuple[str, ...] = tuple(task for task in envs.TASKS if "default" in gaps.presets(task))
    """Tasks, by default all that have a real system called default."""
    methods: tuple[str, ...] = tuple(name for name in NAMES if not get_method(name).sees_system)
    """Methods, in the order in which they run; by default all that start from the usual priors."""
    reals: tuple[str, ...] = ("default",)
    """Real systems of every task: mild, default, hard, sim for no gap, or .toml/.json files: all gaps of a file, or
    file.toml:name."""
    seed: int = 0
    """First seed."""
    seeds: int = 10
    """Seeds of each run, all in one program."""
    rollouts: int = 100
    """Real rollouts per seed, the initial ones included; may grow later."""
    eval_every: int = 5
    """Rollouts between evaluations."""
    devices: int | None = None
    """Devices that share the seeds; 0: all there are; default: one."""


@dataclass(frozen=True)
class GridArgs(WorkArgs, _Systems):  # this order puts the fields of the latter first
    """A grid of fine-tuning runs; everything not named here is as `experiments.finetune` has it."""


def check(args: GridArgs) -> None:
    """Raises UserError for what is wrong in the arguments alone."""
    at_least_one(args, "rollouts", "eval_every")
    not_negative(args, "minutes", "devices")
    each_once(args, "tasks", "methods", "reals")
    for task in args.tasks:
        check_task(task, args.reals)
    for method in args.methods:
        get_method(method)
    seed_list(args.seed, args.seeds)
    check_folder(args.out)


FINETUNING = Kind(
    name="finetune",
    systems="real",
    run=lambda args: finetune(args),
    folder=lambda args: run_folder(args, *args.real),
    config=lambda args: jsonable(resolved(args)) | {"real": args.real[0]},
    title=lambda args: f"{extend.name_of(args.task)}/{gaps.title(args.real[0])}: {label(args)}",
    finished=lambda args, summary: summary.get("final", {}).get("rollouts", 0) >= args.rollouts,
)


def cell_of(
    args: GridArgs, task: str, real: str, method: str, settings: Mapping[str, Any] | None = None, **changes: Any
) -> Cell:
    """The run of one cell, and how far it has got.

    It has the method's own defaults but for `settings`, the options of the grid, and these `changes` of its arguments.
    """
    run = replace(run_of(args, task, real, method), **changes)
    return look_up(FINETUNING, with_settings(run, settings or {}))


def run_of(args: GridArgs, task: str, real: str, method: str) -> FinetuneArgs:
    """The arguments of one cell, with the method's own defaults."""
    shared = ("seed", "seeds", "rollouts", "eval_every", "impl", "devices", "out")
    options = {name: getattr(args, name) for name in shared}
    return arguments(method, task=task, real=(real,), video=False, **options)
