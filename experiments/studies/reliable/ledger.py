"""What a robot really did, and whether exactly that is in the store of a run."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sgft_jax.io.real import RealStore


class Made(NamedTuple):
    """A step of the robot. action, obs: the command in force and what was read at its end, as bytes of float32."""

    action: bytes
    obs: bytes
    clock: float


class Audit(NamedTuple):
    """executed, stored: steps. missing: executed, not stored. alien: stored, not executed then and there.

    unread: commands whose period no one saw the end of, because the robot's process died.
    """

    executed: int
    stored: int
    missing: int
    alien: int
    unread: int


def read(path: Path) -> tuple[list[Made], int]:
    """The steps of a ledger, oldest first, and how many commands have no outcome."""
    made, command, open_ = [], np.zeros(1, np.float32).tobytes(), False
    unread = 0
    for line in path.read_text().splitlines():
        what, clock, *values = line.split()
        numbers = np.array([float.fromhex(x) for x in values], np.float32).tobytes()
        if what == "sent":
            unread += open_
            command, open_ = numbers, True
        else:
            made.append(Made(command, numbers, float(clock)))
            open_ = False
    return made, unread + open_


def stored_steps(folder: Path) -> list[Made]:
    """The valid steps in a run folder, in order."""
    store = RealStore(folder, say=lambda line: None)
    return [step for i in range(len(store)) for step in _steps(store.load(i))]


def _steps(rollout: Mapping[str, Any]) -> list[Made]:
    rows = np.flatnonzero(rollout["valid"][0])
    columns = (rollout[name][0, rows] for name in ("action", "next_obs", "time"))
    return [Made(action.tobytes(), obs.tobytes(), float(t)) for action, obs, t in zip(*columns, strict=True)]


def audit(made: Sequence[Made], stored: Sequence[Made], unread: int = 0) -> Audit:
    """Both in order. A stored step must be one that was made, after the one stored before it."""
    at, alien = 0, 0
    place = {step.obs: i for i, step in enumerate(made)}  # sensors are noisy: no two are alike
    for step in stored:
        i = place.get(step.obs, -1)
        if i < at or made[i].action != step.action:
            alien += 1
        else:
            at = i + 1
    return Audit(len(made), len(stored), len(made) - (len(stored) - alien), alien, unread)
