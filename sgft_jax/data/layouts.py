"""Impure: what lies in recorded files, as rows: HDF5 of D4RL and Minari, tables of a robot, rollouts of our own runs.

A reader tells what is there and changes nothing; `data.logs` judges it and makes transitions of it. What is not as its
layout says is a `UserError` with one line.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from envs.files import read_object
from sgft_jax.io.real import played
from sgft_jax.types import Successors, UserError

_COLUMNS, _TORQUE = 6, 3.0  # of a table; N m
_MAIN, _METADATA = "main_data.hdf5", "metadata.json"


class Rows(NamedTuple):
    """All rows [N, ...] of a file, in its order.

    reward, terminal: None where the file does not tell. ends: [N] bool, last row of an episode. keep: [N] bool, rows
    whose successor is known. layout: its name. successors: where next observations come from. rate: steps per second,
    None where the file does not tell. source: the file that stands for all, or the folder.
    """

    obs: np.ndarray
    action: np.ndarray
    reward: np.ndarray | None
    next_obs: np.ndarray
    terminal: np.ndarray | None
    ends: np.ndarray
    keep: np.ndarray
    layout: str
    successors: str
    source: Path
    rate: float | None = None


def read_hdf5(path: Path, successors: Successors) -> Rows:
    """The rows of a D4RL file, or of a Minari data set: its folder, or the `main_data.hdf5` inside."""
    file = _file_of(path)
    with _opened(file) as content:
        if not _episodes(content):
            return _read_d4rl(file, content, successors)
        if successors == "shifted":
            raise UserError(f"{file}: Minari episodes hold their last observation; leave successors at 'stored'")
        return _read_minari(file, content)


def read_table(path: Path, measured_dim: int) -> tuple[Rows, int]:
    """The rows of a wheel-legged robot's log, without rewards, and how many rows it has in all.

    measured_dim: 4 reads x, v, pitch and its velocity as the observation, 3 leaves x out. See `logs.load_table`.
    """
    table = _table(path)
    state, torque, done = table[:, 4 - measured_dim : 4], table[:, 4:5], table[:, 5] != 0
    small = np.abs(torque[:, 0]) <= _TORQUE
    rows = np.flatnonzero((small & ~done)[:-1] & (small | done)[1:])
    terminal, apart = done[rows + 1], np.diff(rows, append=rows[-1:]) > 1
    found = Rows(
        state[rows], torque[rows] / _TORQUE, None, state[rows + 1], terminal, terminal | apart,
        np.ones(len(rows), bool), "table", "stored", path,
    )  # fmt: skip
    return found, len(table)


def read_rollouts(home: Path) -> Rows:
    """The valid steps of the rollouts in `<home>/real/`, all of the first seed first."""
    each = [own.rows for own in played(home) if len(own.rows["reward"])]
    if not each:
        raise UserError(f"{home / 'real'}: holds no valid step")
    joined = {name: np.concatenate([rows[name] for rows in each]) for name in each[0]}
    last = np.cumsum([len(rows["reward"]) for rows in each]) - 1
    ends = np.isin(np.arange(last[-1] + 1), last)
    return Rows(
        joined["obs"], joined["action"], joined["reward"], joined["next_obs"], joined["discount"] == 0, ends,
        np.ones(len(ends), bool), "rollouts", "stored", home / "real",
    )  # fmt: skip


def _table(file: Path) -> np.ndarray:
    """[N, 6] numbers of a text file."""
    if not file.is_file():
        raise UserError(f"{file}: no such file")
    try:
        with open(file) as text:
            delimiter = "," if "," in text.readline() else None
        table = np.loadtxt(file, dtype=np.float32, ndmin=2, delimiter=delimiter)
    except (ValueError, UnicodeDecodeError) as error:
        said = str(error).splitlines()[0]
        raise UserError(f"{file}: is not a table of numbers ({said}); supply six columns without a head") from error
    if table.shape[1] != _COLUMNS:
        raise UserError(f"{file}: has {table.shape[1]} columns, not x, v, pitch, its velocity, torque and done")
    return table


def _card(folder: Path) -> dict[str, Any]:
    """What Minari says of a data set."""
    return read_object(folder / _METADATA, {}, "supply a whole data set")


def _file_of(path: Path) -> Path:
    """The HDF5 file that `path` means."""
    if not path.exists():
        raise UserError(f"{path}: no such file")
    if not path.is_dir():
        return path
    for folder in (path / "data", path):
        if (folder / _MAIN).exists():
            return folder / _MAIN
        if (folder / _METADATA).exists() and (kind := _card(folder).get("data_format")) != "hdf5":
            raise UserError(f"{folder}: its data_format is {kind}; make the data set with data_format='hdf5'")
    raise UserError(f"{path}: holds no data/{_MAIN}; name an HDF5 file or the folder of a Minari data set")


@contextmanager
def _opened(file: Path) -> Iterator[h5py.File]:
    """An HDF5 file whose damage is a UserError."""
    if not h5py.is_hdf5(file):
        raise UserError(f"{file}: is not an HDF5 file; supply the .hdf5 of D4RL or of Minari")
    try:
        with h5py.File(file, "r") as content:
            yield content
    except (OSError, RuntimeError, KeyError) as error:  # what h5py raises for damaged files
        said = str(error).splitlines()[0].strip("'\"")
        raise UserError(f"{file}: damaged or cut off ({said}); supply a whole file") from error


def _array(file: Path, group: h5py.Group, name: str, rank: int) -> np.ndarray:
    """The numbers of a data set of that rank."""
    if name not in group:
        there = ", ".join(sorted(group)) or "nothing"
        raise UserError(f"{file}: there is no {name!r} in {group.name}, only {there}; supply a D4RL or Minari file")
    data = group[name]
    if not isinstance(data, h5py.Dataset):
        raise UserError(f"{file}: {data.name} is a group; only vectors are read, so flatten it before it is recorded")
    if data.ndim != rank or data.dtype.kind not in "biuf":
        wanted = "[rows]" if rank == 1 else "[rows, entries]"
        raise UserError(
            f"{file}: {data.name} is {data.dtype} {list(data.shape)}, not numbers {wanted}; supply another file"
        )
    return np.asarray(data[()])


def _read_d4rl(file: Path, content: h5py.File, successors: Successors) -> Rows:
    obs, action = _array(file, content, "observations", 2), _array(file, content, "actions", 2)
    reward, terminal, timeout = (_array(file, content, name, 1) for name in ("rewards", "terminals", "timeouts"))
    terminal, timeout = terminal.astype(bool), timeout.astype(bool)
    keep = np.ones(len(obs), bool)
    if successors == "shifted":
        next_obs = np.roll(obs, -1, axis=0)
        keep = ~timeout
        keep[-1:] = False
    elif "next_observations" in content:
        next_obs = _array(file, content, "next_observations", 2)
    else:
        raise UserError(f"{file}: has no 'next_observations'; set successors to 'shifted'")
    return Rows(obs, action, reward, next_obs, terminal, terminal | timeout, keep, "d4rl", successors, file)


def _read_minari(file: Path, content: h5py.File) -> Rows:
    groups = _episodes(content)
    each = [_read_episode(file, group) for group in groups]
    obs, action, reward, next_obs, terminal, ends = map(np.concatenate, zip(*each, strict=True))
    card = _card(file.parent) if file.with_name(_METADATA).exists() else {}
    for name, n in {"total_episodes": len(groups), "total_steps": len(reward)}.items():
        if (said := card.get(name, n)) != n:
            raise UserError(f"{file}: holds {name} {n}, but {_METADATA} says {said}; supply a whole data set")
    rate = 1 / card["control_dt"] if "control_dt" in card else None
    keep = np.ones(len(reward), bool)
    return Rows(obs, action, reward, next_obs, terminal, ends, keep, "minari", "episode", file, rate)


def _episodes(content: h5py.File) -> list[h5py.Group]:
    """The groups `episode_0`, `episode_1`, ... of a Minari file, in the order of their numbers."""
    found = {int(m[1]): content[m[0]] for name in content if (m := re.fullmatch(r"episode_(\d+)", str(name)))}
    return [group for _, group in sorted(found.items()) if isinstance(group, h5py.Group)]


def _read_episode(file: Path, group: h5py.Group) -> tuple[np.ndarray, ...]:
    """The T rows of one episode, which has T + 1 observations: obs, action, reward, next_obs, terminal, ends."""
    obs, action = _array(file, group, "observations", 2), _array(file, group, "actions", 2)
    reward, terminal = _array(file, group, "rewards", 1), _array(file, group, "terminations", 1)
    steps = len(reward)
    if len(obs) != steps + 1 or steps != group.attrs.get("total_steps", steps):
        raise UserError(
            f"{file}: {group.name} has {len(obs)} observations for {steps} of {group.attrs.get('total_steps', steps)} "
            "rewards; every episode needs one observation more than rewards: supply a whole file"
        )
    return obs[:-1], action, reward, obs[1:], terminal.astype(bool), np.arange(steps) == steps - 1
