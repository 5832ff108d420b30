"""The frozen test: every run behind the tables of docs/results.md, in one command.

It makes the priors, runs each method on the test gaps of each task (envs/gaps/test/) and prints the scoreboard. Each
unit of work is a process of its own; --jobs of them run at once on each of --gpus. Units that are finished are left
alone, begun ones go on where they stopped: the same command, given again, does what is missing.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import envs
from envs import gaps
from envs.gaps import SIM
from envs.types import UserError
from experiments.pretrain import PretrainArgs, pretrain, run_folder
from experiments.runner import cli, grid
from experiments.runner.grid import Cell, GridArgs, work
from experiments.runner.options import Impl, at_least_one, not_negative, prior_folders
from experiments.studies.scoreboard import ScoreboardArgs, board
from sgft_jax.io.log import SUMMARY
from sgft_jax.io.runs import CONFIG, check_folder
from sgft_jax.methods import DEFAULT, NAMES, get_method
from sgft_jax.presets import DEFAULT_PRESET, PRESETS, preset_of

TASKS = ("push", "insert", "hammer")
SOFT = ("push-towel", "push-ball")  # two further gaps, each a task with a simulator of its own
EVERYWHERE = (DEFAULT, "sac", "mbpo", "sgft-sac", "sysid", "recurrent", "tdmpc2")  # on all test gaps
ON_SOFT = (DEFAULT, "sac", "mbpo", "sgft-sac")
LEFT_OUT = ("sgft-parts",)  # SGFT-SAC by default; experiments.studies.factorial takes it apart
AGAIN = "again"  # the default method twice, with the same priors and other seeds: how far apart chance sets two rows
ROLLOUTS, EVAL_EVERY = 20, 2
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
    split: int = 1
    """Processes for each unit: they share the seeds of its priors, or the real systems of its run. With more GPUs than
    units, a long unit ends sooner. Priors that an earlier command began in one process stay together."""
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
    impl: Impl = "auto"
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
    at_least_one(args, "jobs", "split", "priors", "fewer")
    not_negative(args, "gpus", "minutes")
    check_folder(args.out / "frozen")
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
    if any(_finished(every, f"{task}/{DEFAULT}") for task in TASKS):  # what others are compared with
        files = tuple(_test_file(task) for task in TASKS)
        print(board(ScoreboardArgs(gaps=files, out=args.out)))
    if failed:
        raise UserError(f"failed, see {args.out / 'frozen'}: {', '.join(failed)}")


# --- what there is to do ----------------------------------------------------------------------------------------------


def units(args: FrozenArgs) -> Iterator[Unit]:
    """All units, in the order in which they are begun."""
    others = [name for name in NAMES if name not in (*EVERYWHERE, *LEFT_OUT)]
    for preset in dict.fromkeys(preset_of(get_method(method)) for method in (*EVERYWHERE, *others)):
        for task in (*TASKS, *(SOFT if preset == DEFAULT_PRESET else ())):
            yield from _prior_units(args, task, preset)
    for method, task in product(EVERYWHERE, TASKS):
        yield from _run_units(args, task, method, (SIM, _test_file(task)))
    for task in TASKS:
        yield from _run_units(args, task, DEFAULT, (SIM, _test_file(task)), again=True)
    for method, task in product(ON_SOFT, SOFT):
        yield from _run_units(args, task, method, ("default",), few=True)
    for method, task in product(others, TASKS):
        yield from _run_units(args, task, method, two_gaps(task), few=True)


def two_gaps(task: str) -> list[str]:
    """The first partial and the first failed test gap of a task."""
    test = gaps.read_file(_test_file(task)).values()
    first = (next(gap.name for gap in test if gap.stratum == stratum) for stratum in ("partial", "failed"))
    return [f"{_test_file(task)}:{name}" for name in first]


def _test_file(task: str) -> Path:
    """The frozen set, as it is named from here if that is shorter: a run may then go on in another checkout."""
    path = Path(envs.__file__).parent / "gaps" / "test" / f"{task}.toml"
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _prior_sets(args: FrozenArgs, task: str, preset: str) -> list[PretrainArgs]:
    """The runs that make the priors of a task, with consecutive seeds: one, or as many as --split says."""
    seeds = args.priors if preset == DEFAULT_PRESET and task in TASKS else args.fewer
    whole = PretrainArgs(
        task=task, preset=preset, seeds=seeds, config=PRESETS[preset], video=False, impl=args.impl, out=args.out
    )
    if args.split == 1 or (run_folder(whole) / CONFIG).exists():
        return [whole]
    bounds = [seeds * i // args.split for i in range(args.split + 1)]
    return [replace(whole, seed=low, seeds=high - low) for low, high in pairwise(bounds) if high > low]


def _prior_units(args: FrozenArgs, task: str, preset: str) -> Iterator[Unit]:
    sets = _prior_sets(args, task, preset)
    for run, name in zip(sets, _part_names(f"{task}/prior-{preset}", len(sets)), strict=True):
        yield Unit(name, (), partial(_prior_state, run), partial(_make_priors, run))


def _prior_state(run: PretrainArgs) -> State:
    if (run_folder(run) / SUMMARY).exists():
        return "finished"
    return "unfinished" if (run_folder(run) / CONFIG).exists() else "missing"


def _make_priors(run: PretrainArgs) -> None:
    pretrain(replace(run, resume=_prior_state(run) == "unfinished"))


def _run_units(
    args: FrozenArgs, task: str, method: str, reals: Sequence[str | Path], *, again: bool = False, few: bool = False
) -> Iterator[Unit]:
    preset = preset_of(get_method(method))
    sets = _prior_sets(args, task, preset)
    needs = _part_names(f"{task}/prior-{preset}", len(sets))
    priors = sum(run.seeds for run in sets)
    systems = gaps.expand(tuple(map(str, reals)))
    shares = [systems[i :: args.split] for i in range(min(args.split, len(systems)))]
    home = run_folder(sets[0]) if len(sets) == 1 else run_folder(sets[0]).parent
    whole = f"{task}/{method}" + (f"-{AGAIN}" if again else "")
    base = GridArgs(rollouts=ROLLOUTS, eval_every=EVAL_EVERY, impl=args.impl, out=args.out)
    seeds = min(priors, args.fewer) if few else priors
    for share, name in zip(shares, _part_names(whole, len(shares)), strict=True):
        shared = replace(base, tasks=(task,), methods=(method,), reals=share, seeds=seeds, seed=priors if again else 0)
        cells = partial(_cells, shared, prior=home, variant=AGAIN if again else "")
        yield Unit(name, needs, partial(_run_state, cells), partial(_complete, cells, shared, home, priors))


def _cells(args: GridArgs, **changes: Any) -> list[Cell]:
    (task,), (method,) = args.tasks, args.methods
    return [grid.cell_of(args, task, real, method, **changes) for real in args.reals]


def _run_state(cells: Callable[[], list[Cell]]) -> State:
    states: set[State] = {cell.state for cell in cells()}
    return states.pop() if len(states) == 1 else "unfinished"


def _complete(cells: Callable[[], list[Cell]], shared: GridArgs, home: Path, priors: int) -> None:
    count = len(prior_folders(home, out=shared.out, task=shared.tasks[0], preset=""))
    if count != priors:  # seeds would start from others than the same seeds of other methods
        raise UserError(f"{home}: holds {count} priors, not {priors}; move those of other runs away")
    work(cells(), shared)


def _part_names(name: str, n: int) -> tuple[str, ...]:
    """What the n processes of a unit are called: the name itself if there is one, else name.1, name.2, ..."""
    return (name,) if n == 1 else tuple(f"{name}.{i + 1}" for i in range(n))


def _finished(every: Mapping[str, Unit], name: str) -> bool:
    """Whether all processes of a unit are done."""
    return all(unit.state() == "finished" for unit in every.values() if f"{unit.name}.".startswith(f"{name}."))


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
            for running in self.running.values():
                running.process.terminate()
        return self.failed

    def _collect(self) -> None:
        """Takes note of the processes that have ended."""
        for name in [name for name, running in self.running.items() if running.process.poll() is not None]:
            process, _, since = self.running.pop(name)
            self.failed += [name] if process.returncode else []
            self._say(f"{'failed' if process.returncode else 'done'} {name}, {time.monotonic() - since:.0f} s")

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
            gpu = min(gpus, key=[running.gpu for running in self.running.values()].count)
            self.waiting.remove(unit)
            self.running[unit.name] = _Running(self._process(unit, gpu), gpu, time.monotonic())
            self._say(f"begun {unit.name}")

    def _process(self, unit: Unit, gpu: int) -> subprocess.Popen:
        command = [sys.executable, "-m", "experiments.studies.frozen", "--unit", unit.name]
        command += [f"--{name}={getattr(self.args, name)}" for name in ("split", "priors", "fewer", "impl", "out")]
        environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", **os.environ}
        if self.args.gpus:
            environment["CUDA_VISIBLE_DEVICES"] = str(gpu)
        with (self.folder / f"{unit.name.replace('/', '-')}.log").open("w") as log:
            return subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)

    def _say(self, words: str) -> None:
        print(f"{time.monotonic() - self.started:6.0f} s  {words}", flush=True)


if __name__ == "__main__":
    cli.run_main(main, FrozenArgs, __doc__ or "")
