"""The robot's side of a rehearsal: the hammer of Meta-World behind the socket.

It needs Python 3.11 with metaworld 3, msgpack and websockets, and `robot_client.py`: a copy beside this file, or that
of the repository. Nothing else of the project, and no JAX.

    python metaworld_robot.py --url ws://127.0.0.1:8765 --token ...
"""

import argparse
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import metaworld
import numpy as np

sys.path.append(str(Path(__file__).parents[2] / "sgft_jax" / "systems"))  # last: a module there is named gymnasium

import robot_client

FRAME = 0.0125  # s of one step of Meta-World
FRAMES = 2  # of them in an action
SETTLE = 40  # frames before an episode: Meta-World starts with the hammer's head in the table, which throws it up
NAIL_Y, DRIVEN = 0.64, 0.09  # m: where the nail's head starts, and how far it has to go
PICTURE = {"render_mode": "rgb_array", "camera_name": "corner", "width": 480, "height": 360}


class Hammer:
    """A Sawyer arm takes a hammer and drives a nail into a block; 40 actions a second.

    A measurement [26]: of the hand its position (m), where it was last sent (m) and velocity (m/s); how far the fingers
    are apart (m) and how fast that changes (m/s); of the hammer the position (m), rotation (quaternion w, x, y, z,
    w not negative), velocity (m/s) and angular velocity (rad/s); how deep the nail is (m) and how fast it moves (m/s).
    Meta-World tells no rates: they follow from the last three frames. The arm lags by some centimetres behind where it
    was sent, so without that place a measurement would not tell what happens next. An action [4]: how far to move that
    place, in units of 2 cm, and the effort that closes (1) or opens (-1) the fingers. The learner's task says what a
    step is worth.

    film: numbers of the episodes, from 0, of which pictures are kept. into: the folder for them.
    """

    obs_size, action_size = 26, 4

    def __init__(self, film: tuple[int, ...] = (), into: Path = Path()) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what Gymnasium thinks of Meta-World's spaces
            made = gymnasium.make("Meta-World/MT1", env_name="hammer-v3", **(PICTURE if film else {}))
        self.env: Any = made.unwrapped
        self.env.set_task(metaworld.MT1("hammer-v3", seed=0).train_tasks[0])  # it plays none without a task
        self.env.seeded_rand_vec, self.env._freeze_rand_vec = True, False  # starts from the seed, not the task
        self.film, self.into = film, into
        self.number, self.pictures = -1, []

    def reset(self, seed: int) -> np.ndarray:
        """The hand at its start and open, the hammer at rest where the seed says."""
        self.number += 1
        self.env.seed(seed)
        self.env.reset()
        measurement = self._frames(np.array([0.0, 0.0, 0.0, -1.0]), SETTLE)
        self._look()
        return measurement

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One step; whether the nail is driven in is in the last of what is returned."""
        measurement = self._frames(np.clip(action, -1.0, 1.0).astype(np.float64), FRAMES)
        self._look()
        return measurement, float("nan"), False, False, {"is_success": bool(measurement[24] > DRIVEN)}

    def stop(self) -> None:
        """A simulation stands still by itself. The pictures of an episode that is over go to disk."""
        if self.pictures:
            self.into.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(self.into / f"episode-{self.number}.npz", pictures=np.stack(self.pictures))
            self.pictures = []

    def _frames(self, action: np.ndarray, count: int) -> np.ndarray:
        for _ in range(count - 1):
            before = self.env.step(action)[0]
        now = self.env.step(action)[0][:18]
        return measured(before[18:36], before[:18], now, self.env.data.mocap_pos[0])

    def _look(self) -> None:
        if self.number in self.film:
            self.pictures.append(self.env.render()[::-1, ::-1])  # this camera of Meta-World is upside down


def measured(first: np.ndarray, second: np.ndarray, now: np.ndarray, sent: np.ndarray) -> np.ndarray:
    """[26] of Meta-World's last three frames [18] each, and of where the hand was sent [3].

    The difference of two frames is a rate in their middle, half a frame ago. Two such differences tell the rate now.
    """
    rate = 1.5 * rates(second, now) - 0.5 * rates(first, second)
    turn = now[7:11] * (1.0 if now[7] >= 0 else -1.0)
    hand, hammer = (now[:3], sent, rate[:3], 0.1 * now[3:4], 0.1 * rate[3:4]), (now[4:7], turn, rate[4:10])
    return np.concatenate([*hand, *hammer, [now[12] - NAIL_Y], rate[10:]])


def rates(before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """[11] per s, between two frames: hand and fingers [4], the hammer's place [3] and rotation [3], the nail."""
    difference = now - before
    turn = 2 * product(now[7:11], before[7:11] * [1, -1, -1, -1])
    return np.concatenate([difference[:7], turn[1:] * (1.0 if turn[0] >= 0 else -1.0), difference[12:13]]) / FRAME


def product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[4] of two quaternions [4] w, x, y, z."""
    scalar = one[0] * other[0] - one[1:] @ other[1:]
    return np.append(scalar, one[0] * other[1:] + other[0] * one[1:] + np.cross(one[1:], other[1:]))


def main() -> None:
    """Plays until the learner ends the run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--url", required=True, help="where the learner listens, ws://HOST:PORT")
    parser.add_argument("--token", required=True, help="what the file that the learner names holds")
    parser.add_argument("--film", type=int, nargs="*", default=(), help="numbers of the episodes to take pictures of")
    parser.add_argument("--into", type=Path, default=Path(), help="folder for the pictures")
    given = parser.parse_args()
    driver = Hammer(tuple(given.film), given.into)
    try:
        print(robot_client.play(driver, given.url, token=given.token, name="meta-world"))
    except robot_client.RefusedError as error:
        parser.exit(2, f"error: the learner refuses this robot: {error}\n")


if __name__ == "__main__":
    main()
