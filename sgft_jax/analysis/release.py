"""Impure: writes what runs say as CSV tables that can be committed, opened in a spreadsheet, and read back.

curves-<task>.csv.gz   a row for each evaluation of each seed (`curves.COLUMNS`)
runs.csv.gz            a row for each of these runs: commit, hardware, options
pretraining.csv.gz     a row for each evaluation of each prior while it was trained
priors.csv.gz          a row for each prior: final evaluation, V_sim, commit, hardware, options
tuning.csv.gz          a row for each trial of tuning; trials.csv.gz: the curves of the trials
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from envs.files import Count, read_object
from envs.types import UserError
from sgft_jax.analysis import curves
from sgft_jax.analysis.curves import COLUMNS, IDENTITY, Curve
from sgft_jax.files.csvfile import read_csv, table_file, write_csv
from sgft_jax.io.log import EVAL, SUMMARY, read_jsonl
from sgft_jax.io.runs import read_config, read_starts

_OF_PRIORS, _OF_TUNING = ("task", "priors"), ("task", "method")
_Pretrained = TypedDict("_Pretrained", {"success/interval": tuple[float, float], "digest": NotRequired[str]})
_DIGITS = 4  # significant ones of a number with a fraction


class _Trial(TypedDict):
    options: dict[str, Any]
    rollouts: Count
    area: float
    final: float


class _Tuning(TypedDict):
    """What `experiments.studies.tune` has chosen for one task and method, see docs/formats.md."""

    task: str
    method: str
    trial: Count
    trials: list[_Trial]
    budget: dict[str, Any]
    space: dict[str, Any]


def export(out: Path, to: Path) -> list[Path]:
    """Writes the tables of all runs below `out` into the folder `to`, and returns their paths.

    Rows of other runs that the tables hold already stay, those of the same runs are replaced. Raises UserError if there
    is no run.
    """
    found, trials = curves.read_runs(out).curves, curves.read_runs(out / "tune").curves
    pretrained = sorted(path.parent for path in (out / "pretrain").glob(f"*/*/*/{SUMMARY}"))
    if not (found or trials or pretrained):
        raise UserError(f"{out}: holds no run; --out names the parent of finetune/ and pretrain/")
    to.mkdir(parents=True, exist_ok=True)
    tables: dict[str, tuple[Iterable[Mapping[str, Any]], tuple[str, ...]]] = {
        "runs": (map(_run, found), IDENTITY),
        "trials": (curves.rows(trials), IDENTITY),
        "tuning": (chain.from_iterable(map(_tuning, sorted((out / "tuned").glob("*/*.json")))), _OF_TUNING),
        "pretraining": (chain.from_iterable(map(_pretraining, pretrained)), _OF_PRIORS),
        "priors": (chain.from_iterable(map(_priors, pretrained)), _OF_PRIORS),
    }
    for task in sorted({curve.task for curve in found}):
        tables[f"curves-{task}"] = (curves.rows([curve for curve in found if curve.task == task]), IDENTITY)
    written = [merge(table_file(to, name), list(new), key) for name, (new, key) in tables.items()]
    return [path for path in written if path is not None]


def _run(curve: Curve) -> dict[str, Any]:
    members = {"seeds": len(curve.seeds), "number_of_priors": len(set(curve.prior.tolist()))}
    return {name: getattr(curve, name) for name in IDENTITY} | dict(curve.facts) | members


def _tuning(path: Path) -> Iterable[dict[str, Any]]:
    """What tuning of one method tried: options of each trial, its scores, and whether it was chosen."""
    result = read_object(path, _Tuning, "put back what experiments.studies.tune has written")
    for number, trial in enumerate(result["trials"]):
        yield {
            "task": result["task"], "method": result["method"], "trial": number, "chosen": number == result["trial"],
            "rollouts": trial["rollouts"], "area": trial["area"], "final": trial["final"],
            "options": json.dumps(trial["options"]),
            "budget": json.dumps(result["budget"]), "space": json.dumps(result["space"]),
        }  # fmt: skip


def _pretraining(folder: Path) -> Iterable[dict[str, Any]]:
    for record in read_jsonl(folder / EVAL, {"step": Count, "success": list[float], "return": list[float]}):
        for i, success in enumerate(record["success"]):
            scores = {"success": success, "return": record["return"][i]}
            yield {**_set_of(folder), "prior": i, "env_steps": record["step"], **scores}


def _priors(folder: Path) -> Iterable[dict[str, Any]]:
    summary, stored, starts = _summary_of(folder), read_config(folder), read_starts(folder) or [{}]
    options = curves.flat({name: value for name, value in stored.items() if name in ("preset", "config")})
    times = {name: value for name, value in summary.items() if name.startswith("time/")}
    for i, one in enumerate(summary["seeds"]):
        low, high = one["success/interval"]
        scores = {name: value for name, value in curves.flat(one).items() if name != "success/interval"}
        bounds = {"success/low": low, "success/high": high}
        yield {**_set_of(folder), "prior": i, **scores, **bounds, **curves.origin(starts[-1]), **times, **options}


def _summary_of(folder: Path) -> dict[str, Any]:
    return read_object(folder / SUMMARY, {"seeds": list[_Pretrained]}, "put back what the run has written")


def _set_of(folder: Path) -> dict[str, str]:
    digests = [one.get("digest", "") for one in _summary_of(folder)["seeds"]]
    return {"task": folder.parent.parent.name, "priors": curves.set_name(folder, digests)}


def merge(path: Path, new: Sequence[Mapping[str, Any]], key: Sequence[str]) -> Path | None:
    """Writes the rows into a table in place of those with the same key; None if there are none."""
    if not new:
        return None
    texts = [{name: _text(value) for name, value in row.items()} for row in new]
    replaced = {tuple(row[name] for name in key) for row in texts}
    kept = [row for row in read_csv(path, needed=key) if tuple(row[name] for name in key) not in replaced]
    every = [*kept, *texts]
    names = COLUMNS if set(every[0]) <= set(COLUMNS) else dict.fromkeys(name for row in every for name in row)
    lines = sorted(every, key=lambda row: tuple(row[name] for name in key))  # stable: evaluations in order
    write_csv(path, list(names), lines)
    return path


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.{_DIGITS}g}"
    return "" if value is None else str(value)
