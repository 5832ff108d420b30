"""Impure: reads fixed sets of recorded transitions, D4RL and Minari HDF5 files, into memory.

Nothing is downloaded: the user supplies the file, and its `Facts` say what it holds. A file that is not what it should
be is a `UserError` with one line. Arrays are float32 on the host; `replay.full` makes them a buffer to sample.
"""

import dataclasses
import hashlib
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, NamedTuple, cast, get_args

import h5py
import numpy as np

from sgft_jax.io.jsonfile import read_json
from sgft_jax.types import Array, Transition, UserError, unknown

Successors = Literal["stored", "shifted"]

_COLUMNS, _TORQUE = 6, 3.0  # of a table; N m
_MAIN, _METADATA = "main_data.hdf5", "metadata.json"


@dataclasses.dataclass(frozen=True)
class Facts:
    """What a file held, for provenance and for a look before training.

    path: of the HDF5 file. layout: "d4rl", "minari" or "table". size: bytes. sha256: of its bytes, hex.
    successors: where next observations come from; "episode" for Minari, whose episodes hold one observation more.
    transitions: rows that are returned; dropped: rows of the file that are not. terminal: returned rows whose discount
        is 0. clipped: returned rows with an action beyond [-1, 1].
    episodes: in the file, one that the end of the file cuts off included; whole_episodes: the others.
    return_*: undiscounted returns of the whole episodes, or of all if none is whole. std is that of the population.
    """

    path: str
    layout: str
    size: int
    sha256: str
    successors: str
    transitions: int
    dropped: int
    terminal: int
    clipped: int
    episodes: int
    whole_episodes: int
    return_mean: float
    return_std: float
    return_min: float
    return_max: float


class Log(NamedTuple):
    """rows: [N, ...] transitions in the order of the file, float32 on the host. facts: where they come from.

    last: [N] bool, the rows that the row below does not follow: what `sequences.full` needs.
    """

    rows: Transition
    facts: Facts
    last: np.ndarray


class _Recorded(NamedTuple):
    """All rows [N, ...] of a file. ends: [N] bool, last row of an episode; keep: [N] bool, rows that are returned."""

    obs: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    next_obs: np.ndarray
    terminal: np.ndarray
    ends: np.ndarray
    keep: np.ndarray


def load(path: Path | str, *, gamma: float, successors: Successors = "stored") -> Log:
    """The transitions of a D4RL file, or of a Minari data set: its folder, or the `main_data.hdf5` inside.

    gamma: a row's discount is gamma, or 0 where it is terminal. A time limit is never terminal: D4RL's `timeouts` and
        Minari's `truncations` only end episodes. Actions are clipped to [-1, 1].
    successors: of D4RL files. "stored" takes `next_observations` and keeps every row. "shifted" takes the observation
        of the row below and drops the rows of time limits and the last row, as D4RL's own `qlearning_dataset` does.
        The successor of a shifted terminal row is the start of the next episode: a discount of 0 hides it from
        critics, but not from a discriminator.
    Raises UserError for a file that is missing, cut off, of another layout, or holds numbers that are not finite.
    """
    if successors not in (known := get_args(Successors)):
        raise UserError(unknown("successors", successors, known))
    file = _file_of(Path(path))
    with _opened(file) as content:
        minari = bool(_episodes(content))
        if minari and successors == "shifted":
            raise UserError(f"{file}: Minari episodes hold their last observation; leave successors at 'stored'")
        recorded = _read_minari(file, content) if minari else _read_d4rl(file, content, successors)
    _check(file, recorded)
    facts = _facts(file, recorded, "episode" if minari else successors)
    below = np.append(recorded.keep[1:], False)
    return Log(_transitions(recorded, gamma), facts, (recorded.ends | ~below)[recorded.keep])


def load_table(path: Path | str, *, gamma: float, obs_dim: int, reward: Callable[..., Array]) -> Log:
    """The transitions of a wheel-legged robot's log: text, a row each control period, with these six columns.

    x (m), v (m/s), pitch (rad), pitch velocity (rad/s), torque (N m), done. obs_dim: 4 reads the first four as the
    observation, 3 leaves x out. reward(obs [N, obs_dim], action [N, 1], next_obs [N, obs_dim]) -> [N], of the task.
    Rows with a torque beyond +-3 N m are dropped, whatever its sign, and an episode ends before each of them. A row
    whose successor is done is terminal; rows that are done are dropped. Source: H2O+'s log of the standing robot, whose
    released loader keeps torques below -3 and joins what lies on both sides of a dropped row.
    Raises UserError for a file that is missing, has other columns, numbers that are not finite, or no transition.
    """
    file = Path(path)
    table = _table(file)
    state, torque, done = table[:, 4 - obs_dim : 4], table[:, 4:5], table[:, 5] != 0
    small = np.abs(torque[:, 0]) <= _TORQUE
    rows = np.flatnonzero((small & ~done)[:-1] & (small | done)[1:])
    obs, action, next_obs = state[rows], torque[rows] / _TORQUE, state[rows + 1]
    terminal, apart = done[rows + 1], np.diff(rows, append=rows[-1:]) > 1
    paid = np.asarray(reward(obs, action, next_obs))
    recorded = _Recorded(obs, action, paid, next_obs, terminal, terminal | apart, np.ones(len(rows), bool))
    _check(file, recorded)
    facts = dataclasses.replace(_facts(file, recorded, "stored"), layout="table", dropped=len(table) - len(rows))
    last = recorded.ends.copy()
    last[-1:] = True
    return Log(_transitions(recorded, gamma), facts, last)


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


def _file_of(path: Path) -> Path:
    """The HDF5 file that `path` means."""
    if not path.exists():
        raise UserError(f"{path}: no such file")
    if not path.is_dir():
        return path
    for folder in (path / "data", path):
        if (folder / _MAIN).exists():
            return folder / _MAIN
        if (folder / _METADATA).exists() and (kind := read_json(folder / _METADATA).get("data_format")) != "hdf5":
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


def _read_d4rl(file: Path, content: h5py.File, successors: Successors) -> _Recorded:
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
    return _Recorded(obs, action, reward, next_obs, terminal, terminal | timeout, keep)


def _read_minari(file: Path, content: h5py.File) -> _Recorded:
    groups = _episodes(content)
    recorded = _Recorded(*map(np.concatenate, zip(*(_read_episode(file, group) for group in groups), strict=True)))
    if (card := file.with_name(_METADATA)).exists():
        found = {"total_episodes": len(groups), "total_steps": len(recorded.reward)}
        for name, n in found.items():
            if (said := read_json(card).get(name, n)) != n:
                raise UserError(f"{file}: holds {name} {n}, but {card.name} says {said}; supply a whole data set")
    return recorded


def _episodes(content: h5py.File) -> list[h5py.Group]:
    """The groups `episode_0`, `episode_1`, ... of a Minari file, in the order of their numbers."""
    found = {int(m[1]): content[m[0]] for name in content if (m := re.fullmatch(r"episode_(\d+)", str(name)))}
    return [group for _, group in sorted(found.items()) if isinstance(group, h5py.Group)]


def _read_episode(file: Path, group: h5py.Group) -> _Recorded:
    """The T rows of one episode, which has T + 1 observations."""
    obs, action = _array(file, group, "observations", 2), _array(file, group, "actions", 2)
    reward, terminal = _array(file, group, "rewards", 1), _array(file, group, "terminations", 1)
    steps = len(reward)
    if len(obs) != steps + 1 or steps != group.attrs.get("total_steps", steps):
        raise UserError(
            f"{file}: {group.name} has {len(obs)} observations for {steps} of {group.attrs.get('total_steps', steps)} "
            "rewards; every episode needs one observation more than rewards: supply a whole file"
        )
    ends, every = np.arange(steps) == steps - 1, np.ones(steps, bool)
    return _Recorded(obs[:-1], action, reward, obs[1:], terminal.astype(bool), ends, every)


def _check(file: Path, recorded: _Recorded) -> None:
    """Raise UserError unless all arrays have as many rows, some rows count, and all their numbers are finite."""
    lengths = {name: len(array) for name, array in recorded._asdict().items()}
    if len(set(lengths.values())) > 1:
        said = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise UserError(f"{file}: the numbers of rows differ ({said}); supply a whole file")
    if not np.any(recorded.keep):
        raise UserError(f"{file}: holds no transitions; supply another file")
    if recorded.next_obs.shape != recorded.obs.shape:
        raise UserError(
            f"{file}: next observations are {list(recorded.next_obs.shape)}, observations {list(recorded.obs.shape)}; "
            "supply another file or set successors to 'shifted'"
        )
    for name in ("obs", "action", "reward", "next_obs"):
        array = getattr(recorded, name)
        finite = np.isfinite(array) if array.ndim == 1 else np.isfinite(array).all(axis=1)
        if not finite.all():
            raise UserError(f"{file}: {name} of row {np.argmin(finite)} is not finite; leave the row out of the file")


def _transitions(recorded: _Recorded, gamma: float) -> Transition:
    def kept(array: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(array[recorded.keep], np.float32)

    action = np.clip(kept(recorded.action), -1.0, 1.0)
    discount = kept(np.where(recorded.terminal, 0.0, gamma))
    rows = kept(recorded.obs), action, kept(recorded.reward), discount, kept(recorded.next_obs)
    return Transition(*cast(tuple[Array, ...], rows))


def _facts(file: Path, recorded: _Recorded, successors: str) -> Facts:
    with open(file, "rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    keep, whole = recorded.keep, int(np.sum(recorded.ends))
    number = np.cumsum(recorded.ends) - recorded.ends  # of the episode of every row
    returns = np.bincount(number, weights=recorded.reward.astype(np.float64))
    judged = returns[:whole] if whole else returns
    return Facts(
        path=str(file),
        layout="minari" if successors == "episode" else "d4rl",
        size=file.stat().st_size,
        sha256=digest,
        successors=successors,
        transitions=int(np.sum(keep)),
        dropped=int(np.sum(~keep)),
        terminal=int(np.sum(recorded.terminal & keep)),
        clipped=int(np.sum((np.abs(recorded.action) > 1).any(axis=1) & keep)),
        episodes=len(returns),
        whole_episodes=whole,
        return_mean=float(np.mean(judged)),
        return_std=float(np.std(judged)),
        return_min=float(np.min(judged)),
        return_max=float(np.max(judged)),
    )
