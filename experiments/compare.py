"""Run every method on every task and real system, cell by cell, and draw what there is.

A cell is one fine-tuning run of all seeds, with the method's own defaults. Cells that are finished are left alone,
begun ones go on where they stopped: the same command, given again, does what is missing.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import envs
from envs.physics import Impl
from experiments import cli, common
from experiments.figures import FiguresArgs, figures
from experiments.finetune import FinetuneArgs, arguments, finetune, run_folder
from sgft_jax.jsonfile import read_json
from sgft_jax.methods import METHODS, get_method
from sgft_jax.runs import CONFIG
from sgft_jax.types import UserError

_SUMMARY = "summary.json"


@dataclass(frozen=True)
class CompareArgs:
    """A grid of fine-tuning runs; everything not named here is as `experiments.finetune` has it."""

    tasks: tuple[str, ...] = tuple(envs.TASKS)
    """Tasks."""
    methods: tuple[str, ...] = tuple(reversed(METHODS))
    """Methods, in the order in which they run."""
    reals: tuple[str, ...] = ("default",)
    """Real systems of every task: mild, default, hard, or .toml/.json files."""
    seed: int = 0
    """First seed."""
    seeds: int = 10
    """Seeds of each cell, all in one program."""
    rollouts: int = 100
    """Real rollouts per seed, the initial ones included; may grow later."""
    initial_rollouts: int = 5
    """Rollouts of the simulator's policy, the same for all methods."""
    eval_every: int = 5
    """Rollouts between evaluations."""
    minutes: float | None = None
    """Begin no new cell after so many minutes."""
    dry: bool = False
    """Only list the cells and what is missing."""
    impl: Impl = "auto"
    """Who steps the physics, as in fine-tuning."""
    devices: int | None = None
    """Devices that share the seeds; 0: all there are; default: one."""
    out: Path = Path("runs")
    """Parent of all run folders."""


class Cell(NamedTuple):
    """One run. state: of its folder; done: its real rollouts so far, as far as a summary tells."""

    args: FinetuneArgs
    state: Literal["missing", "unfinished", "finished"]
    done: int

    def __str__(self) -> str:
        return f"{self.args.task}/{Path(self.args.real).stem}: {self.args.method}"


def main(args: CompareArgs) -> None:
    """Runs what is missing, then draws; raises UserError in the end if some cells could not run."""
    failed = compare(args)
    if args.dry:
        return
    if any(cell.done for cell in cells(args)):
        print(figures(FiguresArgs(out=args.out)).read_text())
    if failed:
        raise UserError(f"{len(failed)} of the cells did not run: {'; '.join(failed)}")


def compare(args: CompareArgs) -> list[str]:
    """Works through the cells in order; returns a line for each that could not run."""
    started, failed = time.monotonic(), []
    grid = cells(args)
    for cell in grid:
        print(f"{cell.state:10} {cell}" + (f", {cell.done} rollouts" if cell.done else ""))
    if args.dry:
        return []
    for cell in [cell for cell in grid if cell.state != "finished"]:
        if args.minutes is not None and time.monotonic() - started > 60 * args.minutes:
            print(f"stopped after {args.minutes:g} minutes; the same command goes on")
            break
        print(f"--- {cell}")
        try:
            finetune(replace(cell.args, resume=cell.state == "unfinished"))
        except UserError as error:  # the other cells may have what this one lacks
            print(f"error: {error}")
            failed.append(f"{cell}: {error}")
    return failed


def cells(args: CompareArgs) -> list[Cell]:
    """The grid, methods innermost, so that every task and real system is compared early."""
    _check(args)
    return [_cell(args, task, real, method) for task in args.tasks for real in args.reals for method in args.methods]


def _cell(args: CompareArgs, task: str, real: str, method: str) -> Cell:
    run = arguments(
        method, task=task, real=real, seed=args.seed, seeds=args.seeds, rollouts=args.rollouts,
        initial_rollouts=args.initial_rollouts, eval_every=args.eval_every, impl=args.impl, devices=args.devices,
        video=False, out=args.out,
    )  # fmt: skip
    folder = run_folder(run)
    if not (folder / CONFIG).exists():
        return Cell(run, "missing", 0)
    done = read_json(folder / _SUMMARY)["final"]["rollouts"] if (folder / _SUMMARY).exists() else 0
    return Cell(run, "finished" if done >= args.rollouts else "unfinished", done)


def _check(args: CompareArgs) -> None:
    for name, given in (("tasks", args.tasks), ("methods", args.methods), ("reals", args.reals)):
        _some(name, given)
    for task in args.tasks:
        cli.choose("--tasks", task, envs.TASKS)
    for method in args.methods:
        get_method(method)
    common.seed_list(args.seed, args.seeds)


def _some(name: str, given: Sequence[str]) -> None:
    if not given:
        raise UserError(f"--{name}: name at least one")


if __name__ == "__main__":
    cli.run_main(main, CompareArgs, __doc__ or "")
