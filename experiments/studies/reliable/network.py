"""Impure: a bad network between robot and learner, and strangers who talk to the learner."""

import contextlib
import socket
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import ServerConnection, serve

from experiments.runner.real_systems import free_port
from experiments.studies.reliable.trial import Trial, late_share
from sgft_jax.systems.robot_client import VERSION, pack


class Fate(NamedTuple):
    """Shares of the messages that are dropped, delayed by between `least` and `most` seconds, and damaged."""

    dropped: float = 0.1
    delayed: float = 0.05
    damaged: float = 0.02
    least: float = 0.05
    most: float = 2.0


class Proxy:
    """Stands between a robot and the learner at `port`, and does to the messages what `fate` says, both ways."""

    def __init__(self, port: int, fate: Fate, seed: int) -> None:
        self._upstream, self._fate, self._luck = f"ws://127.0.0.1:{port}", fate, np.random.default_rng(seed)
        self.counts = {"messages": 0, "dropped": 0, "delayed": 0, "damaged": 0}
        self.port = free_port()
        self._server = serve(self._serve, "127.0.0.1", self.port, compression=None)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def __enter__(self) -> "Proxy":
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()

    def _serve(self, near: ServerConnection) -> None:
        with _quietly(), connect(self._upstream, compression=None, proxy=None) as far:
            threading.Thread(target=self._pump, args=(far, near), daemon=True).start()
            self._pump(near, far)
        near.close()

    def _pump(self, source: ServerConnection | ClientConnection, sink: ServerConnection | ClientConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            for message in source:
                self._pass(message, sink)
        sink.close()

    def _pass(self, message: str | bytes, sink: ServerConnection | ClientConnection) -> None:
        fate, luck = self._fate, self._luck
        self.counts["messages"] += 1
        if luck.uniform() < fate.dropped:
            self.counts["dropped"] += 1
            return
        if isinstance(message, bytes) and luck.uniform() < fate.damaged:
            self.counts["damaged"] += 1
            at = int(luck.integers(len(message)))
            message = message[:at] + bytes([message[at] ^ 255]) + message[at + 1 :]
        if luck.uniform() < fate.delayed:
            self.counts["delayed"] += 1
            threading.Timer(luck.uniform(fate.least, fate.most), _send, (sink, message)).start()
            return
        _send(sink, message)


def bad_network(home: Path, *, seed: int, period: float = 0.2, rollouts: int = 10) -> dict[str, Any]:
    """A run through the proxy; what became of it."""
    with Trial(home, period=period, rollouts=rollouts) as trial, Proxy(trial.port, Fate(), seed) as proxy:
        trial.via = proxy.port
        trial.start()
        trial.finish()
    return {**proxy.counts, **trial.audit(), "late": late_share(home / "commands.log")}


def strangers(
    home: Path, *, seed: int, frames: int = 10_000, rate: float = 100.0, seconds: float = 10.0, rollouts: int = 10
) -> dict[str, Any]:
    """A run while strangers connect, with nonsense and with a wrong token; what became of it."""
    with Trial(home, period=0.2, rollouts=rollouts) as trial:
        trial.start()
        trial.wait_for_motion()
        sent = _nonsense(trial.port, frames, np.random.default_rng(seed))
        knocked = _knock(trial.port, rate, seconds)
        trial.finish()
    lines, late = (
        sum("refused a connection" in line for line in trial.player_lines()),
        late_share(home / "commands.log"),
    )
    return {"frames": sent, "connections": knocked, "lines about them": lines, **trial.audit(), "late": late}


def _nonsense(port: int, frames: int, luck: np.random.Generator) -> int:
    """So many frames of random or truncated bytes: half of them no WebSocket at all; returns how many it sent."""
    good, sent = _hello("x"), 0
    while sent < frames:
        cut = luck.uniform() < 0.5
        data = good[: luck.integers(1, len(good))] if cut else luck.bytes(int(luck.integers(1, 300)))
        with _quietly():
            if sent % 2:
                with socket.create_connection(("127.0.0.1", port), timeout=2) as raw:
                    raw.sendall(data)
            else:
                with connect(f"ws://127.0.0.1:{port}", compression=None, proxy=None, open_timeout=2) as one:
                    one.send(data)
        sent += 1
    return sent


def _knock(port: int, rate: float, seconds: float) -> int:
    """Connections with a wrong token, at this rate; returns how many there were."""
    start, count = time.monotonic(), 0
    hello = _hello("guess")
    while (now := time.monotonic()) < start + seconds:
        with _quietly(), connect(f"ws://127.0.0.1:{port}", compression=None, proxy=None, open_timeout=2) as one:
            one.send(hello)
        count += 1
        time.sleep(max(start + count / rate - now, 0.0))
    return count


def _hello(token: str) -> bytes:
    """The first message of a robot that would fit the task, if it knew the token."""
    return pack(
        "hello", version=VERSION, token=token, robot="r", obs_size=3, action_size=1, period=None, answer_within=None
    )


def _quietly() -> contextlib.suppress:
    """What may happen to a connection is no matter to those who only make trouble."""
    return contextlib.suppress(OSError, ConnectionClosed, InvalidHandshake, TimeoutError)


def _send(sink: ServerConnection | ClientConnection, message: str | bytes) -> None:
    with contextlib.suppress(ConnectionClosed):
        sink.send(message)
