"""The real side of fine-tuning: what plays episodes, in simulation or on hardware."""

from collections.abc import Callable, Generator, Iterable
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from envs.types import Key, PyTree

if TYPE_CHECKING:
    from envs.base import Env, World
    from envs.rollout import Episode
    from sgft_jax.systems.gymnasium import Step

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


@runtime_checkable
class Known(System, Protocol):
    """A system as commands use it.

    env: the task, in the scene of the system. pools: worlds [G, W] of simulated systems, which can be drawn, and played
    again at no cost; None where every episode is a real one.
    """

    env: "Env"
    pools: "World | None"


@runtime_checkable
class Stepped(Known, Protocol):
    """A system whose episodes can be kept step by step."""

    def steps(
        self, policy: Any, states: PyTree, keys: Key, *, explore: bool, asked: "Callable[[Step], None] | None" = None
    ) -> "Generator[Step]":
        """One episode of every member as it happens, see `Gymnasium.steps`."""
        ...

    def episode(self, steps: "Iterable[Step]") -> "Episode":
        """The same as a whole."""
        ...
