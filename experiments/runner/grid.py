"""A grid of fine-tuning runs: its options, its cells and how far each has got."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import envs
from envs import extend, gaps
from envs.types import UserError
from experiments.runner import cells
from experiments.runner.cells import Cell, Kind, WorkArgs
from experiments.runner.finetune_args import (
    VOLATILE,
    FinetuneArgs,
    arguments,
    label,
    resolved,
    run_folder,
    with_settings,
)
from experiments.runner.options import at_least_one, check_task, not_negative, seed_list, without_repeats
from experiments.runner.start import finetune
from sgft_jax.files.disk import jsonable
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import NAMES, get_method


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
    for name, given in (("tasks", args.tasks), ("methods", args.methods), ("reals", args.reals)):
        if not given:
            raise UserError(f"--{name}: name at least one")
        without_repeats(f"--{name}", given)
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
    volatile=VOLATILE,
    finished=lambda args, summary: summary.get("final", {}).get("rollouts", 0) >= args.rollouts,
)


def cell_of(
    args: GridArgs, task: str, real: str, method: str, settings: Mapping[str, Any] | None = None, **changes: Any
) -> Cell:
    """The run of one cell, and how far it has got.

    It has the method's own defaults but for `settings`, the options of the grid, and these `changes` of its arguments.
    """
    return look_up(with_settings(replace(run_of(args, task, real, method), **changes), settings or {}))


def run_of(args: GridArgs, task: str, real: str, method: str) -> FinetuneArgs:
    """The arguments of one cell, with the method's own defaults."""
    shared = ("seed", "seeds", "rollouts", "eval_every", "impl", "devices", "out")
    options = {name: getattr(args, name) for name in shared}
    return arguments(method, task=task, real=(real,), video=False, **options)


def look_up(run: FinetuneArgs) -> Cell:
    """How far the run on the one real system of these arguments has got."""
    return cells.look_up(FINETUNING, run)
