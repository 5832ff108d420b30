"""Impure: panda-gym as the real system of `panda-push`: an environment of its own, and both sides as processes."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from envs.types import UserError
from experiments.runner import real_systems

TASK = "panda-push"
HOME = Path("build/panda-gym")  # where the environment is, or shall be made
PYTHON = os.environ.get("PYTHON311") or "python3.11"  # what makes it
DRIVER = Path("docs/examples/panda_gym_robot.py")  # in the folder of the code, as the priors are
PACKAGES = ("panda-gym==3.0.7", "pybullet==3.2.7", "gymnasium==1.4.0", "numpy==2.4.6", "msgpack==1.2.4")
PACKAGES += ("websockets==17.4",)
_END = 10.0  # seconds that a process has for its end


def check_driver() -> None:
    """Raises UserError where the driver is not, before anything is made."""
    if not DRIVER.exists():
        raise UserError(f"{DRIVER}: no such file; run this command in the folder of the code")


def bullet(home: Path, python: str) -> Path:
    """The Python of the environment with panda-gym in `home`, which is made where there is none.

    Raises UserError where there is no Python 3.11, or where its packages cannot be had.
    """
    bullet_python = home / "bin" / "python"
    if output(str(bullet_python), "import panda_gym, msgpack, websockets") is not None:
        return bullet_python
    if output(python, "import sys; sys.exit(sys.version_info[:2] != (3, 11))") is None:
        raise UserError(f"{python} is no Python 3.11, for which pybullet has wheels; name one with PYTHON311=...")
    print(f"making an environment for Bullet in {home}, once", flush=True)
    install = [str(bullet_python), "-m", "pip", "install", "-q", *PACKAGES]
    for command in ([python, "-m", "venv", "--clear", str(home)], install):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            last = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1]
            raise UserError(f"{' '.join(command[:4])} failed: {last}")
    return bullet_python


def output(python: str, code: str) -> str | None:
    """What Python prints for the code; None where it fails, or where there is no such Python."""
    try:
        done = subprocess.run([python, "-c", code], capture_output=True, text=True)
    except OSError:
        return None
    return None if done.returncode else done.stdout


def fine_tune(python: Path, out: Path, options: Sequence[object], *, log: Path, film: Sequence[object] = ()) -> None:
    """Runs learner and robot as a user would, until the learner is done.

    python: of the environment. out: parent of the run's folder. options: of `experiments.finetune`, beside task, robot
    and seeds. log: file for what the robot's side says. film: options of the driver. Raises UserError where one of the
    two fails; neither outlives this function.
    """
    port = real_systems.free_port()
    learner = [sys.executable, "-u", "-m", "experiments.finetune", "--task", TASK, "--real", f"remote::{port}"]
    learner += ["--seeds", "1", "--out", str(out), *map(str, options)]
    reach = ["--url", f"ws://127.0.0.1:{port}", "--token", real_systems.token(out)]
    together(learner, [str(python), "-u", str(DRIVER), *reach, *map(str, film)], log)


def together(learner: Sequence[str], robot: Sequence[str], log: Path) -> None:
    """Two processes, until the first one is done. log: file for what the second one says.

    Raises UserError where the first one fails, or the second one ends before it. Neither outlives this function.
    """
    with contextlib.ExitStack() as last:
        with open(log, "wb") as file:  # in a session of its own: Ctrl-C reaches the learner alone, which ends both
            other = subprocess.Popen(robot, stdout=file, stderr=subprocess.STDOUT, start_new_session=True)
        last.callback(_end, other)
        first = subprocess.Popen(learner)
        last.callback(_end, first)
        while first.poll() is None and other.poll() is None:
            time.sleep(0.1)
        if first.poll() is None and (other.returncode or not _ends(first)):
            first.kill()  # it would wait for another robot
            raise UserError(f"the robot's side has ended with exit code {other.returncode}; see {log}")
        if first.returncode:
            raise UserError(f"fine-tuning has ended with exit code {first.returncode}; it said why above")


def _ends(process: "subprocess.Popen[bytes]") -> bool:
    """Whether a process ends by itself in the time that it has for that."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_END)
    return process.poll() is not None


def _end(process: "subprocess.Popen[bytes]") -> None:
    """Ends a process that does not end by itself."""
    if not _ends(process):
        process.kill()
        process.wait()
