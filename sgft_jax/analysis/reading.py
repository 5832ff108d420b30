"""Impure: reads the learning curves of run folders, and what their provenance says."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from envs import gaps
from envs.files import Count
from envs.types import UserError
from sgft_jax.analysis.curves import SCORES, Curve, Records
from sgft_jax.io.log import EVAL, METRICS, SUMMARY, check_records, read_jsonl
from sgft_jax.io.runs import CONFIG, NO_DATA, NO_SIMULATOR, read_config, read_own, read_starts
from sgft_jax.train.schedule import Schedule, name_of

# Of a line of eval.jsonl, beside its scores.
_EVALUATION = {"step": Count, "rollouts": Count, "robot_minutes": Annotated[float, Meta(ge=0)]}
_ALWAYS = ("step", "score", "success", "return", "exploded")  # in the evaluations of every task
_UNNAMED = re.compile(r"prior|seeds?-\d+(-\d+)?")  # folders that name no set of priors
# Of a run's options those that are in other columns, or say nothing about its outcome; paths of a machine above all.
_LEFT_OUT = {"out", "prior", "resume", "overwrite", "video", "devices", "checkpoint_every", "impl"}
_LEFT_OUT |= {"task", "method", "variant", "real"}


def measures(line: Mapping[str, Any]) -> list[str]:
    """The names of what else the task is judged by, in a line of `eval.jsonl`."""
    return [name for name in line if name not in _ALWAYS]


def read_curve(folder: Path) -> Curve:
    """The learning curve of one run of `experiments.finetune` or `experiments.hybrid`; UserError if it has none.

    Their folders are finetune/<task>/<gap>/<method>[_<variant>]/<seeds> and
    hybrid/<task>/<simulator>/<data>/<method>[_<preset>]/<seeds>.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder")
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
    # Without a summary to name it, a run is judged by the score that `score` repeats.
    repeated = (name for name in names if all(record.get("score") == record[name] for record in records))
    if (score := summary.get("score") or next(repeated, names[0])) not in names:
        raise UserError(f"{folder / SUMMARY}: score is {score!r}, {EVAL} has {', '.join(names)}; put the files back")
    scores = {name: _column(records, name).T for name in names}
    variant, rollouts = config.get("variant") or "", _column(records, "rollouts")
    digests, seeds = start.get("priors", []), config.get("seed", 0) + np.arange(len(scores[score]))
    return Curve(
        folder.parent.parent.parent.name,
        folder.parent.parent.name,
        folder.parent.name.removesuffix(f"_{variant}"),
        variant,
        set_name(Path(config.get("prior") or config.get("preset") or ""), digests),
        seeds=seeds,
        prior=seeds % len(digests) if digests else np.array(-1),
        x=rollouts,
        transitions=_column(records, "step"),
        minutes=_column(records, "robot_minutes"),
        scores=scores,
        score=score,
        facts={
            **origin(start),
            "gap_definition": json.dumps(summary.get("gap", {})),
            "impl": summary.get("impl", ""),
            **flat({name: value for name, value in config.items() if name not in _LEFT_OUT}),
        },
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
    gap, data = config["gap"], folder.parent.parent.name
    made = {"real": gaps.title(config["real"]), "schedule": name_of(schedule), "updates": schedule.updates_in_all}
    return Curve(
        summary["task"],
        "" if gap == NO_SIMULATOR else gaps.title(gap),
        folder.parent.name.removesuffix(f"_{variant}"),
        variant,
        seeds=np.array(summary["seeds"]),
        x=_column(records, "step"),
        scores={summary["score"]: _column(records, "score").T, **{name: _column(records, name).T for name in others}},
        score=summary["score"],
        facts=origin(start) | made,
        data="" if data == NO_DATA else data,
        unit="updates",
    )


def _column(records: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    """[records, ...] of one name."""
    return np.array([record[name] for record in records])


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


def read_runs(out: Path) -> Records:
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
        runs.setdefault(tuple(curve.identity.values()), []).append((curve, folder))
        if (wanted := curve.facts.get("rollouts", 0)) > curve.x[-1]:
            notes.append(f"{folder}: unfinished, {curve.x[-1]} of {wanted} rollouts")
    together = [_together(same) for same in runs.values()]
    return Records([curve for curve, _ in together], [*notes, *(note for _, more in together for note in more)])


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
    return replace(
        curves[0],
        seeds=np.concatenate([curve.seeds for curve in curves])[order],
        prior=np.concatenate([curve.prior for curve in curves])[order],
        scores={name: np.concatenate([curve.scores[name] for curve in curves])[order] for name in curves[0].scores},
        training=np.concatenate(trained)[order] if len(trained) == len(curves) else None,
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
    options: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            options |= flat(value, f"{prefix}{name}.")
        else:
            options[prefix + name] = " ".join(map(str, value)) if isinstance(value, (list, tuple)) else value
    return options
