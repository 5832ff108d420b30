"""Impure: learning curves, what runs of any kind scored in the real system; reads run folders and released tables.

A curve holds any score (success, return) of several members, one for each seed. Curves as arrays are `Curve.scores`, as
a flat table `rows`.
"""

import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from msgspec import Meta

from envs import extend, gaps
from envs.files import Count
from envs.types import UserError
from sgft_jax.files.csvfile import finite, read_csv, table_file, whole
from sgft_jax.hybrid.schedule import Schedule, name_of
from sgft_jax.hybrid.scores import measures
from sgft_jax.io.log import EVAL, METRICS, SUMMARY, check_records, read_jsonl
from sgft_jax.io.runs import CONFIG, NO_DATA, NO_SIMULATOR, read_config, read_own, read_starts
from sgft_jax.math.stats import ENOUGH, Interval, bootstrap_interval, mean, paired_improvement
from sgft_jax.methods import FIXED_NAMES, NAMES, get_method

LEVEL = 0.9  # success that counts as solved
SCORES = ("success", "return")
IDENTITY = ("task", "gap", "method", "variant", "priors")
_NUMBERS = ("prior", "seed", "rollouts", "transitions", "minutes")
COLUMNS = (*IDENTITY, *_NUMBERS, *SCORES, "training")
# Of a line of eval.jsonl, beside its scores.
_EVALUATION = {"step": Count, "rollouts": Count, "robot_minutes": Annotated[float, Meta(ge=0)]}
_UNNAMED = re.compile(r"prior|seeds?-\d+(-\d+)?")  # folders that name no set of priors
# Of a run's options those that are in other columns, or say nothing about its outcome; paths of a machine above all.
_LEFT_OUT = {"out", "prior", "resume", "overwrite", "video", "devices", "checkpoint_every", "impl"}
_LEFT_OUT |= {"task", "method", "variant", "real"}


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
    variant: str
    priors: str
    seeds: np.ndarray
    prior: np.ndarray
    x: np.ndarray
    transitions: np.ndarray
    minutes: np.ndarray
    scores: Mapping[str, np.ndarray]
    score: str = "success"
    facts: Mapping[str, Any] = field(default_factory=dict)
    training: np.ndarray | None = None
    data: str = ""
    unit: Literal["rollouts", "updates"] = "rollouts"

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


class Found(NamedTuple):
    """Curves, and a line for each run that was left out or is unfinished."""

    curves: list[Curve]
    notes: list[str]


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
            found = dict(zip(other.seeds.tolist(), other.values[:, 0].tolist(), strict=True))
            if set(curve.seeds.tolist()) <= found.keys():
                return np.array([found[seed] for seed in curve.seeds.tolist()])
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
    own, other = area(curve, grid), area(over, grid)
    if own is None or other is None:
        return None
    known = bool((curve.prior >= 0).all() and (over.prior >= 0).all())
    labels = (curve.prior, over.prior) if known else (curve.seeds, over.seeds)
    return paired_improvement(own, other, *labels) if np.intersect1d(*labels).size else None


def transitions_until_held(curve: Curve, level: float = LEVEL) -> int | None:
    """Real transitions at the first of two evaluations in a row at which the mean over members is at least `level`.

    None if that never happened; a single evaluation says too little, as success often falls again after it.
    """
    there = curve.values.mean(0) >= level - 1e-9  # a mean that is 0.9 in exact arithmetic is often a little less
    held = there[:-1] & there[1:]
    return int(curve.transitions[np.argmax(held)]) if held.any() else None


def by_prior(curve: Curve) -> bool:
    """Whether enough priors are behind a curve to treat the prior as the random factor."""
    return bool((curve.prior >= 0).all()) and len(np.unique(curve.prior)) >= ENOUGH


def spread(curve: Curve, scores: np.ndarray) -> Interval:
    """Interquartile mean over members with its interval, pointwise: hierarchical by prior if `by_prior`, else by seed.

    scores: [members, ...], such as those at one evaluation.
    """
    return bootstrap_interval(scores, priors=curve.prior if by_prior(curve) else None)


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
    found: dict[str, Any] = {
        "rollouts": int(curve.x[i]),
        "transitions": int(curve.transitions[i]),
        "robot_minutes": float(curve.minutes[i]),
    }
    for name, values in curve.scores.items():
        band = spread(curve, values[:, i])
        bounds = {"iqm": band.estimate, "low": band.low, "high": band.high, "mean": mean(values[:, i])}
        found[name] = {key: float(value) for key, value in bounds.items()}
    return found


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


# ---------------------------------------------------------------- run folders


def read_curve(folder: Path) -> Curve:
    """The learning curve of one run of `experiments.finetune` or `experiments.hybrid`; UserError if it has none.

    Their folders are finetune/<task>/<gap>/<method>[_<variant>]/<seeds> and
    hybrid/<task>/<simulator>/<data>/<method>[_<preset>]/<seeds>.
    """
    records = read_jsonl(folder / EVAL) if (folder / EVAL).exists() else []
    if not records:
        raise UserError(f"{folder / EVAL}: holds no evaluation yet")
    config, start = read_config(folder), last_start(folder)
    read = _over_updates if read_own(folder / CONFIG).get("kind") == "hybrid" else _over_rollouts
    return read(folder, records, config, start)


def _over_rollouts(
    folder: Path, records: list[dict[str, Any]], config: Mapping[str, Any], start: Mapping[str, Any]
) -> Curve:
    """The curve of a fine-tuning run. records: of `eval.jsonl`. config: its options. start: its last one."""
    names = [name for name in SCORES if name in records[0]] or [SCORES[0]]
    check_records(folder / EVAL, records, _EVALUATION | dict.fromkeys(names, list[float]))
    summary = read_own(folder / SUMMARY)
    if (score := summary.get("score") or _judged_by(records, names)) not in names:
        raise UserError(f"{folder / SUMMARY}: score is {score!r}, {EVAL} has {', '.join(names)}; put the files back")
    scores = {name: _column(records, name).T for name in names}
    variant, rollouts = config.get("variant") or "", _column(records, "rollouts")
    digests, seeds = start.get("priors", []), config.get("seed", 0) + np.arange(len(scores[score]))
    return Curve(
        task=folder.parent.parent.parent.name,
        gap=folder.parent.parent.name,
        method=folder.parent.name.removesuffix(f"_{variant}"),
        variant=variant,
        priors=set_name(Path(config.get("prior") or config.get("preset") or ""), digests),
        seeds=seeds,
        prior=seeds % len(digests) if digests else np.full(len(seeds), -1),
        x=rollouts,
        transitions=_column(records, "step"),
        minutes=_column(records, "robot_minutes"),
        scores=scores,
        score=score,
        facts=_facts(summary, config, start),
        training=_training(folder / METRICS, rollouts),
    )


def _over_updates(
    folder: Path, records: list[dict[str, Any]], config: Mapping[str, Any], start: Mapping[str, Any]
) -> Curve:
    """The curve of a run from a fixed log; arguments as in `_over_rollouts`. Raises UserError for an unfinished one."""
    others = measures(records[0])
    check_records(folder / EVAL, records, {"step": Count, **dict.fromkeys(("score", *others), list[float])})
    summary = read_own(
        folder / SUMMARY, {"task": str, "score": str, "seeds": list[int], "last": list[float], "late": list[float]}
    )
    if not summary:
        raise UserError(f"{folder}: unfinished, {records[-1]['step']} updates")
    schedule, variant = Schedule(**config["schedule"]), config["variant"]
    data = folder.parent.parent.name
    return updates_curve(
        summary["task"],
        "" if config["gap"] == NO_SIMULATOR else gaps.title(config["gap"]),
        folder.parent.name.removesuffix(f"_{variant}"),
        variant,
        data="" if data == NO_DATA else data,
        seeds=summary["seeds"],
        updates=_column(records, "step"),
        scores={summary["score"]: _column(records, "score").T, **{name: _column(records, name).T for name in others}},
        facts={
            **origin(start),
            "real": gaps.title(config["real"]),
            "schedule": name_of(schedule),
            "updates": schedule.updates_in_all,
        },
    )


def _column(records: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    """[records, ...] of one name."""
    return np.array([record[name] for record in records])


def updates_curve(
    task: str,
    gap: str,
    method: str,
    variant: str,
    *,
    data: str,
    seeds: Sequence[int],
    updates: np.ndarray,
    scores: Mapping[str, np.ndarray],
    facts: Mapping[str, Any] | None = None,
) -> Curve:
    """The curve of a run that collects nothing real. scores: [members, evaluations], the first one is what counts.

    updates: [evaluations]. The others as in `Curve`.
    """
    unknown, nothing = np.full(len(seeds), -1), np.full(len(updates), np.nan)
    return Curve(
        task=task,
        gap=gap,
        method=method,
        variant=variant,
        priors="",
        seeds=np.asarray(seeds),
        prior=unknown,
        x=updates,
        transitions=nothing,
        minutes=nothing,
        scores=scores,
        score=next(iter(scores)),
        facts=facts or {},
        data=data,
        unit="updates",
    )


def _judged_by(records: Sequence[Mapping[str, Any]], names: Sequence[str]) -> str:
    """By which score a run is judged that has no summary yet to name it: the one that `score` repeats."""
    repeated = (name for name in names if all(record.get("score") == record[name] for record in records))
    return next(repeated, names[0])


def _training(path: Path, rollouts: np.ndarray) -> np.ndarray | None:
    """`Curve.training` of a run that was evaluated after so many rollouts, from its metrics."""
    records = [record for record in (read_jsonl(path) if path.exists() else []) if "real/score" in record]
    if not records:
        return None
    check_records(path, records, {"rollouts": Count, "real/score": list[float]})
    ends = np.array([record["rollouts"] for record in records])  # a record is the mean of all rollouts since the last
    counts, scores = np.diff(ends, prepend=0), np.array([record["real/score"] for record in records]).T
    means = np.full((len(scores), len(rollouts)), np.nan)
    for i, (before, now) in enumerate(zip([0, *rollouts[:-1]], rollouts, strict=True)):
        if (since := (ends > before) & (ends <= now)).any():
            means[:, i] = np.average(scores[:, since], axis=1, weights=counts[since])
    return means


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
        task=task.name,
        gap=gap,
        method=method,
        variant=variant,
        priors="",
        seeds=np.asarray(seeds),
        prior=np.full(len(seeds), -1),
        x=rollouts,
        transitions=made,
        minutes=made * task.control_dt / 60,
        scores={"success": mean_of(lambda x: x.success), "return": mean_of(lambda x: counted(x)[1])},
        score=task.score,
    )


def read_runs(out: Path) -> Found:
    """Every run below <out>/finetune. Runs that differ in seeds alone are one curve of all their seeds.

    If seeds are in several of them, or evaluations differ, that with the most seeds counts, then with most rollouts.
    """
    runs: dict[tuple[str, ...], list[tuple[Curve, Path]]] = {}
    notes = []
    for folder in sorted(path for path in (out / "finetune").glob("*/*/*/*") if path.is_dir()):
        try:
            curve = read_curve(folder)
        except UserError as error:
            notes.append(str(error))
            continue
        runs.setdefault(tuple(getattr(curve, name) for name in IDENTITY), []).append((curve, folder))
        if (wanted := curve.facts.get("rollouts", 0)) > curve.x[-1]:
            notes.append(f"{folder}: unfinished, {curve.x[-1]} of {wanted} rollouts")
    together = [_together(same) for same in runs.values()]
    return Found([curve for curve, _ in together], [*notes, *(note for _, more in together for note in more)])


def _together(same: list[tuple[Curve, Path]]) -> tuple[Curve, list[str]]:
    """The curve of runs that differ in seeds, and a line for each one that does not fit the largest."""
    (first, home), *others = sorted(same, key=lambda run: (-len(run[0].seeds), -run[0].x[-1]))
    kept, notes, seeds = [first], [], set(first.seeds.tolist())
    for curve, folder in others:
        if seeds.isdisjoint(curve.seeds.tolist()) and np.array_equal(curve.x, first.x):
            kept.append(curve)
            seeds.update(curve.seeds.tolist())
        else:
            notes.append(f"{folder}: left out, {home.name} has more seeds or rollouts, and they cannot be put together")
    return (joined(kept) if len(kept) > 1 else first), notes


def joined(curves: Sequence[Curve]) -> Curve:
    """One curve of the members of all, in the order of their seeds. They were evaluated after the same rollouts."""
    order = np.argsort(np.concatenate([curve.seeds for curve in curves]), kind="stable")
    trained = [curve.training for curve in curves if curve.training is not None]

    def rows(parts: Iterable[np.ndarray]) -> np.ndarray:
        return np.concatenate(list(parts))[order]

    return replace(
        curves[0],
        seeds=rows(curve.seeds for curve in curves),
        prior=rows(curve.prior for curve in curves),
        scores={name: rows(curve.scores[name] for curve in curves) for name in curves[0].scores},
        training=rows(trained) if len(trained) == len(curves) else None,
    )


def set_name(folder: Path, digests: Sequence[str]) -> str:
    """Names a set of priors: its folder and, where known, what tells it from another set trained into that folder.

    A pretraining run lives in <preset>/<seeds>/prior: there the preset is the name.
    """
    parts = [part for part in folder.parts if not _UNNAMED.fullmatch(part)]
    return "-".join([*(part.removeprefix("shipped:") for part in parts[-1:]), *(digest[:6] for digest in digests[:1])])


def last_start(folder: Path) -> dict[str, Any]:
    """What the provenance of a run says of its last start; nothing where there is none."""
    starts = read_starts(folder)
    return starts[-1] if starts else {}


def _facts(summary: Mapping[str, Any], config: Mapping[str, Any], start: Mapping[str, Any]) -> dict[str, Any]:
    return {
        **origin(start),
        "gap_definition": json.dumps(summary.get("gap", {})),
        "impl": summary.get("impl", ""),
        **flat({name: value for name, value in config.items() if name not in _LEFT_OUT}),
    }


def origin(start: Mapping[str, Any]) -> dict[str, Any]:
    """Commit, time, versions and hardware of one start of a run, from its provenance."""
    device, versions = start.get("device", {}), start.get("versions", {})
    return {
        "commit": (start.get("git") or {}).get("commit", "")[:12],
        "started": start.get("started", ""),
        "hardware": " ".join(f"{device.get('count', '')} {device.get('kind', '')}".split()),
        **{name: versions.get(name, "") for name in ("jax", "mujoco")},
    }


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options as one level with dotted names; lists become words."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = " ".join(map(str, value)) if isinstance(value, (list, tuple)) else value
    return found


# ---------------------------------------------------------------- flat tables


def rows(curves: Iterable[Curve]) -> Iterator[dict[str, Any]]:
    """The flat table: a row for each evaluation of each member, with the columns `COLUMNS`.

    A run that is judged by its return has no success: the first score of a row is the one that counts.
    """
    for curve in curves:
        scores = SCORES[SCORES.index(curve.score) :]
        identity = {name: getattr(curve, name) for name in IDENTITY}
        for i, (seed, prior) in enumerate(zip(curve.seeds.tolist(), curve.prior.tolist(), strict=True)):
            for j, (n, used, minutes) in enumerate(
                zip(curve.x.tolist(), curve.transitions.tolist(), curve.minutes.tolist(), strict=True)
            ):
                axes = {"prior": prior, "seed": seed, "rollouts": n, "transitions": used, "minutes": minutes}
                found = {name: float(curve.scores[name][i, j]) for name in scores if name in curve.scores}
                if curve.training is not None and np.isfinite(curve.training[i, j]):
                    found["training"] = float(curve.training[i, j])
                yield {**identity, **axes, **found}


def from_rows(table: Iterable[Mapping[str, Any]]) -> list[Curve]:
    """The curves of a flat table; inverse of `rows`. Raises UserError where members differ in their evaluations."""
    runs: dict[tuple[str, ...], dict[int, list[Mapping[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    for row in table:
        runs[tuple(row[name] for name in IDENTITY)][whole("seed", row["seed"])].append(row)
    return [_curve(identity, members) for identity, members in runs.items()]


def _curve(identity: tuple[str, ...], members: Mapping[int, list[Mapping[str, Any]]]) -> Curve:
    if len({tuple(row["rollouts"] for row in each) for each in members.values()}) > 1:
        raise UserError(f"{'/'.join(identity)}: its seeds were not evaluated after the same rollouts")
    first, *_ = members.values()

    for name, value in zip(IDENTITY, identity, strict=True):
        if value:  # figures are called like these
            extend.folder_name(f"the {name}", value)

    def column(name: str, read: Callable[[str, Any], float] = finite) -> np.ndarray:
        return np.array([[read(name, row[name]) for row in each] for each in members.values()])

    scores = {name: column(name) for name in SCORES if first[0].get(name) not in (None, "")}
    if not scores:
        raise ValueError(f"{'/'.join(identity)} has no {' or '.join(SCORES)}")
    _check_ranges(scores.get("success"), minutes := column("minutes"))
    training = np.array([[_trained(row) for row in rows] for rows in members.values()])
    return Curve(
        *identity,
        seeds=np.array(list(members)),
        prior=np.array([_prior(each[0]["prior"]) for each in members.values()]),
        x=column("rollouts", whole)[0],
        transitions=column("transitions", whole)[0],
        minutes=minutes[0],
        scores=scores,
        score=next(iter(scores)),
        training=training if np.isfinite(training).any() else None,
    )


def _trained(row: Mapping[str, Any]) -> float:
    """The score of training rollouts; nan where a cell has none: at the first evaluation, or everywhere."""
    return np.nan if row.get("training") in (None, "") else finite("training", row["training"])


def _check_ranges(success: np.ndarray | None, minutes: np.ndarray) -> None:
    if success is not None and ((success < 0) | (success > 1)).any():
        raise ValueError(f"success is {success.min():g} to {success.max():g}, not a share")
    if minutes.min() < 0:
        raise ValueError(f"minutes is {minutes.min():g}, less than 0")


def _prior(cell: Any) -> int:
    """Index of a prior; -1: unknown."""
    return whole("prior", float(cell) + 1) - 1


def read_data(folder: Path) -> Found:
    """The curves of released tables, `curves-*.csv.gz` or `.csv`; raises UserError for none, or a damaged one."""
    names = sorted({path.name.partition(".csv")[0] for path in folder.glob("curves-*.csv*")})
    files = [table_file(folder, name) for name in names]
    if not files:
        command = f"python -m experiments.figures --export {folder}"
        raise UserError(f"{folder}: holds no curves-*.csv; write some from runs with: {command}")
    table = [row for path in files for row in read_csv(path, needed=(*IDENTITY, *_NUMBERS, SCORES[0]))]
    try:
        return Found(from_rows(table), [])
    except ValueError as error:  # of int and float
        raise UserError(f"{folder}/curves-*.csv: {error}; put the tables back as they were") from error
