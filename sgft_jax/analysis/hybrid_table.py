"""Impure: what runs on real data and a simulator scored, as a table that can be committed and read back.

hybrid.csv.gz has a row for each evaluation of each run: what was run (`IDENTITY`), the commit, what was measured
(`score`: success or return), the updates before the evaluation (`step`), and a column with the number of each seed.
What else the task is judged by has rows of its own.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from envs.types import UserError
from sgft_jax.analysis.curves import SCORES
from sgft_jax.analysis.hybrid import Outcome, outcome
from sgft_jax.analysis.release import merge
from sgft_jax.files.csvfile import finite, read_csv, table_file, whole

TABLE = "hybrid"
IDENTITY = ("task", "real", "data", "gap", "method", "schedule", "updates")
_NEEDED = (*IDENTITY, "commit", "score", "step")
_SEED = "seed-"


class Run(NamedTuple):
    """One run with all its seeds. real: where it was evaluated. schedule: its name. updates: of the whole run.

    score: "success" or "return". seeds: [seeds], those of the outcome's curve.
    """

    task: str
    real: str
    schedule: str
    updates: int
    commit: str
    score: str
    seeds: list[int]
    outcome: Outcome


def write(to: Path, runs: Iterable[Run]) -> Path | None:
    """Writes runs into hybrid.csv in the folder `to`, in place of rows of the same runs; None if there is no run."""
    to.mkdir(parents=True, exist_ok=True)
    return merge(table_file(to, TABLE), [row for run in runs for row in _rows(run)], IDENTITY)


def read(folder: Path) -> list[Run]:
    """The runs in hybrid.csv. Raises UserError if there is no such table, or if a cell of it cannot be read."""
    path = table_file(folder, TABLE)
    if not path.exists():
        raise UserError(
            f"{folder / TABLE}.csv: no such table; "
            f"write one with: python -m experiments.compare_hybrid --export {folder}"
        )
    runs: dict[tuple[str, ...], list[Mapping[str, str]]] = {}
    for row in read_csv(path, needed=_NEEDED):
        runs.setdefault(tuple(row[name] for name in IDENTITY), []).append(row)
    try:
        return [_run(rows) for rows in runs.values()]
    except ValueError as error:
        raise UserError(f"{path}: {error}; put the table back as it was") from error


def _rows(run: Run) -> Iterator[dict[str, Any]]:
    own = run.outcome
    named = {"task": run.task, "real": run.real, "data": own.data, "gap": own.gap, "method": own.method}
    named |= {"schedule": run.schedule, "updates": run.updates, "commit": run.commit}
    for measured, curve in {run.score: own.curve, **own.measures}.items():
        for step, values in zip(own.updates.tolist(), curve.T.tolist(), strict=True):
            # Six digits: a mean over seeds is printed as it is in the run.
            numbers = {f"{_SEED}{n}": f"{x:.6g}" for n, x in zip(run.seeds, values, strict=True)}
            yield {**named, "score": measured, "step": step, **numbers}


def _run(rows: list[Mapping[str, str]]) -> Run:
    first = next((row for row in rows if row["score"] in SCORES), None)
    if first is None:
        raise ValueError(f"a run of {rows[0]['method']} on {rows[0]['task']} has neither success nor return")
    columns = [name for name, text in first.items() if name.startswith(_SEED) and text]
    seeds = [whole("a seed", name.removeprefix(_SEED)) for name in columns]
    if not seeds:
        raise ValueError(f"a run of {first['method']} on {first['task']} has no seed")
    lines: dict[int, dict[str, Any]] = {}
    for row in rows:
        name = "score" if row["score"] == first["score"] else row["score"]
        step = whole("step", row["step"])
        line = lines.setdefault(step, {"step": step})
        line[name] = [finite(column, row[column]) for column in columns]
    measures = [name for name in dict.fromkeys(row["score"] for row in rows) if name != first["score"]]
    for name in ("score", *measures):
        if any(name not in line for line in lines.values()):
            raise ValueError(f"a run of {first['method']} on {first['task']} lacks rows of {name}")
    own = outcome(first["method"], first["data"], first["gap"], [*lines.values()], measures=measures)
    return Run(
        first["task"], first["real"], first["schedule"], whole("updates", first["updates"]), first["commit"],
        first["score"], seeds, own,
    )  # fmt: skip
