"""What becomes of a run on a simulated robot with a real-time clock when things go wrong around it.

kills: kill -9 at random moments of the process that plays, of its learner and of the robot's, then the run goes on.
network: a proxy that drops, delays and damages messages in both directions.
strangers: random and truncated frames, and connections with a wrong token, at the learner's port.
disk: a disk that is full, and one that cannot be written to (mounts small file systems; needs the right to do so).
clock: the control period at 5 Hz and at 200 Hz, with the learner busy on the same cores.

The robot writes down what it really does. `missing` of its steps are not in the store: at most one for each kill.
`alien` ones are in the store and were never made, or twice: there must be none.
"""

import contextlib
import os
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from envs.types import UserError
from experiments.runner import cli
from experiments.runner.options import at_least_one, each_once, seed_list
from experiments.studies.reliable.network import bad_network, strangers
from experiments.studies.reliable.trial import QUICK_PERIOD, QUICK_TASK, Trial, late_share, periods
from sgft_jax.io import runs
from sgft_jax.io.log import write_summary
from sgft_jax.io.runs import check_folder

_VICTIMS = ("player", "learner", "robot")
_EARLY = 0.2  # share of the kills that come while the processes start, within so many seconds:
_START, _PLAY = 8.0, 3.0  # and the others after the robot has begun to move
_QUICK = {"period": QUICK_PERIOD, "task": str(QUICK_TASK), "patience": 300.0}

type Part = Literal["kills", "network", "strangers", "disk", "clock"]


@dataclass(frozen=True)
class ReliabilityArgs:
    """Which kinds of failure to cause, and how often."""

    parts: tuple[Part, ...] = ("kills", "network", "strangers", "disk", "clock")
    """Kinds of failure; the head of this help explains them."""
    runs: int = 10
    """Runs with kills."""
    kills: int = 10
    """Kills in each of these runs."""
    rollouts: int = 10
    """Rollouts of the other runs."""
    seed: int = 0
    """Seed of all random choices."""
    out: Path = Path("runs")
    """The numbers go to <out>/reliability/summary.json, what the processes said beside it."""


def main(args: ReliabilityArgs) -> dict[str, list[dict[str, Any]]]:
    """Tries, prints a line for each run, writes the numbers and returns them by part."""
    at_least_one(args, "runs", "kills", "rollouts")
    seed_list(args.seed, args.runs)
    each_once(args, "parts")
    check_folder(args.out / "reliability")
    home, lines = (args.out / "reliability").resolve(), {part: [] for part in args.parts}
    for part in args.parts:
        for line in _tries(args, part, home / part):
            lines[part].append(line)
            print(f"{part}: " + ", ".join(f"{name} {_text(x)}" for name, x in line.items()), flush=True)
    print(f"numbers: {write_summary(home, {'provenance': runs.provenance(), **lines})}")
    return lines


def _tries(args: ReliabilityArgs, part: Part, home: Path) -> Iterator[dict[str, Any]]:
    """Causes one kind of failure; yields what became of each run."""
    match part:
        case "kills":
            for i in range(args.runs):
                yield {"run": i, **killed(home / f"run-{i}", kills=args.kills, seed=args.seed + i)}
        case "network":
            yield bad_network(home, seed=args.seed, rollouts=args.rollouts)
        case "strangers":
            yield strangers(home, seed=args.seed, rollouts=args.rollouts)
        case "disk":
            yield stopped_by_disk(home, "full", "size=1m", mended="size=64m", rollouts=20)
            yield stopped_by_disk(home, "read-only", "ro", mended="rw", rollouts=4)
        case "clock":
            wheels = {"task": "wheel-legged", "sizes": (4, 1)}  # numbers that it measures and commands
            yield kept_clock(home / "slow", period=0.2, rollouts=args.rollouts, utd=400)
            yield kept_clock(home / "fast", period=0.005, rollouts=args.rollouts, utd=2, **wheels)


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


# --- kills ------------------------------------------------------------------------------------------------------------


def killed(home: Path, *, kills: int, seed: int) -> dict[str, Any]:
    """One run with so many kills; what became of it. The run grows until all kills are done."""
    luck = np.random.default_rng(seed)
    victims: Counter[str] = Counter()
    with Trial(home, rollouts=20, **_QUICK) as trial:
        trial.start()
        while victims.total() < kills:
            victims.update(_strike(trial, luck))
        trial.finish()
    return {"rollouts": trial.rollouts, **{name: victims[name] for name in _VICTIMS}, **trial.audit()}


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


# --- disks ------------------------------------------------------------------------------------------------------------


def stopped_by_disk(home: Path, name: str, option: str, *, mended: str, rollouts: int) -> dict[str, Any]:
    """A run on a file system mounted with this option, which stops it; remounted with another, it goes on."""
    out = home / name
    out.mkdir(parents=True, exist_ok=True)
    with _mounted(out, option), Trial(home / f"{name}-run", rollouts=rollouts, disk=out, **_QUICK) as trial:
        if name == "full":
            trial.start_robot()
        trial.start_player()
        code, lines = trial.wait(), trial.player_lines()
        _call(["mount", "-o", f"remount,{mended}", str(out)])
        if trial.robot is None:
            trial.start_robot()
        trial.start_player()
        trial.finish()
        return {"disk": name, "exit code": code, "said": lines[-1] if lines else "", **trial.audit()}


@contextlib.contextmanager
def _mounted(folder: Path, option: str) -> Iterator[None]:
    _call(["mount", "-t", "tmpfs", "-o", option, "tmpfs", str(folder)])
    try:
        yield
    finally:
        _call(["umount", "-l", str(folder)])


def _call(command: list[str]) -> None:
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        message = (getattr(error, "stderr", None) or str(error)).strip()
        raise UserError(f"{' '.join(command)}: {message}; leave --parts disk out where you may not mount") from error


# --- the clock --------------------------------------------------------------------------------------------------------


def kept_clock(home: Path, *, period: float, rollouts: int, utd: float, **task: Any) -> dict[str, Any]:
    """A run with a learner on the same cores: lateness, and jitter of the period in ms.

    utd: updates for each step, enough to keep the learner busy for as long as the robot plays. task: another one, with
    its sizes, see `Trial`.
    """
    busy = ("--options.utd", str(utd), "--hand-over", "steps")
    with Trial(home, period=period, rollouts=rollouts, more=busy, **task) as trial:
        trial.start()
        trial.finish()
    log = home / "commands.log"
    off = 1e3 * np.abs(periods(log) - period)
    middle, most, worst = np.percentile(off, [50, 99, 100])
    jitter = {"median ms": middle, "99 % ms": most, "worst ms": worst}
    return {"Hz": 1 / period, "steps": len(off), **jitter, "late": late_share(log), **trial.audit()}


if __name__ == "__main__":
    cli.run_main(main, ReliabilityArgs, __doc__ or "")
