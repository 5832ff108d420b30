"""Impure: real systems that are Gymnasium environments, stepped from Python."""

import statistics
import time
import timeit
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs import extend
from envs.base import Env
from envs.mesh import split_vmap
from envs.observations import remember, with_memory
from envs.rollout import Episode, episode_keys, judged
from envs.types import Array, Key, PyTree, Transition, UserError
from sgft_jax.systems import answers
from sgft_jax.systems.answers import Answer, Observe
from sgft_jax.systems.robot_client import SUCCESS

if TYPE_CHECKING:
    import gymnasium

    from sgft_jax.systems.remote import Remote

__all__ = ["Gymnasium"]

_TRIES = 20  # actions that are timed before a robot with a clock moves
_STARTS, _PAUSE = 4, 0.5  # times that a start is asked for until all its numbers are finite, and seconds in between


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

    @classmethod
    def begun(cls, obs: np.ndarray, command: np.ndarray, over: np.ndarray, when: np.ndarray) -> "Step":
        """A step of the members whose episode is not `over` before it. Nobody knows whether it was made."""
        no, reward, unknown = np.zeros(len(obs), bool), np.zeros(len(obs), np.float32), np.full(len(obs), -1, np.int8)
        outcome = reward, no, np.zeros_like(obs), no, unknown, ~over, ~no, no, when
        return cls(obs, np.zeros_like(command), command, *outcome)

    def in_doubt(self) -> "Step":
        """The step after this one, of which nobody knows whether it was made, or what came of it."""
        return self.begun(np.zeros_like(self.obs), np.zeros_like(self.command), self.over, np.zeros_like(self.time))


class Gymnasium:
    """Gymnasium environments as the real systems of a task, one for each member; all take a step together.

    The environment moves, rewards and ends episodes. The task says how long an episode lasts at most, and what success
    is where `info` has neither `is_success` nor `success`; imagined steps have its reward. Where an environment does
    not know the reward (nan), the task says what the step earned and whether it ended the episode. Actions, clipped to
    [-1, 1], are scaled to the bounds of the action space, and rounded where those are whole numbers; what was sent is
    what is kept, also where `info["sent"]` says that something else was. `info["invalid"]`, a number that is not finite
    or beyond 1e18, or an action that is not finite, which is not sent, ends an episode like exploded physics: the step
    is not learned from. A start with such a number is asked for again, a few times. An environment with a method `rest`
    hears when its episode is over, or when it has returned what cannot be used, which raises UserError.

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
        self.env, self.pools, self.gamma = env, None, gamma
        self._real = answers.played(real)
        self._observe = extend.guard("observe of", self._real.name, observe or answers.reader(env.measured, self._real))
        self._low, self._high = low, high = answers.bounds(env, self._real)
        self._middle, self._half = (low + high) / 2, (high - low) / 2  # what an action of 0 is, and one of 1 beyond it
        self._whole = np.dtype(self._real.action.dtype).kind in "iu"
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
        self, policy: Any, states: PyTree, keys: Key, *, explore: bool, asked: Callable[[Step], None] | None = None
    ) -> Generator[Step]:
        """One episode of every member, step by step as it happens. keys: [M]. The rest: see `play`.

        asked: hears of the first step before an environment does: what the policy saw and wants, the rest in doubt.
        Close it where you leave it early: the robot rests then.
        """
        env, members, latest = self.env, len(keys), states if callable(states) else lambda: states
        if members != (count := self._real.count):
            raise UserError(f"{self._real.name}: {count} for {members} members; give one environment for each seed")
        seeds, act_keys = self._draw(keys)
        carry = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *jnp.shape(x))), policy.init_carry())
        actions = np.zeros((members, env.previous_actions, env.act_dim), np.float32)
        going = np.ones(members, bool)
        new, act = policy.act not in self._programs, self._program(policy)
        try:
            seen = with_memory(env, self._started(seeds.tolist()), actions)
            if new and self._real.answer_within is not None:
                self._check_speed(lambda: act(latest(), carry, seen, act_keys, 0, explore), self._real.answer_within)
                if self._judge is not None:  # compiled before the robot's clock runs
                    jax.block_until_ready(self._judge(seen, np.zeros((members, env.act_dim), np.float32), seen))
            for t in range(env.episode_length):
                wanted, carry = act(latest(), carry, seen, act_keys, t, explore)
                wanted = np.asarray(wanted)
                asks = np.isfinite(wanted).all(1)
                command = np.where(asks[:, None], wanted, np.float32(0))
                step = Step.begun(seen, command, ~going, np.full(members, time.time()))
                if asked is not None and t == 0:
                    asked(step)
                commanded = self._commanded(command)
                answer = self._answered(commanded, going & asks)
                action = self._sent(command, commanded, answer.sent)
                actions = remember(actions, action)
                following = with_memory(env, self._measured("step", answer.obs), actions)
                step = _outcome(step, asks, action, self._judged(answer, seen, action, following), following)
                yield step
                going, seen = ~step.over, following
                if not going.any():
                    return
        finally:
            self._real.rest()

    def episode(self, steps: Iterable[Step]) -> Episode:
        """One episode of each member, [M, ...], from its steps; fewer than T of them if it ended before."""
        env, made = self.env, list(steps)
        rows = Step(*(_padded(np.stack(x, axis=1), env.episode_length) for x in zip(*made, strict=True)))
        valid = jnp.asarray(rows.valid)

        def kept(x: np.ndarray) -> Array:
            return jnp.where(valid.reshape(*valid.shape, *[1] * (x.ndim - 2)), x, 0)

        discount = self.gamma * (1 - rows.terminated)
        transitions = Transition(*map(kept, (rows.obs, rows.action, rows.reward, discount, rows.next_obs)))
        exploded = jnp.asarray(rows.invalid.any(1))
        success, total = jnp.asarray(self._success(rows)) & ~exploded, transitions.reward.sum(1)
        score, world = judged(env, total, success, exploded), jnp.zeros(len(valid), jnp.int32)
        trace = jnp.zeros((len(valid), env.episode_length + 1, 0))
        return Episode(transitions, valid, total, success, exploded, score, world, trace, kept(rows.command))

    def close(self, *, over: bool = True) -> None:
        """Closes the environments. over: False where the run goes on another time, for which a robot then waits."""
        self._real.close(over=over)

    def _check_speed(self, act: Callable[[], Any], allowed: float) -> None:
        """Raises UserError where most actions take longer than a robot waits for one. The first call compiles.

        Single late ones are no reason: anything may interrupt a process, and the robot has a rule for them.
        """
        _, *seconds = timeit.repeat(lambda: jax.block_until_ready(act()), number=1, repeat=1 + _TRIES)
        taken = statistics.median(seconds)
        if taken > allowed:
            times = f"waits {allowed:.3g} s for a command, the policy takes {taken:.3g} s for one"
            advice = "choose a method that does not plan, a smaller plan, or a longer period"
            raise UserError(f"{self._real.name}: {times}; {advice}")

    def _program(self, policy: Any) -> Callable[..., tuple[Array, PyTree]]:
        """The action of all members at a step, one compiled program."""
        if policy.act not in self._programs:
            act = split_vmap(
                lambda state, carry, obs, keys, t, explore: policy.act(state, carry, obs, keys[t], explore=explore),
                (0, 0, 0, 0, None, None),
            )
            self._programs[policy.act] = jax.jit(act)
        return self._programs[policy.act]

    def _drawn(self, key: Key) -> tuple[Array, Key]:
        """The seed of an episode, and the keys [T] with which a policy acts in it; as `play_episode` draws them."""
        seed = seed_of(key)
        _, _, keys = episode_keys(jax.random.key(seed), self.env.episode_length)
        return seed, keys[:, 0]

    def _started(self, seeds: list[int]) -> np.ndarray:
        """[M, measured_dim] at the start of an episode. A camera may need a moment until it sees."""
        tries = 1
        while not (sound := answers.sound(seen := self._measured("reset", self._real.reset(seeds)))).all():
            if tries == _STARTS:
                number = int(np.argwhere(~sound)[0, 1])
                reading = f"measured number {number} is {seen[~sound][0]:g} after {tries} tries"
                raise UserError(f"reset of {self._real.name}: {reading}; no episode can begin there")
            tries += 1
            time.sleep(_PAUSE)
        return seen

    def _commanded(self, action: np.ndarray) -> np.ndarray:
        """[M, act_dim] from [-1, 1] to the bounds of the action space."""
        commanded = self._middle + np.clip(action, -1, 1) * self._half
        return np.clip(np.rint(commanded), self._low, self._high) if self._whole else commanded

    def _answered(self, commanded: np.ndarray, going: np.ndarray) -> Answer:
        """What a step leads to, `answers.stacked`. commanded: [M, act_dim]. going: [M], the members that take it."""
        shape, dtype = self._real.action.shape, self._real.action.dtype
        returned = self._real.step(commanded.reshape(-1, *shape).astype(dtype), going)
        steps = [answers.step(self._real.name, parts, self._low, self._high) for parts in returned]
        return answers.stacked(steps, commanded.shape[1])

    def _sent(self, action: np.ndarray, commanded: np.ndarray, sent: np.ndarray) -> np.ndarray:
        """[M, act_dim] in [-1, 1], what was really commanded; what was asked for unless that is known to differ."""
        unknown = np.isnan(sent)
        exact = (np.where(unknown, commanded, sent) - self._middle) / self._half
        return np.where(~unknown | self._whole, exact, np.clip(action, -1, 1)).astype(np.float32)

    def _judged(self, answer: Answer, seen: np.ndarray, action: np.ndarray, following: np.ndarray) -> Answer:
        """With what the task says of steps whose reward the environment does not know."""
        unknown = np.isnan(answer.reward) & ~answer.invalid
        if not unknown.any():
            return answer
        if self._judge is None:
            task = f"{self.env.name} has none of what is observed"
            raise UserError(f"{self._real.name}: does not know its reward, and {task}")
        reward, terminated = (np.asarray(x) for x in self._judge(seen, action, following))
        terminated = np.where(unknown, terminated, answer.terminated)
        return answer._replace(reward=np.where(unknown, reward, answer.reward), terminated=terminated)

    def _measured(self, method: str, returned: Sequence[Any]) -> np.ndarray:
        """[M, measured_dim] of what a method of every environment has returned."""
        env, where = self.env, f"{method} of {self._real.name}"
        sizes = f"{env.measured_dim}: {', '.join(f'{e.name} [{e.size}]' for e in env.measured)}"
        wanted = f"the task {env.name} measures {sizes}"
        return np.stack([answers.measured(where, self._observe(obs), env.measured_dim, wanted) for obs in returned])

    def _success(self, rows: Step) -> np.ndarray:
        """[M] bool, of the last step, or of any where that is what the task asks."""
        if (rows.success >= 0).any():
            success = rows.success > 0
        elif self._succeeds is not None:
            success = np.asarray(self._succeeds(rows.next_obs)) & rows.valid
        elif self.env.score == "success" and rows.valid.any():
            raise UserError(
                f"{self._real.name}: nothing tells success, by which {self.env.name} is judged: `info` has no "
                f"{' and no '.join(SUCCESS)}, and the task no function of observations; add one to `info`"
            )
        else:
            success = np.zeros_like(rows.valid)
        last = np.maximum(rows.valid.sum(1) - 1, 0)
        return success.any(1) if self.env.success_anytime else success[np.arange(len(last)), last]


def seed_of(key: Key) -> Array:
    """[] uint32 below 2**31: with what an environment is reset for the episode of a key []."""
    return jax.random.bits(key, dtype=jnp.uint32) >> 1


# --- steps ------------------------------------------------------------------------------------------------------------


def _outcome(begun: Step, asks: np.ndarray, action: np.ndarray, answer: Answer, following: np.ndarray) -> Step:
    """What came of a step, see `answers.stacked`; of members of which a policy `asks` [M] nothing none was made."""
    going, when = begun.invalid, np.full(len(asks), time.time())
    bad = ~asks | ~answers.sound(following).all(1) | ~answers.sound(answer.reward) | answer.invalid
    valid, over = going & ~bad, ~going | bad | answer.terminated | answer.truncated
    success = np.where(valid, answer.success, np.int8(-1))
    facts = valid, success, going & bad, over, going & answer.late, when
    return Step(begun.obs, action, begun.command, answer.reward, answer.terminated, following, *facts)


def _padded(rows: np.ndarray, length: int) -> np.ndarray:
    """[M, T, ...] of [M, t, ...]: zeros where nothing happened; for `success` that is not told either way, -1."""
    blank = -1 if rows.dtype == np.int8 else 0
    return np.pad(rows, [(0, 0), (0, length - rows.shape[1]), *[(0, 0)] * (rows.ndim - 2)], constant_values=blank)
