"""Run every method on every data set and simulator, cell by cell, and print tables and draw curves of what there is.

A cell is one run of `experiments.hybrid` with all seeds. Methods without a simulator run once for each data set, those
without data once for each simulator. Cells that are finished are left alone, begun ones go on where they stopped: the
same command, given again, does what is missing. All simulators and seeds of a method and data set share one program.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from envs import extend, gaps
from envs.files import Count
from envs.gaps import SIM
from envs.scales import D4RL
from envs.types import UserError, unknown
from experiments.hybrid import arguments, hybrid
from experiments.runner import cells, cli
from experiments.runner.cells import Cell, Kind, check_begun, complete
from experiments.runner.hybrid_args import (
    DEFAULT,
    NO_DATA,
    VOLATILE,
    HybridArgs,
    SchedulePreset,
    data_name,
    gaps_of,
    run_folder,
)
from experiments.runner.options import (
    Impl,
    at_least_one,
    check_data,
    check_task,
    not_negative,
    seed_list,
    without_repeats,
)
from sgft_jax.files.jsonfile import jsonable
from sgft_jax.hybrid.presets import say_preset
from sgft_jax.hybrid.scores import measures, shown
from sgft_jax.io.log import EVAL, SUMMARY, check_records, read_jsonl
from sgft_jax.io.runs import check_folder, read_own, read_starts
from sgft_jax.methods import FIXED_NAMES, get_method
from sgft_jax.train.schedule import FLEET, SCHEDULES, Schedule, describe, name_of

if TYPE_CHECKING:
    from sgft_jax.analysis.hybrid import Outcome, Results

_SCORES = {"late": "mean of the last ten evaluations", "last": "last evaluation"}
LEGEND = (
    "Scores in the real system ({score}), mean and standard deviation over {seeds} seeds. Means over simulators{scale} "
    "have a 95 % bootstrap interval that draws seeds within every simulator. P(better): a random seed of {reference} "
    "against one of the other method, mean over simulators. Intervals need three seeds. Every run made {schedule}; "
    "methods without a simulator made the updates alone. The data sets are what the files hold: numbers on sets that "
    "were made anew do not belong beside published ones."
)
_MEASURED = "What else the task is judged by, in these evaluations: mean with a 95 % bootstrap interval over seeds."
_RANKS = (
    "Spearman's correlation of the methods' means here with those after {:,} updates (there), with a 95 % bootstrap "
    "interval that draws seeds; methods in either order, the best first."
)


@dataclass(frozen=True)
class CompareHybridArgs:
    """A grid of runs; everything not named here is as `experiments.hybrid` has it."""

    task: str = "halfcheetah"
    """A task by name, or a Python file with a task of your own."""
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
    reference: str = DEFAULT
    """Compare the others with this METHOD or METHOD:PRESET."""
    together: bool = True
    """Step the simulators of a method together; --no-together: one after another, in less memory but more time."""
    minutes: float | None = None
    """Begin no new run after so many minutes."""
    dry: bool = False
    """Only list the runs and what is missing."""
    export: Path | None = None
    """Instead of running, write what has finished into hybrid.csv in this folder, which --released reads back."""
    released: Path | None = None
    """Instead of running, show what hybrid.csv in this folder holds of these runs, such as docs/data."""
    beside: int | None = None
    """With --released: also the rank correlation of the methods with those of runs of so many updates."""
    out: Path = Path("runs")
    """Parent of all run folders; the tables and the curves go to <out>/figures."""
    seed: int = 0
    """Expert: first seed."""
    eval_every: int = 10_000
    """Expert: updates between evaluations in the real system."""
    eval_episodes: int = 10
    """Expert: episodes per seed and evaluation."""
    impl: Impl = "auto"


def _system(args: HybridArgs) -> str:
    """The one simulator, or what stands for none."""
    return gaps_of(args, get_method(args.method, "fixed"))[0]


def _title(args: HybridArgs) -> str:
    method, learnt_from = get_method(args.method, "fixed"), [_gap_of(args), _data_of(args)]
    chosen = f", {say_preset(method, args.preset, _data_of(args))}" if method.by_data and not args.variant else ""
    return f"{'/'.join(filter(None, [extend.name_of(args.task), *learnt_from]))}: {_spec(args)}{chosen}"


def _spec(args: HybridArgs) -> str:
    return ":".join(filter(None, [args.method, args.variant]))


def _data_of(args: HybridArgs) -> str:
    """The name of the data, "" of a method without."""
    return "" if args.data is None else data_name(args.data)


def _gap_of(args: HybridArgs) -> str:
    """The name of the simulator, "" of a method without."""
    return "" if get_method(args.method, "fixed").kind == "offline" else gaps.title(args.gap[0])


HYBRID = Kind(
    name="hybrid",
    systems="gap",
    run=lambda args: hybrid(args),
    folder=lambda args: run_folder(args, _system(args)),
    config=lambda args: jsonable(args) | {"gap": _system(args)},
    title=_title,
    volatile=VOLATILE,
    finished=lambda args, summary: True,  # a summary is written at the end; another schedule is refused
)


def main(args: CompareHybridArgs) -> None:
    """Runs what is missing, then shows tables and curves; raises UserError in the end if some cells could not run."""
    args = replace(args, gaps=gaps.each(args.gaps or tuple(gaps.presets(extend.name_of(args.task), variants=False))))
    check(args)
    if args.released is not None:
        _show(args, released(args, args.released))
        return
    found = grid(args)
    check_begun(found)
    if args.export is not None:
        export(args, found, args.export)
        return
    failed = complete(found, args)
    if args.dry:
        return
    if results := outcomes(args):
        _show(args, results)
    if failed:
        raise UserError(f"{len(failed)} of the cells did not run: {'; '.join(failed)}")


def defaults(argv: Sequence[str]) -> CompareHybridArgs:
    """Those of the chosen schedule."""
    name = cli.preview(argv, schedule_preset=FLEET).schedule_preset
    return CompareHybridArgs(schedule_preset=name, schedule=cli.choose("--schedule-preset", name, SCHEDULES))


def check(args: CompareHybridArgs) -> None:
    """Raises UserError for what is wrong in the arguments alone."""
    at_least_one(args, "eval_every", "eval_episodes")
    not_negative(args, "previous_actions", "minutes", "beside")
    seed_list(args.seed, args.seeds)
    check_task(args.task)
    if not args.methods:
        raise UserError("--methods: name at least one")
    if not args.gaps:
        raise UserError(f"--gaps: {extend.name_of(args.task)} comes with none; name some, or {SIM} for no gap")
    for name, given in (("methods", args.methods), ("gaps", args.gaps), ("data", tuple(map(data_name, args.data)))):
        without_repeats(f"--{name}", given)
    check_task(args.task, args.gaps if args.real == SIM else (*args.gaps, args.real))
    if odd := [one for one in args.methods if one.partition(":")[0] not in FIXED_NAMES]:
        raise UserError(unknown("--methods", odd[0], FIXED_NAMES))
    if args.reference not in args.methods:
        raise UserError(unknown("--reference", args.reference, args.methods))
    learning = [name for name in args.methods if get_method(name.partition(":")[0], "fixed").kind != "simulator"]
    if learning and not args.data:
        raise UserError(f"--data: {learning[0]} learns from real data; name files or folders (docs/data.md)")
    for path in args.data if args.released is None else ():
        check_data("--data", path)
    check_folder(args.out)
    if args.export is not None:
        check_folder(args.export, "--export")
    if args.export is not None and args.released is not None:
        raise UserError("--export and --released exclude each other: one writes hybrid.csv, the other shows it")
    if args.beside is not None and args.released is None:
        raise UserError("--beside: reads released tables; name their folder with --released")


def grid(args: CompareHybridArgs) -> list[Cell]:
    """The cells, methods innermost, so that every data set is compared early."""
    runs = [run for data in args.data or (None,) for method in args.methods for run in _runs(args, method, data)]
    return [cells.look_up(HYBRID, run) for run in dict.fromkeys(runs)]  # of a method without data once


def _runs(args: CompareHybridArgs, method: str, data: Path | None) -> list[HybridArgs]:
    """Of one method on one data set, a run for each simulator."""
    name, _, preset = method.partition(":")
    kind = get_method(name, "fixed").kind
    run = arguments(
        name, preset=preset, variant=preset, task=args.task, data=None if kind == "simulator" else data,
        real=args.real, previous_actions=args.previous_actions, seeds=args.seeds, seed=args.seed,
        schedule_preset=args.schedule_preset, schedule=args.schedule, eval_every=args.eval_every,
        eval_episodes=args.eval_episodes, impl=args.impl, out=args.out, video=False,
    )  # fmt: skip
    return [replace(run, gap=(gap,)) for gap in ((SIM,) if kind == "offline" else args.gaps)]


def outcomes(args: CompareHybridArgs) -> "Results | None":
    """What has finished; None if nothing has."""
    from sgft_jax.analysis.hybrid import Results

    done = [cell for cell in grid(args) if cell.state == "finished"]
    if not done:
        return None
    summaries = [read_own(cell.folder / SUMMARY, {"task": str, "score": str, args.score: list[float]}) for cell in done]
    task, score = (summaries[0][name] for name in ("task", "score"))
    found = [_outcome(cell, one[args.score]) for cell, one in zip(done, summaries, strict=True)]
    return Results(task, score, *_columns(args), found)


def _columns(args: CompareHybridArgs) -> tuple[list[str], list[str], tuple[str, ...]]:
    """What tables have: data sets, simulators and methods."""
    data = [data_name(path) for path in args.data] or [""]
    return data, [gaps.title(gap) for gap in args.gaps], args.methods


def _outcome(cell: Cell, scores: list[float] | None = None) -> "Outcome":
    from sgft_jax.analysis.hybrid import outcome

    run, lines = cell.args, read_jsonl(cell.folder / EVAL, {"step": Count, "score": list[float]})
    others = measures(lines[0])
    check_records(cell.folder / EVAL, lines, {"score": list[float], **dict.fromkeys(others, list[float])})
    return outcome(_spec(run), _data_of(run), _gap_of(run), lines, scores, measures=others)


def export(args: CompareHybridArgs, found: Sequence[Cell], to: Path) -> None:
    """Writes the finished cells into hybrid.csv; raises UserError if there is none."""
    from sgft_jax.analysis import hybrid_table
    from sgft_jax.analysis.curves import origin

    runs = []
    for cell in found:
        if cell.state == "finished":
            summary = read_own(cell.folder / SUMMARY, {"task": str, "score": str, "seeds": list[int]})
            starts = read_starts(cell.folder) or [{}]
            task, score, seeds = (summary[name] for name in ("task", "score", "seeds"))
            runs.append(hybrid_table.Run(
                task, gaps.title(args.real), name_of(args.schedule), args.schedule.updates_in_all,
                origin(starts[-1])["commit"], score, seeds, _outcome(cell),
            ))  # fmt: skip
    if not runs:
        raise UserError(f"--export {to}: none of these runs has finished")
    print(f"written: {hybrid_table.write(to, runs)}, {len(runs)} runs")


def released(args: CompareHybridArgs, folder: Path) -> "Results":
    """What the table in a folder holds of these runs; raises UserError if that is nothing, or if it lacks a seed."""
    from sgft_jax.analysis.hybrid import EVERY, Results
    from sgft_jax.analysis.hybrid_table import TABLE, read
    from sgft_jax.files.csvfile import table_file

    wanted, columns = seed_list(args.seed, args.seeds), _columns(args)
    data, systems, methods = columns
    own = (extend.name_of(args.task), gaps.title(args.real), name_of(args.schedule), args.schedule.updates_in_all)
    found = [
        run
        for run in read(folder)
        if run[: len(own)] == own
        and run.outcome.method in methods
        and run.outcome.data in (*data, EVERY)
        and run.outcome.gap in (*systems, EVERY)
    ]
    path = table_file(folder, TABLE)
    if not found:
        raise UserError(f"{path}: has none of these runs, {own[3]:,} updates of {own[0]} with schedule {own[2]}")
    for run in found:
        if missing := sorted(set(wanted) - set(run.seeds)):
            raise UserError(f"{path}: {run.outcome.method} has no seed {missing[0]}; name others with --seed, --seeds")
    outcomes = [_chosen(run.outcome, [run.seeds.index(seed) for seed in wanted], args.score) for run in found]
    return Results(own[0], found[0].score, *columns, outcomes)


def _chosen(own: "Outcome", members: list[int], score: str) -> "Outcome":
    """Of these members, with the scores that tables show."""
    curve, others = own.curve[members], {name: values[members] for name, values in own.measures.items()}
    return own._replace(curve=curve, measures=others, scores=shown(curve.T, score))


def tables(args: CompareHybridArgs, results: "Results") -> str:
    """The tables as Markdown."""
    from sgft_jax.analysis import hybrid as analysis

    scale = " on D4RL's scale" if results.task in D4RL else ""
    words = {"score": _SCORES[args.score], "seeds": args.seeds, "scale": scale, "reference": args.reference}
    words["schedule"] = describe(args.schedule)
    parts = [f"# {results.task}", LEGEND.format(**words), analysis.headline(results)]
    if len(args.methods) > 1:
        parts.append(analysis.duels(results, args.reference))
    parts.append(analysis.cells(results))
    if measured := analysis.measured(results, args.score):
        parts += [_MEASURED, measured]
    if args.released is not None and args.beside is not None:
        others = replace(args, schedule=replace(args.schedule, updates=args.beside))
        parts += [_RANKS.format(args.beside), analysis.ranks(results, released(others, args.released))]
    return "\n\n".join(parts)


def _show(args: CompareHybridArgs, results: "Results") -> None:
    """Tables on the screen and in a file, and a figure of curves for each data set."""
    from sgft_jax.analysis import figures

    folder, name = args.out / "figures", f"hybrid-{extend.name_of(args.task)}-{gaps.title(args.real)}"
    folder.mkdir(parents=True, exist_ok=True)
    path, text = folder / f"{name}-{args.score}.md", tables(args, results)
    path.write_text(text + "\n")
    print(f"{text}\n\nwritten: {path}")
    for data in results.data:
        if any(results.find(method, data, gap) for method in results.methods for gap in results.gaps):
            title = f"{' on '.join(filter(None, [results.task, data]))}, schedule {name_of(args.schedule)}"
            drawn = figures.hybrid_curves(folder / f"{name}-{data or NO_DATA}.png", results, data, title=title)
            print(f"written: {drawn}")


if __name__ == "__main__":
    cli.run_main(main, CompareHybridArgs, __doc__ or "", default=defaults)
