"""Impure: a bad network between robot and learner, and strangers who talk to the learner."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.sync.server import serve

from experiments.runner.real_systems import free_port
from experiments.studies.reliable.trial import Trial, late_share
from sgft_jax.systems.robot_client import VERSION, pack

_DROPPED, _DELAYED, _DAMAGED = 0.1, 0.05, 0.02  # shares of the messages
_DELAY = 0.05, 2.0  # s, from least to most
_PERIOD = 0.2  # s, of the robot's clock
_FRAMES = 10_000  # of nonsense
_RATE, _KNOCKING = 100.0, 10.0  # connections with a wrong token in a second, for so many seconds


@contextlib.contextmanager
def _proxy(port: int, luck: np.random.Generator) -> Iterator[tuple[int, dict[str, int]]]:
    """(A port that leads to the learner's, what became of messages): it drops, delays and damages some both ways."""
    between, counts = free_port(), {"messages": 0, "dropped": 0, "delayed": 0, "damaged": 0}

    def lead_on(near: Connection) -> None:
        with _quietly(), connect(f"ws://127.0.0.1:{port}", compression=None, proxy=None) as far:
            threading.Thread(target=pump, args=(far, near), daemon=True).start()
            pump(near, far)
        near.close()

    def pump(source: Connection, sink: Connection) -> None:
        with contextlib.suppress(ConnectionClosed):
            for message in source:
                _pass(message, sink, luck, counts)
        sink.close()

    with serve(lead_on, "127.0.0.1", between, compression=None) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield between, counts


def _pass(message: str | bytes, sink: Connection, luck: np.random.Generator, counts: dict[str, int]) -> None:
    counts["messages"] += 1
    if luck.uniform() < _DROPPED:
        counts["dropped"] += 1
        return
    if isinstance(message, bytes) and luck.uniform() < _DAMAGED:
        counts["damaged"] += 1
        at = int(luck.integers(len(message)))
        message = message[:at] + bytes([message[at] ^ 255]) + message[at + 1 :]
    if luck.uniform() < _DELAYED:
        counts["delayed"] += 1
        threading.Timer(luck.uniform(*_DELAY), _send, (sink, message)).start()
        return
    _send(sink, message)


def bad_network(home: Path, *, seed: int, rollouts: int) -> dict[str, Any]:
    """A run through the proxy; what became of it."""
    luck = np.random.default_rng(seed)
    with Trial(home, period=_PERIOD, rollouts=rollouts) as trial, _proxy(trial.port, luck) as (trial.via, counts):
        trial.start()
        trial.finish()
    return {**counts, **trial.audit(), "late": late_share(home / "commands.log")}


def strangers(home: Path, *, seed: int, rollouts: int) -> dict[str, Any]:
    """A run while strangers connect, with nonsense and with a wrong token; what became of it."""
    with Trial(home, period=_PERIOD, rollouts=rollouts) as trial:
        trial.start()
        trial.wait_for_motion()
        _talk_nonsense(trial.port, np.random.default_rng(seed))
        knocked = _knock(trial.port)
        trial.finish()
    lines = sum("refused a connection" in line for line in trial.player_lines())
    counts = {"frames": _FRAMES, "connections": knocked, "lines about them": lines}
    return {**counts, **trial.audit(), "late": late_share(home / "commands.log")}


def _talk_nonsense(port: int, luck: np.random.Generator) -> None:
    """Frames of random or truncated bytes: half of them no WebSocket at all."""
    good = _hello("x")
    for i in range(_FRAMES):
        cut = luck.uniform() < 0.5
        data = good[: luck.integers(1, len(good))] if cut else luck.bytes(int(luck.integers(1, 300)))
        with _quietly():
            if i % 2:
                with socket.create_connection(("127.0.0.1", port), timeout=2) as raw:
                    raw.sendall(data)
            else:
                with connect(f"ws://127.0.0.1:{port}", compression=None, proxy=None, open_timeout=2) as one:
                    one.send(data)


def _knock(port: int) -> int:
    """Connections with a wrong token; returns how many there were."""
    start, count = time.monotonic(), 0
    hello = _hello("guess")
    while (now := time.monotonic()) < start + _KNOCKING:
        with _quietly(), connect(f"ws://127.0.0.1:{port}", compression=None, proxy=None, open_timeout=2) as one:
            one.send(hello)
        count += 1
        time.sleep(max(start + count / _RATE - now, 0.0))
    return count


def _hello(token: str) -> bytes:
    """The first message of a robot that would fit the task, if it knew the token."""
    return pack(
        "hello", version=VERSION, token=token, robot="r", obs_size=3, action_size=1, period=None, answer_within=None
    )


def _quietly() -> contextlib.suppress:
    """What may happen to a connection is no matter to those who only make trouble."""
    return contextlib.suppress(OSError, ConnectionClosed, InvalidHandshake, TimeoutError)


def _send(sink: Connection, message: str | bytes) -> None:
    with contextlib.suppress(ConnectionClosed):
        sink.send(message)
