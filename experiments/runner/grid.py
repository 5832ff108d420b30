"""A grid of fine-tuning runs: its options, its cells and how far each has got."""

from dataclasses import dataclass
from pathlib import Path

import envs
from envs import extend, gaps
from envs.types import UserError
from experiments.finetune import finetune
from experiments.runner import cells
from experiments.runner.cells import Cell, Kind
from experiments.runner.finetune_args import VOLATILE, FinetuneArgs, arguments, label, resolved, run_folder
from experiments.runner.options import Impl, at_least_one, check_task, not_negative, seed_list, without_repeats
from sgft_jax.files.jsonfile import jsonable
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import NAMES, get_method


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


def run_of(args: GridArgs, task: str, real: str, method: str) -> FinetuneArgs:
    """The run of one cell, with the method's own defaults."""
    return arguments(
        method, task=task, real=(real,), seed=args.seed, seeds=args.seeds, rollouts=args.rollouts,
        eval_every=args.eval_every, impl=args.impl, devices=args.devices, video=False, out=args.out,
    )  # fmt: skip


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


def look_up(run: FinetuneArgs) -> Cell:
    """How far the run on the one real system of these arguments has got."""
    return cells.look_up(FINETUNING, run)
