"""How well a robot's clock was kept, from the log of its commands."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from experiments.studies.reliable.runs import TASK, Trial

WHEEL_LEGGED = 4, 1  # numbers that the task measures and commands


def kept_clock(
    home: Path, *, period: float, rollouts: int, utd: float, task: str = str(TASK), sizes: tuple[int, int] = (3, 1)
) -> dict[str, Any]:
    """A run with a learner on the same cores: lateness, and jitter of the period in ms.

    utd: updates for each step, enough to keep the learner busy for as long as the robot plays.
    """
    busy = ("--options.utd", str(utd), "--hand-over", "steps")
    with Trial(home, period=period, rollouts=rollouts, task=task, sizes=sizes, more=busy) as trial:
        trial.start()
        trial.finish()
    log = home / "commands.log"
    off = 1e3 * np.abs(periods(log) - period)
    middle, most, worst = np.percentile(off, [50, 99, 100])
    jitter = {"median ms": middle, "99 % ms": most, "worst ms": worst}
    return {"Hz": 1 / period, "steps": len(off), **jitter, "late": late_share(log), **trial.audit()._asdict()}


def commands(log: Path) -> Iterator[dict[str, Any]]:
    """What the robot's client has written down before it sent it."""
    with open(log, "rb") as file:
        yield from msgpack.Unpacker(file)


def late_share(log: Path) -> float:
    """The share of steps for which no command came in time."""
    return float(np.mean([command["late"] for command in commands(log)]))


def periods(log: Path) -> np.ndarray:
    """Seconds between the commands of every two steps that follow each other in an episode."""
    pairs = itertools.pairwise(commands(log))
    follow = [(a, b) for a, b in pairs if b["episode"] == a["episode"] and b["step"] == a["step"] + 1]
    return np.array([b["clock"] - a["clock"] for a, b in follow])
