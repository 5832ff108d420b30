"""What each factor of a factorial experiment does: paired effects over everything else. Pure."""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sgft_jax.math.stats import Interval, bootstrap_interval, mean


class Factor(NamedTuple):
    """name; low and high: words for its two levels."""

    name: str
    low: str
    high: str


Levels = tuple[bool, ...]  # of every factor, whether it is high


def effects(
    cells: Mapping[Levels, ArrayLike], factors: Sequence[Factor], *, priors: ArrayLike | None = None
) -> dict[str, Interval]:
    """Main effects by name of the factor, and two-way interactions as "one x other".

    cells: [members] scores of every combination of levels; member i of each began from the same prior. A main effect is
    the mean at the high level minus that at the low one. An interaction is half of what one effect gains where the
    other factor is high. Intervals draw members, or priors [members] first where they are given. Raises ValueError
    for a combination that is missing.
    """
    wanted = list(itertools.product((False, True), repeat=len(factors)))
    if missing := [levels for levels in wanted if levels not in cells]:
        raise ValueError(f"no scores of the cell {missing[0]}")
    signs = np.where(np.array(wanted), 1.0, -1.0)  # [cells, factors]
    scores = np.stack([np.asarray(cells[levels], np.float64) for levels in wanted])  # [cells, members]
    contrasts = {factor.name: signs[:, i] for i, factor in enumerate(factors)}
    for (i, one), (j, other) in itertools.combinations(enumerate(factors), 2):
        contrasts[f"{one.name} x {other.name}"] = signs[:, i] * signs[:, j]
    half = len(wanted) / 2
    own = {name: each @ scores / half for name, each in contrasts.items()}
    return {name: bootstrap_interval(each, statistic=mean, priors=priors) for name, each in own.items()}
