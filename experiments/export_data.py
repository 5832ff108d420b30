"""Export the real rollouts of a run as a data set that others read: for Minari, or for LeRobot (v3).

What is exported is what was measured, what was sent, and what the step led to. Episodes end where they ended, their
last observation included. What a policy reads beyond measurements, such as its last actions, is left out.
"""

import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from envs.types import UserError
from experiments.runner import cli
from experiments.runner.options import check_sizes, episodes_of, home_of_rollouts, task_of_rollouts
from sgft_jax.io.runs import check_folder, read_config

_AUTHOR = "sgft_jax experiments.export_data"


@dataclass(frozen=True)
class ExportDataArgs:
    """One data set of one run."""

    run: Path
    """Folder of a fine-tuning run, or any other with rollouts in real/ (docs/formats.md)."""
    to: Literal["minari", "lerobot"]
    """minari: a folder that Minari's library opens. lerobot: a folder that LeRobot's opens, version 3."""
    seed: int | None = None
    """One seed of the run; default: all, the episodes of the first one first."""
    out: Path | None = None
    """The new folder. Minari wants a version at the end of its name. Default: export/<to>/<run>-v0 inside --run."""
    task: str | None = None
    """A Python file with a task of your own; default: the task of the run."""


def main(args: ExportDataArgs) -> None:
    """Writes the data set and says where it is."""
    home = home_of_rollouts("--run", args.run)
    task, folder = task_of_rollouts(home, args.task), args.out or home / "export" / args.to / _name(home, args.seed)
    check_folder(folder)
    if folder.exists():
        raise UserError(f"{folder}: exists already; choose another --out, or remove it")
    if args.to == "minari" and not re.search(r"-v\d+$", folder.name):
        raise UserError(f"--out {folder}: Minari wants a version at the end, such as {folder.name}-v0")
    if args.to == "lerobot" and importlib.util.find_spec("pyarrow") is None:
        raise UserError("--to lerobot: pyarrow is not installed; pip install 'sgft-jax[lerobot]'")
    stored = episodes_of(home, args.seed)
    import envs
    from sgft_jax.datasets import lerobot, recording

    env = envs.make(task)
    check_sizes(home, stored, env)
    episodes = recording.of_stored(stored, env.measured_dim)
    if not episodes:
        raise UserError(f"{home}: holds no valid step")
    if args.to == "minari":
        entries = {"observation": [e._asdict() for e in env.measured], "action": [e._asdict() for e in env.action]}
        about = {"algorithm_name": str(read_config(home).get("method", "")), "author": [_AUTHOR], "task": env.name}
        recording.write_minari(folder, episodes, {**about, "control_dt": env.control_dt, **entries})
    else:
        lerobot.write(folder, episodes, env)
    steps, successes = sum(len(e.reward) for e in episodes), sum(bool(e.success) for e in episodes)
    print(f"{folder}: {len(episodes)} episodes, {steps:,} transitions, {successes} successes")


def _name(home: Path, seed: int | None) -> str:
    """What a data set is called: `push-default-guarded-seeds-0-9-v0`."""
    words = home.absolute().parts[-4:-1] if read_config(home) else ()
    which = home.name if seed is None else f"seed-{seed}"
    return f"{re.sub(r'[^\w.-]', '-', '-'.join([*words, which]))}-v0"


if __name__ == "__main__":
    cli.run_main(main, ExportDataArgs, __doc__ or "")
