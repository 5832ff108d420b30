"""Tune every method with the same budget: so many trials, on real systems that are not those of the comparison.

A trial is one fine-tuning run. The first one has the method's defaults, the next ones settings that papers print or
practice has shown, the others are drawn from the method's own space (`spaces.py`). Trials that are finished are
left alone, begun ones go on where they stopped: the same command, given again, does what is missing, and with more
--trials it adds some. With --halve all trials begin short, and the better half goes on to twice as many rollouts, again
and again (successive halving: Jamieson and Talwalkar 2016). When all trials of a method are finished, the options of
the best one are written down, for `experiments.compare --tuned`.
"""

import itertools
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from envs import extend, gaps
from envs.types import UserError
from experiments.runner import cli, grid, tuned
from experiments.runner.cells import Cell, check_begun, complete
from experiments.runner.finetune_args import with_settings
from experiments.runner.grid import GridArgs
from experiments.runner.options import at_least_one, prior_home, seed_list
from experiments.studies.spaces import SPACES, first, space_of
from sgft_jax.io import runs
from sgft_jax.io.log import SUMMARY
from sgft_jax.methods import NAMES

FOLDER = "tune"  # the trials have a tree of their own, which figures of the comparison do not look into


@dataclass(frozen=True)
class TuneArgs(GridArgs):
    """The budget, the same for all methods; everything not named here is as `experiments.finetune` has it."""

    methods: tuple[str, ...] = tuple(name for name in NAMES if name in SPACES)
    """Methods, in the order in which they run; by default all that have something to tune (`spaces.py`)."""
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
    halve: bool = False
    """Successive halving: the better half of the trials goes on to twice as many rollouts, until two are left at
    --rollouts. The trial with the defaults always goes on. About half the rollouts for eight trials."""


class Rung(NamedTuple):
    """So many trials run up to so many real rollouts per seed."""

    trials: int
    rollouts: int


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
    pairs, started, failed = _pairs(args), time.monotonic(), []
    print(f"budget of each method on each task: {_budget_words(args)}")
    for i in range(len(rungs(args))):
        found = [stages(args, *pair)[i:] for pair in pairs]  # empty where the rung before is not finished
        cells = [cell for stage in found for trial in (stage[0] if stage else []) for cell in trial.cells]
        check_begun(cells)
        failed += complete(cells, args, started=started)
    for task, method in pairs:
        _conclude(args, task, method)
    return failed


def rungs(args: TuneArgs) -> list[Rung]:
    """How many trials run how far, the last ones to --rollouts; one rung without --halve.

    Each rung has half as many trials as the one before, rounded up, and about twice as many rollouts: it ends at an
    evaluation, so that halving changes no curve. Raises UserError where two of them would end at the same.
    """
    counts = [args.trials]
    while args.halve and counts[-1] > 2:
        counts.append(-(-counts[-1] // 2))
    every = args.eval_every
    ends = [-(-args.rollouts // (every * 2**k)) * every for k in range(len(counts) - 1, 0, -1)] + [args.rollouts]
    if any(after <= before for before, after in itertools.pairwise(ends)):
        raise UserError(
            f"--halve: {args.trials} trials would end after {', '.join(map(str, ends))} rollouts, which do not grow; "
            "give more --rollouts, a smaller --eval-every or fewer --trials"
        )
    return list(itertools.starmap(Rung, zip(counts, ends, strict=True)))


def real_rollouts(found: Sequence[Rung]) -> int:
    """Real rollouts of one seed on one real system in all trials; those that go on begin where they stopped."""
    before = [0, *(rung.rollouts for rung in found)]
    return sum(rung.trials * (rung.rollouts - done) for rung, done in zip(found, before, strict=False))


def _budget_words(args: TuneArgs) -> str:
    found = rungs(args)
    steps = ", ".join(f"{rung.trials} trials to {rung.rollouts} rollouts" for rung in found)
    total = real_rollouts(found) * args.seeds * len(args.reals)
    return f"{steps}; seeds: {args.seeds}, real systems: {len(args.reals)}; {total:,} real rollouts in all"


def draw(
    space: Mapping[str, Sequence[Any]], leading: Sequence[dict[str, Any]], trials: int, *, key: Sequence[int]
) -> list[dict[str, Any]]:
    """The leading settings, the defaults before all, and then others of the space, at random and each at most once.

    key: what the draw depends on; of the same key, more trials begin with the same ones.
    """
    every = [leading[0] | dict(zip(space, values, strict=True)) for values in itertools.product(*space.values())]
    others = [settings for settings in every if settings not in leading]
    order = np.random.default_rng(key).permutation(len(others))
    return [*leading, *(others[i] for i in order)][:trials]


def trials(args: TuneArgs, task: str, method: str) -> list[Trial]:
    """The trials of a method on a task, and how far each has got."""
    key = (args.seed, zlib.crc32(task.encode()), zlib.crc32(method.encode()))
    drawn = draw(space_of(method), first(method), args.trials, key=key)
    if len(drawn) < args.trials:
        raise UserError(f"--trials is {args.trials}: {method} has only {len(drawn)} different ones")
    return [
        Trial(k, settings, [_look_up(args, task, real, method, k, settings) for real in args.reals])
        for k, settings in enumerate(drawn)
    ]


def _look_up(args: TuneArgs, task: str, real: str, method: str, number: int, settings: dict[str, Any]) -> Cell:
    run = grid.run_of(args, task, real, method)
    priors = prior_home(args.out, extend.name_of(task), run.preset)
    run = replace(run, prior=priors, variant=f"trial-{number}", out=args.out / FOLDER)
    return grid.look_up(with_settings(run, settings))


def stages(args: TuneArgs, task: str, method: str) -> list[list[Trial]]:
    """The trials of each rung, as far as it is known: who goes on is decided when a rung is finished."""
    found: list[list[Trial]] = []
    numbers, before = list(range(args.trials)), 0
    for rung in rungs(args):
        if found:
            scores = [score(trial, before) for trial in found[-1]]
            finished = [each for each in scores if each is not None]
            if len(finished) < len(scores):
                break
            numbers = [numbers[i] for i in keep(finished, rung.trials)]
        every = trials(replace(args, rollouts=rung.rollouts), task, method)
        found.append([every[number] for number in numbers])
        before = rung.rollouts
    return found


def keep(scores: Sequence[Score], count: int) -> list[int]:
    """Which trials go on, in order: the first, which has the defaults, and the best of the others."""
    others = sorted(range(1, len(scores)), key=lambda i: _merit(scores, i), reverse=True)
    return [0, *sorted(others[: count - 1])]


def score(trial: Trial, rollouts: int) -> Score | None:
    """How its runs went up to so many rollouts; None if one is not finished."""
    from sgft_jax.analysis.curves import area
    from sgft_jax.analysis.reading import read_curve

    if any(cell.state != "finished" for cell in trial.cells):
        return None
    areas, finals = {}, []
    for cell in trial.cells:
        curve = read_curve(cell.folder)
        inside = curve.x <= rollouts
        found = area(curve, curve.x[inside])
        assert found is not None  # a finished run has been evaluated twice at least
        areas[gaps.title(*cell.args.real)] = found.tolist()
        finals.append(curve.values[:, inside][:, -1].mean())
    return Score(float(np.mean(list(areas.values()))), float(np.mean(finals)), areas)


def best(scores: Sequence[Score]) -> int:
    """The trial of the largest area; ties go to the higher final success, then to the earlier trial."""
    return max(range(len(scores)), key=lambda i: _merit(scores, i))


def _merit(scores: Sequence[Score], i: int) -> tuple[float, float, int]:
    return scores[i].area, scores[i].final, -i


class Outcome(NamedTuple):
    """A trial, the rollouts that it was allowed, and its score up to there; None if it is not finished."""

    trial: Trial
    rollouts: int
    score: Score | None


def outcomes(args: TuneArgs, task: str, method: str) -> list[Outcome]:
    """Every trial in its last rung that is known, in order."""
    last = {
        trial.number: Outcome(trial, rung.rollouts, score(trial, rung.rollouts))
        for rung, stage in zip(rungs(args), stages(args, task, method), strict=False)
        for trial in stage
    }
    return [last[number] for number in sorted(last)]


def _conclude(args: TuneArgs, task: str, method: str) -> None:
    """Prints the trials of one method and, if all are finished, writes down which is best."""
    found = outcomes(args, task, method)
    finished = sum(each.score is not None for each in found)
    finalists = {each.trial.number: each.score for each in found if each.rollouts == args.rollouts and each.score}
    complete = finished == len(found) and len(finalists) == rungs(args)[-1].trials
    chosen = list(finalists)[best(list(finalists.values()))] if complete else None
    Console(width=120).print(_table(f"{method} on {task}", found, chosen))
    if args.dry:
        return
    if chosen is None:
        print(f"{task}/{method}: {finished} of {len(found)} trials are finished; nothing is chosen before all are")
        return
    path = tuned.write(args.out, task, method, _result(args, task, method, found, chosen))
    print(f"written: {path}; next: python -m experiments.compare --tuned --tasks {task} --methods {method}")


def _result(args: TuneArgs, task: str, method: str, found: list[Outcome], chosen: int) -> dict[str, Any]:
    """The file of one method, see docs/formats.md."""
    tried = [
        {
            "options": trial.settings, "rollouts": rollouts, **each._asdict(),
            "folders": [cell.folder for cell in trial.cells],
        }
        for trial, rollouts, each in found if each is not None
    ]  # fmt: skip
    budget = {
        "trials": args.trials, "reals": [gaps.title(real) for real in args.reals],
        "seeds": seed_list(args.seed, args.seeds), "rollouts": args.rollouts,
        "eval_every": args.eval_every, "halve": args.halve,
    }  # fmt: skip
    return {
        "task": task, "method": method, "options": found[chosen].trial.settings, "trial": chosen, "budget": budget,
        "gaps": [runs.read_own(cell.folder / SUMMARY, {"gap": dict})["gap"] for cell in found[0].trial.cells],
        "space": space_of(method), "trials": tried, "provenance": runs.provenance(),
    }  # fmt: skip


def _table(title: str, found: Sequence[Outcome], chosen: int | None) -> Table:
    """The trials with the options in which they differ, and their scores; the chosen one is marked."""
    table = Table(title=title)
    differ = [name for name in found[0].trial.settings if len({each.trial.settings[name] for each in found}) > 1]
    for column in ("trial", *differ, "rollouts", "area", "final %", ""):
        table.add_column(column, justify="right")
    for trial, rollouts, each in found:
        cells = ("-", "-") if each is None else (f"{each.area:.3f}", f"{100 * each.final:.0f}")
        note = "chosen" if trial.number == chosen else "defaults" if trial.number == 0 else ""
        own = (trial.settings[name] for name in differ)
        values = (f"{value:g}" if isinstance(value, float) else str(value) for value in own)
        table.add_row(str(trial.number), *values, str(rollouts), *cells, note)
    return table


def _pairs(args: TuneArgs) -> list[tuple[str, str]]:
    """Tasks and methods, checked."""
    grid.check(args)
    at_least_one(args, "trials")
    return [(task, method) for task in args.tasks for method in args.methods]


if __name__ == "__main__":
    cli.run_main(main, TuneArgs, __doc__ or "")
