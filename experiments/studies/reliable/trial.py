"""Impure: a run on the simulated robot in three processes (the one that plays, its learner, the robot), and whether
exactly what the robot did is in the store of the run.
"""

import itertools
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import numpy as np

from envs import extend
from envs.types import UserError
from experiments.runner.real_systems import free_port, token
from sgft_jax.io.real import RealStore

TASK = Path(__file__).parents[3] / "docs/examples/own_task.py"
QUICK_TASK, QUICK_PERIOD = Path(__file__).with_name("quick_task.py"), 0.05  # s
_OPTIONS = """--method sac --prior none --seeds 1 --checkpoint-every 3 --options.initial-rollouts 1 --options.utd 1
    --options.batch-size 32 --options.critic-warmup 0 --options.replay-capacity 2048"""


@dataclass
class Trial:
    """One run in a folder of its own; what still runs ends with the `with` block.

    period: of the robot's clock, in seconds. rollouts: of the run. patience: seconds for it. disk: parent of the run's
    folder, default in `home`. task: with numbers measured and commanded. more: options.
    """

    home: Path
    _: KW_ONLY
    period: float
    rollouts: int
    patience: float = 600.0
    disk: Path | None = None
    task: str = str(TASK)
    sizes: tuple[int, int] = (3, 1)
    more: tuple[str, ...] = ()
    player: "subprocess.Popen[str] | None" = field(default=None, init=False)
    robot: "subprocess.Popen[str] | None" = field(default=None, init=False)

    def __post_init__(self) -> None:
        """An empty folder and a free port."""
        shutil.rmtree(self.home, ignore_errors=True)
        self.home.mkdir(parents=True)
        self.out = self.disk or self.home / "runs"
        self.folder = self.out / "finetune" / extend.name_of(self.task) / "remote/sac/seed-0"  # of the run
        self.port = self.via = free_port()  # via: that the robot connects to, if something stands in between

    def __enter__(self) -> "Trial":
        return self

    def __exit__(self, *error: object) -> None:
        for process in (self.player, self.robot):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait()

    def start(self) -> None:
        """The robot, and the command of a user."""
        self.start_robot()
        self.start_player()

    def start_robot(self) -> None:
        """The robot's process; it waits for the learner."""
        words = [f"ws://127.0.0.1:{self.via}", token(self.out), self.period, self.home, *self.sizes]
        self.robot = self._run(["experiments.studies.reliable.robot", *map(str, words)], "robot.txt")

    def start_player(self) -> None:
        """The command of a user; it goes on if there is something to go on with."""
        options = ["--task", self.task, "--real", f"remote::{self.port}", "--rollouts", str(self.rollouts)]
        options += ["--out", str(self.out), *self.more, *(["--resume"] if self.folder.exists() else [])]
        self.player = self._run(["experiments.finetune", *_OPTIONS.split(), *options], "player.txt")

    def learner(self) -> int | None:
        """The process id of the learner's process, None while there is none."""
        assert self.player is not None
        children = Path(f"/proc/{self.player.pid}/task/{self.player.pid}/children")
        for child in children.read_text().split() if children.exists() else []:
            if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text():
                return int(child)
        return None

    def finish(self) -> None:
        """Waits for the end of the run; raises UserError where it does not come, or is none."""
        if (code := self.wait()) != 0:
            log = self.home / "player.txt"
            raise UserError(f"{log}: the run has not ended well (exit code {code}); see what it said")

    def audit(self) -> dict[str, int]:
        """What the robot has done, against what is stored, as `Audit` has it."""
        made, unread = read_ledger(self.home / "ledger.txt")
        return audit(made, stored_steps(self.folder), unread)._asdict()

    def wait(self, seconds: float | None = None) -> int | None:
        """The exit code of the player if it ends by then, or before the patience ends."""
        assert self.player is not None
        end = time.monotonic() + (self.patience if seconds is None else seconds)
        while time.monotonic() < end and self.player.poll() is None:
            time.sleep(0.02)
        return self.player.poll()

    def wait_for_motion(self) -> bool:
        """Whether the robot moves before the player ends."""
        path, end = self.home / "ledger.txt", time.monotonic() + self.patience
        size = before = path.stat().st_size if path.exists() else 0
        while size == before and time.monotonic() < end and self.wait(0.02) is None:
            size = path.stat().st_size if path.exists() else 0
        return size > before

    def player_lines(self) -> list[str]:
        """What the player has said."""
        path = self.home / "player.txt"
        return path.read_text().strip().splitlines() if path.exists() else []

    def _run(self, command: list[str], log: str) -> "subprocess.Popen[str]":
        with open(self.home / log, "a") as file:
            streams = {"stdout": file, "stderr": subprocess.STDOUT, "text": True}
            return subprocess.Popen([sys.executable, "-m", *command], cwd=TASK.parents[2], **streams)


# --- what the robot did, and what is stored ---------------------------------------------------------------------------


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


def read_ledger(path: Path) -> tuple[list[Made], int]:
    """The steps of a robot's ledger, oldest first, and how many commands have no outcome."""
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
    store, steps = RealStore(folder, say=lambda line: None), []
    for rollout in map(store.load, range(len(store))):
        valid = np.flatnonzero(rollout["valid"][0])
        columns = (rollout[name][0, valid] for name in ("action", "next_obs", "time"))
        steps += [Made(action.tobytes(), obs.tobytes(), float(t)) for action, obs, t in zip(*columns, strict=True)]
    return steps


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


# --- how its clock was kept -------------------------------------------------------------------------------------------


def commands(log: Path) -> Iterator[dict[str, Any]]:
    """What the robot's client has written down before it sent it."""
    with open(log, "rb") as file:
        yield from msgpack.Unpacker(file)


def late_share(log: Path) -> float:
    """The share of steps for which no command came in time."""
    return float(np.mean([command["late"] for command in commands(log)]))


def periods(log: Path) -> np.ndarray:
    """Seconds between the commands of every two steps that follow each other in an episode."""
    pairs = itertools.pairwise(commands(log))
    follow = [(a, b) for a, b in pairs if b["episode"] == a["episode"] and b["step"] == a["step"] + 1]
    return np.array([b["clock"] - a["clock"] for a, b in follow])
