"""Impure: the three processes of a run on the simulated robot: the one that plays, its learner, and the robot."""

import shutil
import subprocess
import sys
import time
from pathlib import Path

from envs import extend
from envs.types import UserError
from experiments.runner.real_systems import free_port, token
from experiments.studies.reliable import ledger

TASK = Path(__file__).parents[3] / "docs/examples/own_task.py"
_OPTIONS = """--method sac --prior none --seeds 1 --checkpoint-every 3 --options.initial-rollouts 1 --options.utd 1
    --options.batch-size 32 --options.critic-warmup 0 --options.replay-capacity 2048"""


class Trial:
    """One run in a folder of its own; what still runs ends with the `with` block.

    period: of the robot's clock, in seconds. rollouts: of the run. patience: seconds for it. out: parent of the run's
    folder, default in `home`. task: with numbers measured and commanded. more: options.
    """

    def __init__(
        self,
        home: Path,
        *,
        period: float,
        rollouts: int,
        patience: float = 600.0,
        out: Path | None = None,
        task: str = str(TASK),
        sizes: tuple[int, int] = (3, 1),
        more: tuple[str, ...] = (),
    ) -> None:
        self.patience = patience
        shutil.rmtree(home, ignore_errors=True)
        home.mkdir(parents=True)
        self.home, self.period, self.rollouts, self.out = home, period, rollouts, out or home / "runs"
        self.task, self.sizes, self.more = task, sizes, more
        self.port = self.via = free_port()  # via: that the robot connects to, if something stands in between
        self.player: subprocess.Popen[str] | None = None
        self.robot: subprocess.Popen[str] | None = None

    def __enter__(self) -> "Trial":
        return self

    def __exit__(self, *error: object) -> None:
        for process in (self.player, self.robot):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait()

    @property
    def folder(self) -> Path:
        """Of the run."""
        return self.out / "finetune" / extend.name_of(self.task) / "remote/sac/seed-0"

    def start(self) -> None:
        """The robot, and the command of a user."""
        self.start_robot()
        self.start_player()

    def start_robot(self) -> None:
        """The robot's process; it waits for the learner."""
        words = [f"ws://127.0.0.1:{self.via}", token(self.out), self.period, self.home, *self.sizes]
        command = ["experiments.studies.reliable.robot", *map(str, words)]
        self.robot = self._run(command, "robot.txt")

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

    def audit(self) -> ledger.Audit:
        """What the robot has done, against what is stored."""
        made, unread = ledger.read(self.home / "ledger.txt")
        return ledger.audit(made, ledger.stored_steps(self.folder), unread)

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

    def said(self, name: str) -> str:
        """What `player.txt` or `robot.txt` holds."""
        path = self.home / name
        return path.read_text() if path.exists() else ""

    def _run(self, command: list[str], log: str) -> "subprocess.Popen[str]":
        with open(self.home / log, "a") as file:
            streams = {"stdout": file, "stderr": subprocess.STDOUT, "text": True}
            return subprocess.Popen([sys.executable, "-m", *command], cwd=TASK.parents[2], **streams)
