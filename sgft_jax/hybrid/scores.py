"""What a run from a fixed data set scores."""

from collections.abc import Mapping
from typing import Any

import numpy as np

LATE = 10  # evaluations that a score averages, beside the last one
_ALWAYS = ("step", "score", "success", "return", "exploded")  # in the evaluations of every task


def late(curve: np.ndarray) -> np.ndarray:
    """[seeds], the mean of the last ten evaluations. curve: [evaluations, seeds]."""
    return curve[-LATE:].mean(0)


def shown(curve: np.ndarray, score: str) -> np.ndarray:
    """[seeds], what tables show of a curve [evaluations, seeds]. score: "last" or "late", see `late`."""
    return curve[-1] if score == "last" else late(curve)


def measures(line: Mapping[str, Any]) -> list[str]:
    """The names of what else the task is judged by, in a line of `eval.jsonl`."""
    return [name for name in line if name not in _ALWAYS]
