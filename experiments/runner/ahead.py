"""Impure: what takes seconds and can be done beside something else: starting, tracing and compiling."""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any

from envs.mujoco import processes


def start(worlds: int, *, devices: bool) -> None:
    """Begins what a command needs after its imports: processes that compile so many worlds, and JAX's devices.

    devices: not where several hosts must meet first.
    """
    processes.begin(worlds)
    import jax

    def first() -> None:
        with contextlib.suppress(Exception):  # it fails again where somebody reads it
            jax.numpy.zeros(()).block_until_ready()

    if devices:
        threading.Thread(target=first).start()


class Ahead:
    """Jitted programs that compile before they are called: a call then finds the compiled one in JAX's own cache.

    Python traces one after another. XLA compiles outside of Python's lock, so as many compile at a time as there are
    cores.
    """

    def __init__(self, tracer: ThreadPoolExecutor, threads: ThreadPoolExecutor) -> None:
        self._tracer, self._threads = tracer, threads
        self._begun: dict[Callable[..., Any], list[Future[Any]]] = {}

    def begin(self, function: Callable[[], Any]) -> None:
        """Begins to call a function in a thread."""
        self._submit(function, function)

    def promise(self, program: Any, args: Callable[[], tuple[Any, ...]]) -> None:
        """Begins to compile a jitted program. args() -> its arguments, or their shapes (see `jax.eval_shape`)."""
        lowered = self._tracer.submit(lambda: program.lower(*args()))
        self._submit(program, lambda: lowered.result().compile())

    def awaited(self, program: Any, waiting: Callable[[], AbstractContextManager[None]]) -> Callable[..., Any]:
        """The program, called when it has been compiled. waiting() says that it has not been yet."""

        def call(*args: Any) -> Any:
            with contextlib.nullcontext() if self.done(program) else waiting():
                self.wait(program)
            return program(*args)

        return call

    def wait(self, *begun: Callable[..., Any]) -> None:
        """Until these are done, if they have begun. What fails fails again when it is called, which says it."""
        for function in begun:
            for future in self._begun.pop(function, []):
                if not future.cancelled():
                    future.exception()

    def done(self, function: Callable[..., Any]) -> bool:
        """Whether waiting for this takes no time."""
        return all(future.done() for future in self._begun.get(function, []))

    def _submit(self, key: Callable[..., Any], work: Callable[[], Any]) -> None:
        self._begun.setdefault(key, []).append(self._threads.submit(work))


@contextlib.contextmanager
def compiling() -> Iterator[Ahead]:
    """Threads for a block; what has not begun when it is left, as by an error, never begins."""
    # More than there are cores would take memory alone.
    pools = [ThreadPoolExecutor(count, thread_name_prefix="compile") for count in (1, processes.cores())]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(interval / 10)  # the main thread makes hundreds of calls to Warp, and waits at each of them
    try:
        yield Ahead(*pools)
    finally:
        sys.setswitchinterval(interval)
        for pool in pools:
            pool.shutdown(wait=False, cancel_futures=True)
