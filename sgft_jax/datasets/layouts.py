"""Impure: what lies in recorded files, as rows: HDF5 of D4RL and Minari, tables of a robot, rollouts of our own runs.

A reader tells what is there and changes nothing; `check` is the one judge of all rows, and `data.logs` makes
transitions of them. What is not as its layout says is a `UserError` with one line.

An HDF5 file may take its numbers from any other file (external storage, links, virtual data sets), may ask for code
that unpacks them (plug-ins), and may claim any size. All of that is refused before a number is read.
"""

import io
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import h5py
import numpy as np

from envs.files import Count, Positive, read_object, read_text
from envs.types import UserError
from sgft_jax.files.arrays import check_claim, check_plain, damage, flags, numbers
from sgft_jax.io.real import played
from sgft_jax.types import Successors

_COLUMNS, _TORQUE = 6, 3.0  # of a table; N m
_MAIN, _METADATA = "main_data.hdf5", "metadata.json"
_LONGEST = 2**30  # bytes of a table
_SAME = 1e-4  # relative; what two copies of an observation differ by
_FIX = "leave the row out of the file"
# Codes of HDF5's own filters: shuffle and checksums; deflate, szip, n-bit, scale-offset, and h5py's LZF.
_REORDERING, _PACKING = {2, 3}, {1, 4, 5, 6, 32000}
_HARD = 0  # a link that is none
_SHOWN = 8  # names in a message
_COPY = "copy the numbers into the file, such as with h5repack"


class Rows(NamedTuple):
    """All rows [N, ...] of a file, in its order.

    reward, terminal: None where the file does not tell. ends: [N] bool, last row of an episode. keep: [N] bool, rows
    whose successor is known. layout: its name. successors: where next observations come from. rate: steps per second,
    None where the file does not tell. source: the file that stands for all, or the folder. assumed: what the file does
    not tell and was taken to be so, in words. dropped: rows of the file that are left out.
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
    assumed: str = ""
    dropped: int = 0


class _Card(TypedDict, total=False):
    """What is read of Minari's card."""

    data_format: str
    total_episodes: Count
    total_steps: Count
    control_dt: Positive


# --- HDF5 files of anybody --------------------------------------------------------------------------------------------


class Reader:
    """An open file. All that it returns together is no more than what the file can really hold."""

    def __init__(self, path: Path, content: h5py.File) -> None:
        self.path, self.content = path, content
        self._claimed = self._stored = 0  # bytes, of all arrays so far

    def has(self, group: h5py.Group | None, name: str) -> bool:
        """Whether something has that name in a group, None for the root."""
        with damage(self.path):
            return (self.content if group is None else group).id.links.exists(name.encode())

    def groups(self, pattern: str) -> list[h5py.Group]:
        """Those of the root with names that fit, in the order of the number that is the pattern's only group."""
        with damage(self.path):
            matches = [match for name in sorted(self.content) if (match := re.fullmatch(pattern, name))]
        members = [self._member(self.content, match[0]) for match in sorted(matches, key=lambda match: int(match[1]))]
        return [member for member in members if isinstance(member, h5py.Group)]

    def array(self, group: h5py.Group | None, name: str, rank: int) -> np.ndarray:
        """The numbers of a data set in a group, None for the root: [rows, entries], or [rows], also from [rows, 1]."""
        data = self._member(self.content if group is None else group, name)
        name = str(data.name)
        if not isinstance(data, h5py.Dataset):
            raise UserError(f"{self.path}: {name} is a group; only vectors are read, so flatten it before recording")
        with damage(self.path):
            shape: tuple[int, ...] | None = data.shape  # None: an empty data set
            kind = data.dtype
            fits = shape is not None and (len(shape) == rank or (rank == 1 and shape[1:] == (1,)))
            if shape is None or not fits or kind.kind not in "biuf" or 0 in shape[1:]:
                wanted = "[rows]" if rank == 1 else "[rows, entries]"
                size = "nothing" if shape is None else list(shape)
                raise UserError(f"{self.path}: {name} is {kind} {size}, not numbers {wanted}; supply another file")
            self._check(name, data)
            array = np.asarray(data[()])
        return array[:, 0] if array.ndim > rank else array

    def attribute(self, group: h5py.Group, name: str) -> int | None:
        """A whole number beside a group; None where there is none."""
        with damage(self.path):
            value = np.asarray(group.attrs[name]) if name in group.attrs else None
        if value is not None and (value.shape != () or value.dtype.kind not in "iu"):
            raise UserError(f"{self.path}: {name} of {group.name} is no whole number; supply a whole file")
        return None if value is None else int(value)

    def _member(self, group: h5py.Group, name: str) -> Any:
        """What lies in the file under that name; a link is not followed."""
        with damage(self.path):
            if not self.has(group, name):
                names = [member if member.isprintable() else repr(member) for member in sorted(group)]
                others = ", ".join(names[:_SHOWN]) + ", ..." * (len(names) > _SHOWN) or "nothing"
                missing = f"there is no {name!r} in {group.name}, only {others}"
                raise UserError(f"{self.path}: {missing}; supply a D4RL or Minari file")
            if group.id.links.get_info(name.encode()).type != _HARD:
                raise UserError(f"{self.path}: {name} is a link; {_COPY}")
            return group[name]

    def _check(self, name: str, data: h5py.Dataset) -> None:
        """Raises UserError for numbers of other files, filters that are not HDF5's own, and sizes that cannot be."""
        if data.is_virtual or data.external:
            raise UserError(f"{self.path}: {name} takes its numbers from other files; {_COPY}")
        about = data.id.get_create_plist()
        filters = [about.get_filter(i)[0] for i in range(about.get_nfilters())]
        packing = [code for code in filters if code not in _REORDERING]
        if len(packing) > 1 or not _PACKING.issuperset(packing):
            raise UserError(f"{self.path}: {name} is packed by the filters {filters}; pack it by gzip alone")
        chunk = math.prod(data.chunks) if data.chunks else 0
        self._claimed += math.prod(data.shape) * data.dtype.itemsize
        self._stored += data.id.get_storage_size()
        stored = min(self._stored, self.path.stat().st_size)  # the same numbers may have many names
        check_claim(self.path, self._claimed + chunk * data.dtype.itemsize, stored)


@contextmanager
def opened(path: Path) -> Iterator[Reader]:
    """A plain file; raises UserError for what is none, or no HDF5."""
    check_plain(path)
    if not h5py.is_hdf5(path):
        raise UserError(f"{path}: is not an HDF5 file; supply the .hdf5 of D4RL or of Minari")
    with damage(path):
        content = h5py.File(path, "r")
    with content:
        yield Reader(path, content)


# --- layouts ----------------------------------------------------------------------------------------------------------


def check(path: Path, rows: Rows) -> Rows:
    """The rows as float32, all finite; raises UserError where they are not, or where they are no transitions."""
    if not np.any(rows.keep):
        raise UserError(f"{path}: holds no transitions; supply another file")
    if rows.next_obs.shape != rows.obs.shape:
        sizes = f"next observations are {list(rows.next_obs.shape)}, observations {list(rows.obs.shape)}"
        raise UserError(f"{path}: {sizes}; supply another file or set successors to 'shifted'")
    n = len(rows.keep)
    shapes = {"obs": (n, None), "action": (n, None), "next_obs": (n, None)}
    shapes |= {} if rows.reward is None else {"reward": (n,)}
    columns = {name: numbers(path, name, getattr(rows, name), shape, fix=_FIX) for name, shape in shapes.items()}
    return rows._replace(**columns)


def ages(ends: np.ndarray) -> np.ndarray:
    """[N] the steps since its episode began of every row. ends: [N] bool, the rows that are the last of one."""
    place, starts = np.arange(len(ends)), np.append(True, ends[:-1])[: len(ends)]
    return place - np.maximum.accumulate(np.where(starts, place, 0))


def files_of(folder: Path) -> list[Path]:
    """The files in a folder, in the order of their names. Hidden ones are left out: systems leave them everywhere."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    return sorted(path for path in paths if not any(part[0] == "." for part in path.relative_to(folder).parts))


def read_hdf5(path: Path, successors: Successors, limit: int | None = None) -> Rows:
    """The rows of a D4RL file, or of a Minari data set: its folder, or the `main_data.hdf5` inside.

    limit: steps after which the task ends an episode, for a file that does not tell where episodes end.
    """
    file = _file_of(path)
    with opened(file) as content:
        groups = content.groups(r"episode_(0|[1-9][0-9]{0,17})")
        if not groups:
            return _read_d4rl(content, successors, limit)
        if successors == "shifted":
            raise UserError(f"{file}: Minari episodes hold their last observation; leave successors at 'stored'")
        return _read_minari(content, groups)


def read_table(path: Path, measured_dim: int) -> Rows:
    """The rows of a wheel-legged robot's log, without rewards: text, a row each control period, with six columns.

    x (m), v (m/s), pitch (rad), pitch velocity (rad/s), torque (N m), done. measured_dim: 4 reads the first four as the
    observation, 3 leaves x out. Rows with a torque beyond +-3 N m are dropped, whatever its sign, and an episode ends
    before each of them. A row whose successor is done is terminal; rows that are done are dropped. Source: H2O+'s log
    of the standing robot, whose released loader keeps torques below -3 and joins both sides of a dropped row.
    """
    table = _table(path)
    state, torque = table[:, 4 - measured_dim : 4], table[:, 4:5]
    done = flags(path, "done", table[:, 5], (None,), fix=_FIX)
    small = np.abs(torque[:, 0]) <= _TORQUE
    rows = np.flatnonzero((small & ~done)[:-1] & (small | done)[1:])
    if not len(rows):
        raise UserError(f"{path}: holds no transitions; supply another file")
    obs, action, next_obs, terminal = state[rows], torque[rows] / _TORQUE, state[rows + 1], done[rows + 1]
    ends, keep = terminal | (np.diff(rows, append=rows[-1:]) > 1), np.ones(len(rows), bool)
    step, dropped = (obs, action, None, next_obs, terminal, ends, keep), len(table) - len(rows)
    return Rows(*step, "table", "stored", path, dropped=dropped)


def read_rollouts(home: Path) -> Rows:
    """The valid steps of the rollouts in `<home>/real/`, all of the first seed first."""
    episodes = [episode.rows for episode in played(home) if len(episode.rows.reward)]
    if not episodes:
        raise UserError(f"{home / 'real'}: holds no valid step")
    obs, action, reward, discount, next_obs = map(np.concatenate, zip(*episodes, strict=True))
    ends, keep = np.zeros(len(reward), bool), np.ones(len(reward), bool)
    ends[np.cumsum([len(rows.reward) for rows in episodes]) - 1] = True
    return Rows(obs, action, reward, next_obs, discount == 0, ends, keep, "rollouts", "stored", home / "real")


def _table(file: Path) -> np.ndarray:
    """[N, 6] numbers of a text file."""
    text = read_text(file, limit=_LONGEST)
    delimiter = "," if "," in text.partition("\n")[0] else None
    try:
        with warnings.catch_warnings(action="ignore"):  # of no rows
            table = np.loadtxt(io.StringIO(text), ndmin=2, delimiter=delimiter)
    except ValueError as error:
        message = str(error).splitlines()[0]
        raise UserError(f"{file}: is not a table of numbers ({message}); supply six columns without a head") from error
    if table.size and table.shape[1] != _COLUMNS:
        raise UserError(f"{file}: has {table.shape[1]} columns, not x, v, pitch, its velocity, torque and done")
    return numbers(file, "a number", table.reshape(-1, _COLUMNS), (None, None), fix=_FIX)


def _card(folder: Path) -> Mapping[str, Any]:
    return read_object(folder / _METADATA, _Card, "supply a whole data set")


def _file_of(path: Path) -> Path:
    """The HDF5 file that `path` means."""
    if not path.is_dir():
        return path
    for folder in (path / "data", path):
        if (folder / _MAIN).exists():
            return folder / _MAIN
        if (folder / _METADATA).exists() and (kind := _card(folder).get("data_format")) != "hdf5":
            raise UserError(f"{folder}: its data_format is {kind}; make the data set with data_format='hdf5'")
    raise UserError(f"{path}: holds no data/{_MAIN}; name an HDF5 file or the folder of a Minari data set")


def _read_d4rl(content: Reader, successors: Successors, limit: int | None) -> Rows:
    file, stored = content.path, None
    obs, action, reward, terminal, timeout = _columns(content, None, "terminals", "timeouts")
    known = content.has(None, "next_observations")
    if successors == "stored" and not known:
        raise UserError(f"{file}: has no 'next_observations'; set successors to 'shifted'")
    if known and (successors == "stored" or timeout is None):
        stored = content.array(None, "next_observations", 2)
    below = {} if stored is None else {"next_observations": stored}
    _check_lengths(file, {"observations": obs, "rewards": reward, **below})
    assumed = ""
    if timeout is None:
        timeout, assumed = _time_limits(obs, stored, terminal, limit)
    keep = np.ones(len(obs), bool)
    if stored is None or successors == "shifted":
        stored, keep = np.roll(obs, -1, axis=0), ~timeout
        keep[-1:] = False
    ends = terminal | timeout
    return Rows(obs, action, reward, stored, terminal, ends, keep, "d4rl", successors, file, assumed=assumed)


def _columns(
    content: Reader, group: h5py.Group | None, terminal: str, timeout: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Observations, actions, rewards and the flags of that name; None in place of time limits that are not there."""
    obs, action = content.array(group, "observations", 2), content.array(group, "actions", 2)
    reward = content.array(group, "rewards", 1)
    names = (terminal, *([timeout] if content.has(group, timeout) else []))
    ends = {name: content.array(group, name, 1) for name in names}
    where = content.path if group is None else f"{content.path}: {group.name}"
    _check_lengths(where, {"actions": action, "rewards": reward, **ends})
    ends = {name: flags(where, name, x, (None,), fix=_FIX) for name, x in ends.items()}
    return obs, action, reward, ends[terminal], ends.get(timeout)


def _time_limits(
    obs: np.ndarray, stored: np.ndarray | None, terminal: np.ndarray, limit: int | None
) -> tuple[np.ndarray, str]:
    """[N] rows that time has ended in a file without 'timeouts', and how that was known, in words."""
    words = "has no 'timeouts': an episode is taken to end at a terminal row"
    if stored is not None and stored.shape == obs.shape:
        with np.errstate(invalid="ignore", over="ignore"):
            here, below = stored[:-1].astype(np.float64), obs[1:].astype(np.float64)
            jump = (np.abs(here - below) > _SAME * (1 + np.abs(below))).any(axis=1)
        return np.append(jump, False)[: len(obs)] & ~terminal, f"{words}, and where the row below begins anew"
    if limit is not None:
        return ((ages(terminal) + 1) % limit == 0) & ~terminal, f"{words}, or after the {limit} steps of the task"
    return np.zeros(len(obs), bool), f"{words} alone"


def _check_lengths(where: Path | str, arrays: Mapping[str, np.ndarray]) -> None:
    lengths = {name: len(array) for name, array in arrays.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {n}" for name, n in lengths.items())
        raise UserError(f"{where}: the numbers of rows differ ({listed}); supply a whole file")


def _read_minari(content: Reader, groups: list[h5py.Group]) -> Rows:
    file = content.path
    episodes = [_read_episode(content, group) for group in groups]
    sizes = [[x.shape[1:] for x in rows] for rows in episodes]
    if odd := [group.name for group, size in zip(groups, sizes, strict=True) if size != sizes[0]]:
        other = f"other sizes of observations or actions than {groups[0].name}"
        raise UserError(f"{file}: {odd[0]} has {other}; supply episodes of one task")
    obs, action, reward, next_obs, terminal, ends = map(np.concatenate, zip(*episodes, strict=True))
    card = _card(file.parent) if file.with_name(_METADATA).exists() else {}
    for name, n in {"total_episodes": len(groups), "total_steps": len(reward)}.items():
        if (stated := card.get(name, n)) != n:
            raise UserError(f"{file}: holds {name} {n}, but {_METADATA} says {stated}; supply a whole data set")
    rate = 1 / card["control_dt"] if "control_dt" in card else None
    keep = np.ones(len(reward), bool)
    return Rows(obs, action, reward, next_obs, terminal, ends, keep, "minari", "episode", file, rate)


def _read_episode(content: Reader, group: h5py.Group) -> tuple[np.ndarray, ...]:
    """The T rows of one episode, which has T + 1 observations: obs, action, reward, next_obs, terminal, ends."""
    obs, action, reward, terminal, _ = _columns(content, group, "terminations", "truncations")
    steps, stated = len(reward), content.attribute(group, "total_steps")
    if len(obs) != steps + 1 or stated not in (None, steps):
        counts = f"{len(obs)} observations for {steps} of {steps if stated is None else stated} rewards"
        rule = "every episode needs one observation more than rewards: supply a whole file"
        raise UserError(f"{content.path}: {group.name} has {counts}; {rule}")
    return obs[:-1], action, reward, obs[1:], terminal, np.arange(steps) == steps - 1
