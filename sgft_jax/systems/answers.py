"""Impure: environments of others, what they are asked, and the one checked way in for what they answer.

A number may be Python's, NumPy's or an array of one, `info` may be None, and None means that something is not known.
Anything else raises UserError: one line with the environment, its method, and the value.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from envs import extend
from envs.base import Entry, Env
from envs.types import UserError
from sgft_jax.systems.robot_client import LARGEST, SUCCESS, flag, number, numbers, printable, success_of

if TYPE_CHECKING:
    import gymnasium

_PARTS = {"reset": ("observation", "info"), "step": ("observation", "reward", "terminated", "truncated", "info")}
_KNOWN = (*SUCCESS, "invalid", "late", "sent", "final_obs", "final_info")  # of `info`
_BOUND = 1e9  # larger bounds of actions are those of a type of number, not of a machine
Observe = Callable[[Any], Any]
_ROUNDING = 1e-4  # by which, as a share of the half range, what was sent may lie beyond the bounds


class Answer(NamedTuple):
    """One environment's answer to a step, or those of several, see `stacked`.

    obs: as it came. reward: float, nan where it does not know it. terminated, truncated, invalid, late: bool. success:
    bool, None where it does not tell. sent: [act_dim] what was really commanded, in its units; None where that is what
    was asked for.
    """

    obs: Any
    reward: Any
    terminated: Any
    truncated: Any
    success: Any
    invalid: Any
    late: Any
    sent: Any


def idle(obs: Any) -> tuple[Any, ...]:
    """What stands for the parts that a step returns where the episode is over."""
    return obs, 0.0, True, False, None


def step(name: str, returned: tuple[Any, ...], low: np.ndarray, high: np.ndarray) -> Answer:
    """The answer to a step, see `_PARTS`. low, high: [act_dim] bounds of what can have been sent."""
    obs, reward, terminated, truncated, info = returned
    with _explained(f"step of {name}"):
        info = _mapping(info)
        ends = number(reward, "reward"), flag(terminated, "terminated"), flag(truncated, "truncated")
        facts = success_of(info), _flag(info, "invalid"), _flag(info, "late"), _sent(info.get("sent"), low, high)
        return Answer(obs, *ends, *facts)


def stacked(steps: Sequence[Answer], act_dim: int) -> Answer:
    """The answers of M environments as arrays [M, ...], `obs` as M of them; what is None is -1 in `success`, else nan.

    reward: float32. success: int8.
    """
    obs, reward, terminated, truncated, success, invalid, late, sent = zip(*steps, strict=True)
    with np.errstate(over="ignore"):  # beyond float32 is as good as not finite
        reward = np.array(reward, np.float32)
    success = np.array([-1 if known is None else known for known in success], np.int8)
    sent = np.stack([np.full(act_dim, np.nan) if known is None else known for known in sent])
    return Answer(
        obs, reward, np.array(terminated), np.array(truncated), success, np.array(invalid), np.array(late), sent
    )


def vector(name: str, returned: tuple[Any, ...], count: int, *, same_step: bool) -> list[tuple[Any, ...]]:
    """The parts that each of `count` environments of a vector environment returns; in `final_obs` what came last.

    same_step: whether it begins the next episode in the step that ends one. Then `final_obs` must be there.
    """
    obs, *columns, info = returned
    with _explained(f"step of {name}"):
        infos = [_of_member(_mapping(info), i, count, _KNOWN) for i in range(count)]
        names = _PARTS["step"][1:-1]
        rows = list(zip(*(_column(x, count, part) for x, part in zip(columns, names, strict=True)), strict=True))
        for (_, terminated, truncated), facts in zip(rows, infos, strict=True):
            if same_step and "final_obs" not in facts and (flag(terminated, names[1]) or flag(truncated, names[2])):
                raise ValueError("an episode has ended, but info has no 'final_obs' of it, only the next one's start")
    return [
        (facts.get("final_obs", seen), *row, {**facts, **facts.get("final_info", {})})
        for seen, row, facts in zip(split(name, "step", obs, count), rows, infos, strict=True)
    ]


def split(name: str, method: str, obs: Any, count: int) -> list[Any]:
    """What each environment observes; copies, because a vector environment may write into its arrays again."""
    if isinstance(obs, Mapping):
        columns = {key: split(name, method, x, count) for key, x in obs.items()}
        return [{key: x[i] for key, x in columns.items()} for i in range(count)]
    with _explained(f"{method} of {name}"):
        return [np.array(x) for x in _column(obs, count, "observation")]


def measured(where: str, values: Any, size: int, sizes: str) -> np.ndarray:
    """[size] float32 of what is observed. sizes: in words. It need not be `sound`."""
    with _explained(where), np.errstate(over="ignore"):
        vector = numbers(values, "the observation").astype(np.float32)
    if vector.size != size:
        raise UserError(f"{where}: observes {vector.size} numbers, {sizes}")
    return vector


def sound(x: np.ndarray) -> np.ndarray:
    """Whether numbers are finite, and small enough for float32 arithmetic; nan is not."""
    return np.abs(x) <= LARGEST


def _mapping(info: Any, name: str = "info") -> Mapping[str, Any]:
    if info is not None and not isinstance(info, Mapping):
        raise ValueError(f"{name} is {printable(repr(info), 60)}, no mapping")
    return info or {}


def _flag(info: Mapping[str, Any], name: str) -> bool:
    return info.get(name) is not None and flag(info[name], f"info[{name!r}]")


def _sent(values: Any, low: np.ndarray, high: np.ndarray) -> np.ndarray | None:
    if values is None:
        return None
    sent = numbers(values, "info['sent']")
    if sent.size != low.size:
        raise ValueError(f"info['sent'] has {sent.size} numbers, not {low.size}")
    room = _ROUNDING * (high - low) / 2
    if not ((low - room <= sent) & (sent <= high + room)).all():  # nan is not
        raise ValueError(f"info['sent'] is {printable(sent, 60)}, beyond the bounds of the action space")
    return np.clip(sent, low, high)


def _column(values: Any, count: int, name: str) -> Sequence[Any]:
    """One part of a vector environment's answer, an entry for each of its environments."""
    try:
        fits = len(values) == count
    except TypeError:
        fits = False
    if not fits:
        raise ValueError(f"{name} is {printable(repr(values), 60)}, not one for each of {count} environments")
    return values


def _of_member(infos: Mapping[str, Any], i: int, count: int, names: Sequence[str]) -> dict[str, Any]:
    """The `info` of environment i. Beside an entry may stand for which environments it is there."""
    info = {}
    for name in (name for name in names if name in infos):
        values, present = infos[name], infos.get(f"_{name}", [True] * count)
        if not flag(_column(present, count, f"info['_{name}']")[i], f"info['_{name}']"):
            continue
        if isinstance(values, Mapping):
            inner = [part for part in values if f"_{part}" in values] if name == "final_obs" else _KNOWN
            info[name] = _of_member(values, i, count, inner)
        else:
            value = _column(values, count, f"info[{name!r}]")[i]
            info[name] = _mapping(value, f"info[{name!r}]") if name == "final_info" else value
    return info


@contextlib.contextmanager
def _explained(where: str) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise UserError(f"{where}: {error}") from None


# --- what they are asked ----------------------------------------------------------------------------------------------


class Separate:
    """Environments, one for each member. Those whose episode is over are left alone."""

    def __init__(self, real: "Sequence[gymnasium.Env]") -> None:
        if not real:
            raise UserError("no environment is given; make one for each seed")
        first: Any = real[0]
        self.real, self.count, self.name = real, len(real), str(first.spec.id if first.spec else first.unwrapped)
        self.observation, self.action = first.observation_space, first.action_space
        if len(set(map(id, real))) < len(real):
            raise UserError(f"{self.name}: the same environment is given twice; make one for each seed")
        if any((env.observation_space, env.action_space) != (self.observation, self.action) for env in real):
            raise UserError(f"{self.name}: the spaces of its {len(real)} environments differ; make them alike")
        self._obs: Sequence[Any] = []

    @property
    def answer_within(self) -> float | None:
        """Seconds that a robot with a clock waits for a command. It is known once an episode has begun."""
        return getattr(self.real[0], "answer_within", None)

    def reset(self, seeds: list[int]) -> Sequence[Any]:
        """What each environment returns at its start."""
        self._obs = [_call(self.name, env, "reset", seed=s)[0] for env, s in zip(self.real, seeds, strict=True)]
        return self._obs

    def step(self, actions: np.ndarray, going: np.ndarray) -> Sequence[tuple[Any, ...]]:
        """Five parts from each. actions: [M, *shape of an action]. going: [M]; the others may stay as they are."""
        returned = [
            _call(self.name, env, "step", action) if on else idle(obs)
            for env, action, on, obs in zip(self.real, actions, going, self._obs, strict=True)
        ]
        self._obs = [first for first, *_ in returned]
        return returned

    def rest(self) -> None:
        """No step follows before the next reset."""
        self._end("rest", [getattr(env, "rest", lambda: None) for env in self.real])

    def close(self, *, over: bool) -> None:
        """The end, or, where it is not over, one on this side."""
        self._end("close", [getattr(env, "close" if over else "leave", env.close) for env in self.real])

    def _end(self, method: str, endings: Sequence[Callable[[], None]]) -> None:
        """All of them, also where one raises."""
        with contextlib.ExitStack() as last:
            for ending in reversed(endings):
                last.callback(extend.guard(f"{method} of", self.name, ending))


class Vector:
    """The same of a vector environment, in either way of beginning episodes anew by itself."""

    answer_within = None

    def __init__(self, real: "gymnasium.vector.VectorEnv") -> None:
        self.real: Any = real  # Gymnasium's stub knows no list of seeds
        self.count, self.name = real.num_envs, str(real.spec.id if real.spec else real)
        self.observation, self.action = self.real.single_observation_space, self.real.single_action_space
        mode = getattr(shown := real.metadata.get("autoreset_mode"), "name", None)
        self._same_step = mode == "SAME_STEP"
        if mode not in ("NEXT_STEP", "SAME_STEP"):
            advice = "make it with AutoresetMode.NEXT_STEP, or give a list of environments"
            raise UserError(f"{self.name}: its autoreset mode is {shown}; {advice}")

    def reset(self, seeds: list[int]) -> list[Any]:
        """What each environment returns at its start."""
        return split(self.name, "reset", _call(self.name, self.real, "reset", seed=seeds)[0], self.count)

    def step(self, actions: np.ndarray, going: np.ndarray) -> list[tuple[Any, ...]]:
        """Five parts from each; of members that do not take the step those of `idle`."""
        returned = _call(self.name, self.real, "step", actions)
        rows = vector(self.name, returned, self.count, same_step=self._same_step)
        return [row if on else idle(row[0]) for row, on in zip(rows, going, strict=True)]

    def rest(self) -> None:
        """Nothing: it begins episodes anew by itself."""

    def close(self, *, over: bool) -> None:
        """The end."""
        self.real.close()


def _call(name: str, real: Any, method: str, *args: Any, **options: Any) -> tuple[Any, ...]:
    """What an environment returns; raises UserError, which says where, if it raises or returns other parts."""
    returned = extend.guard(f"{method} of", name, functools.partial(getattr(real, method), *args, **options))()
    if not isinstance(returned, tuple) or len(returned) != len(_PARTS[method]):
        count = f"{len(returned)} values" if isinstance(returned, tuple) else f"a {type(returned).__name__}"
        raise UserError(f"{method} of {name}: returns {count}, not {', '.join(_PARTS[method])}")
    return returned


Real = Separate | Vector


def played(real: Any) -> Real:
    """The environments that somebody has made; raises UserError for anything else."""
    several = real if isinstance(real, Sequence) else [real]
    if unfit := [env for env in several if isinstance(env, type) or not hasattr(env, "step")]:
        raise UserError(f"{unfit[0]!r} is no Gymnasium environment")
    return Vector(several[0]) if hasattr(real, "num_envs") else Separate(several)


# --- spaces -----------------------------------------------------------------------------------------------------------


def bounds(env: Env, real: Real) -> tuple[np.ndarray, np.ndarray]:
    """[act_dim] each, of the actions; raises UserError for what cannot be commanded."""
    low, high = (getattr(real.action, name, None) for name in ("low", "high"))
    if low is None or high is None:
        raise UserError(f"{real.name}: its actions are {real.action}; only a Box can be commanded")
    if low.size != env.act_dim:
        raise UserError(f"{real.name}: takes {low.size} numbers as action, the task {env.name} has {env.act_dim}")
    low, high = (np.asarray(x, np.float64).reshape(-1) for x in (low, high))
    if not (np.abs([low, high]) <= _BOUND).all():
        advice = "wrap it in gymnasium.wrappers.RescaleAction or similar"
        raise UserError(f"{real.name}: its actions have no bounds below {_BOUND:g}; {advice}")
    if (fixed := np.flatnonzero(~(low < high))).size:
        raise UserError(f"{real.name}: number {fixed[0]} of its action can only be {low[fixed[0]]:g}; leave it out")
    return low, high


def reader(measured: tuple[Entry, ...], real: Real) -> Observe:
    """How observations become a vector [measured_dim]; raises UserError where that has to be said."""
    parts, help_ = getattr(real.observation, "spaces", None), "pass observe= to map them"
    sizes = {e.name: e.size for e in measured}
    if isinstance(parts, Mapping):
        seen = {name: int(np.prod(space.shape)) if space.shape is not None else 0 for name, space in parts.items()}
        if seen != sizes:
            raise UserError(f"{real.name}: observes {seen}, the task measures {sizes}; {help_}")
        return functools.partial(_joined, real.name, sizes)
    if not hasattr(real.observation, "low"):
        raise UserError(f"{real.name}: observes {real.observation}, neither a Box nor a Dict of them; {help_}")
    if (n := int(np.prod(real.observation.shape))) != sum(sizes.values()):
        raise UserError(f"{real.name}: observes {n} numbers, the task measures {sum(sizes.values())}: {sizes}; {help_}")
    return lambda obs: obs


def _joined(name: str, sizes: Mapping[str, int], obs: Any) -> np.ndarray:
    """The parts of a Dict, one after another."""
    if not isinstance(obs, Mapping):
        raise UserError(f"{name}: observes a {type(obs).__name__}, not a mapping with {', '.join(sizes)}")
    parts = ((f"{part} of {name}", obs.get(part), size) for part, size in sizes.items())
    return np.concatenate([measured(where, part, size, f"its space has {size}") for where, part, size in parts])
