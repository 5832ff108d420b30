"""Tune every method with the same budget: so many trials, on real systems that are not those of the comparison.

A trial is one fine-tuning run. The first one has the method's defaults, the others are drawn from the method's own
space (docs/methods.md). Trials that are finished are left alone, begun ones go on where they stopped: the same command,
given again, does what is missing, and with more --trials it adds some. When all trials of a method are finished, the
options of the best one are written down, for `experiments.compare --tuned`.
"""

import itertools
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from envs import gaps
from experiments import cli, grid, tuned
from experiments.finetune_args import with_settings
from experiments.grid import Cell, GridArgs
from experiments.options import prior_home, seed_list
from experiments.spaces import defaults, space_of
from sgft_jax import extend
from sgft_jax.io import runs
from sgft_jax.io.jsonfile import read_json
from sgft_jax.io.log import SUMMARY
from sgft_jax.types import UserError

FOLDER = "tune"  # the trials have a tree of their own, which figures of the comparison do not look into


@dataclass(frozen=True)
class TuneArgs(GridArgs):
    """The budget, the same for all methods; everything not named here is as `experiments.finetune` has it."""

    trials: int = 8
    """Trials of each method on each task, that with the defaults included."""
    reals: tuple[str, ...] = ("mild",)
    """Real systems to tune on, others than those of the comparison: mild, default, hard, or .toml/.json files."""
    seed: int = 100
    """First seed of the runs, which also decides the draw of the trials."""
    seeds: int = 3
    """Seeds of each run, all in one program."""
    rollouts: int = 40
    """Real rollouts per seed, the initial ones included; may grow later."""


class Trial(NamedTuple):
    """One setting of the options in a method's space, and its runs: one for each real system."""

    number: int
    settings: dict[str, Any]
    cells: list[Cell]


class Score(NamedTuple):
    """Of a trial, means over seeds and real systems, and the areas of every seed by real system.

    area: under the success curve over real transitions, from 0 to 1. final: success in the last evaluation.
    """

    area: float
    final: float
    areas: dict[str, list[float]]


def main(args: TuneArgs) -> None:
    """Runs what is missing, then chooses; raises UserError in the end if some trials could not run."""
    if failed := tune(args):
        raise UserError(f"{len(failed)} of the trials did not run: {'; '.join(failed)}")


def tune(args: TuneArgs) -> list[str]:
    """Works through the trials, then writes and prints the results; returns a line for each run that failed."""
    args = replace(args, reals=gaps.each(args.reals))
    cells = [cell for task, method in _pairs(args) for trial in trials(args, task, method) for cell in trial.cells]
    grid.check_begun(cells)
    failed = grid.work(cells, args)
    for task, method in _pairs(args):
        _conclude(args, task, method)
    return failed


def draw(
    space: Mapping[str, Sequence[Any]], default: dict[str, Any], trials: int, *, key: Sequence[int]
) -> list[dict[str, Any]]:
    """The default and then other settings of the space, at random and each at most once.

    key: what the draw depends on; of the same key, more trials begin with the same ones.
    """
    every = [dict(zip(space, values, strict=True)) for values in itertools.product(*space.values())]
    others = [settings for settings in every if settings != default]
    order = np.random.default_rng(key).permutation(len(others))
    return [default, *(others[i] for i in order[: trials - 1])]


def trials(args: TuneArgs, task: str, method: str) -> list[Trial]:
    """The trials of a method on a task, and how far each has got."""
    space = space_of(method)
    if args.trials > (size := math.prod(map(len, space.values()))):
        raise UserError(f"--trials is {args.trials}: {method} has only {size} different ones")
    key = (args.seed, zlib.crc32(task.encode()), zlib.crc32(method.encode()))
    drawn = draw(space, defaults(method), args.trials, key=key)
    return [
        Trial(k, settings, [_look_up(args, task, real, method, k, settings) for real in args.reals])
        for k, settings in enumerate(drawn)
    ]


def _look_up(args: TuneArgs, task: str, real: str, method: str, number: int, settings: dict[str, Any]) -> Cell:
    run = grid.run_of(args, task, real, method)
    priors = prior_home(args.out, extend.name_of(task), run.preset)
    run = replace(run, prior=priors, variant=f"trial-{number}", out=args.out / FOLDER)
    return grid.look_up(with_settings(run, settings))


def score(trial: Trial, rollouts: int) -> Score | None:
    """How its runs went up to so many rollouts; None if one is not finished."""
    from sgft_jax.analysis.curves import area, read_curve

    if any(cell.state != "finished" for cell in trial.cells):
        return None
    areas, finals = {}, []
    for cell in trial.cells:
        curve = read_curve(cell.folder)
        inside = curve.rollouts <= rollouts
        found = area(curve, curve.rollouts[inside])
        assert found is not None  # a finished run has been evaluated twice at least
        areas[gaps.title(*cell.args.real)] = found.tolist()
        finals.append(curve.values[:, inside][:, -1].mean())
    return Score(float(np.mean(list(areas.values()))), float(np.mean(finals)), areas)


def best(scores: Sequence[Score]) -> int:
    """The trial of the largest area; ties go to the higher final success, then to the earlier trial."""
    return max(range(len(scores)), key=lambda i: (scores[i].area, scores[i].final, -i))


def _conclude(args: TuneArgs, task: str, method: str) -> None:
    """Prints the trials of one method and, if all are finished, writes down which is best."""
    found = trials(args, task, method)
    scores = [score(trial, args.rollouts) for trial in found]
    finished = [each for each in scores if each is not None]
    complete = len(finished) == len(found)
    chosen = best(finished) if complete else None
    Console(width=120).print(_table(f"{method} on {task}", found, scores, chosen))
    if args.dry:
        return
    if chosen is None:
        print(f"{task}/{method}: {len(finished)} of {len(found)} trials are finished; nothing is chosen before all are")
        return
    path = tuned.write(args.out, task, method, _result(args, task, method, found, finished, chosen))
    print(f"written: {path}; next: python -m experiments.compare --tuned --tasks {task} --methods {method}")


def _result(
    args: TuneArgs, task: str, method: str, found: list[Trial], scores: list[Score], chosen: int
) -> dict[str, Any]:
    """The file of one method, see docs/formats.md."""
    tried = [
        {"options": trial.settings, **each._asdict(), "folders": [cell.folder for cell in trial.cells]}
        for trial, each in zip(found, scores, strict=True)
    ]
    budget = {
        "trials": args.trials, "reals": [gaps.title(real) for real in args.reals],
        "seeds": seed_list(args.seed, args.seeds), "rollouts": args.rollouts,
        "eval_every": args.eval_every,
    }  # fmt: skip
    return {
        "task": task, "method": method, "options": found[chosen].settings, "trial": chosen, "budget": budget,
        "gaps": [read_json(cell.folder / SUMMARY)["gap"] for cell in found[0].cells],
        "space": space_of(method), "trials": tried, "provenance": runs.provenance(),
    }  # fmt: skip


def _table(title: str, found: Sequence[Trial], scores: Sequence[Score | None], chosen: int | None) -> Table:
    """The trials with their options and scores; the chosen one is marked."""
    table = Table(title=title)
    for column in ("trial", *found[0].settings, "area", "final %", ""):
        table.add_column(column, justify="right")
    for trial, each in zip(found, scores, strict=True):
        cells = ("-", "-") if each is None else (f"{each.area:.3f}", f"{100 * each.final:.0f}")
        note = "chosen" if trial.number == chosen else "defaults" if trial.number == 0 else ""
        values = ("None" if value is None else f"{value:g}" for value in trial.settings.values())
        table.add_row(str(trial.number), *values, *cells, note)
    return table


def _pairs(args: TuneArgs) -> list[tuple[str, str]]:
    """Tasks and methods, checked."""
    grid.check(args)
    if args.trials < 1:
        raise UserError(f"--trials is {args.trials}: must be at least 1")
    return [(task, method) for task in args.tasks for method in args.methods]


if __name__ == "__main__":
    cli.run_main(main, TuneArgs, __doc__ or "")
