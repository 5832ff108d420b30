"""Run every method on every task and real system, cell by cell, and draw what there is.

A cell is one fine-tuning run of all seeds, with the method's own defaults or, with --tuned, the options that
`experiments.studies.tune` chose.
Cells that are finished are left alone, begun ones go on where they stopped: the same command,
given again, does what is missing. The real systems of a task that a method has got equally far on are stepped together
in one program.

`python -m experiments.compare hybrid` compares methods that learn from real data and a simulator, see its --help.
"""

import difflib
import glob
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from envs import extend, gaps
from envs.gaps import SIM
from envs.types import UserError, unknown
from experiments import hybrid
from experiments.figures import FiguresArgs, figures
from experiments.hybrid import HybridArgs, SchedulePreset, data_name
from experiments.runner import cli, grid, options, tuned
from experiments.runner.grid import FINETUNING, Cell, GridArgs, Kind, WorkArgs, check_begun, look_up, work
from experiments.runner.options import FirstSeed, Task
from sgft_jax.files.disk import jsonable, table_file
from sgft_jax.io.runs import NO_DATA, check_folder
from sgft_jax.methods import DEFAULT, FIXED_NAMES, NAMES, get_method
from sgft_jax.presets import say_preset
from sgft_jax.train.schedule import FLEET, SCHEDULES, Schedule, describe, name_of

if TYPE_CHECKING:
    from sgft_jax.analysis.curves import Curve
    from sgft_jax.analysis.hybrid import Results

HYBRID = "hybrid"  # first word of the command line for methods that learn from real data and a simulator
_HYBRID_HELP = """Run every method on every data set and simulator, cell by cell; print tables and draw curves.

A cell is one run of `experiments.hybrid` with all seeds. Methods without a simulator run once for each data set, those
without data once for each simulator. Cells that are finished are left alone, begun ones go on where they stopped: the
same command, given again, does what is missing. All simulators and seeds of a method and data set share one program.
"""
_RANKS = (
    "Spearman's correlation of the methods' means here with those after {:,} updates (there), with a 95 % bootstrap "
    "interval that draws seeds; methods in either order, the best first."
)


@dataclass(frozen=True)
class CompareArgs(GridArgs):
    """A grid of fine-tuning runs; everything not named here is as `experiments.finetune` has it."""

    tuned: bool = False
    """Start from the options that `experiments.studies.tune` chose for each task and method; the runs are a variant
    of their own, `tuned`, beside those with the defaults."""
    reference: str | None = None
    """Compare the others with METHOD or METHOD:VARIANT; default: with the best of each table."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line; its first word may be `hybrid`."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words and difflib.get_close_matches(words[0], [HYBRID]) and words[0] != HYBRID:
        cli.fail(unknown("compare", words[0], [HYBRID]))
    if words[:1] == [HYBRID]:
        cli.run_main(compare_hybrid, HybridGridArgs, _HYBRID_HELP, argv=words[1:], default=hybrid_defaults)
    else:
        cli.run_main(compare, CompareArgs, __doc__ or "", argv=words)


def compare(args: CompareArgs) -> None:
    """Runs what is missing, then draws; raises UserError in the end if some cells could not run."""
    chosen = cells(args)
    if args.tuned:
        check_begun(chosen)  # tuning may have chosen again since
    work(chosen, args, lambda cells: _draw(args) if any(cell.done for cell in cells) else None)


def _draw(args: CompareArgs) -> None:
    print(figures(FiguresArgs(out=args.out, reference=args.reference)).read_text())


def cells(args: CompareArgs) -> list[Cell]:
    """The grid, methods innermost, so that every task and real system is compared early."""
    args = replace(args, reals=gaps.expand(args.reals))
    grid.check(args)
    name = (args.reference or DEFAULT).partition(":")[0]
    if name not in (*NAMES, *args.methods) and not any(args.out.glob(f"finetune/*/*/{glob.escape(name)}*")):
        raise UserError(unknown("--reference", name, {*NAMES, *args.methods}))
    if args.tuned:
        for task in args.tasks:
            tuned.check_fair(args.out, task, args.methods, args.reals)
    runs = [grid.run_of(args, *place) for place in itertools.product(args.tasks, args.reals, args.methods)]
    return [look_up(FINETUNING, tuned.apply(run) if args.tuned else run) for run in runs]


# --- a log and a simulator --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _HybridCells:
    """What the cells are of, and what is shown of them."""

    task: Task = "halfcheetah"
    methods: tuple[str, ...] = FIXED_NAMES
    """Methods in the order in which they run, as METHOD or METHOD:PRESET; the latter is a variant of that name. rebrac
    alone takes on each data set the preset that the file's name contains, if there is one."""
    gaps: tuple[str, ...] = ()
    """How simulators differ from the real system: gaps by name, .toml/.json files, or sim for no gap; default: all that
    come with the task but variants of others, for halfcheetah and walker2d H2O+'s nine and seven."""
    data: tuple[Path, ...] = ()
    """The real data: files or folders, as `--data` of experiments.hybrid takes them (docs/data.md)."""
    real: str = SIM
    """The real system to evaluate in: sim for the task as it is, or a gap by name or as a file."""
    previous_actions: int = 0
    """Last actions that end the observation, for data of a policy that sees them."""
    seeds: int = 5
    """Number of seeds of each run."""
    schedule_preset: SchedulePreset = FLEET
    schedule: Schedule = field(default_factory=Schedule)
    score: Literal["late", "last"] = "late"
    """What tables show of a run: the mean of its last ten evaluations, or its last one."""
    reference: str = hybrid.DEFAULT
    """Compare the others with this METHOD or METHOD:PRESET."""
    export: Path | None = None
    """Instead of running, write what has finished into hybrid.csv in this folder, which --released reads back."""
    released: Path | None = None
    """Instead of running, show what hybrid.csv in this folder holds of these runs, such as docs/data."""
    beside: int | None = None
    """With --released: also the rank correlation of the methods with those of runs of so many updates."""
    seed: FirstSeed = 0
    eval_every: int = 10_000
    """Expert: updates between evaluations in the real system."""
    eval_episodes: int = 10
    """Expert: episodes per seed and evaluation."""


@dataclass(frozen=True)
class HybridGridArgs(WorkArgs, _HybridCells):  # this order puts the fields of the latter first
    """A grid of runs; everything not named here is as `experiments.hybrid` has it."""


def hybrid_defaults(argv: Sequence[str]) -> HybridGridArgs:
    """Those of the chosen schedule."""
    name = cli.preview(argv, schedule_preset=FLEET).schedule_preset
    return HybridGridArgs(schedule_preset=name, schedule=cli.choose("--schedule-preset", name, SCHEDULES))


def compare_hybrid(args: HybridGridArgs) -> None:
    """Runs what is missing, then shows tables and curves; raises UserError in the end if some cells could not run."""
    args = _checked(args)
    if args.released is not None:
        _show(args, released(args, args.released))
        return
    chosen = hybrid_cells(args)
    check_begun(chosen)
    if args.export is not None:
        from sgft_jax.analysis.release import write_hybrid

        if not (curves := _finished(chosen)):
            raise UserError(f"--export {args.export}: none of these runs has finished")
        print(f"written: {write_hybrid(args.export, curves)}, {len(curves)} runs")
        return
    work(chosen, args, lambda cells: _show(args, _results(args, _finished(cells))))


def tables(args: HybridGridArgs, results: "Results") -> str:
    """The tables as Markdown."""
    from sgft_jax.analysis.hybrid import ranks, summary

    texts = summary(results, reference=args.reference, seeds=args.seeds, schedule=describe(args.schedule))
    if args.released is not None and args.beside is not None:
        others = replace(args, schedule=replace(args.schedule, updates=args.beside))
        texts += [_RANKS.format(args.beside), ranks(results, released(others, args.released))]
    return "\n\n".join(texts)


def _show(args: HybridGridArgs, results: "Results") -> None:
    """Tables on the screen and in a file, and a figure of curves for each data set; nothing without any curve."""
    if not results.curves:
        return
    from sgft_jax.analysis.figures import learning_curves  # brings Matplotlib

    folder, name = args.out / "figures", f"hybrid-{extend.name_of(args.task)}-{gaps.title(args.real)}"
    folder.mkdir(parents=True, exist_ok=True)
    path, text = folder / f"{name}-{args.score}.md", tables(args, results)
    path.write_text(text + "\n")
    print(f"{text}\n\nwritten: {path}")
    for data in results.data:
        panels = results.panels(data)
        if any(panels.values()):
            title = f"{' on '.join(filter(None, [results.task, data]))}, schedule {name_of(args.schedule)}"
            print(f"written: {learning_curves(folder / f'{name}-{data or NO_DATA}.png', panels, title=title)}")


def _title(args: HybridArgs) -> str:
    method, data = get_method(args.method, "fixed"), "" if args.data is None else data_name(args.data)
    gap = "" if method.kind == "offline" else gaps.title(args.gap[0])
    spec = ":".join(filter(None, [args.method, args.variant]))
    preset = f", {say_preset(method, args.preset, data)}" if method.by_data and not args.variant else ""
    return f"{'/'.join(filter(None, [extend.name_of(args.task), gap, data]))}: {spec}{preset}"


def _system(args: HybridArgs) -> str:
    """The one simulator, or what stands for none."""
    return hybrid.gaps_of(args, get_method(args.method, "fixed"))[0]


HYBRID_RUNS = Kind(
    name="hybrid",
    systems="gap",
    run=lambda args: hybrid.hybrid(args),
    folder=lambda args: hybrid.run_folder(args, _system(args)),
    config=lambda args: jsonable(args) | {"gap": _system(args)},
    title=_title,
    finished=lambda args, summary: True,  # a summary is written at the end; another schedule is refused
)


def _checked(args: HybridGridArgs) -> HybridGridArgs:
    """The arguments with every gap by name; raises UserError for what is wrong in them alone."""
    args = replace(args, gaps=gaps.expand(args.gaps or tuple(gaps.presets(extend.name_of(args.task), variants=False))))
    options.at_least_one(args, "eval_every", "eval_episodes")
    options.not_negative(args, "previous_actions", "minutes", "beside")
    options.seed_list(args.seed, args.seeds)
    options.check_task(args.task)
    options.each_once(args, "methods")
    if not args.gaps:
        raise UserError(f"--gaps: {extend.name_of(args.task)} comes with none; name some, or {SIM} for no gap")
    options.without_repeats("--gaps", args.gaps)
    options.without_repeats("--data", tuple(map(data_name, args.data)))
    options.check_task(args.task, args.gaps if args.real == SIM else (*args.gaps, args.real))
    if odd := [spec for spec in args.methods if spec.partition(":")[0] not in FIXED_NAMES]:
        raise UserError(unknown("--methods", odd[0], FIXED_NAMES))
    if args.reference not in args.methods:
        raise UserError(unknown("--reference", args.reference, args.methods))
    learning = [name for name in args.methods if get_method(name.partition(":")[0], "fixed").kind != "simulator"]
    if learning and not args.data:
        raise UserError(f"--data: {learning[0]} learns from real data; name files or folders (docs/data.md)")
    for path in args.data if args.released is None else ():
        options.check_data("--data", path)
    check_folder(args.out)
    if args.export is not None:
        check_folder(args.export, "--export")
    if args.export is not None and args.released is not None:
        raise UserError("--export and --released exclude each other: one writes hybrid.csv, the other shows it")
    if args.beside is not None and args.released is None:
        raise UserError("--beside: reads released tables; name their folder with --released")
    return args


def hybrid_cells(args: HybridGridArgs) -> list[Cell]:
    """The cells, methods innermost, so that every data set is compared early."""
    runs = [run for data in args.data or (None,) for method in args.methods for run in _runs(args, method, data)]
    return [look_up(HYBRID_RUNS, run) for run in dict.fromkeys(runs)]  # of a method without data once


def _runs(args: HybridGridArgs, method: str, data: Path | None) -> list[HybridArgs]:
    """Of one method on one data set, a run for each simulator."""
    name, _, preset = method.partition(":")
    kind = get_method(name, "fixed").kind
    shared = ("task", "real", "previous_actions", "seeds", "seed", "schedule_preset", "schedule", "eval_every")
    shared += ("eval_episodes", "impl", "out")
    common = {name: getattr(args, name) for name in shared}
    data = None if kind == "simulator" else data
    run = hybrid.arguments(name, preset=preset, variant=preset, data=data, video=False, **common)
    return [replace(run, gap=(gap,)) for gap in ((SIM,) if kind == "offline" else args.gaps)]


def _results(args: HybridGridArgs, curves: "Sequence[Curve]") -> "Results":
    """Curves with the data sets, simulators and methods that tables have."""
    from sgft_jax.analysis.hybrid import Results

    data = [data_name(path) for path in args.data] or [""]
    return Results(data, [gaps.title(gap) for gap in args.gaps], args.methods, curves, args.score)


def _finished(cells: Sequence[Cell]) -> "list[Curve]":
    """The curves of the cells that have finished."""
    from sgft_jax.analysis.reading import read_curve

    return [read_curve(cell.folder) for cell in cells if cell.state == "finished"]


def released(args: HybridGridArgs, folder: Path) -> "Results":
    """What the table in a folder holds of these runs; raises UserError if that is nothing, or if it lacks a seed."""
    from sgft_jax.analysis.release import read_hybrid

    wanted, columns = options.seed_list(args.seed, args.seeds), _results(args, ())
    task, schedule, updates = extend.name_of(args.task), name_of(args.schedule), args.schedule.updates_in_all
    facts = {"real": gaps.title(args.real), "schedule": schedule, "updates": updates}
    curves = [
        curve
        for curve in read_hybrid(folder)
        if curve.task == task
        and facts.items() <= curve.facts.items()
        and curve.spec in columns.methods
        and curve.data in (*columns.data, "")
        and curve.gap in (*columns.gaps, "")
    ]
    path = table_file(folder, "hybrid")
    if not curves:
        raise UserError(f"{path}: has none of these runs, {updates:,} updates of {task} with schedule {schedule}")
    for curve in curves:
        if missing := sorted(set(wanted) - set(curve.seeds.tolist())):
            raise UserError(f"{path}: {curve.spec} has no seed {missing[0]}; name others with --seed, --seeds")
    chosen = [curve.members([curve.seeds.tolist().index(seed) for seed in wanted]) for curve in curves]
    return columns._replace(curves=chosen)


if __name__ == "__main__":
    main()
