"""Impure: writes what runs say as CSV tables that can be committed, opened in a spreadsheet, and read back.

curves-<task>.csv.gz   a row for each evaluation of each seed (`COLUMNS`)
hybrid.csv.gz          a row for each evaluation and score of each run over updates (`RUN`), a column for each seed
runs.csv.gz            a row for each run over real rollouts: commit, hardware, options
pretraining.csv.gz     a row for each evaluation of each prior while it was trained
priors.csv.gz          a row for each prior: final evaluation, V_sim, commit, hardware, options
tuning.csv.gz          a row for each trial of tuning; trials.csv.gz: the curves of the trials
"""

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np

from envs import extend
from envs.files import Count, read_object
from envs.types import UserError
from sgft_jax.analysis import reading
from sgft_jax.analysis.curves import IDENTITY, SCORES, Curve, Records
from sgft_jax.files.disk import finite, read_csv, table_file, whole, write_csv
from sgft_jax.io.log import EVAL, SUMMARY, read_jsonl
from sgft_jax.io.runs import read_config

_AXES = ("prior", "seed", "rollouts", "transitions", "minutes")
COLUMNS = (*IDENTITY, *_AXES, *SCORES, "training")
RUN = ("task", "real", "data", "gap", "method", "schedule", "updates")
_SEED = "seed-"
_OF_PRIORS, _OF_TUNING = ("task", "priors"), ("task", "method")
_Pretrained = TypedDict("_Pretrained", {"success/interval": tuple[float, float], "digest": NotRequired[str]})
_DIGITS = 4  # significant ones of a number with a fraction

type Row = Mapping[str, Any]


class _Trial(TypedDict):
    options: dict[str, Any]
    rollouts: Count
    area: float
    final: float


# What `experiments.studies.tune` has chosen for one task and method, see docs/formats.md.
_TUNING = {"task": str, "method": str, "trial": Count, "trials": list[_Trial], "budget": dict, "space": dict}


def export(out: Path, to: Path) -> list[Path]:
    """Writes the tables of all runs below `out` into the folder `to`, and returns their paths.

    Rows of other runs that the tables hold already stay, those of the same runs are replaced. Raises UserError if there
    is no run.
    """
    curves, trials = reading.read_runs(out).curves, reading.read_runs(out / "tune").curves
    pretrained = sorted(path.parent for path in (out / "pretrain").glob(f"*/*/*/{SUMMARY}"))
    if not (curves or trials or pretrained):
        raise UserError(f"{out}: holds no run; --out names the parent of finetune/ and pretrain/")
    to.mkdir(parents=True, exist_ok=True)
    tables: dict[str, tuple[Iterable[Mapping[str, Any]], tuple[str, ...]]] = {
        "runs": (map(_run, curves), IDENTITY),
        "trials": (rows(trials), IDENTITY),
        "tuning": (itertools.chain.from_iterable(map(_tuning, sorted((out / "tuned").glob("*/*.json")))), _OF_TUNING),
        "pretraining": (itertools.chain.from_iterable(map(_pretraining, pretrained)), _OF_PRIORS),
        "priors": (itertools.chain.from_iterable(map(_priors, pretrained)), _OF_PRIORS),
    }
    for task in sorted({curve.task for curve in curves}):
        tables[f"curves-{task}"] = (rows([curve for curve in curves if curve.task == task]), IDENTITY)
    written = [merge(table_file(to, name), list(new), key) for name, (new, key) in tables.items()]
    return [path for path in written if path is not None]


def _run(curve: Curve) -> dict[str, Any]:
    members = {"seeds": len(curve.seeds), "number_of_priors": len(set(curve.prior.tolist()))}
    return curve.identity | dict(curve.facts) | members


def _tuning(path: Path) -> Iterable[dict[str, Any]]:
    """What tuning of one method tried: options of each trial, its scores, and whether it was chosen."""
    result = read_object(path, _TUNING, "put back what experiments.studies.tune has written")
    for number, trial in enumerate(result["trials"]):
        identity = {"task": result["task"], "method": result["method"], "trial": number}
        scores = {name: trial[name] for name in ("rollouts", "area", "final")}
        texts = {"options": trial["options"], "budget": result["budget"], "space": result["space"]}
        chosen = {"chosen": number == result["trial"]}
        yield identity | chosen | scores | {name: json.dumps(value) for name, value in texts.items()}


def _pretraining(folder: Path) -> Iterable[dict[str, Any]]:
    _, priors = _pretrained(folder)
    for record in read_jsonl(folder / EVAL, {"step": Count, "success": list[float], "return": list[float]}):
        for i, success in enumerate(record["success"]):
            scores = {"success": success, "return": record["return"][i]}
            yield {**priors, "prior": i, "env_steps": record["step"], **scores}


def _priors(folder: Path) -> Iterable[dict[str, Any]]:
    (summary, priors), stored = _pretrained(folder), read_config(folder)
    begun = reading.origin(reading.last_start(folder))
    options = reading.flat({name: value for name, value in stored.items() if name in ("preset", "config")})
    times = {name: value for name, value in summary.items() if name.startswith("time/")}
    for i, trained in enumerate(summary["seeds"]):
        low, high = trained["success/interval"]
        scores = {name: value for name, value in reading.flat(trained).items() if name != "success/interval"}
        bounds = {"success/low": low, "success/high": high}
        yield {**priors, "prior": i, **scores, **bounds, **begun, **times, **options}


def _pretrained(folder: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """(The summary of a run, what its priors are of and are called)."""
    summary = read_object(folder / SUMMARY, {"seeds": list[_Pretrained]}, "put back what the run has written")
    name = reading.set_name(folder, [prior.get("digest", "") for prior in summary["seeds"]])
    return summary, {"task": folder.parent.parent.name, "priors": name}


def merge(path: Path, new: Sequence[Mapping[str, Any]], key: Sequence[str]) -> Path | None:
    """Writes the rows into a table in place of those with the same key; None if there are none."""
    if not new:
        return None
    texts = [{name: _text(value) for name, value in row.items()} for row in new]
    replaced = {tuple(row[name] for name in key) for row in texts}
    kept = [row for row in read_csv(path, needed=key) if tuple(row[name] for name in key) not in replaced]
    table = [*kept, *texts]
    names = COLUMNS if set(table[0]) <= set(COLUMNS) else dict.fromkeys(name for row in table for name in row)
    lines = sorted(table, key=lambda row: tuple(row[name] for name in key))  # stable: evaluations in order
    write_csv(path, list(names), lines)
    return path


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.{_DIGITS}g}"
    return "" if value is None else str(value)


# ---------------------------------------------------------------- curves over real rollouts


def rows(curves: Iterable[Curve]) -> Iterator[dict[str, Any]]:
    """The flat table: a row for each evaluation of each member, with the columns `COLUMNS`.

    A run that is judged by its return has no success: the first score of a row is the one that counts.
    """
    for curve in curves:
        values = {name: curve.scores[name] for name in SCORES[SCORES.index(curve.score) :] if name in curve.scores}
        members = zip(curve.prior.tolist(), curve.seeds.tolist(), strict=True)
        points = list(zip(curve.x.tolist(), curve.transitions.tolist(), curve.minutes.tolist(), strict=True))
        for (i, member), (j, point) in itertools.product(enumerate(members), enumerate(points)):
            scores = {name: float(array[i, j]) for name, array in values.items()}
            if curve.training is not None and np.isfinite(curve.training[i, j]):
                scores["training"] = float(curve.training[i, j])
            yield {**curve.identity, **dict(zip(_AXES, (*member, *point), strict=True)), **scores}


def from_rows(table: Iterable[Mapping[str, Any]]) -> list[Curve]:
    """The curves of a flat table; inverse of `rows`. Raises UserError where members differ in their evaluations."""
    runs = _grouped(table, lambda row: tuple(row[name] for name in IDENTITY))
    return [_curve(name, _grouped(lines, lambda row: whole("seed", row["seed"]))) for name, lines in runs.items()]


def _grouped[T](table: Iterable[Row], key: Callable[[Row], T]) -> dict[T, list[Row]]:
    """The rows of each key, in their order."""
    groups: dict[T, list[Row]] = {}
    for row in table:
        groups.setdefault(key(row), []).append(row)
    return groups


def _curve(identity: tuple[str, ...], members: Mapping[int, list[Row]]) -> Curve:
    if len({tuple(row["rollouts"] for row in lines) for lines in members.values()}) > 1:
        raise UserError(f"{'/'.join(identity)}: its seeds were not evaluated after the same rollouts")
    for name, value in zip(IDENTITY, identity, strict=True):
        if value:  # figures are called like these
            extend.folder_name(f"the {name}", value)

    def column(name: str, read: Callable[[str, Any], float] = finite) -> np.ndarray:
        return np.array([[read(name, row[name]) for row in lines] for lines in members.values()])

    first, *_ = next(iter(members.values()))
    scores = {name: column(name) for name in SCORES if first.get(name) not in (None, "")}
    if not scores:
        raise ValueError(f"{'/'.join(identity)} has no {' or '.join(SCORES)}")
    success, minutes = scores.get("success", np.zeros(1)), column("minutes")
    if ((success < 0) | (success > 1)).any():
        raise ValueError(f"success is {success.min():g} to {success.max():g}, not a share")
    if minutes.min() < 0:
        raise ValueError(f"minutes is {minutes.min():g}, less than 0")
    # A cell has no score of training rollouts at the first evaluation, or everywhere.
    trained = [[row.get("training", "") for row in lines] for lines in members.values()]
    training = np.array([[np.nan if x == "" else finite("training", x) for x in cells] for cells in trained])
    return Curve(
        *identity,
        seeds=np.array(list(members)),
        prior=np.array([whole("prior", float(lines[0]["prior"]) + 1) - 1 for lines in members.values()]),  # -1: unknown
        x=column("rollouts", whole)[0],
        transitions=column("transitions", whole)[0],
        minutes=minutes[0],
        scores=scores,
        score=next(iter(scores)),
        training=training if np.isfinite(training).any() else None,
    )


def read(out: Path, data: Path | None) -> Records:
    """The curves of released tables in the folder `data` or, without one, of the fine-tuning runs below `out`."""
    return read_data(data) if data else reading.read_runs(out)


def read_data(folder: Path) -> Records:
    """The curves of released tables, `curves-*.csv.gz` or `.csv`; raises UserError for none, or a damaged one."""
    names = sorted({path.name.partition(".csv")[0] for path in folder.glob("curves-*.csv*")})
    files = [table_file(folder, name) for name in names]
    if not files:
        command = f"python -m experiments.figures --export {folder}"
        raise UserError(f"{folder}: holds no curves-*.csv; write some from runs with: {command}")
    table = [row for path in files for row in read_csv(path, needed=(*IDENTITY, *_AXES, SCORES[0]))]
    try:
        return Records(from_rows(table), [])
    except ValueError as error:  # of int and float
        raise UserError(f"{folder}/curves-*.csv: {error}; put the tables back as they were") from error


# ---------------------------------------------------------------- curves over updates


def write_hybrid(to: Path, curves: Iterable[Curve]) -> Path | None:
    """Writes runs into hybrid.csv in the folder `to`, in place of rows of the same runs; None if there is no run.

    curves: over updates, as `reading.read_curve` reads them.
    """
    to.mkdir(parents=True, exist_ok=True)
    return merge(table_file(to, "hybrid"), [row for curve in curves for row in _updates_rows(curve)], RUN)


def read_hybrid(folder: Path) -> list[Curve]:
    """The runs in hybrid.csv. Raises UserError if there is no such table, or if a cell of it cannot be read."""
    path = table_file(folder, "hybrid")
    if not path.exists():
        command = f"python -m experiments.compare hybrid --export {folder}"
        raise UserError(f"{folder / 'hybrid'}.csv: no such table; write one with: {command}")
    table = read_csv(path, needed=(*RUN, "commit", "score", "step"))
    try:
        return list(map(_updates_curve, _grouped(table, lambda row: tuple(row[name] for name in RUN)).values()))
    except ValueError as error:
        raise UserError(f"{path}: {error}; put the table back as it was") from error


def _updates_rows(curve: Curve) -> Iterator[dict[str, Any]]:
    facts = curve.facts
    named = {"task": curve.task, "real": facts["real"], "data": curve.data, "gap": curve.gap, "method": curve.spec}
    named |= {name: facts[name] for name in ("schedule", "updates", "commit")}
    for score, values in curve.scores.items():
        for step, numbers in zip(curve.x.tolist(), values.T.tolist(), strict=True):
            # Six digits: a mean over seeds is printed as it is in the run.
            members = {f"{_SEED}{n}": f"{x:.6g}" for n, x in zip(curve.seeds.tolist(), numbers, strict=True)}
            yield {**named, "score": score, "step": step, **members}


def _updates_curve(lines: Sequence[Row]) -> Curve:
    first = next((row for row in lines if row["score"] in SCORES), None)
    if first is None:
        raise ValueError(f"a run of {lines[0]['method']} on {lines[0]['task']} has neither success nor return")
    run = f"a run of {first['method']} on {first['task']}"
    columns = [name for name, text in first.items() if name.startswith(_SEED) and text]
    seeds = [whole("a seed", name.removeprefix(_SEED)) for name in columns]
    if not seeds:
        raise ValueError(f"{run} has no seed")
    scores: dict[str, dict[int, list[float]]] = {first["score"]: {}}  # by name and step
    for row in lines:
        numbers = [finite(column, row[column]) for column in columns]
        scores.setdefault(row["score"], {})[whole("step", row["step"])] = numbers
    steps = list(dict.fromkeys(step for values in scores.values() for step in values))
    if lacking := [name for name, values in scores.items() if len(values) < len(steps)]:
        raise ValueError(f"{run} lacks rows of {'score' if lacking[0] == first['score'] else lacking[0]}")
    method, _, variant = first["method"].partition(":")
    made = {"updates": whole("updates", first["updates"])}
    return Curve(
        first["task"],
        first["gap"],
        method,
        variant,
        seeds=np.array(seeds),
        x=np.array(steps),
        scores={name: np.array([values[step] for step in steps]).T for name, values in scores.items()},
        score=first["score"],
        facts={name: first[name] for name in ("real", "schedule", "commit")} | made,
        data=first["data"],
        unit="updates",
    )
