"""Kill -9 at random moments: of the process that plays, of its learner, and of the robot's."""

import contextlib
import os
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from envs.types import UserError
from experiments.studies.reliable import quick_task
from experiments.studies.reliable.runs import Trial

_VICTIMS = ("player", "learner", "robot")
_EARLY = 0.2  # share of the kills that come while the processes start, within so many seconds:
_START, _PLAY = 8.0, 3.0  # and the others after the robot has begun to move


def run(home: Path, *, kills: int, seed: int, rollouts: int = 20) -> dict[str, Any]:
    """One run with so many kills; what became of it. The run grows until all kills are done."""
    luck = np.random.default_rng(seed)
    killed: Counter[str] = Counter()
    with Trial(home, period=quick_task.PERIOD, rollouts=rollouts, patience=300.0, task=quick_task.__file__) as trial:
        trial.start()
        while killed.total() < kills:
            killed.update(_strike(trial, luck))
        trial.finish()
    return {"rollouts": trial.rollouts, **{name: killed[name] for name in _VICTIMS}, **trial.audit()._asdict()}


def _strike(trial: Trial, luck: np.random.Generator) -> list[str]:
    """Waits, kills one of the three, and starts what has ended; returns whom it killed, nobody if there was nobody."""
    assert trial.player is not None and trial.robot is not None
    if luck.uniform() < _EARLY:
        trial.wait(luck.uniform(0.0, _START))
    elif trial.wait_for_motion():
        trial.wait(luck.uniform(0.0, _PLAY))
    if trial.player.poll() == 0:
        trial.rollouts += 10  # it was done before all kills were
        with contextlib.suppress(subprocess.TimeoutExpired):
            trial.robot.wait(10.0)  # it was told that the run is over, unless it had only just been started
            trial.start_robot()
        trial.start_player()
        return []
    victim = _VICTIMS[luck.integers(len(_VICTIMS))]
    pid = {"player": trial.player.pid, "learner": trial.learner(), "robot": trial.robot.pid}[victim]
    if pid is None or trial.player.poll() is not None:
        return []
    os.kill(pid, signal.SIGKILL)
    if victim == "robot":
        trial.robot.wait()
        time.sleep(luck.uniform(0.0, 1.0))
        trial.start_robot()
        return [victim]
    code = trial.wait(60.0)
    if (victim, code) == ("learner", 0):  # it had learned all it was asked for
        return [victim]
    if code != (-9 if victim == "player" else 2):
        raise UserError(f"{trial.home / 'player.txt'}: exit code {code} after a kill of the {victim}; see what it said")
    trial.start_player()
    return [victim]
