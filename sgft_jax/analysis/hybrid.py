"""Tables of learning from real data and a simulator: methods on data sets and simulators. Pure.

A method without a simulator has one outcome for each data set, a method without data one for each simulator; both stand
in every row that they belong to.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from envs.scales import D4RL, normalised
from sgft_jax.analysis.scoreboard import improvement
from sgft_jax.analysis.tables import NONE, markdown, number, plain
from sgft_jax.hybrid.scores import shown
from sgft_jax.math.stats import Interval, bootstrap_interval, mean, rank_correlation

EVERY = ""  # data or simulator of a method that sees none
_FEWEST = 3  # methods that have an order worth comparing


class Outcome(NamedTuple):
    """What one run scored in the real system. data, gap: names, or `EVERY`. scores: [seeds], what tables show.

    updates: [evaluations], curve: [seeds, evaluations] scores after so many, for figures. measures: what else the task
    is judged by, by name, as `curve`.
    """

    method: str
    data: str
    gap: str
    scores: np.ndarray
    updates: np.ndarray = np.zeros(0)
    curve: np.ndarray = np.zeros((0, 0))
    measures: Mapping[str, np.ndarray] = MappingProxyType({})


def outcome(
    method: str,
    data: str,
    gap: str,
    lines: Sequence[Mapping[str, Any]],
    scores: ArrayLike | None = None,
    *,
    measures: Sequence[str] = (),
) -> Outcome:
    """What a run scored. lines: of its `eval.jsonl`. scores: [seeds], default those of the last evaluation.

    measures: other names in the lines.
    """
    updates, curve, *others = (np.array([line[name] for line in lines]).T for name in ("step", "score", *measures))
    totals = shown(curve.T, "last") if scores is None else np.asarray(scores)
    return Outcome(method, data, gap, totals, updates, curve, dict(zip(measures, others, strict=True)))


class Results(NamedTuple):
    """The outcomes of one task, and what the tables have: data sets, simulators and methods in their order.

    score: "success" or "return".
    """

    task: str
    score: str
    data: Sequence[str]
    gaps: Sequence[str]
    methods: Sequence[str]
    outcomes: Sequence[Outcome]

    def find(self, method: str, data: str, gap: str) -> Outcome | None:
        """What stands in that cell; None where nothing has finished."""
        for own in self.outcomes:
            if own.method == method and own.data in (data, EVERY) and own.gap in (gap, EVERY):
                return own
        return None

    def of(self, method: str, data: str, gap: str) -> np.ndarray | None:
        """[seeds] scores in that cell; None where nothing has finished."""
        own = self.find(method, data, gap)
        return None if own is None else own.scores


def cells(results: Results) -> str:
    """A row for each data set and simulator: mean of every method with its standard deviation over seeds."""
    rows = [
        [data or NONE, gap, *(_spread(results.of(method, data, gap), results.score) for method in results.methods)]
        for data in results.data
        for gap in results.gaps
    ]
    return markdown(["data", "simulator", *results.methods], rows)


def headline(results: Results) -> str:
    """A row for each data set: mean over simulators with its bootstrap interval, on D4RL's scale if there is one.

    A resample draws seeds within every simulator. A method stands only where it has finished on all of them.
    """
    rows = [[data or NONE, *(_overall(results, method, data) for method in results.methods)] for data in results.data]
    number = len(results.gaps)
    return markdown([f"mean over {number} simulators" if number > 1 else "one simulator", *results.methods], rows)


def duels(results: Results, reference: str) -> str:
    """A row for each data set: probability that a seed of the reference scores higher than one of another method.

    It is the mean over the simulators on which both have finished, in per cent, with its bootstrap interval over seeds.
    """
    others = [method for method in results.methods if method != reference]
    rows = [[data or NONE, *(_duel(results, reference, other, data) for other in others)] for data in results.data]
    return markdown([f"P({reference} better), per cent", *others], rows)


def measured(results: Results, score: str) -> str | None:
    """A row for each measure, data set and simulator: mean of every method with its bootstrap interval over seeds.

    score: "last" or "late", which evaluations count. None where no run has a measure.
    """
    names = dict.fromkeys(name for own in results.outcomes for name in own.measures)
    rows = []
    for name in names:
        for data in results.data:
            for gap in results.gaps:
                found = [results.find(method, data, gap) for method in results.methods]
                rows.append([name, data or NONE, gap, *(_measured(own, name, score) for own in found)])
    return markdown(["measure", "data", "simulator", *results.methods], rows) if rows else None


def ranks(results: Results, others: Results) -> str:
    """A row for each data set and simulator: do other runs, such as longer ones, put the methods in the same order?

    Spearman's correlation of the methods' means, over the methods that have finished in both, with its bootstrap
    interval over the seeds of each method; then the methods in the order of either, the best first. Rows with fewer
    than three methods are left out.
    """
    rows = []
    for data in results.data:
        for gap in results.gaps:
            both = [(m, results.of(m, data, gap), others.of(m, data, gap)) for m in results.methods]
            found = {m: (own, theirs) for m, own, theirs in both if own is not None and theirs is not None}
            if len(found) >= _FEWEST:
                orders = [sorted(found, key=lambda m: -found[m][i].mean()) for i in (0, 1)]
                words = [", ".join(order) for order in orders]
                rows.append([data or NONE, gap, number(agreement(list(found.values())), "", digits=2), *words])
    return markdown(["data", "simulator", "rank correlation", "order here", "order there"], rows)


def agreement(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Interval:
    """Spearman's correlation of means: of each method its scores [seeds] in either set of runs.

    A resample draws seeds of each method, the same in both sets. Seeds that one of the two lacks are left out.
    """
    seeds = min(len(scores) for pair in pairs for scores in pair)
    scores = np.concatenate([np.stack([own[:seeds], theirs[:seeds]], axis=-1) for own, theirs in pairs])

    def correlation(scores: np.ndarray, *, axis: int = 0) -> np.ndarray:
        each = scores.reshape(*scores.shape[:axis], len(pairs), seeds, 2)
        return rank_correlation(each.mean(-2), axis=axis)

    return bootstrap_interval(scores, statistic=correlation, strata=np.repeat(np.arange(len(pairs)), seeds))


def overall(results: Results, method: str, data: str) -> Interval | None:
    """What `headline` shows in a cell; None where a simulator is missing."""
    found = [results.of(method, data, gap) for gap in results.gaps]
    each = [own for own in found if own is not None]
    if len(each) < len(found):
        return None
    if any(own.method == method and own.gap == EVERY for own in results.outcomes):
        each = each[:1]  # the same run in every row: more of it would say that there are more seeds
    strata = np.repeat(np.arange(len(each)), [len(own) for own in each])
    return bootstrap_interval(rescaled(results.task, np.concatenate(each)), statistic=mean, strata=strata)


def rescaled(task: str, scores: np.ndarray) -> np.ndarray:
    """[n] on D4RL's scale, unchanged for a task that has none."""
    return np.array([normalised(task, x) for x in scores.tolist()]) if task in D4RL else scores


def _spread(scores: np.ndarray | None, score: str) -> str:
    if scores is None:
        return NONE
    middle = plain(float(scores.mean()), score) if score == "success" else f"{scores.mean():,.0f}"
    spread = plain(float(scores.std()), score) if score == "success" else f"{scores.std():,.0f}"
    return middle if len(scores) == 1 else f"{middle} ± {spread}"


def _overall(results: Results, method: str, data: str) -> str:
    found = overall(results, method, data)
    return NONE if found is None else number(found, results.score)


def _measured(own: Outcome | None, name: str, score: str) -> str:
    if own is None or name not in own.measures:
        return NONE
    return number(bootstrap_interval(shown(own.measures[name].T, score), statistic=mean), name, digits=2)


def _duel(results: Results, reference: str, other: str, data: str) -> str:
    pairs = [(results.of(reference, data, gap), results.of(other, data, gap)) for gap in results.gaps]
    both = [(own, theirs) for own, theirs in pairs if own is not None and theirs is not None]
    if not both:
        return NONE
    above, below = (np.stack(scores) for scores in zip(*both, strict=True))
    return number(improvement(above, below))
