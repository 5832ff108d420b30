"""The real side of fine-tuning: what a system is, and those that are simulations with other numbers."""

import functools
from collections.abc import Callable, Generator, Iterable
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import jax

from envs.base import EffectRange, Env, World
from envs.mesh import split_vmap
from envs.rollout import Episode, play_episode
from envs.types import Array, Key, PyTree

if TYPE_CHECKING:
    from sgft_jax.systems.gymnasium import Step

__all__ = ["Simulated", "System"]


@runtime_checkable
class System(Protocol):
    """A real system, or several that are played together; M members, each a seed on one of them.

    `Simulated` plays whole episodes in one compiled program. `Gymnasium` is stepped from Python, and so is a robot.
    """

    def play(self, policy: Any, states: PyTree, keys: Key, *, explore: bool) -> Episode:
        """Episodes [M, n, ...] of a policy.

        policy: has `init_carry()` and `act(state, carry, obs, key, *, explore)`, such as a `Finetuner` or a `Policy`.
        states: [M, ...] what `act` takes first. keys: [M, n], each decides one episode. explore: as in `act`.
        """
        ...


@runtime_checkable
class KnownSystem(System, Protocol):
    """A system as commands use it.

    env: the task, in the scene of the system. pools: worlds [G, W] of simulated systems, which can be drawn, and played
    again at no cost; None where every episode is a real one.
    """

    env: Env
    pools: World | None


@runtime_checkable
class SteppedSystem(KnownSystem, Protocol):
    """A system whose episodes can be kept step by step."""

    def steps(
        self, policy: Any, states: PyTree, keys: Key, *, explore: bool, asked: "Callable[[Step], None] | None" = None
    ) -> "Generator[Step]":
        """One episode of every member as it happens, see `Gymnasium.steps`."""
        ...

    def episode(self, steps: "Iterable[Step]") -> Episode:
        """The same as a whole."""
        ...


def drifted(system: System, rollouts: int) -> System:
    """A system as it is after so many rollouts: of simulated ones, sensors may drift; a real one needs no help."""
    return getattr(system, "after", lambda rollouts: system)(rollouts)


class Simulated:
    """Perturbed simulations: all members and episodes in one compiled program.

    env: what steps them. pools: worlds [G, W], a pool for each real system. which: [M], the system of each member.
    gamma: discount factor of the transitions. drift: [G, measured_dim] see `envs.gaps.drifts`.
    """

    def __init__(self, env: Env, pools: World, which: Array, *, gamma: float, drift: Array | None = None) -> None:
        self.env, self.pools, self.which, self.gamma, self.drift = env, pools, which, gamma, drift
        self._programs: dict[Callable[..., Any], Callable[..., Episode]] = {}

    def play(self, policy: Any, states: PyTree, keys: Key, *, explore: bool) -> Episode:
        """Episodes [M, n, ...], see `System`. A key gives the same world, start and noise to every policy."""
        return self.program(policy)(states, self.pools, self.which, keys, explore)

    def program(self, policy: Any) -> Any:
        """What plays (states, pools, which, keys, explore), jitted: exploring and evaluating share it."""
        if policy.act not in self._programs:
            self._programs[policy.act] = jax.jit(split_vmap(self._player(policy), (0, None, 0, 0, None)))
        return self._programs[policy.act]

    def moved(self, pools: World, which: Array) -> "Simulated":
        """Other systems of the same task, played by the programs that are compiled already."""
        other = Simulated(self.env, pools, which, gamma=self.gamma)
        other._programs = self._programs
        return other

    def after(self, rollouts: int) -> "Simulated":
        """The systems as they are after so many rollouts from here: their sensors may have drifted."""
        if self.drift is None:
            return self
        theta, further = self.pools.theta, rollouts * self.drift[:, None]
        ends = (end._replace(obs_bias=end.obs_bias + further) for end in theta.effects)
        return self.moved(self.pools._replace(theta=theta._replace(effects=EffectRange(*ends))), self.which)

    def _player(self, policy: Any) -> Callable[..., Episode]:
        def play(state: PyTree, pools: World, which: Array, keys: Key, explore: Array) -> Episode:
            act, carry = functools.partial(policy.act, state, explore=explore), policy.init_carry()
            return split_vmap(
                lambda key: play_episode(self.env, pools, act, carry, key, gamma=self.gamma, which=which)
            )(keys)

        return play
