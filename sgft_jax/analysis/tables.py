"""Tables in Markdown of what learning curves say. Pure functions."""

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from sgft_jax.analysis.curves import (
    LEVEL,
    Curve,
    area,
    at,
    by_prior,
    common_grid,
    deepest_fall,
    improvement,
    spread,
    training_score,
    transitions_until_held,
    zero_shot,
)
from sgft_jax.math.stats import Interval, bootstrap_interval, difference_interval

NONE = "-"
LEGEND = (
    "Scores on the real system, success in per cent: interquartile mean over seeds with its 95 % bootstrap interval, "
    "which draws priors and then seeds where there are three priors or more, seeds otherwise; none where it would say "
    "nothing. Start: before the first real rollout. Area: mean score over the rollouts given, from evaluations that "
    "all methods of the table have. End: the last evaluation. Deepest fall: how far the mean ever was below the "
    "simulator's policy, and below the method's own start. Training: mean over all training rollouts, exploring. "
    f"{100 * LEVEL:.0f} % held: real transitions at the first of two evaluations in a row at which the mean is there. "
    "The last columns compare areas with those of one method, from the same priors: mean paired difference, and "
    "probability of being better with the prior as the random factor. "
    "Only methods from the same priors can be compared."
)


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of these cells."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows))


def rollouts(n: int) -> str:
    """So many of them, in words."""
    return f"{n} rollout{'s' * (n != 1)}"


def summary(curves: Sequence[Curve], reference: str | None = None) -> str:
    """A row for each curve of one task, gap and set of priors; the methods' defaults decide the grid of the area.

    reference: `Curve.spec` of the one that the others are compared with; default: the one with the largest area.
    """
    grid = shared_grid(curves)
    until = f"area, {grid[0]} to {grid[-1]} rollouts" if len(grid) > 1 else "area"
    head = ["method", "seeds", "start", until, "end (rollouts)", "deepest fall: zero-shot / own start", "training"]
    head.append(f"{100 * LEVEL:.0f} % held after")
    other = _reference(curves, grid, reference)
    rows = [_row(curve, curves, grid) for curve in curves]
    if other is not None and len(curves) > 1:
        head += [f"area minus {other.spec}", f"P(better than {other.spec})"]
        rows = [row + _against(curve, other, grid) for row, curve in zip(rows, curves, strict=True)]
    return markdown(head, rows)


def _reference(curves: Sequence[Curve], grid: np.ndarray, name: str | None) -> Curve | None:
    """The curve of that name; without a name the best one. None where it is not, or has no area."""
    means = {i: float(areas.mean()) for i, curve in enumerate(curves) if (areas := area(curve, grid)) is not None}
    chosen = [i for i in means if name in (None, curves[i].spec)]
    return curves[max(chosen, key=lambda i: means[i])] if chosen else None


def areas_by_task(tasks: Mapping[str, Sequence[Curve]]) -> str:
    """Rows of methods, columns of tasks: areas, each column on its own grid; the last column over all tasks.

    The last one is the interquartile mean over tasks and seeds, with priors and then seeds drawn within each task; it
    stands only for methods that were run on all of them.
    """
    grids = {task: shared_grid(curves) for task, curves in tasks.items()}
    by_name: dict[str, dict[str, tuple[Curve, np.ndarray]]] = {}
    for task, curves in tasks.items():
        for curve in curves:
            if (areas := area(curve, grids[task])) is not None:
                by_name.setdefault(curve.name, {})[task] = (curve, areas)
    head = ["area", *(f"{task}, to {grid[-1]} rollouts" for task, grid in grids.items() if len(grid))]
    rows = [
        [name, *(middle(*cells[task]) if task in cells else NONE for task in tasks), _overall(cells, len(tasks))]
        for name, cells in by_name.items()
    ]
    return markdown([*head, "all tasks"], rows)


def leading(tasks: Mapping[str, Sequence[Curve]], count: int) -> list[str]:
    """The names of so many curves: those that were run on the most tasks, of these the ones with the largest areas."""
    areas: dict[str, list[float]] = {}
    for curves in tasks.values():
        grid = shared_grid(curves)
        for curve in curves:
            members = area(curve, grid)
            areas.setdefault(curve.name, []).append(0.0 if members is None else float(members.mean()))
    return sorted(areas, key=lambda name: (len(areas[name]), float(np.mean(areas[name]))), reverse=True)[:count]


def shared_grid(curves: Sequence[Curve]) -> np.ndarray:
    """The evaluations that the methods with their defaults share or, without any, that all of them do.

    A run that is less than a third as long as the usual one does not shorten the grid of the others.
    """
    plain = [curve for curve in curves if not curve.variant] or curves
    usual = np.median([curve.x[-1] for curve in plain])
    return common_grid([curve for curve in plain if curve.x[-1] >= usual / 3])


def number(band: Interval | None, score: str = "success", *, digits: int = 1) -> str:
    """A score with its interval, "92 [88, 95]", and alone where the interval says nothing; success is in per cent.

    NONE where there is nothing.
    """
    if band is None:
        return NONE
    scale, digits = (100, 0) if score == "success" else (1, digits)
    rounded = [round(scale * float(x), digits) + 0.0 for x in band]  # + 0.0: no minus zero
    estimate, low, high = (f"{x:.{digits}f}" for x in rounded)
    return estimate if math.isnan(band.low) or low == high else f"{estimate} [{low}, {high}]"


def plain(value: float, score: str) -> str:
    """A score without interval, as `number` writes it."""
    return number(Interval(*(np.asarray(x) for x in (value, np.nan, np.nan))), score)


def words(score: str) -> str:
    """What the numbers are, for people."""
    return "success in per cent" if score == "success" else score


def middle(curve: Curve, scores: np.ndarray | None) -> str:
    """The interquartile mean over members of these scores [members] with its interval."""
    return number(None if scores is None else spread(curve, scores), curve.score)


def outcome(curves: Sequence[Curve]) -> str:
    """A row for each curve, a column for each evaluation that any of them has."""
    points = sorted({int(n) for curve in curves for n in curve.x})
    head = ["method", *(rollouts(n) if n else "zero-shot" for n in points)]
    return markdown(head, [[curve.name, *(middle(curve, at(curve, n)) for n in points)] for curve in curves])


def _row(curve: Curve, curves: Sequence[Curve], grid: np.ndarray) -> list[str]:
    before = zero_shot(curve, curves)
    below = NONE if before is None else plain(deepest_fall(curve, before), curve.score)
    return [
        curve.name,
        str(len(curve.seeds)),
        middle(curve, curve.values[:, 0]),
        middle(curve, area(curve, grid)),
        f"{middle(curve, curve.values[:, -1])} ({curve.x[-1]})",
        f"{below} / {plain(deepest_fall(curve), curve.score)}",
        middle(curve, training_score(curve)),
        _held(curve),
    ]


def _held(curve: Curve) -> str:
    """Transitions until success was held; nothing of returns, which have no best value to come near."""
    if curve.score != "success":
        return NONE
    held = transitions_until_held(curve)
    return f"> {curve.transitions[-1]:,}" if held is None else f"{held:,}"


def _against(curve: Curve, other: Curve, grid: np.ndarray) -> list[str]:
    areas, others, better = area(curve, grid), area(other, grid), improvement(curve, other, grid)
    if curve is other or areas is None or others is None or better is None:
        return [NONE, NONE]
    shared, i, j = np.intersect1d(curve.seeds, other.seeds, return_indices=True)
    priors = curve.prior[i] if by_prior(curve) else None
    difference = number(difference_interval(areas[i], others[j], priors=priors), curve.score) if len(shared) else NONE
    return [difference, number(better, "probability", digits=2)]


def _overall(cells: Mapping[str, tuple[Curve, np.ndarray]], tasks: int) -> str:
    if len(cells) < tasks or tasks < 2:
        return NONE
    curves, areas = zip(*cells.values(), strict=True)
    scores, strata = np.concatenate(areas), np.repeat(np.arange(len(cells)), list(map(len, areas)))
    priors = np.concatenate([curve.prior for curve in curves]) if all(map(by_prior, curves)) else None
    return number(bootstrap_interval(scores, priors=priors, strata=strata), curves[0].score)
