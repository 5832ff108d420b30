"""Impure: Python functions that work in several processes, because here one at a time holds Python's lock.

`python -m envs.mujoco.processes` is one of them: it serves the process that has started it, until that ends.
"""

import atexit
import contextlib
import functools
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any


class _Process:
    """A process that finds modules where this one does. JAX takes no GPU there.

    It says nothing: what fails there fails again here, where somebody reads it.
    """

    def __init__(self) -> None:
        variables = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "JAX_PLATFORMS": "cpu"}
        streams: dict[str, Any] = dict.fromkeys(("stdin", "stdout"), subprocess.PIPE) | {"stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen([sys.executable, "-m", __name__], env=variables, **streams)

    def call(self, task: bytes) -> Any:
        """See `_serve`. Raises EOFError or OSError if it has failed."""
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(task)
        self._process.stdin.flush()
        return pickle.load(self._process.stdout)

    def end(self) -> None:
        """It ends with what it reads."""
        with contextlib.suppress(OSError):
            self._process.communicate()


@functools.cache
def _kept(number: int) -> _Process:
    process = _Process()
    atexit.register(process.end)
    return process


def in_parallel(function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], *, keep: bool) -> list[Any] | None:
    """function(*task) of each task, each in a process; None where these cannot do it, as for a function without a name.

    The caller then does it, and is told what is wrong. keep: whether the processes stay for later tasks.
    """
    processes = []
    try:
        written = [pickle.dumps((function, *task)) for task in tasks]
        processes = [_kept(i) if keep else _Process() for i in range(len(tasks))]
        with ThreadPoolExecutor(len(tasks)) as threads:
            return list(threads.map(_Process.call, processes, written))
    except (pickle.PicklingError, AttributeError, TypeError, OSError, EOFError):
        return None
    finally:
        for process in processes if not keep else ():
            process.end()


def _serve(asked: Any, answers: Any) -> None:
    """Answers tasks (function, *arguments) until there are no more."""
    with contextlib.suppress(EOFError):
        while True:
            function, *task = pickle.load(asked)
            pickle.dump(function(*task), answers)
            answers.flush()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that has started this one
    _serve(sys.stdin.buffer, sys.stdout.buffer)
