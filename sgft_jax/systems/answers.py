"""The one checked way in for what an environment returns or a robot says, whatever its kind.

A number may be Python's, NumPy's or an array of one, `info` may be None, and None means that something is not known.
Anything else raises UserError: one line with the environment, its method, and the value.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from envs.files import Count, Positive, Size
from envs.types import UserError
from sgft_jax.systems.robot_client import (
    LARGEST,
    SUCCESS,
    VERSION,
    flag,
    number,
    numbers,
    printable,
    success_of,
    unframed,
)

_PARTS = {"reset": ("observation", "info"), "step": ("observation", "reward", "terminated", "truncated", "info")}
_KNOWN = (*SUCCESS, "invalid", "late", "sent", "final_obs", "final_info")  # of `info`
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


def parts(name: str, method: str, returned: Any) -> tuple[Any, ...]:
    """What a method returns, if it is a tuple of as many parts as it should be."""
    wanted = _PARTS[method]
    if not isinstance(returned, tuple) or len(returned) != len(wanted):
        count = f"{len(returned)} values" if isinstance(returned, tuple) else f"a {type(returned).__name__}"
        raise UserError(f"{method} of {name}: returns {count}, not {', '.join(wanted)}")
    return returned


def step(name: str, returned: tuple[Any, ...], low: np.ndarray, high: np.ndarray) -> Answer:
    """The answer to a step, see `parts`. low, high: [act_dim] bounds of what can have been sent."""
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


@contextmanager
def _explained(where: str) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise UserError(f"{where}: {error}") from None


# --- what a robot says ------------------------------------------------------------------------------------------------


Seconds = Annotated[Positive, Meta(le=3600)]


class Hello(msgspec.Struct, tag_field="type", tag="hello"):
    """The first message. period, answer_within: see `robot_client.play`; None without a clock."""

    version: int
    token: str
    robot: str
    obs_size: Size
    action_size: Size
    period: float | None  # compared with that of the task
    answer_within: Seconds | None


class Began(msgspec.Struct, tag_field="type", tag="began"):
    """The start of an episode. obs: float32."""

    episode: Count
    obs: bytes


class Moved(msgspec.Struct, tag_field="type", tag="moved"):
    """The outcome of a step. sent, obs: float32. reward, success: None where the robot does not know."""

    episode: Count
    step: Count
    sent: bytes
    obs: bytes
    reward: float | None
    terminated: bool
    truncated: bool
    success: bool | None
    late: bool


class Rested(msgspec.Struct, tag_field="type", tag="rested"):
    """The robot has stopped, as it was told."""

    episode: Count


class Failed(msgspec.Struct, tag_field="type", tag="failed"):
    """The robot has stopped because its driver has failed."""

    episode: Count
    reason: str


Message = Hello | Began | Moved | Rested | Failed


class _Version(msgspec.Struct, tag_field="type", tag="hello"):
    version: int


_MESSAGE, _VERSION = (msgspec.msgpack.Decoder(kind) for kind in (Message, _Version))


class VersionError(ValueError):
    """The robot speaks another version of the protocol than the learner."""


def read(data: Any) -> Message:
    """A message of a robot; ValueError says what is wrong with it."""
    body = unframed(data)
    try:
        with suppress(msgspec.MsgspecError):  # before the other fields of a greeting: they may be others
            if (version := _VERSION.decode(body).version) != VERSION:
                versions = f"the robot has {version}, the learner {VERSION}"
                raise VersionError(f"protocol version: {versions}; give both the same robot_client.py")
        return _MESSAGE.decode(body)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"does not fit the protocol ({printable(error, 120)})") from None
