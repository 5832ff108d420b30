"""Impure: a real system behind a socket. The robot's side is `robot_client`, one file that is copied to the robot.

The learner listens, the robot connects. Every step is asked for by number until its outcome has come, and the robot
answers a number that it has done already without moving again: so a message that is lost, damaged or doubled costs
time and nothing else. A step whose outcome never came, because robot or connection died, is in doubt: it ends its
episode and is not learned from.
"""

import contextlib
import hmac
import ipaddress
import math
import queue
import secrets
import socket
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from envs.types import UserError
from sgft_jax.systems.door import Door, url
from sgft_jax.systems.messages import Began, Failed, Hello, Message, Moved, Rested, VersionError, read
from sgft_jax.systems.robot_client import LIMIT, array, pack, printable

__all__ = ["Remote"]

_HELLO = 10.0  # seconds for the first message
_RESTS = 5  # times a robot is told to rest before it is left alone: without commands it stops by itself
_FAILURES = 5  # episodes in a row in which a driver fails before its first step is done; then it is not asked again
_SAME = 0.01  # share by which two periods may differ: 0.033 s is 1 / 30 s
_SAY_EVERY = 10.0  # seconds between two lines about refused connections, and about messages that are ignored
_LINE, _NAME = 600, 40  # letters of a line, and of a robot's name, at most
_WAITING = 64  # answers that nobody has asked for yet; more are lost, and asked for again
_ROUNDING = 1e-6
_SERVER: dict[str, Any] = {"max_size": LIMIT, "max_queue": 16, "compression": None, "open_timeout": _HELLO}


def _box(size: int, bound: float) -> SimpleNamespace:
    """What a Gymnasium space says of numbers [size] from -bound to bound."""
    high = np.full(size, bound, np.float32)
    return SimpleNamespace(low=-high, high=high, shape=high.shape, dtype=high.dtype)


class _Link(NamedTuple):
    """A connection, and the answers that came through it; behind the last one stands None."""

    connection: ServerConnection
    inbox: queue.SimpleQueue[Message | None]

    def send(self, message: bytes) -> None:
        """Sends; that a connection is closed is said by the thread that reads it."""
        with contextlib.suppress(ConnectionClosed):
            self.connection.send(message)

    def put(self, message: Message) -> None:
        """Another answer, unless very many have not been read."""
        if self.inbox.qsize() < _WAITING:
            self.inbox.put(message)


class _Seldom:
    """Says one line of a kind, but not one for each of very many."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._lock, self._unsaid, self._last = say, threading.Lock(), 0, -_SAY_EVERY

    def __call__(self, line: str) -> None:
        with self._lock:
            now, others = time.monotonic(), self._unsaid
            if now - self._last < _SAY_EVERY:
                self._unsaid += 1
                return
            self._unsaid, self._last = 0, now
        self._say(line + (f" ({others} others before it)" if others else ""))


class Remote:
    """One robot, at whatever computer, in the manner of a Gymnasium environment; waits for it as long as it takes.

    Rewards are nan where the robot does not know them. `info` of a step has "sent", what the robot was really told
    [action_size]; "late", if no command came in time; "is_success", if the robot knows; and "invalid" where the outcome
    is in doubt: that step is not to be learned from.

    obs_size, action_size: of the task; a robot with others is refused. period: seconds of a step of the task,
    `env.control_dt`; a robot that says another is refused, and without it none is. steps: after so many the robot ends
    an episode by itself, so that it does not go on when messages are lost. host: interface to listen at, default this
    computer alone. port: 0 chooses a free one. token: what the robot must know, default a fresh one. token_in: where
    people find it, because it is never printed. again: seconds after which an unanswered message is repeated. say:
    hears one line about everything unusual. waits() -> what is entered while there is no robot.
    Raises UserError where one cannot listen there, and for sizes and times that cannot be.
    """

    def __init__(
        self,
        obs_size: int,
        action_size: int,
        *,
        period: float | None = None,
        steps: int | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        token_in: str = "the attribute `token`",
        again: float = 1.0,
        say: Callable[[str], None] = print,
        waits: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext,
    ) -> None:
        if not (obs_size > 0 < action_size and 0 < again < math.inf and (steps is None or steps > 0)):
            raise UserError("Remote: sizes, steps and `again` must be more than 0")
        if period is not None and not 0 < period < math.inf:
            raise UserError(f"Remote: a step cannot take {period} seconds")
        self._period, self._steps = period, steps
        self.obs_size, self.action_size, self.token = obs_size, action_size, token or secrets.token_hex(16)
        self._waits = waits
        self._again, self._say, self._token_in = again, lambda line: say(printable(line, _LINE)), token_in
        self._refused, self._ignored = _Seldom(self._say), _Seldom(self._say)
        self._lock, self._connected = threading.Lock(), threading.Event()
        self._link: _Link | None = None  # to the robot that is connected now
        self._played: _Link | None = None  # to the one that began the episode: no other knows its steps
        self._episode, self._step, self._failures, self._reason = 0, 0, 0, ""
        self._obs = np.zeros(obs_size, np.float32)
        self.answer_within: float | None = None  # seconds in which the connected robot wants a command
        self.observation_space, self.action_space = _box(obs_size, math.inf), _box(action_size, 1.0)
        self.spec, self.unwrapped = None, self
        self._host, self._door = host, Door(host, port)
        self._server = serve(self._serve, sock=self._door, origins=[None], **_SERVER)
        self.url = url(host, self._door.port)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def reset(self, *, seed: int) -> tuple[np.ndarray, dict[str, Any]]:
        """Has the robot begin an episode; returns what it measures, [obs_size], and nothing else.

        Raises UserError where its driver has failed again and again.
        """
        pause = 0.0
        while self._failures < _FAILURES:
            time.sleep(pause)  # a robot that cannot begin now may be able to later
            self._played = self._wait()
            self._episode, self._step = self._episode + 1, 0
            began = self._ask(pack("reset", episode=self._episode, seed=seed, steps=self._steps), Began)
            if began is not None:
                return self._obs, {}
            pause = self._again * 2 ** max(self._failures - 1, 0)
        advice = "mend it, nothing is lost: the same command with --resume goes on"
        raise UserError(f"{self}: its driver has failed {self._failures} times in a row: {self._reason}; {advice}")

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Has the robot take a step: obs, reward, terminated, truncated, info. action: [action_size] in [-1, 1]."""
        message = pack("act", episode=self._episode, step=self._step, action=np.asarray(action))
        moved = self._ask(message, Moved)
        if moved is None:
            return self._obs, float("nan"), False, True, {"invalid": True}
        self._step, self._failures = self._step + 1, 0
        reward = float("nan") if moved.reward is None else moved.reward
        info = {"sent": self._sent, "late": moved.late, "is_success": moved.success}
        return self._obs, reward, moved.terminated, moved.truncated, info

    def rest(self) -> None:
        """Stops the robot until the next episode; waits a moment for its answer."""
        if self._played is not None:
            self._ask(pack("rest", episode=self._episode), Rested, tries=_RESTS)

    def __str__(self) -> str:
        return f"robot at {self.url}"

    def close(self) -> None:
        """Ends the run on both sides."""
        if (link := self._link) is not None:
            link.send(pack("end"))
        self.leave()

    def leave(self) -> None:
        """Ends it on this side; the robot stops, and waits until somebody goes on with the run."""
        self._server.shutdown()
        self._thread.join()

    # ------------------------------------------------------------ asking

    def _wait(self) -> _Link:
        """The link to a robot, once there is one."""
        while not self._connected.is_set() or (link := self._link) is None:
            self._say(f"waiting for a robot at {self.url}; its token is in {self._token_in}")
            with self._waits():
                self._connected.wait()
        return link

    def _ask[T: (Began, Moved, Rested)](self, message: bytes, kind: type[T], tries: int | None = None) -> T | None:
        """The answer to a message of this episode and step; None if the robot is gone or has failed.

        tries: how often it is said at most.
        """
        assert self._played is not None, "call reset first"
        link, due = self._played, 0.0
        while True:
            now = time.monotonic()
            if now >= due:  # other messages may come all the time
                if tries is not None and (tries := tries - 1) < 0:
                    return None
                link.send(message)
                due = now + self._again
            try:
                answer = link.inbox.get(timeout=max(due - now, 0.0))
            except queue.Empty:
                continue
            if answer is None:
                link.inbox.put(None)  # it stays the last one
                if kind is not Rested:
                    self._say(f"the robot is gone in episode {self._episode} before the outcome of step {self._step}")
                return None
            if isinstance(answer, Hello) or answer.episode != self._episode:
                continue  # of before
            if isinstance(answer, Failed) and kind is not Rested:
                return self._fail(f"the robot has stopped: {answer.reason}")
            if isinstance(answer, kind) and getattr(answer, "step", self._step) == self._step:
                try:
                    self._read(answer)
                except ValueError as error:
                    return self._fail(f"the robot's {kind.__name__.lower()} of step {self._step}: {error}")
                return answer

    def _fail(self, reason: str) -> None:
        self._failures, self._reason = self._failures + 1, reason
        self._say(reason)

    def _read(self, answer: Began | Moved | Rested) -> None:
        """Keeps the arrays of an answer; ValueError for wrong sizes and numbers."""
        if isinstance(answer, Moved):
            sent = array(answer.sent, self.action_size, "sent")
            if (np.abs(sent) > 1 + _ROUNDING).any():
                raise ValueError("sent holds a command beyond [-1, 1]")
            self._sent = sent
        if not isinstance(answer, Rested):
            self._obs = array(answer.obs, self.obs_size, "obs")

    # ------------------------------------------------------------ the server's threads

    def _serve(self, connection: ServerConnection) -> None:
        """One connection, from its first message to its end."""
        link = _Link(connection, queue.SimpleQueue())
        if (refusal := self._admit(link)) is not None:
            reason, final = printable(refusal[0], _LINE), refusal[1]
            self._refused(f"refused a connection: {reason}")
            link.send(pack("refused", reason=reason, final=final))
            return
        try:
            link.send(pack("welcome"))
            self._connected.set()
            for data in connection:
                try:
                    link.put(read(data))
                except ValueError as error:
                    self._ignored(f"ignored: a message of the robot {error}")
        except ConnectionClosed:
            pass
        finally:
            link.inbox.put(None)
            with self._lock:
                self._connected.clear()
                self._link = None

    def _admit(self, link: _Link) -> tuple[str, bool] | None:
        """Takes a robot that fits as the one robot; else says why not, and whether it need not try again."""
        try:
            hello = read(link.connection.recv(timeout=_HELLO))
        except VersionError as error:
            return str(error), True
        except (ValueError, TimeoutError) as error:
            return f"its first message {error or 'did not come'}", False
        except ConnectionClosed:
            return "it was closed before its first message", False
        if not isinstance(hello, Hello):
            return f"its first message is {type(hello).__name__.lower()}, not hello", True
        if (name := self._foreign(link.connection)) is not None:
            return f"it asked for the host {name!r}; connect to {self.url}, or to an address", True
        if not hmac.compare_digest(hello.token.encode(), self.token.encode()):
            return "wrong token", True
        robot = printable(hello.robot, _NAME)
        if (difference := self._difference(hello)) is not None:
            return f"{robot}: {difference}", True
        with self._lock:
            if self._link is not None:  # perhaps it is the same one, and its lost connection has not been noticed yet
                return f"{robot}: another robot is connected", False
            self._link, self.answer_within = link, hello.answer_within
        self._door.admit(link.connection.socket)
        return None

    def _foreign(self, connection: ServerConnection) -> str | None:
        """The name that a connection was made to, if it is none of this computer's: a web page may have made it up."""
        headers = connection.request.headers.get_all("Host") if connection.request else []
        try:
            (host,) = headers
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:  # none, or several
            name = ""
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name)
            return None
        known = {self._host, "localhost", socket.gethostname(), socket.gethostname().partition(".")[0]}
        plain = name.removesuffix(".").removesuffix(".local")
        return None if {name, plain} & {other.lower() for other in known} else name

    def _difference(self, hello: Hello) -> str | None:
        """What of a robot does not fit, if anything."""
        period, sizes = hello.period, (hello.obs_size, hello.action_size)
        wanted = {"numbers measured": self.obs_size, "numbers commanded": self.action_size}
        for (name, ours), theirs in zip(wanted.items(), sizes, strict=True):
            if ours != theirs:
                return f"{name}: the robot has {theirs}, the learner {ours}"
        if period is not None and self._period is not None and not math.isclose(period, self._period, rel_tol=_SAME):
            seconds = f"the robot has {period:g}, the learner's task {self._period:g}"
            return f"seconds of a step: {seconds}; change the period of the robot, or the task"
        if period is not None and not 0 < period < math.inf:
            return f"seconds of a step: the robot has {period:g}, which cannot be"
        if hello.answer_within is not None and not (period and hello.answer_within <= period):
            return f"answer_within is {hello.answer_within:g}: give at most the period, {period} s"
        return None
