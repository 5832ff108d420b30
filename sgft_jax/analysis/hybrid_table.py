"""Impure: what runs on real data and a simulator scored, as a table that can be committed and read back.

hybrid.csv.gz has a row for each evaluation of each run: what was run (`IDENTITY`), the commit, what was measured
(`score`: success or return), the updates before the evaluation (`step`), and a column with the number of each seed.
What else the task is judged by has rows of its own.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from envs.types import UserError
from sgft_jax.analysis.curves import SCORES, Curve, updates_curve
from sgft_jax.analysis.release import merge
from sgft_jax.files.csvfile import finite, read_csv, table_file, whole

TABLE = "hybrid"
IDENTITY = ("task", "real", "data", "gap", "method", "schedule", "updates")
_NEEDED = (*IDENTITY, "commit", "score", "step")
_SEED = "seed-"


def write(to: Path, curves: Iterable[Curve]) -> Path | None:
    """Writes runs into hybrid.csv in the folder `to`, in place of rows of the same runs; None if there is no run.

    curves: over updates, as `curves.read_curve` reads them.
    """
    to.mkdir(parents=True, exist_ok=True)
    return merge(table_file(to, TABLE), [row for curve in curves for row in _rows(curve)], IDENTITY)


def read(folder: Path) -> list[Curve]:
    """The runs in hybrid.csv. Raises UserError if there is no such table, or if a cell of it cannot be read."""
    path = table_file(folder, TABLE)
    if not path.exists():
        command = f"python -m experiments.compare hybrid --export {folder}"
        raise UserError(f"{folder / TABLE}.csv: no such table; write one with: {command}")
    runs: dict[tuple[str, ...], list[Mapping[str, str]]] = {}
    for row in read_csv(path, needed=_NEEDED):
        runs.setdefault(tuple(row[name] for name in IDENTITY), []).append(row)
    try:
        return [_curve(rows) for rows in runs.values()]
    except ValueError as error:
        raise UserError(f"{path}: {error}; put the table back as it was") from error


def _rows(curve: Curve) -> Iterator[dict[str, Any]]:
    facts = curve.facts
    named = {"task": curve.task, "real": facts["real"], "data": curve.data, "gap": curve.gap, "method": curve.spec}
    named |= {name: facts[name] for name in ("schedule", "updates", "commit")}
    for score, values in curve.scores.items():
        for step, numbers in zip(curve.x.tolist(), values.T.tolist(), strict=True):
            # Six digits: a mean over seeds is printed as it is in the run.
            members = {f"{_SEED}{n}": f"{x:.6g}" for n, x in zip(curve.seeds.tolist(), numbers, strict=True)}
            yield {**named, "score": score, "step": step, **members}


def _curve(rows: list[Mapping[str, str]]) -> Curve:
    first = next((row for row in rows if row["score"] in SCORES), None)
    if first is None:
        raise ValueError(f"a run of {rows[0]['method']} on {rows[0]['task']} has neither success nor return")
    columns = [name for name, text in first.items() if name.startswith(_SEED) and text]
    seeds = [whole("a seed", name.removeprefix(_SEED)) for name in columns]
    if not seeds:
        raise ValueError(f"a run of {first['method']} on {first['task']} has no seed")
    scores: dict[str, dict[int, list[float]]] = {first["score"]: {}}  # by name and step
    for row in rows:
        numbers = [finite(column, row[column]) for column in columns]
        scores.setdefault(row["score"], {})[whole("step", row["step"])] = numbers
    steps = list(dict.fromkeys(step for lines in scores.values() for step in lines))
    for name, lines in scores.items():
        if len(lines) < len(steps):
            lacking = "score" if name == first["score"] else name
            raise ValueError(f"a run of {first['method']} on {first['task']} lacks rows of {lacking}")
    method, _, variant = first["method"].partition(":")
    return updates_curve(
        first["task"],
        first["gap"],
        method,
        variant,
        data=first["data"],
        seeds=seeds,
        updates=np.array(steps),
        scores={name: np.array([lines[step] for step in steps]).T for name, lines in scores.items()},
        facts={name: first[name] for name in ("real", "schedule", "commit")}
        | {"updates": whole("updates", first["updates"])},
    )
