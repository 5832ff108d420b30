"""Impure: where a learner listens. Strangers cannot fill it up, so that the robot always gets in."""

import contextlib
import ipaddress
import re
import socket
import threading
import time
from typing import Any

from envs.types import UserError

STRANGERS = 32  # connections that nobody has admitted yet, of four files each; beyond them the oldest is closed
_NAME = re.compile(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*\.?")
_NUMBERS = re.compile(r"[0-9.]+")
_LOOK = 1.0  # seconds after which a door that waits sees that it has been closed


class Door(socket.socket):
    """A socket that listens. Of the connections that `admit` has not heard of only the latest are kept open.

    Where the process may open no more files, the oldest of them make room. Raises UserError where one cannot listen.
    """

    def __init__(self, host: str, port: int) -> None:
        super().__init__(fileno=bound(host, port).detach())
        self._strangers: list[socket.socket] = []
        self._lock = threading.Lock()
        self.settimeout(_LOOK)

    @property
    def port(self) -> int:
        """That it listens at."""
        return self.getsockname()[1]

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection; OSError once the door is closed."""
        while True:
            try:
                stranger, address = super().accept()
            except OSError as error:
                if self.fileno() < 0:
                    raise
                if not isinstance(error, TimeoutError):  # no more files, or a connection that is gone already
                    self._close_oldest(len(self._strangers) // 2)
                    time.sleep(0.01)
                continue
            self._close_oldest(STRANGERS - 1)
            with self._lock:
                self._strangers.append(stranger)
            return stranger, address

    def admit(self, connection: socket.socket) -> None:
        """Keeps one open, however many strangers come."""
        with self._lock:
            self._strangers = [other for other in self._strangers if other is not connection]

    def close(self) -> None:
        """The end; no stranger is waited for."""
        self._close_oldest(0)
        super().close()

    def _close_oldest(self, kept: int) -> None:
        """So many strangers are left."""
        with self._lock:
            self._strangers = [other for other in self._strangers if other.fileno() >= 0]
            while len(self._strangers) > kept:
                with contextlib.suppress(OSError):  # the thread that reads it closes it then
                    self._strangers.pop(0).shutdown(socket.SHUT_RDWR)


def bound(host: str, port: int) -> socket.socket:
    """A socket that listens at an interface of this computer. Raises UserError where there can be none."""
    if not isinstance(port, int) or not 0 <= port <= 65_535:
        raise UserError(f"port {port!r}: ports go from 1 to 65535, 0 chooses a free one")
    check_host(host)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen()
    except (OSError, UnicodeError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or error
        advice = "choose another port, or an address of this computer"
        raise UserError(f"cannot listen at {host}:{port} ({reason}); {advice}") from None
    return listener


def check_host(host: str) -> None:
    """Raises UserError for what is neither a name nor an address of a computer."""
    if ":" in host or _NUMBERS.fullmatch(host):
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(host)
            return
    elif len(host) < 254 and _NAME.fullmatch(host):
        return
    raise UserError(f"host {host!r}: is neither a name nor an address of a computer")


def url(host: str, port: int) -> str:
    """With brackets around an IPv6 address."""
    return f"ws://[{host}]:{port}" if ":" in host else f"ws://{host}:{port}"
