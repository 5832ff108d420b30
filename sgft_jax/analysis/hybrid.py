"""Tables of learning from real data and a simulator: methods on data sets and simulators. Pure.

A method without a simulator has one outcome for each data set, a method without data one for each simulator; both stand
in every row that they belong to.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from envs import D4RL, normalised
from sgft_jax.analysis.curves import SCORES, Curve, improvement_of_pairs
from sgft_jax.analysis.tables import NONE, markdown, number, plain
from sgft_jax.math.stats import Interval, bootstrap_interval, mean, rank_correlation

LEGEND = (
    "Scores in the real system ({score}), mean and standard deviation over {seeds} seeds. Means over simulators{scale} "
    "have a 95 % bootstrap interval that draws seeds within every simulator. P(better): a random seed of {reference} "
    "against one of the other method, mean over simulators. Intervals need three seeds. Every run made {schedule}; "
    "methods without a simulator made the updates alone. The data sets are what the files hold: numbers on sets that "
    "were made anew do not belong beside published ones."
)
LATE = 10  # evaluations that a score averages, beside the last one
_SCORES = {"late": "mean of the last ten evaluations", "last": "last evaluation"}
_MEASURED = "What else the task is judged by, in these evaluations: mean with a 95 % bootstrap interval over seeds."
_FEWEST = 3  # methods that have an order worth comparing


def late(curve: np.ndarray) -> np.ndarray:
    """[seeds], the mean of the last ten evaluations. curve: [evaluations, seeds]."""
    return curve[-LATE:].mean(0)


def shown(curve: np.ndarray, score: str) -> np.ndarray:
    """[seeds], what tables show of a curve [evaluations, seeds]. score: "last" or "late", see `late`."""
    return curve[-1] if score == "last" else late(curve)


class Results(NamedTuple):
    """Curves over updates of one task, and what the tables have: data sets, simulators and methods in their order.

    methods: as METHOD or METHOD:PRESET. shown: which evaluations of a curve count, the last or the last ten.
    """

    data: Sequence[str]
    gaps: Sequence[str]
    methods: Sequence[str]
    curves: Sequence[Curve]
    shown: Literal["late", "last"] = "late"

    @property
    def task(self) -> str:
        """The one task."""
        return self.curves[0].task

    @property
    def score(self) -> str:
        """What counts: success or return."""
        return self.curves[0].score

    def find(self, method: str, data: str, gap: str) -> Curve | None:
        """What stands in that cell; None where nothing has finished."""
        for curve in self.curves:
            if curve.spec == method and curve.data in (data, "") and curve.gap in (gap, ""):
                return curve
        return None

    def of(self, method: str, data: str, gap: str, score: str | None = None) -> np.ndarray | None:
        """[seeds] scores in that cell, default the one that counts; None where nothing has finished."""
        curve = self.find(method, data, gap)
        values = None if curve is None else curve.scores.get(score or curve.score)
        return None if values is None else shown(values.T, self.shown)

    def panels(self, data: str) -> dict[str, list[Curve]]:
        """What a figure of one data set shows, see `figures.learning_curves`: simulators with the methods on each.

        A method that sees no simulator, or no data, has the same line wherever it belongs.
        """
        cells = {gap: [self.find(method, data, gap) for method in self.methods] for gap in self.gaps}
        return {f"simulator: {gap}": [curve for curve in row if curve is not None] for gap, row in cells.items()}

    def places(self) -> list[tuple[str, str]]:
        """Data sets and simulators, the rows of tables."""
        return [(data, gap) for data in self.data for gap in self.gaps]


def summary(results: Results, *, reference: str, seeds: int, schedule: str) -> list[str]:
    """The tables and their legend, a text for each. schedule: what every run made, in words."""
    scale, score = " on D4RL's scale" if results.task in D4RL else "", _SCORES[results.shown]
    legend = LEGEND.format(score=score, seeds=seeds, scale=scale, reference=reference, schedule=schedule)
    against = [duels(results, reference)] if len(results.methods) > 1 else []
    others = measured(results)
    texts = [f"# {results.task}", legend, headline(results), *against, cells(results)]
    return texts if others is None else [*texts, _MEASURED, others]


def cells(results: Results) -> str:
    """A row for each data set and simulator: mean of every method with its standard deviation over seeds."""

    def cell(method: str, data: str, gap: str) -> str:
        if (scores := results.of(method, data, gap)) is None:
            return NONE
        numbers = [float(scores.mean()), float(scores.std())][: len(scores)]  # one seed has no deviation
        success = results.score == "success"
        return " ± ".join(plain(x, results.score) if success else f"{x:,.0f}" for x in numbers)

    return _table(("data", "simulator"), results.places(), results.methods, cell)


def headline(results: Results) -> str:
    """A row for each data set: mean over simulators with its bootstrap interval, on D4RL's scale if there is one.

    A resample draws seeds within every simulator. A method stands only where it has finished on all of them.
    """
    count = len(results.gaps)
    head = f"mean over {count} simulators" if count > 1 else "one simulator"

    def cell(method: str, data: str) -> str:
        return number(overall(results, method, data), results.score)

    return _table((head,), [(data,) for data in results.data], results.methods, cell)


def duels(results: Results, reference: str) -> str:
    """A row for each data set: probability that a seed of the reference scores higher than one of another method.

    It is the mean over the simulators on which both have finished, in per cent, with its bootstrap interval over seeds.
    """
    others = [method for method in results.methods if method != reference]

    def cell(method: str, data: str) -> str:
        pairs = [(results.of(reference, data, gap), results.of(method, data, gap)) for gap in results.gaps]
        both = [(above, below) for above, below in pairs if above is not None and below is not None]
        return number(improvement_of_pairs(*map(np.stack, zip(*both, strict=True))) if both else None)

    return _table((f"P({reference} better), per cent",), [(data,) for data in results.data], others, cell)


def measured(results: Results) -> str | None:
    """A row for each measure, data set and simulator: mean of every method with its bootstrap interval over seeds.

    None where no run has a measure.
    """
    names = dict.fromkeys(name for curve in results.curves for name in curve.scores if name not in SCORES)
    places = [(name, *place) for name in names for place in results.places()]

    def cell(method: str, name: str, data: str, gap: str) -> str:
        values = results.of(method, data, gap, name)
        return number(None if values is None else bootstrap_interval(values, statistic=mean), name, digits=2)

    return _table(("measure", "data", "simulator"), places, results.methods, cell) if places else None


def _table(
    head: Sequence[str], places: Iterable[Sequence[str]], methods: Sequence[str], cell: Callable[..., str]
) -> str:
    """A row for each place, which begins with its names, and a column for each method. cell: of (method, *place)."""
    rows = [[*(name or NONE for name in place), *(cell(method, *place) for method in methods)] for place in places]
    return markdown([*head, *methods], rows)


def ranks(results: Results, others: Results) -> str:
    """A row for each data set and simulator: do other runs, such as longer ones, put the methods in the same order?

    Spearman's correlation of the methods' means, over the methods that have finished in both, with its bootstrap
    interval over the seeds of each method; then the methods in the order of either, the best first. Rows with fewer
    than three methods are left out.
    """
    rows = []
    for data, gap in results.places():
        pairs = {m: (results.of(m, data, gap), others.of(m, data, gap)) for m in results.methods}
        both = {m: (here, there) for m, (here, there) in pairs.items() if here is not None and there is not None}
        if len(both) >= _FEWEST:
            words = [", ".join(sorted(both, key=lambda m: -both[m][i].mean())) for i in (0, 1)]
            rows.append([data or NONE, gap, number(agreement(list(both.values())), "", digits=2), *words])
    return markdown(["data", "simulator", "rank correlation", "order here", "order there"], rows)


def agreement(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Interval:
    """Spearman's correlation of means: of each method its scores [seeds] in either set of runs.

    A resample draws seeds of each method, the same in both sets. Seeds that one of the two lacks are left out.
    """
    seeds = min(len(scores) for pair in pairs for scores in pair)
    scores = np.concatenate([np.stack([here[:seeds], there[:seeds]], axis=-1) for here, there in pairs])

    def correlation(scores: np.ndarray, *, axis: int = 0) -> np.ndarray:
        by_method = scores.reshape(*scores.shape[:axis], len(pairs), seeds, 2)
        return rank_correlation(by_method.mean(-2), axis=axis)

    return bootstrap_interval(scores, statistic=correlation, strata=np.repeat(np.arange(len(pairs)), seeds))


def overall(results: Results, method: str, data: str) -> Interval | None:
    """What `headline` shows in a cell; None where a simulator is missing."""
    scores = [values for gap in results.gaps if (values := results.of(method, data, gap)) is not None]
    if len(scores) < len(results.gaps):
        return None
    if any(curve.spec == method and not curve.gap for curve in results.curves):
        scores = scores[:1]  # the same run in every row: more of it would say that there are more seeds
    strata = np.repeat(np.arange(len(scores)), [len(values) for values in scores])
    return bootstrap_interval(rescaled(results.task, np.concatenate(scores)), statistic=mean, strata=strata)


def rescaled(task: str, scores: np.ndarray) -> np.ndarray:
    """[n] on D4RL's scale, unchanged for a task that has none."""
    return np.array([normalised(task, x) for x in scores.tolist()]) if task in D4RL else scores
