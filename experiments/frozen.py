"""The frozen test: every run behind the tables of docs/results.md, in one command.

It makes the priors, runs each method on the test gaps of each task (envs/gaps/test/) and prints the scoreboard. Each
unit of work is a process of its own; --jobs of them run at once on each of --gpus. Units that are finished are left
alone, begun ones go on where they stopped: the same command, given again, does what is missing.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import envs
from envs import gaps
from envs.gaps import SIM
from experiments import cli, grid
from experiments.cells import Cell, complete
from experiments.grid import GridArgs
from experiments.options import at_least_one
from experiments.pretrain import PretrainArgs, pretrain, run_folder
from experiments.scoreboard import ScoreboardArgs, board
from sgft_jax.io.runs import CONFIG
from sgft_jax.methods import DEFAULT, NAMES, get_method
from sgft_jax.presets import DEFAULT_PRESET, PRESETS, preset_of
from sgft_jax.types import UserError

TASKS = ("push", "insert", "hammer")
SOFT = ("push-towel", "push-ball")  # two further gaps, each a task with a simulator of its own
EVERYWHERE = (DEFAULT, "sac", "mbpo", "sgft-sac", "sysid", "recurrent", "tdmpc2")  # on all test gaps
ON_SOFT = (DEFAULT, "sac", "mbpo", "sgft-sac")
LEFT_OUT = ("sgft-parts",)  # SGFT-SAC by default; experiments.factorial takes it apart
AGAIN = "again"  # the default method twice, with the same priors and other seeds: how far apart chance sets two rows
ROLLOUTS, EVAL_EVERY = 20, 2
_SUMMARY = "summary.json"
_PAUSE = 1.0  # seconds between looks at the processes


@dataclass(frozen=True)
class FrozenArgs:
    """What runs is frozen; these say which part of it, and where."""

    only: tuple[str, ...] = ()
    """Units by the beginning of their names, such as push or push/guarded, and the priors that they need."""
    jobs: int = 1
    """Processes at once on each GPU, or in all without --gpus. Four to eight keep an H100 busy."""
    gpus: int = 0
    """GPUs to share the processes; 0: the processes see whatever there is."""
    minutes: float | None = None
    """Begin no new unit after so many minutes."""
    dry: bool = False
    """Only list the units and what is missing."""
    priors: int = 12
    """Priors of a task, with consecutive seeds from 0, and seeds of each run on all test gaps."""
    fewer: int = 6
    """The same for methods that need priors of their own, for towel and ball, and for runs on two gaps a task."""
    unit: str = ""
    """Expert: do this one unit in this process, and nothing else."""
    impl: grid.Impl = "auto"
    """Physics engine, as in fine-tuning."""
    out: Path = Path("runs")
    """Parent of all run folders; what the processes print goes to <out>/frozen."""


State = Literal["missing", "unfinished", "finished"]


class Unit(NamedTuple):
    """A piece of work that one process does. needs: names of the units that must be finished before."""

    name: str
    needs: tuple[str, ...]
    state: Callable[[], State]
    work: Callable[[], object]


def main(args: FrozenArgs) -> None:
    """Does what is missing, then prints the scoreboard; raises UserError if some units failed."""
    at_least_one(args, "jobs", "priors", "fewer")
    every = {unit.name: unit for unit in units(args)}
    if args.unit:
        cli.choose("--unit", args.unit, every).work()
        return
    chosen = select(every, args.only)
    for unit in chosen:
        print(f"{unit.state():10} {unit.name}")
    if args.dry:
        return
    failed = Pool(args, [unit for unit in chosen if unit.state() != "finished"]).work()
    if any(every[f"{task}/{DEFAULT}"].state() == "finished" for task in TASKS):  # what others are compared with
        files = tuple(_test_file(task) for task in TASKS)
        print(board(ScoreboardArgs(gaps=files, out=args.out)))
    if failed:
        raise UserError(f"failed, see {args.out / 'frozen'}: {', '.join(failed)}")


# --- what there is to do ----------------------------------------------------------------------------------------------


def units(args: FrozenArgs) -> Iterator[Unit]:
    """All units, in the order in which they are begun."""
    for preset in dict.fromkeys(preset_of(get_method(method)) for method in EVERYWHERE):
        for task in TASKS:
            yield _prior_unit(args, task, preset)
        if preset == DEFAULT_PRESET:
            yield from (_prior_unit(args, task, preset) for task in SOFT)
    for method in EVERYWHERE:
        yield from (_run_unit(args, task, method, (SIM, _test_file(task))) for task in TASKS)
    yield from (_run_unit(args, task, DEFAULT, (SIM, _test_file(task)), again=True) for task in TASKS)
    for method in ON_SOFT:
        yield from (_run_unit(args, task, method, ("default",), few=True) for task in SOFT)
    for method in (name for name in NAMES if name not in (*EVERYWHERE, *LEFT_OUT)):
        yield from (_run_unit(args, task, method, two_gaps(task), few=True) for task in TASKS)


def two_gaps(task: str) -> tuple[str, str]:
    """The first partial and the first failed test gap of a task."""
    found = list(gaps.read_file(_test_file(task)).values())
    first = [next(gap.name for gap in found if gap.stratum == stratum) for stratum in ("partial", "failed")]
    return f"{_test_file(task)}:{first[0]}", f"{_test_file(task)}:{first[1]}"


def _test_file(task: str) -> Path:
    """The frozen set, as it is named from here if that is shorter: a run may then go on in another checkout."""
    path = Path(envs.__file__).parent / "gaps" / "test" / f"{task}.toml"
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _priors(args: FrozenArgs, task: str, preset: str) -> PretrainArgs:
    seeds = args.priors if preset == DEFAULT_PRESET and task in TASKS else args.fewer
    return PretrainArgs(
        task=task, preset=preset, seeds=seeds, config=PRESETS[preset], video=False, impl=args.impl, out=args.out
    )


def _prior_unit(args: FrozenArgs, task: str, preset: str) -> Unit:
    own = _priors(args, task, preset)

    def state() -> State:
        if (run_folder(own) / _SUMMARY).exists():
            return "finished"
        return "unfinished" if (run_folder(own) / CONFIG).exists() else "missing"

    return Unit(_prior_name(task, preset), (), state, lambda: pretrain(replace(own, resume=state() == "unfinished")))


def _run_unit(
    args: FrozenArgs, task: str, method: str, reals: Sequence[str | Path], *, again: bool = False, few: bool = False
) -> Unit:
    preset = preset_of(get_method(method))
    own = _priors(args, task, preset)
    seeds = min(own.seeds, args.fewer) if few else own.seeds
    shared = GridArgs(
        tasks=(task,), methods=(method,), reals=gaps.each(tuple(map(str, reals))), seeds=seeds,
        seed=own.seeds if again else 0, rollouts=ROLLOUTS, eval_every=EVAL_EVERY, impl=args.impl, out=args.out,
    )  # fmt: skip

    def cells() -> list[Cell]:
        runs = (grid.run_of(shared, task, real, method) for real in shared.reals)
        changes = {"prior": run_folder(own), "variant": AGAIN if again else ""}
        return [grid.look_up(replace(run, **changes)) for run in runs]

    def state() -> State:
        states: set[State] = {cell.state for cell in cells()}
        return states.pop() if len(states) == 1 else "unfinished"

    def work() -> None:
        if failed := complete(cells(), shared):
            raise UserError("; ".join(failed))

    name = f"{task}/{method}" + (f"-{AGAIN}" if again else "")
    return Unit(name, (_prior_name(task, preset),), state, work)


def _prior_name(task: str, preset: str) -> str:
    return f"{task}/prior-{preset}"


def select(every: dict[str, Unit], only: Sequence[str]) -> list[Unit]:
    """The units whose names begin with one of these words, and what they need; all without a word."""
    for word in only:
        if not any(name.startswith(word) for name in every):
            raise UserError(f"--only {word}: no unit begins like this; --dry lists them all")
    named = {name for name in every if not only or name.startswith(tuple(only))}
    needed = {need for name in named for need in every[name].needs}
    return [unit for name, unit in every.items() if name in named | needed]


# --- doing it ---------------------------------------------------------------------------------------------------------


class _Running(NamedTuple):
    process: subprocess.Popen
    gpu: int
    since: float


class Pool:
    """Impure: runs units as processes, each after those that it needs.

    waiting: what has not begun, in order. failed: names of the units that failed, or need one that did.
    """

    def __init__(self, args: FrozenArgs, waiting: list[Unit]) -> None:
        self.args, self.waiting, self.started = args, waiting, time.monotonic()
        self.running: dict[str, _Running] = {}
        self.failed: list[str] = []
        self.folder = args.out / "frozen"
        self.folder.mkdir(parents=True, exist_ok=True)

    def work(self) -> list[str]:
        """Goes on until nothing is left that can be done; returns `failed`."""
        try:
            while self.waiting or self.running:
                self._collect()
                self._give_up()
                self._begin()
                time.sleep(_PAUSE)
        finally:
            for own in self.running.values():
                own.process.terminate()
        return self.failed

    def _collect(self) -> None:
        """Takes note of the processes that have ended."""
        for name in [name for name, own in self.running.items() if own.process.poll() is not None]:
            own = self.running.pop(name)
            self.failed += [name] if own.process.returncode else []
            self._say(f"{'failed' if own.process.returncode else 'done'} {name}, {time.monotonic() - own.since:.0f} s")

    def _give_up(self) -> None:
        """Drops what needs a unit that failed, and all that waits when the time is up."""
        lost = [unit for unit in self.waiting if set(unit.needs) & set(self.failed)]
        self.failed += [unit.name for unit in lost]
        self.waiting = [unit for unit in self.waiting if unit not in lost]
        minutes = self.args.minutes
        if self.waiting and minutes is not None and time.monotonic() - self.started > 60 * minutes:
            self._say(f"no new units after {minutes:g} minutes; the same command goes on")
            self.waiting = []

    def _begin(self) -> None:
        """Starts what is ready, on the GPU with the fewest processes, as long as there is room."""
        unfinished = {unit.name for unit in self.waiting} | set(self.running)
        gpus = range(max(self.args.gpus, 1))
        ready = [unit for unit in self.waiting if not set(unit.needs) & unfinished]
        for unit in ready[: len(gpus) * self.args.jobs - len(self.running)]:
            gpu = min(gpus, key=[own.gpu for own in self.running.values()].count)
            self.waiting.remove(unit)
            self.running[unit.name] = _Running(self._process(unit, gpu), gpu, time.monotonic())
            self._say(f"begun {unit.name}")

    def _process(self, unit: Unit, gpu: int) -> subprocess.Popen:
        words = [f"--{name}={getattr(self.args, name)}" for name in ("priors", "fewer", "impl", "out")]
        environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", **os.environ}
        if self.args.gpus:
            environment["CUDA_VISIBLE_DEVICES"] = str(gpu)
        with (self.folder / f"{unit.name.replace('/', '-')}.log").open("w") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "experiments.frozen", "--unit", unit.name, *words],
                env=environment, stdout=log, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def _say(self, words: str) -> None:
        print(f"{time.monotonic() - self.started:6.0f} s  {words}", flush=True)


if __name__ == "__main__":
    cli.run_main(main, FrozenArgs, __doc__ or "")
