"""Impure: programs that compile in threads, beside each other and beside what the main thread does."""

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from envs.mujoco.processes import cores


class Ahead:
    """Jitted programs that compile before they are called: a call then finds the compiled one in JAX's own cache.

    XLA compiles outside of Python's lock, so as many programs compile at a time as there are cores.
    """

    def __init__(self, threads: ThreadPoolExecutor) -> None:
        self._threads = threads
        self._begun: dict[Callable[..., Any], Future[Any]] = {}

    def begin(self, function: Callable[[], Any]) -> None:
        """Begins to call a function in a thread."""
        self._begun[function] = self._threads.submit(function)

    def compile(self, program: Any, *args: Any) -> None:
        """Begins to compile a jitted program for these arguments, or for their shapes (see `jax.eval_shape`)."""
        self._begun[program] = self._threads.submit(program.lower(*args).compile)

    def wait(self, *begun: Callable[..., Any]) -> None:
        """Until these are done, if they have begun. What fails fails again when it is called, which says it."""
        for function in begun:
            if future := self._begun.pop(function, None):
                future.exception()


@contextlib.contextmanager
def compiling() -> Iterator[Ahead]:
    """Threads for a block; what has not begun when it is left, as by an error, never begins."""
    threads = ThreadPoolExecutor(cores(), thread_name_prefix="compile")  # more would take memory alone
    try:
        yield Ahead(threads)
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
