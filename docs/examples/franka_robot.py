"""The robot's side of `push` on a Franka arm: a driver to start from, which has not been run on an arm.

It needs franky (which plans the motion between commands), numpy, msgpack, websockets, a copy of `robot_client.py`
beside it, and a camera that sees the puck. Before the first rollout: a hand on the stop button.
"""

from typing import Any

import franky
import numpy as np
import robot_client

FRAME = np.array([0.2, 0.0])  # origin of the task's frame from the robot's base, m
STEP, HEIGHT, DOWN = 0.05, 0.03, [1.0, 0.0, 0.0, 0.0]  # m at an action of 1; of the fingertips, m; they point down
START = FRAME + np.array([0.15, 0.0])
LOW, HIGH = np.array([0.3, -0.35]), np.array([0.75, 0.35])  # the part of the table that is clear, from the base, m


class Push:
    """Hand and puck, xy in m of the task's frame, and steps of the hand."""

    obs_size, action_size = 4, 2

    def __init__(self, arm: Any, camera: Any) -> None:
        """camera.puck() -> x and y from the robot's base, m."""
        self.arm, self.camera = arm, camera

    def reset(self, seed: int) -> np.ndarray:
        """Puts the hand at its start and asks somebody for the puck."""
        self.arm.recover_from_errors()
        self._go(START)
        input("Put the puck before the hand, then press Enter. ")
        return self.read()

    def read(self) -> np.ndarray:
        """[4]: hand and puck."""
        return np.concatenate([self._hand() - FRAME, self.camera.puck() - FRAME])

    def send(self, action: np.ndarray) -> None:
        """Begins to move and does not wait."""
        self._go(self._hand() + STEP * action, asynchronous=True)

    def stop(self) -> None:
        """Ends the motion."""
        self.arm.move(franky.CartesianStopMotion(), asynchronous=True)

    def _hand(self) -> np.ndarray:
        return np.array(self.arm.current_cartesian_state.pose.end_effector_pose.translation)[:2]

    def _go(self, xy: np.ndarray, **options: Any) -> None:
        x, y = np.clip(xy, LOW, HIGH)
        self.arm.move(franky.CartesianMotion(franky.Affine([x, y, HEIGHT], DOWN)), **options)


def main(camera: Any, token: str) -> None:
    """Slowly, and with small commands, until you trust it."""
    arm = franky.Robot("172.16.0.2")
    arm.relative_dynamics_factor = 0.05
    robot_client.play(
        Push(arm, camera),
        "ws://127.0.0.1:8765",
        token=token,
        period=0.2,
        log="commands.msgpack",
        limits=robot_client.Limits(low=-0.2, high=0.2),
    )
