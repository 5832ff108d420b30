"""Impure: the robot's side of a remote real system. Copy this one file to the robot's computer.

It needs Python 3.9 or newer, numpy, msgpack and websockets, and nothing else of this project. You write a driver,
one of

    class Simulated:                        class Arm:
        obs_size, action_size = 18, 3           obs_size, action_size = 18, 3
        def reset(self, seed): ...              def reset(self, seed): ...     # brings it to a start, returns obs
        def step(self, action): ...             def read(self): ...            # what the sensors say now
        def stop(self): ...                     def send(self, action): ...    # commands the motors, does not wait
                                                def stop(self): ...            # safe, at any time and repeatedly

and call `play(driver, "ws://learner:8765", token=...)`. `step` returns what a Gymnasium environment's does: obs,
reward, terminated, truncated, info. A driver with `read` and `send` is run by the clock: from the first command of an
episode on one step every `period` seconds, and `judge(obs)` may return reward, terminated and success of what was
read. Actions lie in [-1, 1].
"""

from __future__ import annotations

import contextlib
import io
import os
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import connect

VERSION = 2
LIMIT = 64 * 1024  # bytes of a message at most
LARGEST = 1e18  # of a measurement or reward: squares of larger ones are beyond float32
SUCCESS = ("is_success", "success")  # what `info` may call it; the first that says something counts
_REASON = 500  # letters of one at most
_PATIENCE = 10  # late steps in a row that end an episode
_SHAPES: dict[str, dict[str, set[type]]] = {  # what the learner says, and of which types; `messages` has the rest
    "welcome": {},
    "refused": {"reason": {str}, "final": {bool}},
    "reset": {"episode": {int}, "seed": {int}, "steps": {int, type(None)}},
    "act": {"episode": {int}, "step": {int}, "action": {bytes}},
    "rest": {"episode": {int}},
    "end": {},
}


# --- messages ---------------------------------------------------------------------------------------------------------


def pack(kind: str, **fields: Any) -> bytes:
    """A message: a checksum, then a msgpack map. Arrays become little-endian float32."""
    body = _encoded(type=kind, **fields)
    return zlib.crc32(body).to_bytes(4, "little") + body


def unframed(data: Any) -> bytes:
    """The msgpack map of a message; ValueError for what is none of ours, or was damaged on the way."""
    if not isinstance(data, bytes):
        raise ValueError("is text, not bytes")
    if len(data) > LIMIT:
        raise ValueError(f"has {len(data):,} bytes, at most {LIMIT:,} are allowed")
    if len(data) < 5 or zlib.crc32(data[4:]).to_bytes(4, "little") != data[:4]:
        raise ValueError("was damaged on the way")
    return data[4:]


def unpack(data: Any) -> dict[str, Any]:
    """The fields of a message of the learner, with its "type"; ValueError says what is wrong with it."""
    body = unframed(data)
    try:
        fields = msgpack.unpackb(body)
    except Exception as error:  # msgpack raises half a dozen types
        raise ValueError(f"is no msgpack ({type(error).__name__})") from error
    kind = fields.get("type") if isinstance(fields, dict) else None
    if not isinstance(kind, str) or kind not in _SHAPES:
        raise ValueError(f"is of the unknown type {kind!r}")
    for name, types in _SHAPES[kind].items():
        if name not in fields or type(fields[name]) not in types:
            raise ValueError(f"{kind} has no proper {name!r}")
    return fields


def array(data: bytes, size: int, what: str) -> np.ndarray:
    """[size] float32; ValueError where it has another size, or a number that is not finite or beyond `LARGEST`."""
    if len(data) != 4 * size:
        raise ValueError(f"{what} has {len(data) / 4:g} numbers, expected {size}")
    values = np.frombuffer(data, "<f4").astype(np.float32)
    if not (np.abs(values) <= LARGEST).all():  # nan is not
        raise ValueError(f"{what} holds a number that is not finite, or beyond {LARGEST:g}")
    return values


def number(value: Any, what: str) -> float:
    """A number, also as an array of one; nan, which means unknown, for None. ValueError for anything else."""
    return float("nan") if value is None else float(_single(value, what, "a number"))


def flag(value: Any, what: str) -> bool:
    """A truth value, 0 or 1, also as an array of one; ValueError for anything else."""
    if (single := _single(value, what, "true or false")) not in (0, 1):
        raise ValueError(f"{what} is {single!r}, not true or false")
    return bool(single)


def success_of(info: Mapping[str, Any]) -> bool | None:
    """What `info` says of success; None where it says nothing. ValueError where that is no truth value."""
    return next((flag(info[name], f"info[{name!r}]") for name in SUCCESS if info.get(name) is not None), None)


def printable(text: object, length: int = _REASON) -> str:
    """One line that a terminal can show, whoever has written it."""
    line = "".join(letter if letter.isprintable() else " " for letter in str(text)[: 4 * length])
    return line if len(line) <= length else f"{line[: length - 3]}..."


def numbers(value: Any, what: str, wanted: str = "numbers alone") -> np.ndarray:
    """[n], in the type that they came in; ValueError where it is not `wanted`."""
    try:
        values = np.asarray(value).reshape(-1)
    except (TypeError, ValueError, RuntimeError):  # rows of different lengths, a tensor of another device
        values = np.empty(0, object)
    if values.dtype.kind not in "biuf":
        raise ValueError(f"{what} is {printable(repr(value), 60)}, not {wanted}")
    return values


def _single(value: Any, what: str, wanted: str) -> Any:
    values = numbers(value, what, wanted)
    if values.size != 1:
        raise ValueError(f"{what} is {printable(repr(value), 60)}, not {wanted}")
    return values.item()


def _encoded(**fields: Any) -> bytes:
    return msgpack.packb(fields, default=_plain) or b""  # of None, which it never is, only its types speak


def _plain(value: Any) -> Any:
    """What msgpack can hold of NumPy's."""
    return value.astype("<f4").tobytes() if isinstance(value, np.ndarray) else value.item()


# --- playing ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Limits:
    """What the robot may be told. Every command is brought within, also one for a late step; what was sent is reported.

    low, high: of every action, one number for all motors or one for each. change: how far an action may be from the one
    before, at most; low and high come first where they contradict it. workspace: the lowest and the highest value of
    every number that is measured, infinite where any will do. Beyond them the robot is stopped and the episode ends
    there; it cannot begin there either.
    """

    low: float | Sequence[float] = -1.0
    high: float | Sequence[float] = 1.0
    change: float | Sequence[float] = np.inf
    workspace: tuple[Sequence[float], Sequence[float]] | None = None

    def check(self, obs_size: int, action_size: int) -> None:
        """Raises ValueError for a bound of the wrong size, one that is no number, and for one that allows nothing."""
        if self.workspace is not None:
            if [np.shape(bound) for bound in self.workspace] != 2 * [(obs_size,)]:
                bounds = f"a lowest and a highest value for each of {obs_size} measured numbers"
                raise ValueError(f"the workspace needs {bounds}")
            lowest, highest = np.asarray(self.workspace, float)
            if not (lowest <= highest).all():  # nan is not
                raise ValueError("limits: no lowest value of the workspace may be above the highest, and none nan")
        low, high = (_motors(getattr(self, name), action_size, f"limits: {name}") for name in ("low", "high"))
        if not np.isfinite([low, high]).all():
            raise ValueError("limits: low and high need finite numbers, for example -1 and 1")
        if not (low <= high).all():
            raise ValueError("limits: low is above high; swap them")
        if (low > 1).any() or (high < -1).any():
            raise ValueError("limits: low and high allow no action in [-1, 1]")
        if not (_motors(self.change, action_size, "limits: change") > 0).all():
            raise ValueError("limits: change must be above 0; leave it out where any change is allowed")

    def of(self, action: np.ndarray, before: np.ndarray) -> np.ndarray:
        """The nearest action that is allowed. before: the last one sent, zeros at the start of an episode."""
        change = np.asarray(self.change)
        near = np.clip(np.clip(action, before - change, before + change), self.low, self.high)
        return np.clip(near, -1.0, 1.0).astype(np.float32)

    def beyond(self, obs: np.ndarray) -> str:
        """What of a measurement lies beyond the workspace; nothing if all is well."""
        if self.workspace is None:
            return ""
        low, high = (np.asarray(x) for x in self.workspace)
        beyond = np.flatnonzero((obs < low) | (obs > high))
        return f"measured number {beyond[0]} is {obs[beyond[0]]:.4g}, beyond the workspace" if len(beyond) else ""


def _motors(bound: Any, action_size: int, what: str) -> np.ndarray:
    """[action_size], of one number for all motors or one for each; ValueError for anything else."""
    try:
        values = np.asarray(bound, float)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape not in ((), (action_size,)):
        raise ValueError(f"{what} is {bound!r}; give one number, or {action_size} of them, one for each motor")
    return np.full(action_size, values)


class RefusedError(Exception):
    """The learner does not want this robot, and says why."""


def play(
    driver: Any,
    url: str,
    *,
    token: str,
    name: str = "robot",
    period: float | None = None,
    answer_within: float | None = None,
    late: str | Sequence[float] = "hold",
    patience: int = _PATIENCE,
    limits: Limits = Limits(),
    log: str | os.PathLike[str] | None = None,
    retry: float = 1.0,
    say: Callable[[str], None] = print,
) -> dict[str, int]:
    """Plays episodes for a learner until it ends the run; returns how many steps there were and how many were late.

    driver: see the top of this file. url: of the learner. token: it says where that is. period: seconds of a step. A
    driver with `read` and `send` needs it; with `step` it is only compared with the learner's task. answer_within:
    seconds after which a command is too late, default half a period; the first of an episode may take as long as it
    wants, so `reset` must leave the robot where it can wait.
    late: what happens then: "hold" leaves the last command, an action is sent instead, within `limits`. patience: after
    so many late steps in a row the episode ends. These three are refused for a driver with `step`, which waits.
    log: a file to which every command is appended before it is sent. retry: seconds between attempts to connect. say:
    hears one line about everything unusual.

    A lost connection stops the robot; it connects again and goes on with the next episode. Whatever happens, `stop` is
    called before this returns or raises. Raises `RefusedError` if the learner says that the two do not fit; ValueError
    for an argument that cannot be right, before the robot moves; OSError where the log cannot be written, before the
    command is sent; and whatever the driver's `stop` raises.
    """
    sizes = {"obs_size": int(driver.obs_size), "action_size": int(driver.action_size)}
    limits.check(**sizes)
    rhythm = _rhythm(driver, period, answer_within, late, patience)
    robot = _Robot(driver, rhythm, limits, _Log(log), say)
    times = {"period": period and float(period), "answer_within": rhythm and float(rhythm.answer_within)}
    hello = pack("hello", version=VERSION, token=token, robot=name, **sizes, **times)
    try:
        while (lost := _session(robot, url, hello)) is not None:
            driver.stop()
            if (reason := printable(lost)) != robot.absent:
                say(f"no connection to {url} ({reason}); the robot is stopped, trying again")
            robot.absent = reason
            time.sleep(retry)
        return robot.counts
    finally:
        driver.stop()
        robot.log.close()


def _session(robot: _Robot, url: str, hello: bytes) -> Exception | None:
    """Plays over one connection; returns why there is none, or how it was lost; None where the learner ends the run.

    Raises RefusedError if the learner refuses the robot for good, and what goes wrong on this side: another connection
    would not help. The robot stops at once, because closing a connection takes seconds where the other side is gone.
    """
    with contextlib.ExitStack() as stack:
        try:
            socket = stack.enter_context(connect(url, max_size=LIMIT, compression=None, proxy=None, open_timeout=10))
            socket.send(hello)
            answer = unpack(socket.recv(timeout=10))
            if answer["type"] == "refused":
                raise (RefusedError if answer["final"] else ValueError)(printable(answer["reason"]))
        except (ConnectionClosed, InvalidHandshake, OSError, ValueError) as error:  # OSError: also TimeoutError
            return error
        robot.say(f"connected to {url}")
        try:
            robot.serve(socket)
        except ConnectionClosed as error:
            return error
        finally:
            robot.driver.stop()
    return None


@dataclass(frozen=True)
class _Rhythm:
    """instead: what is sent where no command came in time, [action_size]; None leaves the last one."""

    period: float
    answer_within: float
    instead: np.ndarray | None
    patience: int


def _rhythm(
    driver: Any, period: float | None, answer_within: float | None, late: str | Sequence[float], patience: int
) -> _Rhythm | None:
    """The clock of a driver with `send`; None for one with `step`, which waits for its commands.

    Raises ValueError for times that no robot can keep, for no action in `late`, and where one that waits is told what
    to do when it is late.
    """
    hold, size = isinstance(late, str) and late == "hold", int(driver.action_size)
    try:
        instead = None if hold else array(np.asarray(late, "<f4").tobytes(), size, "late")
    except (TypeError, ValueError) as error:
        raise ValueError(f'late is {late!r}; give "hold", or {size} finite numbers') from error
    if period is not None and not 0 < period < np.inf:  # nan is not
        raise ValueError(f"period is {period}; give the seconds of a step, more than 0")
    if not hasattr(driver, "send"):
        chosen = {"answer_within": answer_within is not None, "late": not hold, "patience": patience != _PATIENCE}
        if names := [name for name, is_set in chosen.items() if is_set]:
            waits = "no command is late for a driver with `step`; give it `read` and `send`"
            raise ValueError(f"{', '.join(names)}: {waits}")
        return None
    if period is None:
        raise ValueError("a driver with `send` needs a period, in seconds")
    within = period / 2 if answer_within is None else answer_within
    if not 0 < within <= period:
        raise ValueError(f"answer_within is {within}; give seconds, more than 0 and at most the period of {period}")
    if not patience >= 1:
        raise ValueError(f"patience is {patience}; give a number of steps, 1 or more")
    return _Rhythm(period, within, instead, patience)


class _Log:
    """Commands on disk before they are sent, one msgpack map each; nothing without a path.

    Raises OSError, with what to do, where the file cannot be opened or written.
    """

    def __init__(self, path: str | os.PathLike[str] | None) -> None:
        self._path, self._file = path, None
        if path is not None:
            with self._explained():
                self._file = io.FileIO(os.fspath(path), "ab")

    def write(self, **fields: Any) -> None:
        if self._file is not None:
            line = memoryview(_encoded(**fields))
            with self._explained():
                while line:
                    line = line[self._file.write(line) :]
                os.fsync(self._file.fileno())

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            advice = "the robot is stopped. Make room, or choose another file"
            raise OSError(f"the log {self._path}: {error.strerror}; {advice}") from error


class _Robot:
    """A driver and what it has answered, so that a message that comes twice moves nothing twice.

    Of an episode all answers stay: the first that says how it began, then one for each step, and perhaps how it failed.
    """

    def __init__(
        self, driver: Any, rhythm: _Rhythm | None, limits: Limits, log: _Log, say: Callable[[str], None]
    ) -> None:
        self.driver, self.rhythm, self.limits, self.log, self.say = driver, rhythm, limits, log, say
        self.counts = {"steps": 0, "late": 0}
        self.absent = ""  # why there was no connection, as it was said last
        self._socket: Any = None
        self._episode, self._over = -1, True
        self._answers: list[bytes] = []
        self._failed: bytes | None = None
        self._last = np.zeros(driver.action_size, np.float32)
        self._tick = 0.0
        self._lates, self._most = 0, None  # _most: steps after which an episode is over, whether it is told so or not

    def serve(self, socket: Any) -> None:
        """Answers until the learner ends the run."""
        self._socket, self.absent, self._over = socket, "", True  # an episode of another connection is over
        while True:
            message = self._next()
            if message is None:  # no command came in time
                assert self.rhythm is not None
                self._move(self._last if self.rhythm.instead is None else self.rhythm.instead, late=True)
            elif message["type"] == "end":
                return
            elif message["type"] == "rest":
                if message["episode"] == self._episode:  # a late one of an episode before must not end this one
                    self._stop()
                self._send(pack("rested", episode=message["episode"]))
            elif message["type"] == "reset":
                self._reset(message)
            elif message["type"] == "act":
                self._act(message)

    def _next(self) -> Mapping[str, Any] | None:
        """The next message; None where the clock says that it is too late for one."""
        while True:
            wait = None
            if self.rhythm is not None and not self._over and len(self._answers) > 1:  # the first command is there
                wait = max(self._tick + self.rhythm.answer_within - time.monotonic(), 1e-3)
            try:
                return unpack(self._socket.recv(timeout=wait))
            except TimeoutError:
                return None
            except ValueError as error:
                self.say(f"ignored: a message of the learner {printable(error)}")

    def _send(self, message: bytes) -> None:
        """Sends; a connection that is closed says so when it is read, after what came before its end."""
        with contextlib.suppress(ConnectionClosed):
            self._socket.send(message)

    def _stop(self) -> None:
        self._over = True
        self.driver.stop()

    def _reset(self, message: Mapping[str, Any]) -> None:
        if message["episode"] == self._episode and not self._over:
            self._send(self._answers[0])  # the learner has not heard it
            return
        self.driver.stop()
        self._episode, self._most, self._over, self._lates = message["episode"], message["steps"], False, 0
        self._answers, self._failed = [], None
        self._last = np.zeros(self.driver.action_size, np.float32)
        try:
            obs = self._checked(self.driver.reset(message["seed"]))
            if beyond := self.limits.beyond(obs):
                raise ValueError(beyond)
        except Exception as error:
            self._fail(error)
        else:
            self._tell("began", obs=obs)

    def _act(self, message: Mapping[str, Any]) -> None:
        step, done = message["step"], len(self._answers) - 1
        if message["episode"] != self._episode:
            return
        if 0 <= step < done:
            self._send(self._answers[step + 1])  # too late, or heard already: what happened is said again
        elif self._failed is not None:
            self._send(self._failed)
        elif step == done and not self._over:
            try:
                action = array(message["action"], self.driver.action_size, "an action")
            except ValueError as error:
                self._fail(error)
            else:
                self._move(action, late=False)

    def _tell(self, kind: str, **fields: Any) -> None:
        self._answers.append(pack(kind, episode=self._episode, **fields))
        self._send(self._answers[-1])

    def _move(self, wanted: np.ndarray, *, late: bool) -> None:
        """A step with the nearest command that is allowed. Nothing reaches the driver but through here."""
        action = self.limits.of(wanted, self._last)
        step = len(self._answers) - 1
        if step == 0:
            self._tick = time.monotonic()
        when = {"time": time.time(), "clock": time.monotonic()}
        self.log.write(episode=self._episode, step=step, action=action, late=late, **when)
        try:
            sent = action.copy()  # the driver may change its array; what is reported and stored stays
            moved = self._outcome(self._by_clock(sent, late=late) if self.rhythm else self.driver.step(sent))
        except Exception as error:
            self._fail(error)
            return
        self._last = action
        self._lates = self._lates + 1 if late else 0
        self.counts["steps"] += 1
        self.counts["late"] += late
        if self.rhythm and self._lates >= self.rhythm.patience:
            self.say(f"{self._lates} steps in a row without a command in time; the episode ends here")
            moved["truncated"] = True
        if beyond := self.limits.beyond(moved["obs"]):
            self.say(f"{beyond}; the robot is stopped, the episode ends here")
            moved["truncated"] = True
        moved["truncated"] |= self._most is not None and step + 1 >= self._most
        if moved["terminated"] or moved["truncated"]:
            self._stop()
        self._tell("moved", step=step, sent=action, late=late, **moved)

    def _by_clock(self, action: np.ndarray, *, late: bool) -> tuple[Any, ...]:
        """Sends, waits for the end of the period, reads. The clock goes on from where it should be, not from now."""
        assert self.rhythm is not None
        if not late or self.rhythm.instead is not None:
            self.driver.send(action)
        self._tick += self.rhythm.period
        time.sleep(max(self._tick - time.monotonic(), 0.0))
        self._tick = max(self._tick, time.monotonic() - self.rhythm.period)  # what was lost is not caught up
        obs = self._checked(self.driver.read())
        judge = getattr(self.driver, "judge", None)
        reward, terminated, success = (None, False, None) if judge is None else judge(obs)
        return obs, reward, terminated, False, {"success": success}

    def _outcome(self, returned: Any) -> dict[str, Any]:
        """What a step led to, as the fields of a message; raises where it is not what a driver should return."""
        if not isinstance(returned, tuple) or len(returned) != 5:
            raise TypeError("step does not return obs, reward, terminated, truncated, info")
        obs, reward, terminated, truncated, info = returned
        earned = {"obs": self._checked(obs), "reward": number(reward, "reward")}
        ends = {"terminated": flag(terminated, "terminated"), "truncated": flag(truncated, "truncated")}
        return {**earned, **ends, "success": success_of(info or {})}

    def _checked(self, obs: Any) -> np.ndarray:
        with np.errstate(over="ignore"):
            values = numbers(obs, "an observation").astype("<f4")
        return array(values.tobytes(), self.driver.obs_size, "an observation")

    def _fail(self, error: Exception) -> None:
        self._stop()
        reason = printable(f"{type(error).__name__}: {error}")
        self.say(f"the robot is stopped: {reason}")
        self._failed = pack("failed", episode=self._episode, reason=reason)
        self._send(self._failed)
