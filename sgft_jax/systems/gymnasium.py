"""Impure: real systems that are Gymnasium environments, stepped from Python."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Entry, Env
from envs.history import remember, with_memory
from envs.rollout import Episode, episode_keys
from sgft_jax.mesh import split_vmap
from sgft_jax.types import Array, Key, PyTree, Transition, UserError

if TYPE_CHECKING:
    import gymnasium

SUCCESS = ("is_success", "success")  # what `info` may call it; the first that is there counts
Observe = Callable[[Any], Any]


class Gymnasium:
    """Gymnasium environments as the real systems of a task, one for each member; all take a step together.

    The environment moves, rewards and ends episodes. The task says how long an episode lasts at most, and what success
    is where `info` has neither `is_success` nor `success`; imagined steps have its reward. Where an environment does
    not know the reward (nan), the task says what the step earned and whether it ended the episode. Actions in [-1, 1]
    are scaled to the bounds of the action space; what `info["sent"]` says was commanded instead is what is kept.
    `info["invalid"]`, or a number that is not finite, ends an episode like exploded physics: the step is not learned
    from. An environment with a method `rest` hears when its episode is over.

    env: the task. real: an environment, several, or a vector environment with one for each member. A vector environment
    also steps members whose episode is over. gamma: discount factor of the transitions, that of the prior.
    observe: what an environment returns -> [measured_dim], in the order and units of `env.measured`. Default: a Box
    as it is, a Dict in the order of the task's entries, which must be its keys.
    Raises UserError for spaces that do not fit the task.
    """

    def __init__(
        self,
        env: Env,
        real: "gymnasium.Env | Sequence[gymnasium.Env] | gymnasium.vector.VectorEnv",
        *,
        gamma: float,
        observe: Observe | None = None,
    ) -> None:
        self.env, self.gamma = env, gamma
        self._real = _played(real)
        self._observe = observe or _reader(env.measured, self._real)
        low, high = _bounds(env, self._real)
        self._middle, self._half = (low + high) / 2, (high - low) / 2  # what an action of 0 is, and one of 1 beyond it
        self._draw = jax.jit(jax.vmap(self._drawn))
        self._programs: dict[Callable[..., Any], Callable[..., tuple[Array, PyTree]]] = {}
        self._judge = None
        if env.reward is not None and env.terminated is not None:
            reward, ended = env.reward, env.terminated
            self._judge = jax.jit(jax.vmap(lambda *step: (reward(*step), ended(*step))))
        self._succeeds = None if env.success is None else jax.jit(jax.vmap(jax.vmap(env.success)))

    def play(self, policy: Any, states: PyTree, keys: Key, *, explore: bool) -> Episode:
        """Episodes [M, n, ...], see `System`, one after another.

        The seed with which an environment is reset follows from its key, see `seeds_of`. Raises UserError where there
        is not one environment for each member, or where the task is judged by success and nothing tells it.
        """
        members, n = keys.shape
        if members != self._real.count:
            given = self._real.count
            raise UserError(f"{self._real.name}: {given} for {members} members; give one environment for each seed")
        played = [self._play(policy, states, keys[:, i], explore=explore) for i in range(n)]
        return jax.tree.map(lambda *x: jnp.stack(x, axis=1), *played)

    def close(self) -> None:
        """Closes the environments."""
        self._real.close()

    def _play(self, policy: Any, states: PyTree, keys: Key, *, explore: bool) -> Episode:
        """One episode of each member, [M, ...]. keys: [M]."""
        env, members = self.env, self._real.count
        seeds, act_keys = self._draw(keys)
        act = self._program(policy)
        carry = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *jnp.shape(x))), policy.init_carry())
        actions = np.zeros((members, env.previous_actions, env.act_dim), np.float32)
        going = np.ones(members, bool)
        seen = with_memory(env, self._measured(self._real.reset(seeds.tolist())), actions)
        rows = _Rows.blank(env, members)
        for t in range(env.episode_length):
            action, carry = act(states, carry, seen, act_keys, t, explore)
            action = np.asarray(action)
            after = self._real.step(self._commanded(action), going)
            action = self._sent(action, after.infos)
            actions = remember(actions, action)
            following = with_memory(env, self._measured(after.obs), actions)
            going &= ~rows.put(t, going, seen, action, self._judged(after, seen, action, following), following)
            if not going.any():
                break
            seen = following
        self._real.rest()
        return self._episode(rows)

    def _program(self, policy: Any) -> Callable[..., tuple[Array, PyTree]]:
        """The action of all members at a step, one compiled program."""
        if policy.act not in self._programs:

            def act(
                state: PyTree, carry: PyTree, obs: Array, keys: Key, t: Array, explore: Array
            ) -> tuple[Array, PyTree]:
                return policy.act(state, carry, obs, keys[t], explore=explore)

            self._programs[policy.act] = jax.jit(split_vmap(act, (0, 0, 0, 0, None, None)))
        return self._programs[policy.act]

    def _drawn(self, key: Key) -> tuple[Array, Key]:
        """The seed of an episode, and the keys [T] with which a policy acts in it; as `play_episode` draws them."""
        seed = seed_of(key)
        _, _, keys = episode_keys(jax.random.key(seed), self.env.episode_length)
        return seed, keys[:, 0]

    def _commanded(self, action: np.ndarray) -> np.ndarray:
        """[M, act_dim] from [-1, 1] to the bounds of the action space."""
        return self._middle + action * self._half

    def _sent(self, action: np.ndarray, infos: "Sequence[Mapping[str, Any]]") -> np.ndarray:
        """[M, act_dim] in [-1, 1], what was really commanded, as far as `infos` tell."""
        told = [
            (info["sent"] - self._middle) / self._half if "sent" in info else own
            for own, info in zip(action, infos, strict=True)
        ]
        return np.stack(told).astype(np.float32)

    def _judged(self, after: "_After", seen: np.ndarray, action: np.ndarray, following: np.ndarray) -> "_After":
        """With what the task says of steps whose reward the environment does not know."""
        unknown = np.isnan(after.reward) & np.array(["invalid" not in info for info in after.infos])
        if not unknown.any():
            return after
        if self._judge is None:
            raise UserError(
                f"{self._real.name}: does not know its reward, and {self.env.name} has none of what is observed"
            )
        reward, terminated = (np.asarray(x) for x in self._judge(seen, action, following))
        return after._replace(
            reward=np.where(unknown, reward, after.reward), terminated=np.where(unknown, terminated, after.terminated)
        )

    def _measured(self, returned: Sequence[Any]) -> np.ndarray:
        """[M, measured_dim] of what every environment has returned."""
        found = [np.asarray(self._observe(one), np.float32).reshape(-1) for one in returned]
        if found[0].size != self.env.measured_dim:
            raise UserError(
                f"observe: returns {found[0].size} numbers, the task {self.env.name} measures {_sizes(self.env)}"
            )
        return np.stack(found)

    def _episode(self, rows: "_Rows") -> Episode:
        env, valid = self.env, jnp.asarray(rows.valid)
        transitions = Transition(
            jnp.asarray(rows.obs), jnp.asarray(rows.action), jnp.asarray(rows.reward),
            jnp.where(valid, self.gamma * (1 - rows.terminated), 0.0), jnp.asarray(rows.next_obs),
        )  # fmt: skip
        succeeded, exploded = jnp.asarray(self._success(rows)), jnp.asarray(rows.invalid.any(1))
        total = transitions.reward.sum(1)
        return Episode(
            transitions=transitions,
            valid=valid,
            total_reward=total,
            success=succeeded & ~exploded,
            exploded=exploded,
            score=(succeeded & ~exploded).astype(jnp.float32) if env.score == "success" else total,
            world=jnp.zeros(len(valid), jnp.int32),
            trace=jnp.zeros((len(valid), env.episode_length + 1, 0)),
        )

    def _success(self, rows: "_Rows") -> np.ndarray:
        """[M] bool, of the last step, or of any where that is what the task asks."""
        if (rows.success >= 0).any():
            each = rows.success > 0
        elif self._succeeds is not None:
            each = np.asarray(self._succeeds(rows.next_obs)) & rows.valid
        elif self.env.score == "success":
            raise UserError(
                f"{self._real.name}: nothing tells success, by which {self.env.name} is judged: `info` has no "
                f"{' and no '.join(SUCCESS)}, and the task no function of observations; add one to `info`"
            )
        else:
            each = np.zeros_like(rows.valid)
        last = np.maximum(rows.valid.sum(1) - 1, 0)
        return each.any(1) if self.env.success_anytime else each[np.arange(len(last)), last]


def seed_of(key: Key) -> Array:
    """[] uint32 below 2**31: with what an environment is reset for the episode of a key []."""
    return jax.random.bits(key, dtype=jnp.uint32) >> 1


# --- rows -------------------------------------------------------------------------------------------------------------


class _After(NamedTuple):
    """What a step of M environments returned. obs: M of what they return; arrays [M]; infos: M dicts."""

    obs: Sequence[Any]
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    infos: Sequence[Mapping[str, Any]]


class _Rows(NamedTuple):
    """One episode of M members on the host, [M, T, ...]; zeros where nothing happened.

    success: int8, -1 where `info` did not say. invalid: steps that must not be learned from.
    """

    obs: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    next_obs: np.ndarray
    valid: np.ndarray
    success: np.ndarray
    invalid: np.ndarray

    @classmethod
    def blank(cls, env: Env, members: int) -> "_Rows":
        """No step yet."""
        shape = members, env.episode_length
        obs, action, reward = (np.zeros((*shape, *own), np.float32) for own in ((env.obs_dim,), (env.act_dim,), ()))
        no = np.zeros(shape, bool)
        return cls(obs, action, reward, no, obs.copy(), no.copy(), np.full(shape, -1, np.int8), no.copy())

    def put(
        self, t: int, going: np.ndarray, seen: np.ndarray, action: np.ndarray, after: _After, following: np.ndarray
    ) -> np.ndarray:
        """Writes step t of the members that are `going` [M]; returns which episodes are over [M]."""
        finite = np.isfinite(following).all(1) & np.isfinite(after.reward)
        bad = ~finite | np.array([bool(info.get("invalid", False)) for info in after.infos])
        valid = going & ~bad
        self.valid[:, t], self.invalid[:, t] = valid, going & bad
        self.obs[valid, t], self.action[valid, t], self.next_obs[valid, t] = (
            seen[valid],
            action[valid],
            following[valid],
        )
        self.reward[valid, t], self.terminated[valid, t] = after.reward[valid], after.terminated[valid]
        for i in np.flatnonzero(valid).tolist():
            told = [after.infos[i][name] for name in SUCCESS if name in after.infos[i]]
            self.success[i, t] = int(bool(told[0])) if told else -1
        return bad | after.terminated | after.truncated


# --- environments -----------------------------------------------------------------------------------------------------


class _Real(Protocol):
    """M environments that are reset and stepped together."""

    name: str
    count: int
    observation: Any
    action: Any

    def reset(self, seeds: list[int]) -> Sequence[Any]:
        """What each one returns at its start."""
        ...

    def step(self, actions: np.ndarray, going: np.ndarray) -> _After:
        """actions: [M, act_dim]. going: [M], whose episode goes on; the others may stay as they are."""
        ...

    def rest(self) -> None:
        """No step follows before the next reset."""
        ...

    def close(self) -> None:
        """The end."""
        ...


class _Each:
    """Environments of their own. Those whose episode is over are left alone."""

    def __init__(self, each: "Sequence[gymnasium.Env]") -> None:
        first = each[0]
        self.each, self.count, self.name = each, len(each), str(first.spec.id if first.spec else first.unwrapped)
        self.observation, self.action = first.observation_space, first.action_space
        if len({id(one) for one in each}) < len(each):
            raise UserError(f"{self.name}: the same environment is given twice; make one for each seed")
        self._obs: Sequence[Any] = []

    def reset(self, seeds: list[int]) -> Sequence[Any]:
        self._obs = [one.reset(seed=seed)[0] for one, seed in zip(self.each, seeds, strict=True)]
        return self._obs

    def step(self, actions: np.ndarray, going: np.ndarray) -> _After:
        found = [
            one.step(action.astype(self.action.dtype)) if on else (obs, 0.0, True, False, {})
            for one, action, on, obs in zip(self.each, actions, going, self._obs, strict=True)
        ]
        self._obs, reward, terminated, truncated, infos = zip(*found, strict=True)
        return _After(self._obs, np.array(reward, np.float32), np.array(terminated), np.array(truncated), infos)

    def rest(self) -> None:
        for one in self.each:
            getattr(one, "rest", _nothing)()

    def close(self) -> None:
        for one in self.each:
            one.close()


class _Vector:
    """A vector environment, in either way of beginning episodes anew by itself."""

    def __init__(self, real: "gymnasium.vector.VectorEnv") -> None:
        self.real: Any = real  # Gymnasium's stub knows no list of seeds
        self.count, self.name = real.num_envs, str(real.spec.id if real.spec else real)
        self.observation, self.action = real.single_observation_space, real.single_action_space
        mode = real.metadata.get("autoreset_mode")
        if getattr(mode, "name", None) not in ("NEXT_STEP", "SAME_STEP"):
            raise UserError(
                f"{self.name}: its autoreset mode is {mode}; make it with AutoresetMode.NEXT_STEP, or give a list of "
                "environments"
            )

    def reset(self, seeds: list[int]) -> list[Any]:
        return self._split(self.real.reset(seed=seeds)[0])

    def step(self, actions: np.ndarray, going: np.ndarray) -> _After:
        obs, reward, terminated, truncated, infos = self.real.step(actions.astype(self.action.dtype))
        told = [_info(infos, i) for i in range(self.count)]
        last = [own.get("final_obs", seen) for own, seen in zip(told, self._split(obs), strict=True)]  # SAME_STEP
        told = [{**own, **own.get("final_info", {})} for own in told]
        return _After(last, np.array(reward, np.float32), np.array(terminated), np.array(truncated), told)

    def rest(self) -> None:
        pass

    def close(self) -> None:
        self.real.close()

    def _split(self, obs: Any) -> list[Any]:
        """What each environment returned; copies, because a vector environment may write into its arrays again."""
        return [jax.tree.map(lambda x, i=i: np.array(x[i]), obs) for i in range(self.count)]


def _nothing() -> None:
    """What most environments do between episodes."""


def _info(infos: Mapping[str, Any], i: int) -> dict[str, Any]:
    """The `info` of environment i: a vector environment says beside every entry for which ones it is there."""
    there = {name: x for name, x in infos.items() if f"_{name}" in infos and infos[f"_{name}"][i]}
    return {name: _info(x, i) if isinstance(x, Mapping) else x[i] for name, x in there.items()}


def _played(real: Any) -> _Real:
    if isinstance(real, Sequence):
        return _Each(real)
    return _Vector(real) if hasattr(real, "num_envs") else _Each([real])


# --- spaces -----------------------------------------------------------------------------------------------------------


def _bounds(env: Env, real: _Real) -> tuple[np.ndarray, np.ndarray]:
    """[act_dim] each, of the actions; raises UserError for what cannot be commanded."""
    low, high = (getattr(real.action, name, None) for name in ("low", "high"))
    if low is None or high is None:
        raise UserError(f"{real.name}: its actions are {real.action}; only a Box can be commanded")
    if low.size != env.act_dim:
        raise UserError(f"{real.name}: takes {low.size} numbers as action, the task {env.name} has {env.act_dim}")
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise UserError(
            f"{real.name}: its actions have no bounds; wrap it in gymnasium.wrappers.RescaleAction or similar"
        )
    return low.astype(np.float64).reshape(-1), high.astype(np.float64).reshape(-1)


def _reader(measured: tuple[Entry, ...], real: _Real) -> Observe:
    """How observations become a vector [measured_dim]; raises UserError where that has to be said."""
    parts, help_ = getattr(real.observation, "spaces", None), "pass observe= to map them"
    sizes = {e.name: e.size for e in measured}
    if isinstance(parts, Mapping):
        found = {name: int(np.prod(space.shape)) if space.shape is not None else 0 for name, space in parts.items()}
        if found != sizes:
            raise UserError(f"{real.name}: observes {found}, the task measures {sizes}; {help_}")
        return lambda obs: np.concatenate([np.asarray(obs[name], np.float32).reshape(-1) for name in sizes])
    if not hasattr(real.observation, "low"):
        raise UserError(f"{real.name}: observes {real.observation}, neither a Box nor a Dict of them; {help_}")
    if (n := int(np.prod(real.observation.shape))) != sum(sizes.values()):
        raise UserError(f"{real.name}: observes {n} numbers, the task measures {sum(sizes.values())}: {sizes}; {help_}")
    return lambda obs: obs


def _sizes(env: Env) -> str:
    return f"{env.measured_dim}: {', '.join(f'{e.name} [{e.size}]' for e in env.measured)}"
