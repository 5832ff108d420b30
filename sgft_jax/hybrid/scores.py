"""What a run scores. D4RL's scale, where 0 is a random policy and 100 an expert: Fu et al. 2020."""

from collections.abc import Mapping
from typing import Any

import numpy as np

BOUNDS = {"halfcheetah": (-280.178953, 12135.0), "walker2d": (1.629008, 4592.3)}  # return at 0 and at 100
LATE = 10  # evaluations that a score averages, beside the last one
_ALWAYS = ("step", "score", "success", "return", "exploded")  # in the evaluations of every task


def normalised(task: str, total: float) -> float | None:
    """An undiscounted return [] on that scale; None for a task that has none."""
    if task not in BOUNDS:
        return None
    low, high = BOUNDS[task]
    return 100 * (total - low) / (high - low)


def late(curve: np.ndarray) -> np.ndarray:
    """[seeds], the mean of the last ten evaluations. curve: [evaluations, seeds]."""
    return curve[-LATE:].mean(0)


def shown(curve: np.ndarray, score: str) -> np.ndarray:
    """[seeds], what tables show of a curve [evaluations, seeds]. score: "last" or "late", see `late`."""
    return curve[-1] if score == "last" else late(curve)


def measures(line: Mapping[str, Any]) -> list[str]:
    """The names of what else the task is judged by, in a line of `eval.jsonl`."""
    return [name for name in line if name not in _ALWAYS]
