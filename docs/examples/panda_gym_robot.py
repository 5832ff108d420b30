"""The robot's side of a rehearsal: PandaPush of panda-gym, simulated by Bullet, behind the socket.

It needs Python 3.11 with panda-gym, msgpack and websockets, and `robot_client.py`: a copy beside this file, or that of
the repository. Nothing else of the project, and no JAX.

    python panda_gym_robot.py --url ws://127.0.0.1:8765 --token ...
"""

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

sys.path.append(str(Path(__file__).parents[2] / "sgft_jax" / "systems"))  # last: a module there is named gymnasium

import robot_client

importlib.import_module("panda_gym")  # registers its tasks

PICTURE = {"render_width": 480, "render_height": 360, "render_distance": 0.7, "render_yaw": 60, "render_pitch": -30}


class PandaPush:
    """A Franka arm pushes a cube to a mark; 25 steps a second.

    A measurement [21]: of the fingertip position (m) and velocity (m/s); of the cube position, rotation (Euler angles,
    rad), velocity and angular velocity (rad/s); the place of the mark (m). An action [3]: how far the fingertip should
    move, in units of 5 cm. panda-gym ends an episode as soon as the cube is within 5 cm of the mark, whatever its
    speed. This driver does not: the learner's task says how long an episode is, and asks where the cube lies at its
    end. It also says what a step is worth.

    film: numbers of the episodes, from 0, of which pictures are kept. into: the folder for them.
    """

    obs_size, action_size = 21, 3

    def __init__(self, film: tuple[int, ...] = (), into: Path = Path()) -> None:
        self.env: Any = gymnasium.make("PandaPush-v3", **PICTURE).unwrapped
        self.film, self.into = film, into
        self.number, self.pictures = -1, []

    def reset(self, seed: int) -> np.ndarray:
        """The arm at its start, cube and mark where the seed says."""
        self.number += 1
        observed = self.env.reset(seed=seed)[0]
        self._look()
        return measured(observed)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One step; whether the cube is within 5 cm of the mark is in the last of what is returned."""
        observed, _, _, _, info = self.env.step(action)
        self._look()
        return measured(observed), float("nan"), False, False, info

    def stop(self) -> None:
        """A simulation stands still by itself. The pictures of an episode that is over go to disk."""
        if self.pictures:
            self.into.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(self.into / f"episode-{self.number}.npz", pictures=np.stack(self.pictures))
            self.pictures = []

    def _look(self) -> None:
        if self.number in self.film:
            self.pictures.append(self.env.render())


def measured(observed: dict[str, np.ndarray]) -> np.ndarray:
    """[21]; where the cube is (`achieved_goal`) is among the 18 numbers of `observation`."""
    return np.concatenate([observed["observation"], observed["desired_goal"]])


def main() -> None:
    """Plays until the learner ends the run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--url", required=True, help="where the learner listens, ws://HOST:PORT")
    parser.add_argument("--token", required=True, help="what the file that the learner names holds")
    parser.add_argument("--film", type=int, nargs="*", default=(), help="numbers of the episodes to take pictures of")
    parser.add_argument("--into", type=Path, default=Path(), help="folder for the pictures")
    given = parser.parse_args()
    driver = PandaPush(tuple(given.film), given.into)
    try:
        print(robot_client.play(driver, given.url, token=given.token, name="panda-gym"))
    except robot_client.RefusedError as error:
        parser.exit(2, f"error: the learner refuses this robot: {error}\n")


if __name__ == "__main__":
    main()
