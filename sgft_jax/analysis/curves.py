"""Learning curves: what runs of any kind scored in the real system, what a curve says, which are comparable. Pure.

A curve holds any score (success, return) of several members, one for each seed, as arrays in `Curve.scores`. `reading`
makes curves of run folders, `release` of released tables.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from sgft_jax.math.stats import ENOUGH, Interval, bootstrap_interval, iqm, mean, paired_improvement
from sgft_jax.methods import FIXED_NAMES, NAMES, get_method

LEVEL = 0.9  # success that counts as solved
SCORES = ("success", "return")
IDENTITY = ("task", "gap", "method", "variant", "priors")


@dataclass(frozen=True)
class Curve:
    """Evaluations of one run in the real system; the first one is before it learns anything.

    task, method, variant ("" for a method's defaults): what was run. gap: the real system of fine-tuning, or the
    simulator of learning from a log, "" where the method sees none. data: the log, "" without one. priors: name of the
    set of priors that the members began from; curves are comparable member by member where it is the same. seeds:
    [members]. prior: [members] index into the set, -1 where unknown. x: [evaluations], in `unit`: real rollouts or
    updates so far. transitions: [evaluations] real ones used so far, nan where nothing real is collected. minutes:
    [evaluations] of robot time without resets. scores: by name, [members, evaluations], the task's own, never reshaped,
    and what else it is judged by. score: the one that summaries are of. facts: commit, hardware and options of the run,
    for tables of runs. training: [members, evaluations] mean score of the training rollouts since the evaluation
    before, nan where there were none; None where it is not known.
    """

    task: str
    gap: str
    method: str
    variant: str = ""
    priors: str = ""
    _: KW_ONLY
    seeds: np.ndarray
    x: np.ndarray
    scores: Mapping[str, np.ndarray]
    score: str = "success"
    prior: np.ndarray = field(default_factory=lambda: np.array(-1))
    transitions: np.ndarray = field(default_factory=lambda: np.array(np.nan))
    minutes: np.ndarray = field(default_factory=lambda: np.array(np.nan))
    facts: Mapping[str, Any] = field(default_factory=dict)
    training: np.ndarray | None = None
    data: str = ""
    unit: Literal["rollouts", "updates"] = "rollouts"

    def __post_init__(self) -> None:
        """What nobody knows is so for every member and evaluation."""
        for name, like in (("prior", self.seeds), ("transitions", self.x), ("minutes", self.x)):
            object.__setattr__(self, name, np.broadcast_to(getattr(self, name), like.shape))

    @property
    def identity(self) -> dict[str, str]:
        """What tells runs over real rollouts apart but for their seeds, see `IDENTITY`."""
        return {name: getattr(self, name) for name in IDENTITY}

    @property
    def values(self) -> np.ndarray:
        """[members, evaluations] of the chosen score."""
        return self.scores[self.score]

    @property
    def spec(self) -> str:
        """The method with its variant, as commands take it: METHOD or METHOD:VARIANT."""
        return ":".join(filter(None, [self.method, self.variant]))

    @property
    def name(self) -> str:
        """The method with its variant, as tables and legends have it; over updates that is a preset, as typed."""
        return self.spec if self.unit == "updates" else self.spec.replace(":", " ", 1)

    @property
    def family(self) -> str:
        """The kind of method; "own" for one that does not come with the library."""
        if self.unit == "updates":
            return get_method(self.method, "fixed").kind if self.method in FIXED_NAMES else "own"
        return get_method(self.method).family if self.method in NAMES else "own"

    def of(self, score: str) -> "Curve":
        """The same curve for another score; training rollouts are known by the run's own alone."""
        return replace(self, score=score, training=self.training if score == self.score else None)

    def first(self, n: int) -> "Curve":
        """The same curve with its first n members alone; with all of them where there are fewer."""
        return self.members(range(min(n, len(self.seeds))))

    def members(self, indices: Sequence[int]) -> "Curve":
        """The same curve of these members, in this order."""
        chosen = np.asarray(indices, int)
        scores = {name: values[chosen] for name, values in self.scores.items()}
        training = None if self.training is None else self.training[chosen]
        return replace(self, seeds=self.seeds[chosen], prior=self.prior[chosen], scores=scores, training=training)


class Records(NamedTuple):
    """Curves, and a line for each run that was left out or is unfinished."""

    curves: list[Curve]
    notes: list[str]


def make_curve(
    evaluations: Mapping[int, Any],
    task: Any,
    *,
    gap: str,
    method: str,
    seeds: Sequence[int],
    variant: str = "",
    transitions: Sequence[float] | None = None,
) -> Curve:
    """A curve from Python alone, without a run folder.

    evaluations: the real rollouts made so far -> what `sgft_jax.evaluate` played then, episodes [members, n]. task: the
    `Env`. gap, method, variant: names for tables and figures. seeds: [members]. transitions: [evaluations] real ones
    made so far, such as the mean of `FinetuneProgress.transitions`; None where no rollout ended early.
    """
    from envs.rollout import counted  # brings JAX, which reading curves does without

    played, rollouts = list(evaluations.values()), np.array(list(evaluations))

    def mean_of(score: Callable[[Any], Any]) -> np.ndarray:
        return np.stack([np.asarray(score(episodes)).mean(1) for episodes in played], axis=1)

    made = rollouts * task.episode_length if transitions is None else np.rint(transitions).astype(int)
    return Curve(
        task.name,
        gap,
        method,
        variant,
        seeds=np.asarray(seeds),
        x=rollouts,
        transitions=made,
        minutes=made * task.control_dt / 60,
        scores={"success": mean_of(lambda x: x.success), "return": mean_of(lambda x: counted(x)[1])},
        score=task.score,
    )


# ---------------------------------------------------------------- metrics


def common_grid(curves: Iterable[Curve]) -> np.ndarray:
    """The x at which every one of the curves was evaluated, in order."""
    first, *others = (set(curve.x.tolist()) for curve in curves)
    return np.array(sorted(first.intersection(*others)), int)


def at(curve: Curve, x: int) -> np.ndarray | None:
    """[members] score at the evaluation at exactly this x; None where there was none."""
    (index,) = np.nonzero(curve.x == x)
    return curve.values[:, index[-1]] if index.size else None


def area(curve: Curve, grid: Sequence[int] | np.ndarray) -> np.ndarray | None:
    """[members] mean score from the first to the last x of a grid: area by trapezoids over length.

    grid: of x, increasing, the same for all curves that are compared; None unless the curve was evaluated at two or
    more of them and at all of them. High where learning is early and lasts.
    """
    points = [point for n in grid if (point := at(curve, int(n))) is not None]
    if len(points) < max(len(grid), 2):
        return None
    return np.trapezoid(np.stack(points, 1), np.asarray(grid, np.float64)) / (grid[-1] - grid[0])


def deepest_fall(curve: Curve, below: np.ndarray | None = None) -> float:
    """How far the mean over members ever was below the mean of these scores [members]; never negative.

    below: for example `zero_shot`; default: the method's own start.
    """
    average = curve.values.mean(0)
    return max(float((average[0] if below is None else below.mean()) - average.min()), 0.0)


def zero_shot(curve: Curve, others: Iterable[Curve]) -> np.ndarray | None:
    """[members] scores of the simulator's policy before any fine-tuning, with the same seeds and priors.

    others: curves of the same task, gap and set of priors, to look it up where the method itself begins otherwise (see
    `Online.zero_shot`). None if it was not evaluated there.
    """
    for other in sorted(others, key=lambda other: other is not curve):
        if other.method in NAMES and get_method(other.method).zero_shot and other.x[0] == 0:
            place = {seed: i for i, seed in enumerate(other.seeds.tolist())}
            if set(curve.seeds.tolist()) <= place.keys():
                return other.values[[place[seed] for seed in curve.seeds.tolist()], 0]
    return None


def training_score(curve: Curve) -> np.ndarray | None:
    """[members] mean score of all training rollouts: what the robot lived through. None where it is not known."""
    if curve.training is None:
        return None
    weights = np.diff(curve.x, prepend=0) * np.isfinite(curve.training)
    played = weights.sum(1)
    return np.nansum(curve.training * weights, axis=1) / played if played.all() else None


def improvement(curve: Curve, over: Curve, grid: Sequence[int] | np.ndarray) -> Interval | None:
    """Probability that the area of one method is larger than that of another from the same prior, with its interval.

    The prior is the random factor; where priors are unknown, the seed. None where there is nothing to compare.
    """
    areas, others = area(curve, grid), area(over, grid)
    if areas is None or others is None:
        return None
    known = bool((curve.prior >= 0).all() and (over.prior >= 0).all())
    labels = (curve.prior, over.prior) if known else (curve.seeds, over.seeds)
    return paired_improvement(areas, others, *labels) if np.intersect1d(*labels).size else None


def improvement_of_pairs(above: np.ndarray, below: np.ndarray) -> Interval:
    """P(above > below) over all pairs of runs, mean over gaps; [gaps, members] each. Ties count half. Draws members."""
    a, b = above[:, :, None], below[:, None, :]
    wins = ((a > b) + 0.5 * (a == b)).mean(0)  # [members of one, members of the other], mean over gaps
    estimate = np.asarray(wins.mean())
    if min(wins.shape) < ENOUGH:
        return Interval(estimate, np.asarray(np.nan), np.asarray(np.nan))
    rng = np.random.default_rng(0)
    drawn = [wins[np.ix_(*(rng.integers(n, size=n) for n in wins.shape))].mean() for _ in range(1000)]
    return Interval(estimate, *np.quantile(drawn, (0.025, 0.975)))


def transitions_until_held(curve: Curve, level: float = LEVEL) -> int | None:
    """Real transitions at the first of two evaluations in a row at which the mean over members is at least `level`.

    None if that never happened; a single evaluation says too little, as success often falls again after it.
    """
    reached = curve.values.mean(0) >= level - 1e-9  # a mean that is 0.9 in exact arithmetic is often a little less
    held = reached[:-1] & reached[1:]
    return int(curve.transitions[np.argmax(held)]) if held.any() else None


def by_prior(curve: Curve) -> bool:
    """Whether enough priors are behind a curve to treat the prior as the random factor."""
    return bool((curve.prior >= 0).all()) and len(np.unique(curve.prior)) >= ENOUGH


def spread(curve: Curve, scores: np.ndarray, statistic: Callable[..., np.ndarray] = iqm) -> Interval:
    """A statistic over members with its interval, pointwise: hierarchical by prior if `by_prior`, else by seed.

    scores: [members, ...], such as those at one evaluation.
    """
    return bootstrap_interval(scores, statistic=statistic, priors=curve.prior if by_prior(curve) else None)


def describe(curve: Curve) -> dict[str, Any]:
    """The numbers of a run for machines, as JSON data.

    zero_shot, final: every score, as interquartile mean with its 95 % interval (`spread`; nan where too few
    seeds tell) and as mean. deepest_fall, transitions_until_held: of the mean over seeds.
    """
    return {
        "zero_shot": _point(curve, 0),
        "final": _point(curve, -1),
        "deepest_fall": deepest_fall(curve),
        "transitions_until_held": {"level": LEVEL, "transitions": transitions_until_held(curve)},
        "seeds": len(curve.seeds),
    }


def _point(curve: Curve, i: int) -> dict[str, Any]:
    point: dict[str, Any] = {
        "rollouts": int(curve.x[i]),
        "transitions": int(curve.transitions[i]),
        "robot_minutes": float(curve.minutes[i]),
    }
    for name, values in curve.scores.items():
        band = spread(curve, values[:, i])
        bounds = {"iqm": band.estimate, "low": band.low, "high": band.high, "mean": mean(values[:, i])}
        point[name] = {key: float(value) for key, value in bounds.items()}
    return point


# ---------------------------------------------------------------- choosing what to compare


def by_priors(curves: Iterable[Curve]) -> dict[str, list[Curve]]:
    """Curves by their set of priors, the set with the most methods first, in the order of `methods.NAMES`."""
    sets: dict[str, list[Curve]] = defaultdict(list)
    for curve in sorted(curves, key=_rank):
        sets[curve.priors].append(curve)
    return dict(sorted(sets.items(), key=lambda item: -len({curve.method for curve in item[1]})))


def from_main_priors(curves: Iterable[Curve]) -> list[Curve]:
    """Curves of methods with their defaults that are comparable: from one set of priors for each kind of prior.

    Methods on SAC's priors and on TD-MPC2's cannot share a set; of either kind the set with the most methods counts.
    """
    chosen: dict[str, str] = {}
    plain = [curve for curve in curves if not curve.variant]
    for name, members in by_priors(plain).items():
        for curve in members:
            chosen.setdefault(_kind(curve), name)
    return sorted((curve for curve in plain if chosen[_kind(curve)] == curve.priors), key=_rank)


def _kind(curve: Curve) -> str:
    return get_method(curve.method).prior if curve.method in NAMES else "sac"


def _rank(curve: Curve) -> tuple[bool, int, str]:
    place = NAMES.index(curve.method) if curve.method in NAMES else len(NAMES)
    return (curve.variant != "", place, curve.name)
