"""Impure: the real rollouts of a run on disk. What a robot did is never repeated, cut off or deleted."""

import json
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from envs.files import read_text
from envs.types import Transition, UserError
from sgft_jax.files.arrays import flags, numbers, read_npz
from sgft_jax.files.disk import sync, written

_REAL, _ROLLOUT, _HALF, _STEPS = "real", "rollout-", ".half", ".steps.jsonl"
_ROWS = Transition._fields
_LONGEST = 2**30  # bytes of a journal
_FIX = "docs/formats.md lists what a rollout holds"


class RealStore:
    """Every real rollout, on disk in `<folder>/real/` before anything learns from it.

    One `.npz` per rollout, numbered from 0, written under another name, flushed to disk and renamed. Arrays only,
    nothing is ever pickled. On a resume, rollouts from after the last checkpoint are loaded and learned from again.
    """

    def __init__(self, folder: Path, *, say: Callable[[str], None] = print) -> None:
        """Open or make the store of a run folder; `say` hears of a rollout that a kill has cut short."""
        self.folder = Path(folder) / _REAL
        self.folder.mkdir(parents=True, exist_ok=True)
        for half in sorted(self.folder.glob(f"*{_HALF}")):
            say(f"ignored: {half}: writing it was cut short")

    def __len__(self) -> int:
        """Rollouts on disk."""
        return max(map(_number_of, self.folder.glob(f"{_ROLLOUT}*.npz")), default=-1) + 1

    def append(self, rollout: Mapping[str, Any]) -> int:
        """Store one rollout, {name: array [..., T, ...]}, and return its number once it is safely on disk."""
        arrays = {name: np.asarray(x) for name, x in rollout.items()}
        if unfit := [name for name, x in arrays.items() if x.dtype.kind not in "biufSU"]:
            raise TypeError(f"a rollout holds plain numeric arrays only, not {unfit}")
        number = len(self)
        path = self._path(number)
        with written(path, path.with_suffix(_HALF)) as half, open(half, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        return number

    def load(self, number: int) -> dict[str, np.ndarray]:
        """The arrays of one rollout; raises UserError if it is missing or damaged."""
        path = self._path(number)
        if not path.exists():
            raise UserError(f"{path}: rollout {number} is missing; this run cannot go on without it")
        return read_npz(path)

    def rollout(self, number: int) -> dict[str, np.ndarray]:
        """One rollout of [S] seeds and T steps, as docs/formats.md lists its arrays; UserError where it is none."""
        return _checked(self._path(number), self.load(number))

    def journal(self, number: int, *, sync_every: int = 1) -> "Journal":
        """Where the steps of a rollout go while it is played."""
        return Journal(self.folder / f"{_ROLLOUT}{number:06d}{_STEPS}", sync_every)

    def _path(self, number: int) -> Path:
        return self.folder / f"{_ROLLOUT}{number:06d}.npz"


class Journal:
    """The steps of one rollout, a line each. A line is with the operating system before the next step begins.

    So a killed process loses none. Before them stands the first step as it was asked for, so that a kill during it is
    known. sync_every: steps between two flushes to disk; a power cut loses fewer than that.
    """

    def __init__(self, path: Path, sync_every: int) -> None:
        self.path, self._every, self._count = path, sync_every, 0
        self._file: Any = None

    def read(self) -> list[dict[str, np.ndarray]]:
        """The steps so far; the first one as it was asked for where it has no outcome, none where it was not asked for.

        A last line that a kill has torn is left out. Raises UserError for a damaged file.
        """
        if not self.path.exists():
            return []
        lines = read_text(self.path, limit=_LONGEST).split("\n")[:-1]  # what follows the last newline is torn
        if not lines:
            return []
        try:
            first, *steps = [json.loads(line) for line in lines]  # an outcome that is nan or infinite is one, too
            asked, types = first["asked"], {name: np.dtype(str(kind)) for name, kind in first["types"].items()}
            read = [{name: _typed(step[name], kind) for name, kind in types.items()} for step in (asked, *steps)]
            if any(x.shape != read[0][name].shape for step in read for name, x in step.items()):
                raise ValueError("its steps differ in size")
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise UserError(f"{self.path}: damaged: {error}; move it away to go on without these steps") from error
        return read[1:] or read

    def begin(self, asked: Mapping[str, np.ndarray]) -> None:
        """Says what the first step is asked to be, {name: array}, on disk before it is."""
        types = {name: x.dtype.name for name, x in asked.items()}
        self._write({"types": types, "asked": {name: x.tolist() for name, x in asked.items()}})
        os.fsync(self._file.fileno())

    def append(self, step: Mapping[str, np.ndarray]) -> None:
        """Adds a step with its outcome, {name: array}."""
        self._count += 1
        self._write({name: x.tolist() for name, x in step.items()})
        if self._count % self._every == 0:
            os.fsync(self._file.fileno())

    def __enter__(self) -> "Journal":
        """Opens the file before the robot moves: that takes longer than a step."""
        self._file = open(self.path, "w")
        sync(self.path.parent)
        return self

    def __exit__(self, *error: object) -> None:
        """Closes the file; it stays where it is."""
        self._file.close()

    def remove(self) -> None:
        """When the rollout is in the store."""
        self.path.unlink(missing_ok=True)

    def _write(self, line: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()


class Played(NamedTuple):
    """One stored episode of one seed.

    seed: its place among the seeds of the run. number: of the rollout. rows: [T, ...] on the host, the valid steps
    alone. command: [T, act_dim] what the policy asked for; None where it is what was sent. success:
    whether it ended well. world: its number in the pool. trace: [steps + 1, k], see `Env.trace`; of all steps,
    k = 0 where nothing was kept.
    """

    seed: int
    number: int
    rows: Transition
    command: np.ndarray | None
    success: bool
    world: int
    trace: np.ndarray


def home_of(folder: Path) -> Path | None:
    """The folder whose `real/` holds rollouts: `folder`, or its parent where that is `real/` itself; else None."""
    home = folder.parent if folder.name == _REAL else folder
    return home if any((home / _REAL).glob(f"{_ROLLOUT}*.npz")) else None


def played(home: Path) -> list[Played]:
    """The episodes in `<home>/real/`, all of the first seed first; raises UserError for what is no rollout of ours."""
    store = RealStore(home)
    stored = [store.rollout(number) for number in range(len(store))]
    for number, arrays in enumerate(stored):
        for name in _ROWS:
            (seeds, steps), wanted = arrays["valid"].shape, stored[0][name].shape
            here = [len(stored[0]["valid"]), steps, *wanted[2:]]
            if list(arrays[name].shape) != here:
                path = store.folder / f"{_ROLLOUT}{number:06d}.npz"
                raise UserError(f"{path}: {name} has shape {list(arrays[name].shape)}, here {here}; keep it apart")
    seeds = range(len(stored[0]["valid"]))
    return [_of_seed(arrays, seed, number) for seed in seeds for number, arrays in enumerate(stored)]


def _number_of(path: Path) -> int:
    """The number in the name of a stored rollout."""
    match = re.fullmatch(rf"{_ROLLOUT}([0-9]{{6,12}})\.npz", path.name)
    if match is None:
        raise UserError(f"{path}: is no name of a rollout, such as {_ROLLOUT}000000.npz; move it away or rename it")
    return int(match[1])


def _checked(path: Path, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a rollout with flags as bool and rows as float32, of which the valid ones are finite."""
    if missing := {*_ROWS, "valid", "success"} - set(arrays):
        raise UserError(f"{path}: lacks {min(missing)}; {_FIX}")
    valid = flags(path, "valid", arrays["valid"], (None, None), fix=_FIX)
    n, steps = valid.shape
    if not valid.size:
        raise UserError(f"{path}: has no step; {_FIX}")
    if (valid[:, 1:] & ~valid[:, :-1]).any():
        raise UserError(f"{path}: valid goes on after a step that is not valid, which ends an episode; {_FIX}")
    shapes = dict.fromkeys(("obs", "action", "next_obs", "command"), (n, steps, None))
    shapes |= {"reward": (n, steps), "discount": (n, steps), "trace": (n, steps + 1, None)}
    beside = {"total_reward": (n,), "score": (n,), "world": (n,), "late": (n, None), "time": (n, None)}
    # Which numbers count; of an episode that exploded those beside its rows may be anything.
    counts = {"trace": np.pad(valid, ((0, 0), (0, 1))), **dict.fromkeys(beside, np.zeros((), bool))}
    read = dict(arrays, valid=valid)
    for name in {"success", "exploded"} & set(arrays):
        read[name] = flags(path, name, arrays[name], (n,), fix=_FIX)
    for name, shape in {**shapes, **beside}.items():
        if name in arrays:
            values = numbers(path, name, arrays[name], shape, fix=_FIX, valid=counts.get(name, valid))
            read[name] = arrays[name] if name in counts else values
    for name, other in (("next_obs", "obs"), ("command", "action")):
        if name in read and read[name].shape != read[other].shape:
            raise UserError(f"{path}: {name} has {read[name].shape[2]} entries, {other} {read[other].shape[2]}; {_FIX}")
    if "world" in arrays and (arrays["world"].dtype.kind not in "iu" or (arrays["world"] < 0).any()):
        raise UserError(f"{path}: world is {arrays['world'].tolist()}, no numbers of worlds; {_FIX}")
    if ((discount := read["discount"][valid]) < 0).any() or (discount > 1).any():
        raise UserError(f"{path}: discount is not between 0 and 1; {_FIX}")
    return read


def _typed(value: Any, kind: np.dtype) -> np.ndarray:
    """What a line of a journal says, as it was; ValueError for what cannot have been written."""
    plain = np.asarray(value).dtype.kind
    if kind.kind not in "biuf" or plain not in "biuf" or (kind.kind == "b") != (plain == "b"):
        raise ValueError(f"{value!r:.40} is no {kind}")
    with np.errstate(over="ignore"):
        return np.array(value, kind)


def _of_seed(arrays: Mapping[str, np.ndarray], seed: int, number: int) -> Played:
    """The episode of one seed in a rollout of all."""
    valid = arrays["valid"][seed]
    rows = Transition(*cast(Any, (arrays[name][seed][valid] for name in _ROWS)))
    command = arrays["command"][seed][valid] if "command" in arrays else None
    world = int(arrays["world"][seed]) if "world" in arrays else 0
    trace = arrays["trace"][seed] if "trace" in arrays else np.zeros((len(valid) + 1, 0))
    return Played(seed, number, rows, command, bool(arrays["success"][seed]), world, trace)
