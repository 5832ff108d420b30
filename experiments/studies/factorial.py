"""What do SGFT's parts do? Shaping, shortening, their horizon, a new critic and warm-up, all combinations of them.

Every cell is a run of `sgft-parts` with equal branches. Cells that are finished are left alone, begun ones go on where
they stopped. When all are finished, the learning curve of every cell and the effects of each part on area, end and
deepest fall are printed; the effects are drawn, and the curves of the cells that are as the paper prints them. With
--data, nothing runs: the curves come from released tables.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from envs import extend, gaps
from envs.types import UserError
from experiments.runner import cli, grid
from experiments.runner.grid import Cell, GridArgs, check_begun, work
from experiments.runner.options import check_prior, prior_folders
from sgft_jax.analysis import tables
from sgft_jax.analysis.curves import Curve, area, by_prior, common_grid, deepest_fall, spread
from sgft_jax.analysis.reading import read_curve
from sgft_jax.analysis.release import read_data
from sgft_jax.files.disk import jsonable, write_json
from sgft_jax.math.stats import Interval, bootstrap_interval, mean
from sgft_jax.methods import get_method

Levels = tuple[bool, ...]  # of every factor, whether it is high
Place = tuple[str, str]  # a task, and a real system as the user gave it
Curves = dict[Place, dict[Levels, Curve]]

METHOD, MEASURES = "sgft-parts", ("area", "end", "deepest fall")
COLD = {"critic_warmup": 0, "lr_warmup": 0, "dynamics_warmup": 0, "actor_ramp": 0}  # as the paper prints it


@dataclass(frozen=True)
class FactorialArgs(GridArgs):
    """The 32 cells on each real system; everything not named here is as `experiments.finetune` has it."""

    tasks: tuple[str, ...] = ("push",)
    """Tasks."""
    methods: tuple[str, ...] = (METHOD,)
    """Method of the cells: always sgft-parts."""
    reals: tuple[str, ...] = ("default", "sim")
    """Real systems: gaps by name, sim for no gap, or .toml/.json files; of every task, or as TASK=REAL of that one."""
    seeds: int = 12
    rollouts: int = 12
    """Real rollouts per seed, the initial ones included."""
    eval_every: int = 2
    prior: Path | None = None
    """Folder of priors (prior/seed-*); default: those of <out>/pretrain/<task>/<preset>."""
    horizon: int = 4
    """Horizon H that is compared with H = 1."""
    anchor: float = 0.0
    """The same for all cells: price for leaving the simulator's policy (--options.anchor)."""
    identify: bool = False
    """The same for all cells: --options.identify."""
    guard: bool = False
    """The same for all cells: --options.guard."""
    data: Path | None = None
    """Folder of released tables to read instead of running the cells, such as docs/data."""


def main(args: FactorialArgs) -> None:
    """Runs what is missing, then says what the parts do."""
    check(args)
    places = [(task, real) for task in args.tasks for real in reals_of(args, task)]
    if args.data:
        print(report(args, released(args, args.data, places)))
        return
    cells = {place: cells_of(args, *place) for place in places}
    every = [cell for by_levels in cells.values() for cell in by_levels.values()]

    def conclude(now: Sequence[Cell]) -> None:
        if unfinished := sum(cell.state != "finished" for cell in now):
            print(f"{unfinished} cells are not finished; the same command goes on")
        else:
            curves = {place: {k: read_curve(cell.folder) for k, cell in of.items()} for place, of in cells.items()}
            print(report(args, curves))

    check_begun(every)  # the same folders with other options or priors
    work(every, args, conclude)


def check(args: FactorialArgs) -> None:
    """Raises UserError for what is wrong in the arguments alone."""
    if args.methods != (METHOD,):
        raise UserError(f"--methods: the cells are all of {METHOD}")
    if args.horizon < 2:
        raise UserError(f"--horizon is {args.horizon}: must be at least 2, to differ from 1")
    get_method(METHOD).config(**settings(args, (True,) * len(factors(args))))
    grid.check(replace(args, reals=(gaps.SIM,)))  # all but the real systems, which may differ between tasks
    for task in args.tasks:
        if args.prior is not None and args.data is None:
            for folder in prior_folders(args.prior, out=args.out, task=task, preset=""):
                check_prior(folder, get_method(METHOD), extend.name_of(task))
        reals = reals_of(args, task)
        if not reals:
            raise UserError(f"--reals: names no real system of {task}")
        grid.check(replace(args, tasks=(task,), reals=reals))


def reals_of(args: FactorialArgs, task: str) -> tuple[str, ...]:
    """The real systems of a task: those of every task and those that name it, one gap each."""
    pairs = [text.partition("=") for text in args.reals]
    named = [(of, real) if equals and of in args.tasks else (task, of + equals + real) for of, equals, real in pairs]
    return gaps.expand([real for of, real in named if of == task])


def factors(args: FactorialArgs) -> dict[str, tuple[str, str]]:
    """What varies, in the order of `Levels`: words for the low and the high level of each factor."""
    return {
        "shape": ("task reward", "shaped"),
        "shorten": ("infinite", "short"),
        "horizon": ("1", str(args.horizon)),
        "new critic": ("kept", "new"),
        "warm-up": ("none", "warm"),
    }


def settings(args: FactorialArgs, levels: Levels) -> dict[str, Any]:
    """The options of a cell."""
    shape, shorten, horizon, new, warm = levels
    varied = {"shape": shape, "shorten": shorten, "horizon": args.horizon if horizon else 1, "reset_critic": new}
    shared = {"anchor": args.anchor, "identify": args.identify, "guard": args.guard}
    return varied | shared | ({} if warm else COLD)


def variants(args: FactorialArgs) -> dict[Levels, str]:
    """Every combination of levels, and what its runs are called."""
    words = [[word.replace(" ", ".") for word in pair] for pair in factors(args).values()]
    combinations = itertools.product((False, True), repeat=len(words))
    return dict(zip(combinations, map("-".join, itertools.product(*words)), strict=True))


def cells_of(args: FactorialArgs, task: str, real: str) -> dict[Levels, Cell]:
    """Every combination of levels on a real system."""
    return {
        levels: grid.cell_of(args, task, real, METHOD, settings(args, levels), prior=args.prior, variant=variant)
        for levels, variant in variants(args).items()
    }


def released(args: FactorialArgs, folder: Path, places: Sequence[Place]) -> Curves:
    """The curves of every cell in tables that `experiments.figures --export` wrote; UserError where one is missing."""
    names = {place: {k: (place[0], gaps.title(place[1]), v) for k, v in variants(args).items()} for place in places}
    wanted = [name for by_levels in names.values() for name in by_levels.values()]
    runs: dict[tuple[str, ...], Curve] = {}
    for curve in read_data(folder).curves:
        name = (curve.task, curve.gap, curve.variant)
        if curve.method == METHOD and name in wanted:
            if name in runs:
                raise UserError(f"{folder}: {METHOD} {' '.join(name)} ran with several sets of priors; keep one")
            runs[name] = curve
    if missing := [name for name in wanted if name not in runs]:
        task, gap, variant = missing[0]
        raise UserError(f"{folder}: has no run of {METHOD} on {task}, {gap}, variant {variant}")
    return {place: {levels: runs[name] for levels, name in by_levels.items()} for place, by_levels in names.items()}


def report(args: FactorialArgs, curves: Curves) -> str:
    """Tables of the cells and of the effects; writes factorial.json, factorial.png and as-printed.png."""
    from sgft_jax.analysis import figures  # brings Matplotlib

    folder, names, by_place, texts, score = args.out / "factorial", list(factors(args)), {}, [], ""
    for (task, real), runs in curves.items():
        first = next(iter(runs.values()))
        score, priors = first.score, first.prior if by_prior(first) else None
        scores = {levels: measures(curve) for levels, curve in runs.items()}
        by_measure = {
            name: effects({levels: numbers[name] for levels, numbers in scores.items()}, names, priors=priors)
            for name in MEASURES
        }
        rows = [
            [effect, *(tables.number(bands[effect], score) for bands in by_measure.values())]
            for effect in by_measure[MEASURES[0]]
        ]
        place = f"{task}, {gaps.title(real)}"
        by_place[place] = by_measure
        texts += [f"{place}, {tables.words(score)}:", _cells(args, runs)]
        texts += [f"{place}, effects on {tables.words(score)}:", tables.markdown(("effect of", *MEASURES), rows)]
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "factorial.json", jsonable(by_place))
    figures.effects(folder / "factorial.png", by_place, label=f"change of {score}")
    panels = {f"{task}, {gaps.title(real)}": as_printed(args, runs) for (task, real), runs in curves.items()}
    figures.learning_curves(folder / "as-printed.png", panels, title="A new critic and no warm-up, as in the paper")
    return "\n\n".join([*texts, f"written: {folder}"])


def as_printed(args: FactorialArgs, curves: dict[Levels, Curve]) -> list[Curve]:
    """With a new critic and no warm-up, the cell with neither part and those with both."""
    cells = {
        "task reward": (False, False, False, True, False),
        "SGFT, H = 1": (True, True, False, True, False),
        f"SGFT, H = {args.horizon}": (True, True, True, True, False),
    }
    return [replace(curves[levels], method=name, variant="") for name, levels in cells.items()]


def _cells(args: FactorialArgs, curves: dict[Levels, Curve]) -> str:
    """A line for each cell; its area also beside the cell with neither shaping nor shortening and all else equal."""
    rows = []
    for levels, variant in variants(args).items():
        curve, neither = curves[levels], curves[(False, False, *levels[2:])]
        areas, score = measures(curve)["area"], curve.score
        more = spread(curve, areas - measures(neither)["area"], mean)
        means = " ".join(tables.plain(value, score) for value in curve.values.mean(axis=0))
        fall = tables.plain(deepest_fall(curve), score)
        rows.append([variant, means, tables.plain(areas.mean(), score), fall, tables.number(more, score)])
    rollouts = ", ".join(str(n) for n in curves[levels].x)
    head = ("cell", f"mean after {rollouts} rollouts", "area", "fall of the mean", "area more than with neither")
    return tables.markdown(head, rows)


def measures(curve: Curve) -> dict[str, Any]:
    """[members] of each of MEASURES: area under the curve, score at the end, deepest fall below the own start."""
    values = curve.values
    numbers = (area(curve, common_grid([curve])), values[:, -1], values[:, 0] - values.min(axis=1))
    return dict(zip(MEASURES, numbers, strict=True))


def effects(
    cells: Mapping[Levels, ArrayLike], factors: Sequence[str], *, priors: ArrayLike | None = None
) -> dict[str, Interval]:
    """Main effects by name of the factor, and two-way interactions as "one x other".

    cells: [members] scores of every combination of levels; member i of each began from the same prior. A main effect is
    the mean at the high level minus that at the low one. An interaction is half of what one effect gains where the
    other factor is high. Intervals draw members, or priors [members] first where they are given. Raises ValueError
    for a combination that is missing.
    """
    combinations = list(itertools.product((False, True), repeat=len(factors)))
    if missing := [levels for levels in combinations if levels not in cells]:
        raise ValueError(f"no scores of the cell {missing[0]}")
    signs = dict(zip(factors, np.where(np.array(combinations), 1.0, -1.0).T, strict=True))  # of each factor [cells]
    scores = np.stack([np.asarray(cells[levels], np.float64) for levels in combinations])  # [cells, members]
    pairs = itertools.combinations(factors, 2)
    contrasts = signs | {f"{one} x {other}": signs[one] * signs[other] for one, other in pairs}
    half = len(combinations) / 2
    return {
        name: bootstrap_interval(contrast @ scores / half, statistic=mean, priors=priors)
        for name, contrast in contrasts.items()
    }


if __name__ == "__main__":
    cli.run_main(main, FactorialArgs, __doc__ or "")
