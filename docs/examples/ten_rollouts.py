"""How many rollouts tell whether to choose `sac` or `guarded`? From the released data.

    python docs/examples/ten_rollouts.py

Every `robust` prior met every system once with both methods: 24 test gaps, towel, ball and Bullet. The first table
sorts these pairs by success before fine-tuning. For the second one rollouts of the policy are drawn, and `guarded` is
chosen where enough of them fail; systems count alike. Falls: share of runs that were at any time 10 points below.
"""

from itertools import pairwise
from math import comb
from pathlib import Path
from typing import Any

import numpy as np

from sgft_jax.analysis import release
from sgft_jax.analysis.tables import markdown

DATA = Path(__file__).parent.parent / "data"
METHODS = ("sac", "guarded")
STARTS = (0, 60, 70, 80, 97, 101)  # per cent
RULES = ((0, 1), (0, 0), (4, 1), (4, 2), (10, 2), (10, 3), (10, 4), (20, 6))  # rollouts, failures: never, always, ...
FALL, ROLLOUTS = 10, 20  # points that count; rollouts of fine-tuning


def main() -> None:
    """Prints both tables, in per cent."""
    systems = pairs()
    start, end, fall = np.concatenate(systems, axis=1)
    start, fell = start.mean(1), 100.0 * (fall > FALL)
    rows = []
    for low, high in pairwise(STARTS):
        inside = (start >= low) & (start < high)
        rows.append([f"{low} to {high - 1}", f"{inside.sum()}", *cells([*end[inside].mean(0), *fell[inside].mean(0)])])
    print(markdown(["start", "priors", *(f"{name}: {x}" for x in ("end", "fell") for name in METHODS)], rows))

    weights = np.concatenate([np.full(x.shape[1], 1 / len(systems) / x.shape[1]) for x in systems])
    rows = []
    for n, failures in RULES:
        guarded = probability(n, failures, start / 100)
        scores = [weights @ (x[:, 0] + guarded * (x[:, 1] - x[:, 0])) for x in (end, fell)]
        chosen = [100 * probability(n, failures, np.array(p)) for p in (0.4, 0.6, 0.75, 0.9)]
        rows.append([f"{failures} of {n}", *cells([*scores, *chosen])])
    print(markdown(["`guarded` if", "end", "fell", *(f"chosen at {p}" for p in (40, 60, 75, 90))], rows))


def pairs() -> list[np.ndarray]:
    """Of each system [3, priors, 2]: start, end and deepest fall in per cent, of `sac` and `guarded`."""
    systems: dict[str, dict[str, np.ndarray]] = {}
    for curve in release.read(Path("runs"), DATA).curves:
        drawn = "-2-" in curve.gap or curve.task in ("push-towel", "push-ball", "panda-push")
        if drawn and curve.priors == "robust" and curve.spec in METHODS:
            values = 100 * curve.values[:, curve.x <= ROLLOUTS]
            scores = np.stack([values[:, 0], values[:, -1], values[:, 0] - values.min(1)])
            systems.setdefault(f"{curve.task}/{curve.gap}", {})[curve.method] = scores
    return [np.stack([played[name] for name in METHODS], axis=-1) for played in systems.values()]


def probability(n: int, failures: int, success: np.ndarray) -> np.ndarray:
    """That at least so many of n rollouts fail, for a policy that succeeds so often (0 to 1)."""
    terms = [comb(n, k) * (1 - success) ** k * success ** (n - k) for k in range(failures, n + 1)]
    return np.sum(terms, axis=0) * np.ones_like(success)


def cells(values: list[Any]) -> list[str]:
    """Whole numbers."""
    return [f"{value:.0f}" for value in values]


if __name__ == "__main__":
    main()
