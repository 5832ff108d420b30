"""Fit the prediction of `experiments.diagnose` to finished fine-tuning runs, and measure how well it holds.

Without --check, the gains on every second gap are predicted from the others (docs/diagnose.md).
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from envs.types import UserError
from experiments.runner import cli
from experiments.runner.options import Impl, Json, Out, seed_list
from sgft_jax.presets import DEFAULT_PRESET


@dataclass(frozen=True)
class CalibrateArgs:
    """One fit of the prediction."""

    runs: tuple[Path, ...]
    """Finished fine-tuning runs to fit to: their folders, or folders that hold some."""
    check: tuple[Path, ...] = ()
    """Other runs, on which the fitted prediction is then checked."""
    task: str | None = None
    """A task by name, or a Python file with a task of your own; default: the task of each run."""
    prior: Path | None = None
    """Folder of a prior of SAC, or of several (prior/seed-*); default: those that the runs began with, else those of
    <out>/pretrain/<task>/<preset>."""
    json: Json = False
    out: Out = Path("runs")
    preset: str = DEFAULT_PRESET
    """Expert: pretraining preset whose priors to take where neither --prior nor a run names any."""
    seed: int = 0
    """Expert: another seed plays other simulated rollouts."""
    impl: Impl = "auto"


def main(args: CalibrateArgs) -> None:
    """Fits, checks and prints. Raises UserError where runs hold too little, or are in both lists."""
    runs, others = check(args)
    from experiments.studies.calibration import calibrate

    summary, lines = calibrate(args, runs, others)
    print(json.dumps(summary) if args.json else "\n".join(lines))


def check(args: CalibrateArgs) -> tuple[list[Path], list[Path]]:
    """The runs to fit to and those to check on; UserError where runs hold too little, or are in both lists."""
    seed_list(args.seed, 1)
    if not args.runs:
        raise UserError("--runs: name at least one finished fine-tuning run, or a folder that holds some")
    runs, others = find_runs("--runs", args.runs), find_runs("--check", args.check)
    if shared := set(runs) & set(others):
        raise UserError(f"--check: {min(shared)} is also in --runs; what was fitted cannot check the fit")
    return runs, others


def find_runs(option: str, folders: Sequence[Path]) -> list[Path]:
    """The folders of fine-tuning runs with recorded rollouts and a curve; raises UserError where there is none."""
    runs: dict[Path, None] = {}
    for folder in folders:
        inside = [path.parent for path in sorted(folder.rglob("eval.jsonl")) if (path.parent / "real").is_dir()]
        if not inside:
            raise UserError(
                f"{option} {folder}: holds no fine-tuning run with recorded rollouts (eval.jsonl and real/)"
            )
        runs |= dict.fromkeys(inside)
    return list(runs)


if __name__ == "__main__":
    cli.run_main(main, CalibrateArgs, __doc__ or "")
