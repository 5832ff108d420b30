"""Impure: data sets in the layout of LeRobot v3, written and read without its library: Parquet tables and JSON.

A frame is one step: `observation.state` and `action`, and under `next.` what the step led to, as LeRobot's own
evaluations name it: `next.reward`, `next.done`, `next.truncated`, `next.success`. `next.observation.state` is ours: the
successor, which the last frame of an episode would lack otherwise. Videos and images are neither written nor read.
Layout: documentation of LeRobotDataset v3.0.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.base import Entry
from envs.files import read_object
from sgft_jax.data.layouts import Rows
from sgft_jax.data.recording import Recorded
from sgft_jax.io.jsonfile import write_json
from sgft_jax.types import UserError

INFO = Path("meta/info.json")
_VERSION, _FILE = "v3.0", "chunk-000/file-000.parquet"
_STATE, _ACTION, _SUCCESSOR = "observation.state", "action", "next.observation.state"
_REWARD, _DONE, _TRUNCATED, _SUCCESS = "next.reward", "next.done", "next.truncated", "next.success"
_INDICES = ("frame_index", "episode_index", "index", "task_index")
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def write(
    folder: Path,
    episodes: Sequence[Recorded],
    *,
    task: str,
    control_dt: float,
    observation: Sequence[Entry],
    action: Sequence[Entry],
) -> None:
    """A data set of episodes that are of one task; `meta/info.json` appears last, when all else is there.

    task: what LeRobot calls the instruction. control_dt: seconds of a step. observation, action: what the numbers of
    `Recorded.obs` and `action` are; their names and units are written down. Raises UserError without pyarrow.
    """
    pa, pq = _pyarrow(folder)
    rate = 1 / control_dt
    rate = round(rate) if abs(rate - round(rate)) < 1e-6 * rate else rate
    features = _features(observation, action)
    starts = np.cumsum([0, *(len(own.reward) for own in episodes)])
    each = [_frames(own, i, int(starts[i]), rate) for i, own in enumerate(episodes)]
    schema = pa.schema([(name, _type_of(pa, about)) for name, about in features.items()])
    for part in ("data/chunk-000", "meta/episodes/chunk-000"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(folder / "data" / _FILE, schema) as file:
        for frames in each:  # a row group for each episode, so that one can be read alone
            file.write_table(pa.table({name: _column(pa, frames[name]) for name in features}, schema=schema))
    about = [_episode_row(frames, task, i, int(starts[i])) for i, frames in enumerate(each)]
    pq.write_table(pa.Table.from_pylist(about), folder / "meta/episodes" / _FILE)
    pq.write_table(_tasks(pa, task), folder / "meta/tasks.parquet")
    joined = {name: np.concatenate([frames[name] for frames in each]) for name in features}
    write_json(folder / "meta/stats.json", {name: _statistics(values) for name, values in joined.items()})
    info = {
        "codebase_version": _VERSION,
        "robot_type": None,
        "total_episodes": len(episodes),
        "total_frames": int(starts[-1]),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": rate,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }
    write_json(folder / INFO, info)


def _features(observation: Sequence[Entry], action: Sequence[Entry]) -> dict[str, dict[str, Any]]:
    """What `meta/info.json` says of every column."""
    state, command = _vector(observation), _vector(action)
    number = lambda dtype: {"dtype": dtype, "shape": [1], "names": None}  # noqa: E731
    return {
        _STATE: state,
        _ACTION: command,
        _SUCCESSOR: state,
        _REWARD: number("float32"),
        **{name: number("bool") for name in (_DONE, _TRUNCATED, _SUCCESS)},
        "timestamp": number("float32"),
        **{name: number("int64") for name in _INDICES},
    }


def _vector(entries: Sequence[Entry]) -> dict[str, Any]:
    names = [f"{e.name}.{i}" if e.size > 1 else e.name for e in entries for i in range(e.size)]
    units = [e.unit for e in entries for _ in range(e.size)]
    return {"dtype": "float32", "shape": [len(names)], "names": names, "info": {"units": units}}


def _frames(own: Recorded, number: int, first: int, rate: float) -> dict[str, np.ndarray]:
    """The columns [T, ...] of one episode. first: index of its first frame in the data set."""
    steps = np.arange(len(own.reward))
    last = steps == len(steps) - 1
    return {
        _STATE: own.obs[:-1],
        _ACTION: own.action,
        _SUCCESSOR: own.obs[1:],
        _REWARD: own.reward,
        _DONE: last,
        _TRUNCATED: last & (not own.terminated),
        _SUCCESS: last & bool(own.success),
        "timestamp": (steps / rate).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full_like(steps, number),
        "index": first + steps,
        "task_index": np.zeros_like(steps),
    }


def _episode_row(frames: Mapping[str, np.ndarray], task: str, number: int, first: int) -> dict[str, Any]:
    """What `meta/episodes` says of one episode."""
    length = len(frames["index"])
    stats = {f"stats/{name}/{key}": x for name, values in frames.items() for key, x in _statistics(values).items()}
    return {
        "episode_index": number,
        "tasks": [task],
        "length": length,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": first,
        "dataset_to_index": first + length,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        **stats,
    }


def _statistics(values: np.ndarray) -> dict[str, list[float]]:
    """Of a column [N, ...], for each of its numbers."""
    x = values.astype(np.float64).reshape(len(values), -1)
    found = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0), "std": x.std(0), "count": np.array([len(x)])}
    found |= {name: np.quantile(x, share, axis=0) for name, share in _QUANTILES.items()}
    return {name: own.tolist() for name, own in found.items()}


def _type_of(pa: Any, about: Mapping[str, Any]) -> Any:
    """The Arrow type of a column: a number, or a list of as many as the vector has."""
    kind = {"float32": pa.float32(), "bool": pa.bool_(), "int64": pa.int64()}[about["dtype"]]
    return kind if about["shape"] == [1] else pa.list_(kind, about["shape"][0])


def _column(pa: Any, values: np.ndarray) -> Any:
    """[N] or [N, 1] as numbers, [N, k] as lists."""
    if values.size == len(values):
        return pa.array(values.reshape(-1))
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def _tasks(pa: Any, task: str) -> Any:
    """The table of tasks. LeRobot reads it with pandas, whose index the column `task` must be."""
    told = lambda name, kind, numpy: {  # noqa: E731
        "name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None,
    }  # fmt: skip
    columns = [told("task_index", "int64", "int64"), told("task", "unicode", "object")]
    about = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": pa.array([task], pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(about)})


# --- reading ----------------------------------------------------------------------------------------------------------


def read(folder: Path) -> Rows:
    """The frames of a data set, also of others' without `next.` columns: `Rows` says what they do not tell.

    Without `next.observation.state` the successor is the frame below, and the last frame of every episode has none.
    `next.done` alone does not tell whether the task or the time ended an episode. Raises UserError for another
    version, without pyarrow, and where tables and `meta/info.json` disagree.
    """
    info = read_object(folder / INFO, {"features": dict, "fps": float}, "supply a whole data set")
    version = str(info.get("codebase_version", ""))
    if not version.startswith("v3."):
        raise UserError(f"{folder}: is LeRobot {version}; convert it to {_VERSION} with LeRobot's own script")
    features = info["features"]
    if missing := [name for name in (_STATE, _ACTION) if name not in features]:
        raise UserError(f"{folder}: has no {missing[0]}, only {', '.join(sorted(features))}; record it as a vector")
    if missing := [name for name in ("frame_index", "episode_index") if name not in features]:
        raise UserError(f"{folder}: has no {missing[0]}; supply a whole data set")
    wanted = (_STATE, _ACTION, _SUCCESSOR, _REWARD, _DONE, _TRUNCATED, "frame_index", "episode_index")
    columns = _columns(folder, {name: features[name] for name in wanted if name in features})
    episode, frame = columns["episode_index"], columns["frame_index"]
    ends = np.append(np.diff(episode) != 0, True)
    _check(folder, info, episode, frame, ends)
    obs, keep = columns[_STATE], np.ones(len(ends), bool)
    next_obs = columns.get(_SUCCESSOR)
    if next_obs is None:
        next_obs, keep = np.roll(obs, -1, axis=0), ~ends
    terminal = columns[_DONE] & ~columns[_TRUNCATED] if {_DONE, _TRUNCATED} <= set(columns) else None
    return Rows(
        obs, columns[_ACTION], columns.get(_REWARD), next_obs, terminal, ends, keep, "lerobot",
        "stored" if _SUCCESSOR in columns else "shifted", folder, float(info["fps"]),
    )  # fmt: skip


def _columns(folder: Path, features: Mapping[str, Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """[N] numbers or [N, k] vectors by name, from all files in their order."""
    pa, pq = _pyarrow(folder)
    paths = sorted(folder.glob("data/*/*.parquet"))
    if not paths:
        raise UserError(f"{folder}: holds no data/*/*.parquet; supply a whole data set")
    try:
        table = pa.concat_tables([pq.read_table(path, columns=list(features)) for path in paths])
        return {name: _numbers(folder, name, table[name], about["shape"]) for name, about in features.items()}
    except (pa.ArrowException, OSError, KeyError, TypeError) as error:
        said = str(error).splitlines()[0].strip("'\"")
        raise UserError(f"{folder}: damaged or cut off ({said}); supply a whole data set") from error


def _numbers(folder: Path, name: str, column: Any, shape: Sequence[int]) -> np.ndarray:
    """A column as its feature describes it."""
    values = column.combine_chunks()
    flat = values.flatten() if hasattr(values, "flatten") and hasattr(values.type, "value_type") else values
    found = flat.to_numpy(zero_copy_only=False)
    vector = name in (_STATE, _ACTION, _SUCCESSOR)
    if len(shape) != 1 or len(found) != len(column) * shape[0] or found.dtype.kind not in "biuf":
        raise UserError(f"{folder}: {name} is no column of numbers [{shape}]; only vectors are read")
    return found.reshape(len(column), -1) if vector else found


def _check(folder: Path, info: Mapping[str, Any], episode: np.ndarray, frame: np.ndarray, ends: np.ndarray) -> None:
    """Raise UserError where frames are missing or in another order."""
    for name, n in {"total_frames": len(frame), "total_episodes": len(np.unique(episode))}.items():
        if info.get(name, n) != n:
            raise UserError(f"{folder}: holds {name} {n}, but {INFO} says {info[name]}; supply a whole data set")
    starts = np.concatenate([[True], ends[:-1]])
    wanted = np.arange(len(frame)) - np.maximum.accumulate(np.where(starts, np.arange(len(frame)), 0))
    if (odd := frame != wanted).any():
        i = int(np.argmax(odd))
        raise UserError(
            f"{folder}: episode {episode[i]} has frame {frame[i]} where {wanted[i]} is due; supply a whole data set"
        )


def _pyarrow(folder: Path) -> tuple[Any, Any]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise UserError(f"{folder}: LeRobot's layout needs pyarrow; pip install 'sgft-jax[lerobot]'") from error
    return pa, pq
