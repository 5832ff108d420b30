"""What do SGFT's parts do? Shaping, shortening, their horizon, a new critic and warm-up, all combinations of them.

Every cell is a run of `sgft-parts` with equal branches. Cells that are finished are left alone, begun ones go on where
they stopped. When all are finished, the learning curve of every cell and the effects of each part on area, end and
deepest fall are printed, and the effects are drawn. With --data, nothing runs: the curves come from released tables.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from envs import extend, gaps
from envs.types import UserError
from experiments.runner import cli, grid
from experiments.runner.cells import Cell, check_begun, complete
from experiments.runner.finetune_args import with_settings
from experiments.runner.grid import GridArgs
from experiments.runner.options import check_prior, prior_folders
from sgft_jax.files.jsonfile import jsonable, write_json
from sgft_jax.methods import get_method

if TYPE_CHECKING:
    from sgft_jax.analysis.curves import Curve
    from sgft_jax.analysis.factorial import Factor, Levels

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
    """Seeds of each run, all in one program."""
    rollouts: int = 12
    """Real rollouts per seed, the initial ones included."""
    eval_every: int = 2
    """Rollouts between evaluations."""
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
    every = [cell for each in cells.values() for cell in each.values()]
    check_begun(every)  # the same folders with other options or priors
    failed = complete(every, args)
    if args.dry:
        return
    if failed:
        raise UserError(f"{len(failed)} of the cells did not run: {'; '.join(failed)}")
    states = [grid.look_up(cell.args).state for cell in every]
    if left := len(states) - states.count("finished"):
        print(f"{left} cells are not finished; the same command goes on")
        return
    from sgft_jax.analysis.reading import read_curve

    curves = {place: {at: read_curve(cell.folder) for at, cell in own.items()} for place, own in cells.items()}
    print(report(args, curves))


def check(args: FactorialArgs) -> None:
    """Raises UserError for what is wrong in the arguments alone."""
    if args.methods != (METHOD,):
        raise UserError(f"--methods: the cells are all of {METHOD}")
    if args.horizon < 2:
        raise UserError(f"--horizon is {args.horizon}: must be at least 2, to differ from 1")
    options = {"horizon": args.horizon, "anchor": args.anchor, "identify": args.identify, "guard": args.guard}
    get_method(METHOD).config(**options)
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
    found = []
    for text in args.reals:
        name, equals, real = text.partition("=")
        if not (equals and name in args.tasks):
            found.append(text)
        elif name == task:
            found.append(real)
    return gaps.each(found)


def factors(args: FactorialArgs) -> "list[Factor]":
    """What varies, in the order of `Levels`."""
    from sgft_jax.analysis.factorial import Factor

    return [
        Factor("shape", "task reward", "shaped"),
        Factor("shorten", "infinite", "short"),
        Factor("horizon", "1", str(args.horizon)),
        Factor("new critic", "kept", "new"),
        Factor("warm-up", "none", "warm"),
    ]


def settings(args: FactorialArgs, levels: "Levels") -> dict[str, Any]:
    """The options of a cell."""
    shape, shorten, horizon, new, warm = levels
    own = {"shape": shape, "shorten": shorten, "horizon": args.horizon if horizon else 1, "reset_critic": new}
    shared = {"anchor": args.anchor, "identify": args.identify, "guard": args.guard}
    return own | shared | ({} if warm else COLD)


def variants(args: FactorialArgs) -> "dict[Levels, str]":
    """Every combination of levels, and what its runs are called."""
    names = [(factor.low, factor.high) for factor in factors(args)]
    return {
        levels: "-".join(name[high].replace(" ", ".") for name, high in zip(names, levels, strict=True))
        for levels in itertools.product((False, True), repeat=len(names))
    }


def cells_of(args: FactorialArgs, task: str, real: str) -> "dict[Levels, Cell]":
    """Every combination of levels on a real system."""
    found = {}
    for levels, variant in variants(args).items():
        run = replace(grid.run_of(args, task, real, METHOD), prior=args.prior, variant=variant)
        found[levels] = grid.look_up(with_settings(run, settings(args, levels)))
    return found


def released(args: FactorialArgs, folder: Path, places: "Sequence[Place]") -> "Curves":
    """The curves of every cell in tables that `experiments.figures --export` wrote; UserError where one is missing."""
    from sgft_jax.analysis.release import read_data

    wanted = {
        (task, gaps.title(real), variant): ((task, real), levels)
        for task, real in places
        for levels, variant in variants(args).items()
    }
    found: Curves = {place: {} for place in places}
    for curve in read_data(folder).curves:
        name = (curve.task, curve.gap, curve.variant)
        if curve.method == METHOD and name in wanted:
            place, levels = wanted[name]
            if levels in found[place]:
                raise UserError(f"{folder}: {METHOD} {' '.join(name)} ran with several sets of priors; keep one")
            found[place][levels] = curve
    for name, (place, levels) in wanted.items():
        if levels not in found[place]:
            raise UserError(f"{folder}: has no run of {METHOD} on {name[0]}, {name[1]}, variant {name[2]}")
    return found


def report(args: FactorialArgs, curves: "Curves") -> str:
    """Tables of the cells and of the effects; writes factorial.json and factorial.png."""
    from sgft_jax.analysis import figures, tables
    from sgft_jax.analysis.curves import by_prior
    from sgft_jax.analysis.factorial import effects

    folder, found, said, score = args.out / "factorial", {}, [], ""
    for (task, real), each in curves.items():
        scores = {levels: measures(curve) for levels, curve in each.items()}
        first = next(iter(each.values()))
        score, priors = first.score, first.prior if by_prior(first) else None
        place = f"{task}, {gaps.title(real)}"
        found[place] = {
            what: effects({levels: own[what] for levels, own in scores.items()}, factors(args), priors=priors)
            for what in MEASURES
        }
        rows = [
            [name, *(tables.number(found[place][what][name], score) for what in MEASURES)]
            for name in found[place][MEASURES[0]]
        ]
        said += [f"{place}, {tables.words(score)}:", "", _cells(args, each), ""]
        said += [f"{place}, effects on {tables.words(score)}:", "", tables.markdown(("effect of", *MEASURES), rows), ""]
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "factorial.json", jsonable(found))
    figures.effects(folder / "factorial.png", found, label=f"change of {score}")
    return "\n".join([*said, f"written: {folder}"])


def _cells(args: FactorialArgs, curves: "dict[Levels, Curve]") -> str:
    """A line for each cell; its area also beside the cell with neither shaping nor shortening and all else equal."""
    from sgft_jax.analysis import tables
    from sgft_jax.analysis.curves import by_prior, deepest_fall
    from sgft_jax.math.stats import bootstrap_interval, mean

    lines = []
    for levels, variant in variants(args).items():
        curve, neither = curves[levels], curves[(False, False, *levels[2:])]
        area = measures(curve)["area"]
        more = bootstrap_interval(
            area - measures(neither)["area"], statistic=mean, priors=curve.prior if by_prior(curve) else None
        )
        lines.append([
            variant,
            " ".join(tables.plain(value, curve.score) for value in curve.values.mean(axis=0)),
            tables.plain(area.mean(), curve.score),
            tables.plain(deepest_fall(curve), curve.score),
            tables.number(more, curve.score),
        ])  # fmt: skip
    rollouts = ", ".join(str(n) for n in curves[levels].x)
    head = ("cell", f"mean after {rollouts} rollouts", "area", "fall of the mean", "area more than with neither")
    return tables.markdown(head, lines)


def measures(curve: "Curve") -> dict[str, Any]:
    """[members] of each of MEASURES: area under the curve, score at the end, deepest fall below the own start."""
    from sgft_jax.analysis.curves import area, common_grid

    values = curve.values
    numbers = (area(curve, common_grid([curve])), values[:, -1], values[:, 0] - values.min(axis=1))
    return dict(zip(MEASURES, numbers, strict=True))


if __name__ == "__main__":
    cli.run_main(main, FactorialArgs, __doc__ or "")
