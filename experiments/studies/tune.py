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

from envs import extend, gaps
from envs.types import UserError
from experiments.runner import cli, grid, tuned
from experiments.runner.grid import Cell, GridArgs, check_begun, complete, refuse
from experiments.runner.options import at_least_one, prior_home, seed_list
from experiments.studies.spaces import SPACES, first, space_of
from sgft_jax.analysis.curves import area
from sgft_jax.analysis.reading import read_curve
from sgft_jax.io import runs
from sgft_jax.io.log import SUMMARY
from sgft_jax.methods import NAMES, get_method
from sgft_jax.presets import preset_of

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
    rollouts: int = 40
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


class Outcome(NamedTuple):
    """A trial, the rollouts that it was allowed, and its score up to there; None if it is not finished."""

    trial: Trial
    rollouts: int
    score: Score | None


def tune(args: TuneArgs) -> None:
    """Works through the trials, then writes and prints the results; raises UserError in the end if some did not run."""
    args = replace(args, reals=gaps.expand(args.reals))
    grid.check(args)
    at_least_one(args, "trials")
    pairs, started, failed = list(itertools.product(args.tasks, args.methods)), time.monotonic(), []
    print(f"budget of each method on each task: {_budget_words(args)}")
    for i in range(len(rungs(args))):
        begun = [stages(args, *pair)[i:] for pair in pairs]  # empty where the rung before is not finished
        cells = [cell for stage in begun for outcome in (stage[0] if stage else []) for cell in outcome.trial.cells]
        check_begun(cells)
        failed += complete(cells, args, started=started)
    for task, method in pairs:
        _conclude(args, task, method)
    refuse(failed, "trials")


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


def real_rollouts(steps: Sequence[Rung]) -> int:
    """Real rollouts of one seed on one real system in all trials; those that go on begin where they stopped."""
    before = [0, *(rung.rollouts for rung in steps)]
    return sum(rung.trials * (rung.rollouts - done) for rung, done in zip(steps, before, strict=False))


def _budget_words(args: TuneArgs) -> str:
    words = ", ".join(f"{trials} trials to {rollouts} rollouts" for trials, rollouts in rungs(args))
    total = real_rollouts(rungs(args)) * args.seeds * len(args.reals)
    return f"{words}; seeds: {args.seeds}, real systems: {len(args.reals)}; {total:,} real rollouts in all"


def draw(
    space: Mapping[str, Sequence[Any]], leading: Sequence[dict[str, Any]], trials: int, *, key: Sequence[int]
) -> list[dict[str, Any]]:
    """The leading settings, the defaults before all, and then others of the space, at random and each at most once.

    key: what the draw depends on; of the same key, more trials begin with the same ones.
    """
    product = (leading[0] | dict(zip(space, values, strict=True)) for values in itertools.product(*space.values()))
    others = [settings for settings in product if settings not in leading]
    order = np.random.default_rng(key).permutation(len(others))
    return [*leading, *(others[i] for i in order)][:trials]


def trials(args: TuneArgs, task: str, method: str) -> list[Trial]:
    """The trials of a method on a task, and how far each has got."""
    key = (args.seed, zlib.crc32(task.encode()), zlib.crc32(method.encode()))
    drawn = draw(space_of(method), first(method), args.trials, key=key)
    if len(drawn) < args.trials:
        raise UserError(f"--trials is {args.trials}: {method} has only {len(drawn)} different ones")
    prior = prior_home(args.out, extend.name_of(task), preset_of(get_method(method)))

    def cell(real: str, k: int, settings: dict[str, Any]) -> Cell:
        changes = {"prior": prior, "variant": f"trial-{k}", "out": args.out / FOLDER}
        return grid.cell_of(args, task, real, method, settings, **changes)

    return [Trial(k, settings, [cell(real, k, settings) for real in args.reals]) for k, settings in enumerate(drawn)]


def stages(args: TuneArgs, task: str, method: str) -> list[list[Outcome]]:
    """The trials of each rung, as far as it is known: who goes on is decided when a rung is finished."""
    known: list[list[Outcome]] = []
    numbers = list(range(args.trials))
    for rung in rungs(args):
        if known:
            scores = [outcome.score for outcome in known[-1] if outcome.score is not None]
            if len(scores) < len(known[-1]):
                break
            numbers = [numbers[i] for i in keep(scores, rung.trials)]
        drawn = trials(replace(args, rollouts=rung.rollouts), task, method)
        known.append([Outcome(drawn[i], rung.rollouts, score(drawn[i], rung.rollouts)) for i in numbers])
    return known


def keep(scores: Sequence[Score], count: int) -> list[int]:
    """Which trials go on, in order: the first, which has the defaults, and the best of the others."""
    others = sorted(range(1, len(scores)), key=lambda i: scores[i][:2], reverse=True)
    return [0, *sorted(others[: count - 1])]


def score(trial: Trial, rollouts: int) -> Score | None:
    """How its runs went up to so many rollouts; None if one is not finished."""
    if any(cell.state != "finished" for cell in trial.cells):
        return None
    areas, finals = {}, []
    for cell in trial.cells:
        curve = read_curve(cell.folder)
        inside = curve.x <= rollouts
        by_seed = area(curve, curve.x[inside])
        assert by_seed is not None  # a finished run has been evaluated twice at least
        areas[gaps.title(*cell.args.real)] = by_seed.tolist()
        finals.append(curve.values[:, inside][:, -1].mean())
    return Score(float(np.mean(list(areas.values()))), float(np.mean(finals)), areas)


def best(scores: Sequence[Score]) -> int:
    """The trial of the largest area; ties go to the higher final success, then to the earlier trial."""
    return max(range(len(scores)), key=lambda i: scores[i][:2])  # the first of several


def _conclude(args: TuneArgs, task: str, method: str) -> None:
    """Prints the trials of one method and, if all are finished, writes down which is best."""
    last = {outcome.trial.number: outcome for stage in stages(args, task, method) for outcome in stage}
    tried = [last[number] for number in sorted(last)]
    finished = sum(outcome.score is not None for outcome in tried)
    finalists = {trial.number: scored for trial, rollouts, scored in tried if rollouts == args.rollouts and scored}
    complete = finished == len(tried) and len(finalists) == rungs(args)[-1].trials
    chosen = list(finalists)[best(list(finalists.values()))] if complete else None
    print("\n".join([f"{method} on {task}", *_table(tried, chosen)]))
    if args.dry:
        return
    if chosen is None:
        print(f"{task}/{method}: {finished} of {len(tried)} trials are finished; nothing is chosen before all are")
        return
    path = tuned.write(args.out, task, method, _result(args, task, method, tried, chosen))
    print(f"written: {path}; next: python -m experiments.compare --tuned --tasks {task} --methods {method}")


def _result(args: TuneArgs, task: str, method: str, tried: list[Outcome], chosen: int) -> dict[str, Any]:
    """The file of one method, see docs/formats.md."""
    trials = [
        {"options": trial.settings, "rollouts": n, **scored._asdict(), "folders": [c.folder for c in trial.cells]}
        for trial, n, scored in tried
        if scored is not None
    ]
    reals = [gaps.title(real) for real in args.reals]
    budget = {"trials": args.trials, "reals": reals, "seeds": seed_list(args.seed, args.seeds)}
    budget |= {name: getattr(args, name) for name in ("rollouts", "eval_every", "halve")}
    return {
        "task": task,
        "method": method,
        "options": tried[chosen].trial.settings,
        "trial": chosen,
        "budget": budget,
        "gaps": [runs.read_own(cell.folder / SUMMARY, {"gap": dict})["gap"] for cell in tried[0].trial.cells],
        "space": space_of(method),
        "trials": trials,
        "provenance": runs.provenance(),
    }


def _table(tried: Sequence[Outcome], chosen: int | None) -> list[str]:
    """The trials with the options in which they differ, and their scores, a line each; the chosen one is marked."""
    options = [outcome.trial.settings for outcome in tried]
    differ = [name for name in options[0] if len({settings[name] for settings in options}) > 1]
    rows = [["trial", *differ, "rollouts", "area", "final %", ""]]
    for trial, rollouts, scored in tried:
        cells = ("-", "-") if scored is None else (f"{scored.area:.3f}", f"{100 * scored.final:.0f}")
        note = "chosen" if trial.number == chosen else "defaults" if trial.number == 0 else ""
        values = [trial.settings[name] for name in differ]
        words = (f"{value:g}" if isinstance(value, float) else str(value) for value in values)
        rows.append([str(trial.number), *words, str(rollouts), *cells, note])
    return cli.columns(rows)


if __name__ == "__main__":
    cli.run_main(tune, TuneArgs, __doc__ or "")
