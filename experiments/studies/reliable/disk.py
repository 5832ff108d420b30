"""Impure: a disk that is full, or cannot be written to, under a run. Needs the right to mount a small file system."""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from envs.types import UserError
from experiments.studies.reliable import quick_task
from experiments.studies.reliable.runs import Trial

_FULL, _ROOM = "1m", "64m"  # sizes of the file system, before and after somebody has made room


def full(home: Path, *, rollouts: int = 20) -> dict[str, Any]:
    """A run whose disk fills up; then there is room, and it goes on."""
    return _stopped(home, "full", ["-o", f"size={_FULL}"], f"size={_ROOM}", rollouts)


def read_only(home: Path, *, rollouts: int = 4) -> dict[str, Any]:
    """A run in a folder that nobody can write to; then somebody can."""
    return _stopped(home, "read-only", ["-o", "ro"], "rw", rollouts)


def _stopped(home: Path, name: str, options: list[str], mended: str, rollouts: int) -> dict[str, Any]:
    out = home / name
    out.mkdir(parents=True, exist_ok=True)
    quick = {"period": quick_task.PERIOD, "task": quick_task.__file__, "patience": 300.0}
    with _mounted(out, options), Trial(home / f"{name}-run", rollouts=rollouts, out=out, **quick) as trial:
        if name == "full":
            trial.start_robot()
        trial.start_player()
        code, lines = trial.wait(), trial.said("player.txt").strip().splitlines()
        _call(["mount", "-o", f"remount,{mended}", str(out)])
        if trial.robot is None:
            trial.start_robot()
        trial.start_player()
        trial.finish()
        return {"disk": name, "exit code": code, "said": lines[-1] if lines else "", **trial.audit()._asdict()}


@contextlib.contextmanager
def _mounted(folder: Path, options: list[str]) -> Iterator[None]:
    _call(["mount", "-t", "tmpfs", *options, "tmpfs", str(folder)])
    try:
        yield
    finally:
        _call(["umount", "-l", str(folder)])


def _call(command: list[str]) -> None:
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        message = (getattr(error, "stderr", None) or str(error)).strip()
        raise UserError(f"{' '.join(command)}: {message}; leave --parts disk out where you may not mount") from error
