"""Real systems that are simulations with other numbers: all members and episodes in one compiled program."""

from collections.abc import Callable
from typing import Any

import jax

from envs.base import Env, World
from envs.mesh import split_vmap
from envs.rollout import Episode, play_episode
from envs.types import Array, Key, PyTree

__all__ = ["Simulated"]


class Simulated:
    """Perturbed simulations.

    env: what steps them. pools: worlds [G, W], a pool for each real system. which: [M], the system of each member.
    gamma: discount factor of the transitions.
    """

    def __init__(self, env: Env, pools: World, which: Array, *, gamma: float) -> None:
        self.env, self.pools, self.which, self.gamma = env, pools, which, gamma
        self._programs: dict[Callable[..., Any], Callable[..., Episode]] = {}

    def play(self, policy: Any, states: PyTree, keys: Key, *, explore: bool) -> Episode:
        """Episodes [M, n, ...], see `System`. A key gives the same world, start and noise to every policy."""
        if policy.act not in self._programs:  # exploring and evaluating share it: compiling physics takes long
            self._programs[policy.act] = jax.jit(split_vmap(self._player(policy), (0, None, 0, 0, None)))
        return self._programs[policy.act](states, self.pools, self.which, keys, explore)

    def moved(self, pools: World, which: Array) -> "Simulated":
        """Other systems of the same task, played by the programs that are compiled already."""
        other = Simulated(self.env, pools, which, gamma=self.gamma)
        other._programs = self._programs
        return other

    def _player(self, policy: Any) -> Callable[..., Episode]:
        def play(state: PyTree, pools: World, which: Array, keys: Key, explore: Array) -> Episode:
            def act(carry: PyTree, obs: Array, key: Key) -> tuple[Array, PyTree]:
                return policy.act(state, carry, obs, key, explore=explore)

            def episode(key: Key) -> Episode:
                return play_episode(self.env, pools, act, policy.init_carry(), key, gamma=self.gamma, which=which)

            return split_vmap(episode)(keys)

        return play
