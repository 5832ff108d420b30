"""A real system of your own that no gap expresses: pushing with worn gears. `--real gymnasium:MODULE:WornPush-v0`."""

from typing import Any

import gymnasium
import numpy as np

from envs.adapters.gymnasium import TaskEnv


class WornPush(gymnasium.ActionWrapper):
    """Gears with play: a command that turns back moves nothing until it has crossed the slack."""

    def __init__(self, slack: float = 0.2) -> None:
        super().__init__(TaskEnv("push"))
        self.slack, self.at = slack, np.zeros(2, np.float32)

    def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """The gears begin in the middle of their play."""
        self.at = np.zeros(2, np.float32)
        return self.env.reset(**options)

    def action(self, action: np.ndarray) -> np.ndarray:
        """What the arm gets of a command."""
        self.at = np.clip(self.at, action - self.slack, action + self.slack)
        return self.at


gymnasium.register("WornPush-v0", entry_point=WornPush)
