"""Every task as a Gymnasium environment: one at a time, or many in one compiled program.

Importing this module registers them, `sgft_jax/Push-v0` and so on. Gymnasium looks for no entry points of packages; the
import is its own way, also inside a name: `gymnasium.make("envs.adapters.gymnasium:sgft_jax/Push-v0")`.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

import envs
from envs import gaps
from envs.base import Env, EnvState, World
from envs.gaps import SIM, Gap
from envs.rollout import begin_episode, episode_keys, real_env, real_worlds, select
from envs.types import Array, Key

NAMESPACE, VERSION = "sgft_jax", 0
_SEEDS = 2**31  # episodes after a seeded one draw theirs from below this


class _Episode(NamedTuple):
    """One that is going on. keys: [T], the environment's of each step."""

    world: World
    state: EnvState
    keys: Key


class _Played:
    """A task on one real system, as functions of one environment: `begin(seed)` and `step(episode, action)`.

    Arguments: see `TaskEnv`.
    """

    def __init__(self, task: str | Env, gap: str | Gap, impl: str, worlds: int) -> None:
        env = envs.make(task, impl) if isinstance(task, str) else task
        real_gap = gaps.load(env, gap) if isinstance(gap, str) else gap
        self.env = real_env(env, [real_gap])
        self.pool = jax.tree.map(lambda x: x[0], real_worlds(self.env, [real_gap], jax.random.key(0), worlds))
        self.observation = spaces.Box(-np.inf, np.inf, (self.env.obs_dim,), np.float32)
        self.action = spaces.Box(-1.0, 1.0, (self.env.act_dim,), np.float32)

    def begin(self, seed: Array) -> _Episode:
        """The episode of a seed [] uint32, the one that `play_episode` plays with `jax.random.key(seed)`."""
        key_world, key_reset, keys = episode_keys(jax.random.key(seed), self.env.episode_length)
        _, world, state = begin_episode(self.env, self.pool, key_world, key_reset)
        return _Episode(world, state, keys[:, 1])

    def step(self, episode: _Episode, action: Array) -> tuple[_Episode, EnvState]:
        """One control step, and the state as users see it.

        Exploded physics ends an episode by truncation, with the last observation before it and no reward.
        """
        before = episode.state
        state = self.env.step(episode.world, before, action, episode.keys[before.time])
        valid = ~state.invalid
        seen = state._replace(
            physics=None,
            obs=jnp.where(valid, state.obs, before.obs),
            reward=jnp.where(valid, state.reward, jnp.zeros_like(state.reward)),
            terminated=state.terminated & valid,
            truncated=state.truncated | state.invalid,
            success=state.success & valid,
        )
        return episode._replace(state=state), seen

    def info(self, after: EnvState) -> dict[str, Any]:
        """What `info` says of steps; success only where the task has it."""
        known = {"invalid": np.asarray(after.invalid)}
        if self.env.score == "success" or self.env.success is not None:
            known["is_success"] = np.asarray(after.success)
        return known


class TaskEnv(gymnasium.Env):
    """A task of this project, or one of your own, for anything that trains on Gymnasium environments.

    Observations are those of the task, [measured_dim] float32 in raw units, sensor noise included; actions are
    [act_dim] in [-1, 1]. `info` has `is_success`, where the task has a success, and `invalid`: physics exploded.

    task: by name, file or module, or an `Env`. gap: the real system, by name or file ("file.toml:name" for one of
    several), or a `Gap`; "sim" is the training domain, a new world in every episode. impl: the physics engine. worlds:
    how many are compiled where they differ. The episode of a seed is the one of `envs.play_episode` with that key.
    Raises UserError for a task or gap that does not exist.
    """

    metadata: ClassVar = {"render_modes": []}

    def __init__(self, task: str | Env, gap: str | Gap = SIM, *, impl: str = "auto", worlds: int = 256) -> None:
        self._played = _Played(task, gap, impl, worlds)
        self.observation_space, self.action_space = self._played.observation, self._played.action
        self._begin, self._step = jax.jit(self._played.begin), jax.jit(self._played.step)
        self._episode: _Episode | None = None

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A fresh start; without a seed the next one that the last seed leads to."""
        super().reset(seed=seed)
        self._episode = start = self._begin(_seed(seed, self.np_random))
        return np.array(start.state.obs), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step; action: [act_dim] in [-1, 1]."""
        assert self._episode is not None, "call reset first"
        self._episode, after = self._step(self._episode, jnp.asarray(action, jnp.float32))
        after = jax.device_get(after)
        info = {name: bool(x) for name, x in self._played.info(after).items()}
        return np.array(after.obs), float(after.reward), bool(after.terminated), bool(after.truncated), info


class TaskVectorEnv(VectorEnv):
    """`num_envs` of the environments of `TaskEnv`, stepped by one compiled program.

    Environment i with seed s plays the episodes of a `TaskEnv` with seed s. An episode that is over begins anew with
    the next step, whose action is ignored and whose reward is 0 (`AutoresetMode.NEXT_STEP`). Arguments: see `TaskEnv`.
    """

    metadata: ClassVar = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self, task: str | Env, gap: str | Gap = SIM, *, num_envs: int = 1, impl: str = "auto", worlds: int = 256
    ) -> None:
        self._played = played = _Played(task, gap, impl, worlds)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = played.observation, played.action
        self.observation_space = batch_space(played.observation, num_envs)
        self.action_space = batch_space(played.action, num_envs)
        self._begin, self._step = jax.jit(jax.vmap(played.begin)), jax.jit(jax.vmap(played.step))
        self._restart = jax.jit(select)
        self._generators = [seeding.np_random()[0] for _ in range(num_envs)]
        self._over = np.zeros(num_envs, bool)
        self._episodes: _Episode | None = None

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Fresh starts everywhere; seed: of each environment, or an int for seed, seed + 1, and so on."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed or [None] * self.num_envs
        for i, chosen in enumerate(seeds):
            if chosen is not None:
                self._generators[i] = seeding.np_random(chosen)[0]
        first = [_seed(chosen, generator) for chosen, generator in zip(seeds, self._generators, strict=True)]
        self._episodes = start = self._begin(np.stack(first))
        self._over = np.zeros(self.num_envs, bool)
        return np.array(start.state.obs), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step everywhere; actions: [num_envs, act_dim] in [-1, 1]."""
        assert self._episodes is not None, "call reset first"
        over, fresh = self._over, self._episodes
        if over.any():
            drawn = [_next(g) if ended else np.uint32(0) for ended, g in zip(over, self._generators, strict=True)]
            fresh = self._begin(np.stack(drawn))
        stepped, after = self._step(self._episodes, jnp.asarray(actions, jnp.float32))
        self._episodes = self._restart(over, fresh, stepped) if over.any() else stepped
        obs = np.where(over[:, None], fresh.state.obs, after.obs)
        reward = np.where(over, 0.0, after.reward)
        terminated, truncated = (np.asarray(x) & ~over for x in (after.terminated, after.truncated))
        self._over = terminated | truncated
        info = self._played.info(after)
        return obs, reward, terminated, truncated, info | {f"_{name}": ~over for name in info}


def _seed(seed: int | None, generator: np.random.Generator) -> np.uint32:
    """Of the next episode: the one given, or the generator's next one."""
    return _next(generator) if seed is None else np.uint32(seed % 2**32)


def _next(generator: np.random.Generator) -> np.uint32:
    return np.uint32(generator.integers(_SEEDS))


def name_of(task: str) -> str:
    """What Gymnasium calls a task: `sgft_jax/PushBall-v0` for push-ball."""
    return f"{NAMESPACE}/{''.join(word.capitalize() for word in task.split('-'))}-v{VERSION}"


def register() -> None:
    """Makes all tasks known to `gymnasium.make` and `gymnasium.make_vec`."""
    one, many = (f"{__name__}:{cls.__name__}" for cls in (TaskEnv, TaskVectorEnv))
    for task in envs.TASKS:
        gymnasium.register(name_of(task), entry_point=one, vector_entry_point=many, kwargs={"task": task})


register()
