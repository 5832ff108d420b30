"""Impure: a real system behind a socket. The robot's side is `robot_client`, one file that is copied to the robot.

The learner listens, the robot connects. Every step is asked for by number until its outcome has come, and the robot
answers a number that it has done already without moving again: so a message that is lost, damaged or doubled costs
time and nothing else. A step whose outcome never came, because robot or connection died, is in doubt: it ends its
episode and is not learned from.
"""

import contextlib
import hmac
import math
import queue
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from sgft_jax.systems.robot_client import LIMIT, VersionError, array, pack, unpack
from sgft_jax.types import UserError

_HELLO = 10.0  # seconds for the first message
_RESTS = 5  # times a robot is told to rest before it is left alone: without commands it stops by itself
_SAME = 0.01  # share by which two periods may differ: 0.033 s is 1 / 30 s
_SAY_EVERY = 10.0  # seconds between two lines about refused connections
_GONE = {"type": "gone"}


class Box(NamedTuple):
    """Bounds of numbers, as a Gymnasium space names them. low, high: [n]."""

    low: np.ndarray
    high: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        """(n,)"""
        return self.low.shape

    @property
    def dtype(self) -> np.dtype:
        """That of the bounds."""
        return self.low.dtype


class _Refusal(NamedTuple):
    """Why a robot is not taken. final: it need not try again."""

    reason: str
    final: bool


class _Link(NamedTuple):
    """A connection that was admitted, and the answers that came through it; the last one is `_GONE`."""

    connection: ServerConnection
    inbox: queue.SimpleQueue[Mapping[str, Any]]

    def send(self, message: bytes) -> None:
        """Sends; that a connection is closed is said by the thread that reads it."""
        with contextlib.suppress(ConnectionClosed):
            self.connection.send(message)


class Remote:
    """One robot, at whatever computer, in the manner of a Gymnasium environment; waits for it as long as it takes.

    Rewards are nan where the robot does not know them. `info` of a step has "sent", what the robot was really told
    [action_size]; "late", if no command came in time; "is_success", if the robot knows; and "invalid" where the outcome
    is in doubt: that step is not to be learned from.

    obs_size, action_size: of the task; a robot with others is refused. period: seconds of a step of the task,
    `env.control_dt`; a robot that says another is refused, and without it none is. steps: after so many the robot ends
    an episode by itself, so that it does not go on when messages are lost. host: interface to listen at, default this
    computer alone. port: 0 chooses a free one. token: what the robot must know, default a fresh one. again: seconds
    after which an unanswered message is repeated. say: hears one line about everything unusual.
    Raises UserError where the port is taken.
    """

    def __init__(
        self, obs_size: int, action_size: int, *, period: float | None = None, steps: int | None = None,
        host: str = "127.0.0.1", port: int = 0, token: str | None = None, again: float = 1.0,
        say: Callable[[str], None] = print,
    ) -> None:  # fmt: skip
        self._period, self._steps = period, steps
        self.obs_size, self.action_size, self.token = obs_size, action_size, token or secrets.token_hex(16)
        self._again, self._say = again, say
        self._lock, self._there = threading.Lock(), threading.Event()
        self._link: _Link | None = None  # to the robot that is connected now
        self._played: _Link | None = None  # to the one that began the episode: no other knows its steps
        self._refused, self._said = 0, -_SAY_EVERY  # connections since the last line about them, and when that was
        self._episode, self._step = 0, 0
        self._obs = np.zeros(obs_size, np.float32)
        self.answer_within: float | None = None  # seconds in which the connected robot wants a command
        self.observation_space = Box(*(x * np.full(obs_size, np.inf, np.float32) for x in (-1, 1)))
        self.action_space = Box(*(x * np.ones(action_size, np.float32) for x in (-1, 1)))
        self.spec, self.unwrapped = None, self
        try:
            self._server = serve(
                self._serve, host, port, max_size=LIMIT, max_queue=16, compression=None, open_timeout=_HELLO
            )
        except OSError as error:
            raise UserError(f"cannot listen at {host}:{port} ({error.strerror}); choose another port") from error
        self.url = "ws://{}:{}".format(*self._server.socket.getsockname()[:2])
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def reset(self, *, seed: int) -> tuple[np.ndarray, dict[str, Any]]:
        """Has the robot begin an episode; returns what it measures, [obs_size], and nothing else."""
        while True:
            self._played = self._wait()
            self._episode, self._step = self._episode + 1, 0
            said = self._ask(pack("reset", episode=self._episode, seed=seed, steps=self._steps), "began")
            if said is not None:
                self._obs = said["obs"]
                return self._obs, {}
            time.sleep(self._again)  # a robot that cannot begin now may be able to later

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Has the robot take a step: obs, reward, terminated, truncated, info. action: [action_size] in [-1, 1]."""
        said = self._ask(pack("act", episode=self._episode, step=self._step, action=np.asarray(action)), "moved")
        if said is None:
            return self._obs, float("nan"), False, True, {"invalid": True}
        self._step += 1
        self._obs = said["obs"]
        reward = float("nan") if said["reward"] is None else said["reward"]
        info = {"sent": said["sent"], "late": said["late"]}
        if said["success"] is not None:
            info["is_success"] = said["success"]
        return self._obs, reward, said["terminated"], said["truncated"], info

    def rest(self) -> None:
        """Stops the robot until the next episode; waits a moment for its answer."""
        if self._played is not None:
            self._ask(pack("rest", episode=self._episode), "rested", tries=_RESTS)

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
        while not self._there.is_set() or (link := self._link) is None:
            self._say(f"waiting for a robot at {self.url}, token {self.token}")
            self._there.wait()
        return link

    def _ask(self, message: bytes, answer: str, tries: int | None = None) -> Mapping[str, Any] | None:
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
                said = link.inbox.get(timeout=max(due - now, 0.0))
            except queue.Empty:
                continue
            if said is _GONE:
                link.inbox.put(_GONE)  # it stays the last one
                if answer != "rested":
                    self._say(f"the robot is gone in episode {self._episode} before the outcome of step {self._step}")
                return None
            if said["episode"] != self._episode:
                continue  # of before
            if said["type"] == "failed" and answer != "rested":
                self._say(f"the robot has stopped: {said['reason']}")
                return None
            if said["type"] == answer and said.get("step", self._step) == self._step:
                try:
                    return self._read(said)
                except ValueError as error:
                    self._say(f"the robot's {answer} of step {self._step}: {error}")
                    return None

    def _read(self, said: Mapping[str, Any]) -> Mapping[str, Any]:
        """With its arrays as arrays; ValueError for wrong sizes and numbers."""
        sizes = {"obs": self.obs_size, "sent": self.action_size}
        return {**said, **{name: array(said[name], n, name) for name, n in sizes.items() if name in said}}

    # ------------------------------------------------------------ the server's threads

    def _serve(self, connection: ServerConnection) -> None:
        """One connection, from its first message to its end."""
        link = _Link(connection, queue.SimpleQueue())
        refusal = self._admit(link)
        if refusal is not None:
            self._say_refused(refusal.reason)
            link.send(pack("refused", reason=refusal.reason[:500], final=refusal.final))
            return
        try:
            link.send(pack("welcome"))
            self._there.set()
            for data in connection:
                try:
                    message = unpack(data)
                except ValueError as error:
                    self._say(f"ignored: a message of the robot {error}")
                    continue
                if message["type"] in ("began", "moved", "rested", "failed"):
                    link.inbox.put(message)
        except ConnectionClosed:
            pass
        finally:
            link.inbox.put(_GONE)
            with self._lock:
                self._there.clear()
                self._link = None

    def _say_refused(self, reason: str) -> None:
        """One line, but not one for each of very many."""
        with self._lock:
            self._refused += 1
            now, count = time.monotonic(), self._refused
            if now - self._said < _SAY_EVERY:
                return
            self._refused, self._said = 0, now
        more = f" ({count - 1} others before it)" if count > 1 else ""
        self._say(f"refused a connection: {reason}{more}")

    def _admit(self, link: _Link) -> _Refusal | None:
        """Takes a robot that fits as the one robot; else says why not."""
        try:
            said = unpack(link.connection.recv(timeout=_HELLO))
        except VersionError as error:
            return _Refusal(str(error), final=True)
        except (ValueError, TimeoutError) as error:
            return _Refusal(f"its first message {error or 'did not come'}", final=False)
        except ConnectionClosed:
            return _Refusal("it was closed before its first message", final=False)
        if said["type"] != "hello":
            return _Refusal(f"its first message is {said['type']}, not hello", final=True)
        if not hmac.compare_digest(said["token"].encode(), self.token.encode()):
            return _Refusal("wrong token", final=True)
        for name, own, theirs in (
            ("numbers measured", self.obs_size, said["obs_size"]),
            ("numbers commanded", self.action_size, said["action_size"]),
        ):
            if own != theirs:
                return _Refusal(f"{said['robot']}: {name}: the robot has {theirs}, the learner {own}", final=True)
        if not _same(self._period, said["period"]):
            return _Refusal(
                f"{said['robot']}: seconds of a step: the robot has {said['period']:g}, the learner's task "
                f"{self._period:g}; change the period of the robot, or the task",
                final=True,
            )
        with self._lock:
            if self._link is not None:  # perhaps it is the same one, and its lost connection has not been noticed yet
                return _Refusal(f"{said['robot']}: another robot is connected", final=False)
            self._link, self.answer_within = link, said["answer_within"]
        return None


def _same(own: float | None, theirs: float | None) -> bool:
    """Whether two periods, in seconds, are the same, as far as both are known."""
    return own is None or theirs is None or math.isclose(own, theirs, rel_tol=_SAME)
