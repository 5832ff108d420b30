"""A simulated robot with a real-time clock, in a process of its own; writes down what it really does.

The robot of `docs/examples/own_task.py`: a pusher slides a puck along a rail, but its motor lags and is weak. It needs
numpy and the robot's client alone, so it is up again in a moment after a kill.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np

from sgft_jax.systems import robot_client

STEP, LOW, HIGH = 0.08, -0.2, 0.5  # m per command of 1; where the pusher may be
LAG, SLIDE, CONTACT = 0.6, 0.5, 0.04  # share of the way made in a period; speed that is left; distance of the centres
NOISE = 1e-3  # m, of every sensor: no two steps are alike


class Rail:
    """The driver. Everything that it does is in `ledger` at once: `sent` before a command, `read` after its outcome.

    sizes: numbers measured and commanded; those beyond three and one are noise and do nothing.
    """

    def __init__(self, ledger: Path, sizes: tuple[int, int]) -> None:
        self.obs_size, self.action_size = sizes
        self._ledger = os.open(ledger, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        self._luck = np.random.default_rng()
        self._command = np.zeros(1)
        self.pusher, self.puck, self.speed = -0.15, 0.0, 0.0

    def reset(self, seed: int) -> np.ndarray:
        """The pusher behind the puck."""
        self.pusher, self.puck, self.speed = -0.15, float(np.random.default_rng(seed).uniform(-0.05, 0.1)), 0.0
        self._command = np.zeros(1)
        return self._sense()

    def send(self, action: np.ndarray) -> None:
        """A command, in force until the next one."""
        self._write("sent", action)
        self._command = np.array(action, np.float64)

    def read(self) -> np.ndarray:
        """One period later."""
        target = np.clip(self.pusher + STEP * self._command[0], LOW, HIGH)
        before, self.pusher = self.pusher, self.pusher + LAG * (target - self.pusher)
        self.speed *= SLIDE
        if self.pusher > self.puck - CONTACT:
            self.speed = max(self.pusher - before, 0.0)
            self.puck = self.pusher + CONTACT
        self.puck += self.speed
        obs = self._sense()
        self._write("read", obs)
        return obs

    def stop(self) -> None:
        """It stays where it is."""
        self._command = np.zeros(1)

    def _sense(self) -> np.ndarray:
        seen = NOISE * self._luck.standard_normal(self.obs_size)
        seen[:3] += [self.pusher, self.puck, self.speed]
        return seen.astype(np.float32)

    def _write(self, what: str, numbers: np.ndarray) -> None:
        values = " ".join(float(x).hex() for x in np.asarray(numbers, np.float32))
        os.write(self._ledger, f"{what} {time.monotonic():.6f} {values}\n".encode())


def main() -> None:
    """The command line: where the learner is, its token, the period in seconds, a folder, and two sizes."""
    url, token, period, folder, measured, commanded = sys.argv[1:]
    rail, log = Rail(Path(folder) / "ledger.txt", (int(measured), int(commanded))), Path(folder) / "commands.log"
    robot_client.play(rail, url, token=token, period=float(period), log=log, retry=0.1)


if __name__ == "__main__":
    main()
