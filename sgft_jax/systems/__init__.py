"""The real side of fine-tuning: what plays episodes, in simulation or on hardware."""

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from envs.types import Key, PyTree

if TYPE_CHECKING:
    from envs.rollout import Episode

__all__ = ["System"]


@runtime_checkable
class System(Protocol):
    """A real system, or several that are played together; M members, each a seed on one of them.

    `Simulated` plays whole episodes in one compiled program. `Gymnasium` is stepped from Python, and so is a robot.
    """

    def play(self, policy: Any, states: PyTree, keys: Key, *, explore: bool) -> "Episode":
        """Episodes [M, n, ...] of a policy.

        policy: has `init_carry()` and `act(state, carry, obs, key, *, explore)`, such as a `Finetuner` or a `Policy`.
        states: [M, ...] what `act` takes first. keys: [M, n], each decides one episode. explore: as in `act`.
        """
        ...
