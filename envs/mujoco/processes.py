"""Impure: Python functions that work in several processes, because here one at a time holds Python's lock.

`python -m envs.mujoco.processes` is one of them: it serves the process that has started it, and ends with that. They
exchange pickles, which may run code, by a socket that no third process can reach.
"""

import atexit
import contextlib
import importlib
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

WORTH = 256  # worlds for which a process is worth its start, which takes as long


class _Process:
    """A process that finds modules where this one does. JAX takes no GPU there.

    It says nothing: what fails there fails again here, where somebody reads it.
    """

    def __init__(self) -> None:
        here, there = socket.socketpair()
        with here, there:
            variables = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "JAX_PLATFORMS": "cpu"}
            streams: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
            command = [sys.executable, "-P", "-m", __name__, str(there.fileno())]
            self._process = subprocess.Popen(command, env=variables, pass_fds=[there.fileno()], **streams)
            self._file, self._lock = here.makefile("rwb"), threading.Lock()

    def call(self, task: bytes) -> Any:
        """See `_serve`. Raises whatever reading does if it has failed."""
        with self._lock:
            self._file.write(task)
            self._file.flush()
            return pickle.load(self._file)

    def end(self) -> None:
        """It ends at once, whatever it does. Who waits for it hears EOFError or OSError."""
        self._process.kill()
        self._process.wait()

    def alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None


def cores() -> int:
    """How many this process may use, where the system tells, or else has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_KEPT: list[_Process] = []
_STARTING = threading.Lock()
os.register_at_fork(after_in_child=_KEPT.clear)  # they serve one process


def _kept(count: int) -> list[_Process]:
    """So many processes, which stay."""
    with _STARTING:
        _KEPT[:] = filter(_Process.alive, _KEPT)
        _KEPT.extend(_Process() for _ in range(count - len(_KEPT)))
        return _KEPT[:count]


def begin(worlds: int) -> None:
    """Starts the processes that will compile so many worlds, which import what they need meanwhile."""
    if (count := min(cores(), worlds // WORTH)) > 1:
        tasks = [("envs.mujoco.worlds",)] * count
        threading.Thread(target=in_parallel, args=(_prepare, tasks), kwargs={"keep": True}).start()


def _prepare(module: str) -> None:
    importlib.import_module(module)


def running() -> int:
    """How many processes stay for tasks."""
    return sum(map(_Process.alive, _KEPT))


@atexit.register
def _end_kept() -> None:
    for process in _KEPT:
        process.end()


def in_parallel(function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], *, keep: bool) -> list[Any] | None:
    """function(*task) of each task, each in a process; None where these cannot do it, as for a function without a name.

    The caller then does it, and is told what is wrong. keep: whether the processes stay for later tasks. Whatever goes
    wrong ends them, Ctrl-C included.
    """
    try:
        written = [pickle.dumps((function, *task)) for task in tasks]
        if any(b"__main__" in task for task in written):
            return None  # they would look for what a script or a notebook defines in their own script
        with ThreadPoolExecutor(len(tasks)) as threads, contextlib.ExitStack() as ends:
            processes = _kept(len(tasks)) if keep else [_Process() for _ in tasks]
            for process in processes:
                ends.callback(process.end)
            answers = list(threads.map(_Process.call, processes, written))
            if keep:
                ends.pop_all()
            return answers
    except Exception:  # whatever a function or its arguments raise where they are written or read
        return None


def _serve(stream: Any) -> None:
    """Answers tasks (function, *arguments) until there are no more."""
    with contextlib.suppress(EOFError):
        while True:
            function, *task = pickle.load(stream)
            pickle.dump(function(*task), stream)
            stream.flush()


def _end_with(other: socket.socket) -> None:
    """Ends this process as soon as nobody is at the other end."""
    ends = select.poll()
    ends.register(other, 0)
    ends.poll()
    os._exit(1)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that has started this one
    # Not by stdin and stdout, which are for what others print there, MuJoCo and tasks among them.
    connection = socket.socket(fileno=int(sys.argv[1]))
    connection.set_inheritable(False)
    threading.Thread(target=_end_with, args=(connection,), daemon=True).start()
    _serve(connection.makefile("rwb"))
