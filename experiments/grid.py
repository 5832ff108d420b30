"""A grid of fine-tuning runs on disk: how far each has got, and doing what is missing."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import envs
from envs import gaps
from experiments.finetune import finetune
from experiments.finetune_args import VOLATILE, FinetuneArgs, arguments, label, run_folder
from experiments.options import Impl, check_task, seed_list, without_repeats
from sgft_jax import extend
from sgft_jax.io.jsonfile import jsonable, read_json
from sgft_jax.io.log import SUMMARY
from sgft_jax.io.runs import CONFIG, InUseError, check_same, in_use
from sgft_jax.methods import NAMES, get_method
from sgft_jax.types import UserError


@dataclass(frozen=True)
class GridArgs:
    """A grid of fine-tuning runs; everything not named here is as `experiments.finetune` has it."""

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
    together: bool = True
    """Step the real systems of a task together; --no-together: one after another, in less memory but more time."""
    minutes: float | None = None
    """Begin no new run after so many minutes."""
    dry: bool = False
    """Only list the runs and what is missing."""
    impl: Impl = "auto"
    """Physics engine, as in fine-tuning."""
    devices: int | None = None
    """Devices that share the seeds; 0: all there are; default: one."""
    out: Path = Path("runs")
    """Parent of all run folders."""


class Cell(NamedTuple):
    """One run, on one real system. state: of its folder; done: the real rollouts from which it would go on."""

    args: FinetuneArgs
    state: Literal["missing", "unfinished", "finished"]
    done: int

    def __str__(self) -> str:
        (real,) = self.args.real
        return f"{extend.name_of(self.args.task)}/{gaps.title(real)}: {label(self.args)}"

    @property
    def folder(self) -> Path:
        """Where it is on disk."""
        return run_folder(self.args, *self.args.real)


def check(args: GridArgs) -> None:
    """Raises UserError for what is wrong in the arguments alone."""
    for name, given in (("tasks", args.tasks), ("methods", args.methods), ("reals", args.reals)):
        if not given:
            raise UserError(f"--{name}: name at least one")
        without_repeats(f"--{name}", given)
    for task in args.tasks:
        check_task(task, args.reals)
    for method in args.methods:
        get_method(method)
    seed_list(args.seed, args.seeds)


def run_of(args: GridArgs, task: str, real: str, method: str) -> FinetuneArgs:
    """The run of one cell, with the method's own defaults."""
    return arguments(
        method, task=task, real=(real,), seed=args.seed, seeds=args.seeds, rollouts=args.rollouts,
        eval_every=args.eval_every, impl=args.impl, devices=args.devices, video=False, out=args.out,
    )  # fmt: skip


def look_up(run: FinetuneArgs) -> Cell:
    """How far the run on the one real system of these arguments has got."""
    from sgft_jax.io import checkpoint

    folder = run_folder(run, *run.real)
    if not (folder / CONFIG).exists():
        return Cell(run, "missing", 0)

    summed_up = read_json(folder / SUMMARY)["final"]["rollouts"] if (folder / SUMMARY).exists() else 0
    state = "finished" if summed_up >= run.rollouts else "unfinished"
    return Cell(run, state, checkpoint.latest(folder, say=lambda _: None) or 0)


def check_begun(cells: Iterable[Cell]) -> None:
    """Raises UserError if a run on disk was made with other options than its cell has now."""
    for cell in cells:
        if cell.state != "missing":
            (real,) = cell.args.real
            check_same(cell.folder, "finetune", jsonable(cell.args) | {"real": real}, VOLATILE)


def work(cells: Sequence[Cell], args: GridArgs, *, started: float | None = None) -> list[str]:
    """Lists the cells, then runs those that are missing, in order; returns a line for each that could not run.

    Several processes may work on one grid: each skips cells that another has finished or is running.
    started: `time.monotonic` from which --minutes count, default now.
    """
    started, failed = time.monotonic() if started is None else started, []
    for cell in cells:
        print(f"{cell.state:10} {cell}" + (f", step {cell.done}" if cell.done else ""))
    if args.dry:
        return []
    for batch in _batches(cells, together=args.together):
        if args.minutes is not None and time.monotonic() - started > 60 * args.minutes:
            print(f"stopped after {args.minutes:g} minutes; the same command goes on")
            break
        now = [look_up(cell.args) for cell in batch]  # others may have got further since
        theirs = [cell for cell in now if in_use(cell.folder)]
        for cell in theirs:
            _leave(cell)
        for group in _batches([cell for cell in now if cell not in theirs], together=args.together):
            failed += _run(group)
    return failed


def _leave(cell: Cell) -> None:
    print(f"left to another process: {cell}")


def _batches(cells: Sequence[Cell], *, together: bool) -> list[list[Cell]]:
    """The cells that are not finished, in their order; those that one call can do follow their first one."""
    batches: dict[Any, list[Cell]] = {}
    for cell in [cell for cell in cells if cell.state != "finished"]:
        real = () if together else cell.args.real
        batches.setdefault((replace(cell.args, real=real), cell.state, cell.done), []).append(cell)
    return list(batches.values())


def _run(batch: Sequence[Cell]) -> list[str]:
    """Runs cells that differ in their real systems alone; returns a line for each that could not run."""
    print(f"--- {', '.join(map(str, batch))}")
    first = batch[0]
    reals = tuple(real for cell in batch for real in cell.args.real)
    try:
        finetune(replace(first.args, real=reals, resume=first.state == "unfinished"))
    except UserError as error:
        if len(batch) > 1:
            print(f"error: {error}")
            # The others may have what one of them lacks; how far each has got is looked up again.
            return [line for cell in batch for line in _run([look_up(cell.args)])]
        if isinstance(error, InUseError):
            _leave(first)
            return []
        print(f"error: {error}")
        return [f"{first}: {error}"]
    return []
