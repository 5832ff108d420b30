"""Learn one policy from a fixed set of real data and an imperfect simulator. The real system is only evaluated in."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

from tyro.conf import arg

from envs import extend
from envs.gaps import SIM, expand, title
from envs.types import UserError
from experiments.runner import cli, options
from experiments.runner.options import FirstSeed, Impl, Out, Successors, Task
from sgft_jax.files.disk import jsonable
from sgft_jax.io.runs import NO_DATA, NO_SIMULATOR
from sgft_jax.methods import FIXED_NAMES, get_method
from sgft_jax.presets import preset_for, say_preset
from sgft_jax.train.schedule import FLEET, SCHEDULES, Schedule, describe
from sgft_jax.types import Fixed

DEFAULT = "h2oplus"

SchedulePreset = Annotated[
    str,
    arg(
        help="A schedule by name: fleet, 25 simulators that make one step each before 25 updates follow, or released, "
        "that of H2O+'s code, one simulator that makes 1,000 steps before 1,000 updates follow."
    ),
]


@dataclass(frozen=True)
class HybridArgs:
    """Several seeds for one or more simulators at once, all in one compiled program."""

    # May differ when a run goes on. What is in the data may not, nor what a schedule has, whatever it is called.
    volatile: ClassVar = ("resume", "overwrite", "out", "video", "data", "schedule_preset")

    task: Task = "halfcheetah"
    method: str = DEFAULT
    """A method from the table at the top."""
    gap: tuple[str, ...] = ("gravity",)
    """How the simulator differs from the real system: gaps by name, .toml/.json files, or sim for no gap. Several share
    one program; each has a run folder of its own. Methods without a simulator leave it out."""
    data: Path | None = None
    """The real data: a D4RL or Minari HDF5 file, the folder of a Minari or LeRobot data set or of a run with rollouts
    in real/, or the .txt or .csv log of a wheel-legged robot (docs/data.md)."""
    real: str = SIM
    """The real system to evaluate in: sim for the task as it is, or a gap by name or as a file."""
    previous_actions: int = 0
    """Last actions that end the observation, for data of a policy that sees them, such as a prior of the preset
    `robust`, which sees 2."""
    seeds: int = 5
    """Number of seeds."""
    out: Out = Path("runs")
    resume: bool = False
    """Continue from the last checkpoint."""
    overwrite: bool = False
    """Replace an earlier run of the same name."""
    preset: str = ""
    """Named settings of the method, see the table at the top. Default: of rebrac those of the data set that the name of
    --data contains, if there are any; else the method's first."""
    options: Any = None  # the `Config` of the method
    """Options of the method that --method names:"""
    schedule_preset: SchedulePreset = FLEET
    schedule: Schedule = field(default_factory=Schedule)
    successors: Successors = "stored"
    seed: FirstSeed = 0
    eval_every: int = 10_000
    """Expert: updates between evaluations in the real system, rounded to whole chunks. No choice depends on them."""
    eval_episodes: int = 10
    """Expert: episodes per seed and evaluation, without exploration."""
    checkpoint_every: int = 100_000
    """Expert: updates between checkpoints, rounded to whole chunks."""
    variant: str = ""
    """Expert: a word for these options. The run gets a folder of its own beside the method's."""
    impl: Impl = "auto"
    video: bool = True
    """Expert: render an episode of the first seed in the real system, where MuJoCo can render."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line. The method is looked up first: the other options and their defaults are its own."""
    cli.run_main(hybrid, HybridArgs, f"{__doc__}\n\n{_table()}", argv=argv, default=_defaults)


def hybrid(args: HybridArgs) -> list[dict[str, Any]]:
    """Runs from (or back) to disk, one for each simulator; returns their summaries in the order of `gap`."""
    args = replace(args, gap=expand(args.gap))
    method, seeds = check(args)
    for line in choices(args, method):
        print(line)
    homes = {run_folder(args, name): jsonable(args) | {"gap": name} for name in gaps_of(args, method)}
    from experiments.runner.hybrid_run import run  # JAX starts here

    return run(args, method, seeds, homes)


def arguments(method: str, *, preset: str = "", data: Path | None = None, **changes: Any) -> HybridArgs:
    """The arguments with which a method runs unless the user says otherwise, and any changes to these.

    preset: "" for the one that suits the data, if the method has presets by data set, else the first.
    """
    chosen = get_method(method, "fixed")
    preset = preset or ("" if data is None else preset_for(chosen, data_name(data)))
    config = cli.choose("--preset", preset or next(iter(chosen.presets)), dict(chosen.presets))
    return HybridArgs(**{"method": method, "preset": preset, "options": config, "data": data, **changes})


def choices(args: HybridArgs, method: Fixed) -> list[str]:
    """What was chosen by name or by data, in words."""
    preset = say_preset(method, args.preset, data_name(args.data)) if method.by_data and args.data else ""
    schedule = "" if method.kind == "offline" else describe(args.schedule)
    return [f"{method.name}: {words}" for words in (preset, schedule) if words]


def gaps_of(args: HybridArgs, method: Fixed) -> tuple[str, ...]:
    """The simulators, or the one word that stands for none."""
    return (NO_SIMULATOR,) if method.kind == "offline" else args.gap


def run_folder(args: HybridArgs, gap: str) -> Path:
    """Where the run with that simulator lives; the seeds of one call share a folder."""
    method = get_method(args.method, "fixed")
    data = NO_DATA if method.kind == "simulator" or args.data is None else data_name(args.data)
    label = "_".join(filter(None, [method.name, args.variant]))
    seeds = options.seeds_name(options.seed_list(args.seed, args.seeds))
    systems = title(gap) if args.real == SIM else f"{title(gap)}-for-{title(args.real)}"
    return args.out / "hybrid" / extend.name_of(args.task) / systems / data / label / seeds


def data_name(path: Path) -> str:
    """What a data set is called in folders: its file without the ending, or its folder."""
    inside = path.parent.parent if path.name == "main_data.hdf5" else path
    return extend.folder_name("--data", re.sub(r"[^\w.-]", "-", inside.name.removesuffix(".hdf5")))


def check(args: HybridArgs) -> tuple[Fixed, list[int]]:
    """The method and the seeds; raises UserError for what is wrong in the arguments and with the run folders."""
    options.at_least_one(args, "eval_every", "eval_episodes", "checkpoint_every")
    options.not_negative(args, "previous_actions")
    method, seeds = get_method(args.method, "fixed"), options.seed_list(args.seed, args.seeds)
    if not isinstance(args.options, type(method.config)):
        raise UserError(f"--method {method.name}: the options are those of another method")
    if method.kind != "simulator" and args.data is None:
        raise UserError(f"--data: {method.name} learns from real data; name a file or folder (docs/data.md)")
    if method.kind == "simulator" and args.data is not None:
        raise UserError(f"--data {args.data}: {method.name} learns in the simulator alone; leave one of them out")
    if args.data is not None:
        options.check_data("--data", args.data)
    options.check_variant(args.variant)
    if not args.gap:
        raise UserError(f"--gap: name at least one, or {SIM} for no gap")
    options.without_repeats("--gap", args.gap)
    systems = () if method.kind == "offline" else args.gap
    options.check_task(args.task, systems if args.real == SIM else (*systems, args.real))
    systems = gaps_of(args, method)
    options.check_folders("--gap", args.gap, [run_folder(args, gap) for gap in systems], args)
    return method, seeds


def _defaults(argv: Sequence[str]) -> HybridArgs:
    """Those of the chosen method, of its preset and of the schedule."""
    chosen = cli.preview(argv, method=DEFAULT, preset="", data="", schedule_preset=FLEET)
    schedule = cli.choose("--schedule-preset", chosen.schedule_preset, SCHEDULES)
    data = Path(chosen.data) if chosen.data else None
    presets = {"preset": chosen.preset, "schedule_preset": chosen.schedule_preset}
    return arguments(chosen.method, data=data, schedule=schedule, **presets)


def _table() -> str:
    """The methods, a line each."""
    methods = [get_method(name, "fixed") for name in FIXED_NAMES]
    rows = [("", m.name, m.kind, f"{m.description} ({m.source}); presets: {', '.join(m.presets)}") for m in methods]
    return "\n".join(["methods:", *cli.columns(rows)])


if __name__ == "__main__":
    main()
