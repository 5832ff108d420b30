"""The point mass as a Gymnasium environment that counts its episodes and may break off: `toy_gymnasium:Turned-v0`."""

from typing import ClassVar

import gymnasium
import toy

from envs.adapters.gymnasium import TaskEnv
from envs.gaps import Gap

NAME = "gymnasium:toy_gymnasium:Turned-v0"
GAP = Gap("turned", {"mass": 2.0, "friction": 4.0}, {"action_rotation": 0.52})


class BrokenError(BaseException):
    """Stands for whatever ends a process in the middle of an episode."""


class Turned(gymnasium.Wrapper):
    """seeds: of all episodes since a test cleared the list. breaks: after how many more steps, None for never."""

    seeds: ClassVar[list[int]] = []  # all environments of a test share it
    breaks: int | None = None

    def __init__(self, rotation=None):
        gap = GAP if rotation is None else GAP._replace(effects={"action_rotation": rotation})
        super().__init__(TaskEnv(toy.make(), gap))

    def reset(self, *, seed=None, options=None):
        Turned.seeds.append(seed)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        if Turned.breaks is not None:
            Turned.breaks -= 1
            if Turned.breaks < 0:
                raise BrokenError
        return super().step(action)


gymnasium.register("Turned-v0", entry_point=Turned)
