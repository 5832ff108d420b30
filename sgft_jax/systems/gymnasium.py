"""Impure: real systems that are Gymnasium environments, stepped from Python."""

import functools
import statistics
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Entry, Env
from envs.history import remember, with_memory
from envs.rollout import Episode, episode_keys
from sgft_jax import extend
from sgft_jax.mesh import split_vmap
from sgft_jax.types import Array, Key, PyTree, Transition, UserError

if TYPE_CHECKING:
    import gymnasium

    from sgft_jax.systems.remote import Remote

SUCCESS = ("is_success", "success")  # what `info` may call it; the first that is there counts
_RETURNED = {"reset": ("observation", "info"), "step": ("observation", "reward", "terminated", "truncated", "info")}
_TRIES = 20  # actions that are timed before a robot with a clock moves
Observe = Callable[[Any], Any]


class Step(NamedTuple):
    """One step of M members, on the host. If a member's episode was over, its `valid` and `invalid` are both False.

    obs, next_obs: [M, obs_dim], raw units. action: [M, act_dim] in [-1, 1], what was really commanded. command:
    [M, act_dim], what the policy asked for. reward: [M]. terminated, valid: [M] bool. success: [M] int8, -1 where
    nothing tells it. invalid: [M] bool, a step that must not be learned from. over: [M] bool, no step follows.
    late: [M] bool, no command came in time. time: [M] float64, seconds since the epoch when its outcome was there.
    """

    obs: np.ndarray
    action: np.ndarray
    command: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    next_obs: np.ndarray
    valid: np.ndarray
    success: np.ndarray
    invalid: np.ndarray
    over: np.ndarray
    late: np.ndarray
    time: np.ndarray

    def in_doubt(self) -> "Step":
        """The step after this one, of which nobody knows whether it was made, or what came of it."""
        return _in_doubt(np.zeros_like(self.obs), np.zeros_like(self.command), self.over, np.zeros_like(self.time))


class Gymnasium:
    """Gymnasium environments as the real systems of a task, one for each member; all take a step together.

    The environment moves, rewards and ends episodes. The task says how long an episode lasts at most, and what success
    is where `info` has neither `is_success` nor `success`; imagined steps have its reward. Where an environment does
    not know the reward (nan), the task says what the step earned and whether it ended the episode. Actions in [-1, 1]
    are scaled to the bounds of the action space; what `info["sent"]` says was commanded instead is what is kept.
    `info["invalid"]`, or a number that is not finite, ends an episode like exploded physics: the step is not learned
    from. An environment with a method `rest` hears when its episode is over.

    env: the task. real: an environment, several, or a vector environment with one for each member; or a robot behind a
    socket, `Remote`. A vector environment also steps members whose episode is over. gamma: discount factor of the
    transitions, that of the prior.
    observe: what an environment returns -> [measured_dim], in the order and units of `env.measured`. Default: a Box
    as it is, a Dict in the order of the task's entries, which must be its keys.
    Raises UserError for spaces that do not fit the task.
    """

    def __init__(
        self,
        env: Env,
        real: "gymnasium.Env | Sequence[gymnasium.Env] | gymnasium.vector.VectorEnv | Remote",
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

        states: also a function without arguments that returns them. It is asked once an episode has begun, and again
        at every step: a learner that works meanwhile hands over what it has.
        The seed with which an environment is reset follows from its key, see `seed_of`. Raises UserError where there
        is not one environment for each member, where the task is judged by success and nothing tells it, or where a
        robot has a clock and the policy is too slow for it.
        """
        played = [self.episode(self.steps(policy, states, keys[:, i], explore=explore)) for i in range(keys.shape[1])]
        return jax.tree.map(lambda *x: jnp.stack(x, axis=1), *played)

    def steps(
        self, policy: Any, states: PyTree, keys: Key, *, explore: bool,
        asked: Callable[[Step], None] = lambda step: None,
    ) -> Generator[Step]:  # fmt: skip
        """One episode of every member, step by step as it happens. keys: [M]. The rest: see `play`.

        asked: hears of the first step before an environment does: what the policy saw and wants, the rest in doubt.
        Close it where you leave it early: the robot rests then.
        """
        env, members, latest = self.env, len(keys), states if callable(states) else lambda: states
        if members != self._real.count:
            given = self._real.count
            raise UserError(f"{self._real.name}: {given} for {members} members; give one environment for each seed")
        seeds, act_keys = self._draw(keys)
        carry = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *jnp.shape(x))), policy.init_carry())
        actions = np.zeros((members, env.previous_actions, env.act_dim), np.float32)
        going = np.ones(members, bool)
        new, act = policy.act not in self._programs, self._program(policy)
        seen = with_memory(env, self._measured(self._real.reset(seeds.tolist())), actions)
        try:
            if new and self._real.answer_within is not None:
                self._check_speed(lambda: act(latest(), carry, seen, act_keys, 0, explore), self._real.answer_within)
                if self._judge is not None:  # compiled before the robot's clock runs
                    jax.block_until_ready(self._judge(seen, np.zeros((members, env.act_dim), np.float32), seen))
            for t in range(env.episode_length):
                wanted, carry = act(latest(), carry, seen, act_keys, t, explore)
                command = np.asarray(wanted)
                if t == 0:
                    asked(_in_doubt(seen, command, ~going, np.full(members, time.time())))
                after = self._real.step(self._commanded(command), going)
                action = self._sent(command, after.infos)
                actions = remember(actions, action)
                following = with_memory(env, self._measured(after.obs), actions)
                judged = self._judged(after, seen, action, following)
                step = _step(going, seen, command, action, judged, following)
                yield step
                going = ~step.over
                if not going.any():
                    return
                seen = following
        finally:
            self._real.rest()

    def episode(self, steps: Iterable[Step]) -> Episode:
        """One episode of each member, [M, ...], from its steps; fewer than T of them if it ended before."""
        env, made = self.env, list(steps)
        rows = Step(*(_padded(np.stack(x, axis=1), env.episode_length) for x in zip(*made, strict=True)))
        valid = jnp.asarray(rows.valid)
        kept = lambda x: jnp.where(valid.reshape(*valid.shape, *[1] * (x.ndim - 2)), x, 0)  # noqa: E731
        transitions = Transition(
            kept(rows.obs), kept(rows.action), kept(rows.reward),
            jnp.where(valid, self.gamma * (1 - rows.terminated), 0.0), kept(rows.next_obs),
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
            command=kept(rows.command),
        )

    def close(self, *, over: bool = True) -> None:
        """Closes the environments. over: False where the run goes on another time, for which a robot then waits."""
        self._real.close(over=over)

    def _check_speed(self, act: Callable[[], Any], allowed: float) -> None:
        """Raises UserError where most actions take longer than a robot waits for one. The first call compiles.

        Single late ones are no reason: anything may interrupt a process, and the robot has a rule for them.
        """
        jax.block_until_ready(act())
        taken = statistics.median(_seconds(act) for _ in range(_TRIES))
        if taken > allowed:
            raise UserError(
                f"{self._real.name}: waits {allowed:.3g} s for a command, the policy takes {taken:.3g} s for one; "
                "choose a method that does not plan, a smaller plan, or a longer period"
            )

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

    def _success(self, rows: Step) -> np.ndarray:
        """[M] bool, of the last step, or of any where that is what the task asks."""
        if (rows.success >= 0).any():
            each = rows.success > 0
        elif self._succeeds is not None:
            each = np.asarray(self._succeeds(rows.next_obs)) & rows.valid
        elif self.env.score == "success" and rows.valid.any():
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


# --- steps ------------------------------------------------------------------------------------------------------------


class _After(NamedTuple):
    """What a step of M environments returned. obs: M of what they return; arrays [M]; infos: M dicts."""

    obs: Sequence[Any]
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    infos: Sequence[Mapping[str, Any]]


def _step(
    going: np.ndarray, seen: np.ndarray, command: np.ndarray, action: np.ndarray, after: _After, following: np.ndarray
) -> Step:
    """The step of the members that are `going` [M]."""
    finite = np.isfinite(following).all(1) & np.isfinite(after.reward)
    bad = ~finite | _flag("invalid", after.infos)
    told = [[info[name] for name in SUCCESS if name in info] for info in after.infos]
    success = [int(bool(own[0])) if own and on else -1 for own, on in zip(told, going & ~bad, strict=True)]
    return Step(
        seen, action, command, after.reward, after.terminated, following, going & ~bad, np.array(success, np.int8),
        going & bad, ~going | bad | after.terminated | after.truncated, going & _flag("late", after.infos),
        np.full(len(going), time.time()),
    )  # fmt: skip


def _in_doubt(seen: np.ndarray, command: np.ndarray, over: np.ndarray, when: np.ndarray) -> Step:
    """A step of the members whose episode is not `over` [M] before it, of which nobody knows whether it was made."""
    no, zero = np.zeros(len(seen), bool), np.zeros(len(seen), np.float32)
    return Step(
        seen, np.zeros_like(command), command, zero, no, np.zeros_like(seen), no, np.full(len(seen), -1, np.int8),
        ~over, ~no, no, when,
    )  # fmt: skip


def _flag(name: str, infos: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """[M] bool, False where `info` does not have it."""
    return np.array([bool(info.get(name, False)) for info in infos])


def _padded(rows: np.ndarray, length: int) -> np.ndarray:
    """[M, T, ...] of [M, t, ...]: zeros where nothing happened; for `success` that is not told either way, -1."""
    blank = -1 if rows.dtype == np.int8 else 0
    return np.pad(rows, [(0, 0), (0, length - rows.shape[1]), *[(0, 0)] * (rows.ndim - 2)], constant_values=blank)


def _seconds(act: Callable[[], Any]) -> float:
    started = time.perf_counter()
    jax.block_until_ready(act())
    return time.perf_counter() - started


# --- environments -----------------------------------------------------------------------------------------------------


class _Real(Protocol):
    """M environments that are reset and stepped together."""

    name: str
    count: int
    observation: Any
    action: Any

    @property
    def answer_within(self) -> float | None:
        """Seconds that a robot with a clock waits for a command. It is known once an episode has begun."""
        ...

    def reset(self, seeds: list[int]) -> Sequence[Any]:
        """What each one returns at its start."""
        ...

    def step(self, actions: np.ndarray, going: np.ndarray) -> _After:
        """actions: [M, act_dim]. going: [M], whose episode goes on; the others may stay as they are."""
        ...

    def rest(self) -> None:
        """No step follows before the next reset."""
        ...

    def close(self, *, over: bool) -> None:
        """The end, or, where it is not over, one on this side."""
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

    @property
    def answer_within(self) -> float | None:
        return getattr(self.each[0], "answer_within", None)

    def reset(self, seeds: list[int]) -> Sequence[Any]:
        each = zip(self.each, seeds, strict=True)
        self._obs = [_asked(self.name, one, "reset", seed=seed)[0] for one, seed in each]
        return self._obs

    def step(self, actions: np.ndarray, going: np.ndarray) -> _After:
        found = [
            _asked(self.name, one, "step", action.astype(self.action.dtype)) if on else (obs, 0.0, True, False, {})
            for one, action, on, obs in zip(self.each, actions, going, self._obs, strict=True)
        ]
        self._obs, reward, terminated, truncated, infos = zip(*found, strict=True)
        return _After(self._obs, np.array(reward, np.float32), np.array(terminated), np.array(truncated), infos)

    def rest(self) -> None:
        for one in self.each:
            getattr(one, "rest", _nothing)()

    def close(self, *, over: bool) -> None:
        for one in self.each:
            getattr(one, "close" if over else "leave", one.close)()


class _Vector:
    """A vector environment, in either way of beginning episodes anew by itself."""

    answer_within = None

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
        return self._split(_asked(self.name, self.real, "reset", seed=seeds)[0])

    def step(self, actions: np.ndarray, going: np.ndarray) -> _After:
        found = _asked(self.name, self.real, "step", actions.astype(self.action.dtype))
        obs, reward, terminated, truncated, infos = found
        told = [_info(infos, i) for i in range(self.count)]
        last = [own.get("final_obs", seen) for own, seen in zip(told, self._split(obs), strict=True)]  # SAME_STEP
        told = [{**own, **own.get("final_info", {})} for own in told]
        return _After(last, np.array(reward, np.float32), np.array(terminated), np.array(truncated), told)

    def rest(self) -> None:
        pass

    def close(self, *, over: bool) -> None:
        self.real.close()

    def _split(self, obs: Any) -> list[Any]:
        """What each environment returned; copies, because a vector environment may write into its arrays again."""
        return [jax.tree.map(lambda x, i=i: np.array(x[i]), obs) for i in range(self.count)]


def _asked(name: str, real: Any, method: str, *given: Any, **named: Any) -> tuple[Any, ...]:
    """What an environment returns; raises UserError, which says where, if it raises or returns other parts."""
    parts = _RETURNED[method]
    found = extend.guard(f"{method} of", name, functools.partial(getattr(real, method), *given, **named))()
    if not isinstance(found, tuple) or len(found) != len(parts):
        count = f"{len(found)} values" if isinstance(found, tuple) else f"a {type(found).__name__}"
        raise UserError(f"{method} of {name}: returns {count}, not {', '.join(parts)}")
    return found


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
