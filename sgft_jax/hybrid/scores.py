"""What a run scores. D4RL's scale, where 0 is a random policy and 100 an expert: Fu et al. 2020."""

import numpy as np

BOUNDS = {"halfcheetah": (-280.178953, 12135.0), "walker2d": (1.629008, 4592.3)}  # return at 0 and at 100
LATE = 10  # evaluations that a score averages, beside the last one


def normalised(task: str, total: float) -> float | None:
    """An undiscounted return [] on that scale; None for a task that has none."""
    if task not in BOUNDS:
        return None
    low, high = BOUNDS[task]
    return 100 * (total - low) / (high - low)


def late(curve: np.ndarray) -> np.ndarray:
    """[seeds], the mean of the last ten evaluations. curve: [evaluations, seeds]."""
    return curve[-LATE:].mean(0)
