"""Say from a few real rollouts which system this is, and what simulation promises of corrections (docs/diagnose.md)."""

import json
from dataclasses import dataclass
from pathlib import Path

from envs import extend
from envs.types import UserError
from experiments.runner import cli, options
from experiments.runner.cli import Json
from experiments.runner.options import Impl
from experiments.runner.real_systems import check as check_real
from experiments.runner.real_systems import title
from sgft_jax.io.runs import check_folder, read_config
from sgft_jax.presets import DEFAULT_PRESET


@dataclass(frozen=True)
class DiagnoseArgs:
    """One diagnosis, by every prior."""

    task: str | None = None
    """A task by name, or a Python file with a task of your own; default: the task of the prior."""
    prior: Path | None = None
    """Folder of a prior of SAC, or of several (prior/seed-*); default: those that a run began with, else those of
    <out>/pretrain/<task>/<preset>."""
    real: str = "default"
    """Where the policies play, zero-shot: a gap by name, a .toml/.json file, file.toml:name, gymnasium:NAME, or
    remote[:HOST[:PORT]], a robot (docs/real-robot.md). Or what was recorded: a folder of a fine-tuning run, or any
    other with rollouts in real/ (docs/formats.md)."""
    rollouts: int | None = None
    """Only the first so many recorded rollouts; default: all, of which ten tell the system. On a gap: how many to play,
    default 4."""
    json: Json = False
    out: Path = Path("runs")
    """Parent of all run folders; picture and numbers go to <out>/diagnose/<task>/<name>."""
    preset: str = DEFAULT_PRESET
    """Expert: pretraining preset whose priors to take where neither --prior nor a run names any."""
    seed: int = 0
    """Expert: another seed plays other rollouts."""
    impl: Impl = "auto"


def folder_of(args: DiagnoseArgs, task: str, recorded: Path | None) -> Path:
    """Where picture and numbers go."""
    name = title(args.real)
    if recorded is not None:
        name = "_".join(recorded.parts[-3:] if read_config(recorded) else recorded.parts[-1:])
    return args.out / "diagnose" / extend.name_of(task) / name


def main(args: DiagnoseArgs) -> None:
    """Diagnoses and prints."""
    checked = check(args)
    from experiments.runner.diagnose_run import diagnose

    summary, lines = diagnose(args, *checked, folder_of(args, *checked[1:]))
    print(json.dumps(summary) if args.json else "\n".join(lines))


def check(args: DiagnoseArgs) -> tuple[list[Path], str, Path | None]:
    """The folders of the priors, the task, and where real/ is if --real is no gap; UserError for what is wrong."""
    options.seed_list(args.seed, 1)
    if args.rollouts is not None:
        options.at_least_one(args, "rollouts")
    check_folder(args.out / "diagnose")
    recorded = options.home_of_rollouts("--real", Path(args.real)) if Path(args.real).is_dir() else None
    if recorded and recorded.name in ("", ".."):
        recorded = recorded.resolve()  # what is written is called like it
    config = read_config(recorded) if recorded else {}
    task, prior = args.task, args.prior
    if task is None and recorded and "task" in config:
        task = options.task_of_rollouts(recorded, None)
    if task is not None:
        check_real(task, [] if recorded else [args.real])
    if prior is None and task is None:
        raise UserError("nothing to diagnose with: name a prior with --prior, or a task with --task")
    if prior is None and config.get("prior"):
        prior = Path(config["prior"])
    folders = options.prior_folders(prior, out=args.out, task=task or "", preset=config.get("preset") or args.preset)
    task = options.task_of_priors(folders, task)
    check_real(task, [] if recorded else [args.real])
    check_folder(home := folder_of(args, task, recorded))
    if blocked := [path for path in home.glob("*.*") if path.is_dir()]:  # files go there, and the folder real/
        raise UserError(f"{blocked[0]}: is a folder; move it away or choose another --out")
    return folders, task, recorded


if __name__ == "__main__":
    cli.run_main(main, DiagnoseArgs, __doc__ or "")
