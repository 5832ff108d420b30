"""Impure: data sets in the layout of LeRobot v3, written and read without its library: Parquet tables and JSON.

A frame is one step: `observation.state` and `action`, and under `next.` what the step led to, as LeRobot's own
evaluations name it: `next.reward`, `next.done`, `next.truncated`, `next.success`. `next.observation.state` is ours: the
successor, which the last frame of an episode would lack otherwise. Videos and images are neither written nor read.
Layout: documentation of LeRobotDataset v3.0.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np

from envs.base import Entry, Env
from envs.files import Count, Positive, Size, checked, read_object
from envs.types import UserError
from sgft_jax.datasets.layouts import Rows, ages, files_of
from sgft_jax.datasets.recording import Recorded
from sgft_jax.files.arrays import check_claim, damage, flags
from sgft_jax.files.disk import write_json

INFO = Path("meta/info.json")
_VERSION, _FILE = "v3.0", "chunk-000/file-000.parquet"
_STATE, _ACTION, _SUCCESSOR = "observation.state", "action", "next.observation.state"
_REWARD, _DONE, _TRUNCATED, _SUCCESS = "next.reward", "next.done", "next.truncated", "next.success"
_INDICES = ("frame_index", "episode_index", "index", "task_index")
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_WIDEST = 8  # bytes of a number
_WHOLE = "supply a whole data set"


class _Feature(TypedDict):
    """What is read of a column's description."""

    shape: list[Size]


class _Info(TypedDict):
    """What is read of `meta/info.json`."""

    codebase_version: str
    features: dict[str, Any]
    fps: Positive
    total_frames: NotRequired[Count]
    total_episodes: NotRequired[Count]
    data_path: NotRequired[str]


def write(folder: Path, episodes: Sequence[Recorded], env: Env) -> None:
    """A data set of episodes that are of one task; `meta/info.json` appears last, when all else is there.

    env: the task. Its name is what LeRobot calls the instruction; names and units of what it measures, `Recorded.obs`,
    and of its actions are written down. Raises UserError without pyarrow.
    """
    pa, pq = _pyarrow(folder)
    rate = 1 / env.control_dt
    rate = round(rate) if abs(rate - round(rate)) < 1e-6 * rate else rate
    features = _features(env)
    starts = np.cumsum([0, *(len(episode.reward) for episode in episodes)])
    frames = [_frames(episode, i, int(starts[i]), rate) for i, episode in enumerate(episodes)]
    tables = [pa.table({name: _column(pa, columns[name]) for name in features}) for columns in frames]
    for part in ("data/chunk-000", "meta/episodes/chunk-000"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(folder / "data" / _FILE, tables[0].schema) as file:
        for table in tables:  # a row group for each episode, so that one can be read alone
            file.write_table(table)
    about = [_episode_row(columns, env.name, i, int(starts[i])) for i, columns in enumerate(frames)]
    pq.write_table(pa.Table.from_pylist(about), folder / "meta/episodes" / _FILE)
    pq.write_table(_tasks(pa, env.name), folder / "meta/tasks.parquet")
    joined = {name: np.concatenate([columns[name] for columns in frames]) for name in features}
    write_json(folder / "meta/stats.json", {name: _statistics(values) for name, values in joined.items()})
    counts = {"total_episodes": len(episodes), "total_frames": int(starts[-1]), "total_tasks": 1}
    limits = {"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
    paths = {"data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "video_path": None}
    info = {"codebase_version": _VERSION, "robot_type": None, **counts, **limits, "fps": rate}
    write_json(folder / INFO, {**info, "splits": {"train": f"0:{len(episodes)}"}, **paths, "features": features})


def _features(env: Env) -> dict[str, dict[str, Any]]:
    """What `meta/info.json` says of every column."""
    state, command = _vector(env.measured), _vector(env.action)

    def number(dtype: str) -> dict[str, Any]:
        return {"dtype": dtype, "shape": [1], "names": None}

    step = {_STATE: state, _ACTION: command, _SUCCESSOR: state, _REWARD: number("float32")}
    ends = dict.fromkeys((_DONE, _TRUNCATED, _SUCCESS), number("bool"))
    return {**step, **ends, "timestamp": number("float32"), **dict.fromkeys(_INDICES, number("int64"))}


def _vector(entries: Sequence[Entry]) -> dict[str, Any]:
    names = [f"{e.name}.{i}" if e.size > 1 else e.name for e in entries for i in range(e.size)]
    units = [e.unit for e in entries for _ in range(e.size)]
    return {"dtype": "float32", "shape": [len(names)], "names": names, "info": {"units": units}}


def _frames(episode: Recorded, number: int, first: int, rate: float) -> dict[str, np.ndarray]:
    """The columns [T, ...] of one episode. first: index of its first frame in the data set."""
    steps = np.arange(len(episode.reward))
    last = steps == len(steps) - 1
    moved = {_STATE: episode.obs[:-1], _ACTION: episode.action, _SUCCESSOR: episode.obs[1:], _REWARD: episode.reward}
    ends = {_DONE: last, _TRUNCATED: last & (not episode.terminated), _SUCCESS: last & bool(episode.success)}
    places = {"timestamp": (steps / rate).astype(np.float32), "frame_index": steps}
    places |= {"episode_index": np.full_like(steps, number), "index": first + steps, "task_index": np.zeros_like(steps)}
    return {**moved, **ends, **places}


def _episode_row(frames: Mapping[str, np.ndarray], task: str, number: int, first: int) -> dict[str, Any]:
    """What `meta/episodes` says of one episode."""
    length = len(frames["index"])
    stats = {f"stats/{name}/{key}": x for name, values in frames.items() for key, x in _statistics(values).items()}
    episode = {"episode_index": number, "tasks": [task], "length": length}
    rows = {"dataset_from_index": first, "dataset_to_index": first + length}
    data, meta = ({f"{part}/chunk_index": 0, f"{part}/file_index": 0} for part in ("data", "meta/episodes"))
    return {**episode, **data, **rows, **meta, **stats}


def _statistics(values: np.ndarray) -> dict[str, list[float]]:
    """Of a column [N, ...], for each of its numbers."""
    x = values.astype(np.float64).reshape(len(values), -1)
    facts = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0), "std": x.std(0), "count": np.array([len(x)])}
    facts |= {name: np.quantile(x, share, axis=0) for name, share in _QUANTILES.items()}
    return {name: fact.tolist() for name, fact in facts.items()}


def _column(pa: Any, values: np.ndarray) -> Any:
    """[N] or [N, 1] as numbers, [N, k] as lists of k; of the same type as the array."""
    if values.size == len(values):
        return pa.array(values.reshape(-1))
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def _tasks(pa: Any, task: str) -> Any:
    """The table of tasks. LeRobot reads it with pandas, whose index the column `task` must be."""
    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, (kind, numpy) in kinds.items()
    ]
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
    info = read_object(folder / INFO, _Info, _WHOLE)
    version, features = info["codebase_version"], info["features"]
    if not version.startswith("v3."):
        raise UserError(f"{folder}: is LeRobot {version}; convert it to {_VERSION} with LeRobot's own script")
    path = info.get("data_path", "data/")
    if not path.startswith("data/") or ".." in path:
        raise UserError(f"{folder}: its data_path {path!r} is not in data/; {_WHOLE}")
    needed: dict[str, str] = dict.fromkeys(
        (_STATE, _ACTION), f", only {', '.join(sorted(features))}; record it as a vector"
    )
    needed |= dict.fromkeys(("frame_index", "episode_index"), f"; {_WHOLE}")
    if missing := [name for name in needed if name not in features]:
        raise UserError(f"{folder}: has no {missing[0]}{needed[missing[0]]}")
    wanted = (_STATE, _ACTION, _SUCCESSOR, _REWARD, _DONE, _TRUNCATED, "frame_index", "episode_index")
    chosen = {name: features[name] for name in wanted if name in features}
    shapes = {name: checked(f"{folder / INFO}: {name}", x, _Feature, _WHOLE)["shape"] for name, x in chosen.items()}
    columns = _columns(folder, shapes)
    episode, frame = (_whole(folder, name, columns[name]) for name in ("episode_index", "frame_index"))
    ends = np.append(np.diff(episode) != 0, True)[: len(episode)]
    _check(folder, info, episode, frame, ends)
    obs, next_obs, keep, successors = columns[_STATE], columns.get(_SUCCESSOR), np.ones(len(ends), bool), "stored"
    if next_obs is None:
        next_obs, keep, successors = np.roll(obs, -1, axis=0), ~ends, "shifted"
    over = {n: flags(folder, n, columns[n], (None,), fix=_WHOLE) for n in (_DONE, _TRUNCATED) if n in columns}
    terminal = over[_DONE] & ~over[_TRUNCATED] if len(over) == 2 else None
    step, facts = (obs, columns[_ACTION], columns.get(_REWARD), next_obs), (folder, float(info["fps"]))
    return Rows(*step, terminal, ends, keep, "lerobot", successors, *facts)


def _columns(folder: Path, shapes: Mapping[str, Sequence[int]]) -> dict[str, np.ndarray]:
    """[N] numbers or [N, k] vectors by name, from all files in their order."""
    _, pq = _pyarrow(folder)
    paths = [path for path in files_of(folder) if path.parent.parent == folder / "data" and path.suffix == ".parquet"]
    if not paths:
        raise UserError(f"{folder}: holds no data/*/*.parquet; {_WHOLE}")
    parts: dict[str, list[np.ndarray]] = {name: [] for name in shapes}
    for path in paths:
        with damage(path, _WHOLE):
            with pq.ParquetFile(path) as file:
                _check_size(path, file.metadata, shapes)
                table = file.read(columns=list(shapes))
            for name, shape in shapes.items():
                parts[name].append(_numbers(path, name, table[name], shape))
    return {name: np.concatenate(values) for name, values in parts.items()}


def _check_size(path: Path, about: Any, shapes: Mapping[str, Sequence[int]]) -> None:
    """Raises UserError where a file claims more numbers than it can hold.

    Not by its columns, one by one: pyarrow ends the process where what a file says of them is damaged.
    """
    width = _WIDEST * sum(math.prod(shape) for shape in shapes.values())
    groups = [about.row_group(i) for i in range(about.num_row_groups)]
    claimed = sum(max(width * group.num_rows, group.total_byte_size) for group in groups)
    check_claim(path, claimed, path.stat().st_size)


def _numbers(path: Path, name: str, column: Any, shape: Sequence[int]) -> np.ndarray:
    """A column as its feature describes it: every row a number or a list of so many, in whatever type of list."""
    values = column.combine_chunks()
    listed = hasattr(values.type, "value_type") and hasattr(values, "flatten")
    flat = (values.flatten() if listed else values).to_numpy(zero_copy_only=False)
    sizes = np.array(values.value_lengths()) if listed else np.ones(len(values), int)
    if values.null_count or len(shape) != 1 or (sizes != shape[0]).any() or flat.dtype.kind not in "biuf":
        raise UserError(f"{path}: {name} is no column of numbers {shape}; only vectors are read")
    return flat.reshape(-1, shape[0]) if name in (_STATE, _ACTION, _SUCCESSOR) else flat.reshape(-1)


def _whole(folder: Path, name: str, values: np.ndarray) -> np.ndarray:
    """[N] int64."""
    if values.dtype.kind not in "iu":
        raise UserError(f"{folder}: {name} holds {values.dtype.name}, not whole numbers; {_WHOLE}")
    return values.astype(np.int64)


def _check(folder: Path, info: Mapping[str, Any], episode: np.ndarray, frame: np.ndarray, ends: np.ndarray) -> None:
    """Raise UserError where frames are missing or in another order."""
    for name, n in {"total_frames": len(frame), "total_episodes": len(np.unique(episode))}.items():
        if info.get(name, n) != n:
            raise UserError(f"{folder}: holds {name} {n}, but {INFO} says {info[name]}; {_WHOLE}")
    due, due_frame = np.cumsum(ends) - ends, ages(ends)
    if len(odd := np.flatnonzero(episode != due)):
        i = odd[0]
        raise UserError(f"{folder}: row {i} is of episode {episode[i]} where {due[i]} is due; {_WHOLE}")
    if len(odd := np.flatnonzero(frame != due_frame)):
        i = odd[0]
        raise UserError(f"{folder}: episode {episode[i]} has frame {frame[i]} where {due_frame[i]} is due; {_WHOLE}")


def _pyarrow(folder: Path) -> tuple[Any, Any]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise UserError(f"{folder}: LeRobot's layout needs pyarrow; pip install 'sgft-jax[lerobot]'") from error
    return pa, pq
