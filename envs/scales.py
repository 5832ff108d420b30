"""Returns on the scale of D4RL, where 0 is a random policy and 100 an expert. Imports nothing heavy."""

D4RL = {"halfcheetah": (-280.178953, 12135.0), "walker2d": (1.629008, 4592.3)}  # return at 0 and at 100, by task


def normalised(task: str, total: float) -> float | None:
    """An undiscounted return [] on that scale; None for a task that has none. Source: D4RL (Fu et al. 2020)."""
    if task not in D4RL:
        return None
    low, high = D4RL[task]
    return 100 * (total - low) / (high - low)
