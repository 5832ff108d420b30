"""What each factor of a factorial experiment does: paired effects over everything else. Pure."""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from sgft_jax.math.stats import Interval, bootstrap_interval, mean

Levels = tuple[bool, ...]  # of every factor, whether it is high


def effects(
    cells: Mapping[Levels, ArrayLike], factors: Sequence[str], *, priors: ArrayLike | None = None
) -> dict[str, Interval]:
    """Main effects by name of the factor, and two-way interactions as "one x other".

    cells: [members] scores of every combination of levels; member i of each began from the same prior. A main effect is
    the mean at the high level minus that at the low one. An interaction is half of what one effect gains where the
    other factor is high. Intervals draw members, or priors [members] first where they are given. Raises ValueError
    for a combination that is missing.
    """
    combinations = list(itertools.product((False, True), repeat=len(factors)))
    if missing := [levels for levels in combinations if levels not in cells]:
        raise ValueError(f"no scores of the cell {missing[0]}")
    signs = dict(zip(factors, np.where(np.array(combinations), 1.0, -1.0).T, strict=True))  # of each factor [cells]
    scores = np.stack([np.asarray(cells[levels], np.float64) for levels in combinations])  # [cells, members]
    pairs = itertools.combinations(factors, 2)
    contrasts = signs | {f"{one} x {other}": signs[one] * signs[other] for one, other in pairs}
    half = len(combinations) / 2
    return {
        name: bootstrap_interval(contrast @ scores / half, statistic=mean, priors=priors)
        for name, contrast in contrasts.items()
    }
