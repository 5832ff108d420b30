"""What a learner hears from a robot: a schema for every message. What it says itself, `robot_client` checks."""

import contextlib
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from envs.files import Count, Positive, Size
from sgft_jax.systems.robot_client import VERSION, printable, unframed

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
        with contextlib.suppress(msgspec.MsgspecError):  # before the other fields of a greeting: they may be others
            if (version := _VERSION.decode(body).version) != VERSION:
                versions = f"the robot has {version}, the learner {VERSION}"
                raise VersionError(f"protocol version: {versions}; give both the same robot_client.py")
        return _MESSAGE.decode(body)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"does not fit the protocol ({printable(error, 120)})") from None
