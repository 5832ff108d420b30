"""Impure: a process that learns while this one plays, for robots that cannot wait."""

import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

import jax
import jax.numpy as jnp

from envs.types import Array, PyTree, UserError
from sgft_jax.train.finetuning import Phase, Updates
from sgft_jax.train.simulation import SimulatedRows
from sgft_jax.types import Finetuner, Metrics


class LearnerProcess:
    """The learning phases of `finetune` in a process of its own, with cores of its own where there are enough.

    This process keeps the first core that it may use, and the learner gets the others. It ends with this process.
    What has been learned is received in a thread, so that taking it over costs the one who plays no time.

    build() -> the finetuner. It is sent to the process, so it must be a function of a module, or a `functools.partial`
    of one. seeds: [M] uint32. which: [M] the prior of each. simulated: see `finetune`.
    """

    def __init__(
        self, build: Callable[[], Finetuner], seeds: Array, which: Array, simulated: Callable[[], SimulatedRows] | None
    ) -> None:
        spawn = multiprocessing.get_context("spawn")  # a fork would copy JAX in the middle of its work
        self._connection, connection = spawn.Pipe()
        self._cores = cores()
        args = (
            connection,
            build,
            *jax.device_get((seeds, which, simulated and simulated())),
            self._cores[1:] or self._cores,
        )
        self._process = spawn.Process(target=_work, args=args, daemon=True)
        self._process.start()
        connection.close()
        pin(self._cores[:1])
        self._receiver = ThreadPoolExecutor(1, "learned")
        self._result: Future[Any] = self._receiver.submit(self._receive)  # that it is up

    def wait(self) -> None:
        """Until the process is up, so that its start disturbs no robot. Raises UserError if it is gone, or its own."""
        self._result.result()

    def submit(self, agent: PyTree, parts: Sequence[int], updates: int | Array, phase: Phase) -> None:
        """Begins the learning phases `parts`, when those before are done."""
        self.wait()
        self._talk(lambda: self._connection.send((*jax.device_get((agent, list(parts), updates)), phase)))
        self._result = self._receiver.submit(self._receive)

    def ready(self) -> bool:
        """Whether `result` would not wait."""
        return self._result.done()

    def result(self) -> tuple[PyTree, Metrics]:
        """What the phases have led to; the same until the next `submit`. Raises UserError if the process is gone."""
        return self._result.result()

    def close(self) -> None:
        """Ends the process, whatever it does."""
        self._process.kill()
        self._process.join()
        self._receiver.shutdown()
        self._connection.close()
        pin(self._cores)

    def _receive(self) -> Any:
        """The next message, on this process's device; in the thread."""
        message = self._talk(self._connection.recv)
        if isinstance(message, UserError):
            raise message
        if isinstance(message, str):
            raise RuntimeError(f"the learner's process has failed:\n{message}")
        return jax.block_until_ready(jax.device_put(message))

    def _talk[T](self, say: Callable[[], T]) -> T:
        try:
            return say()
        except (EOFError, OSError) as error:
            self._process.join(timeout=5)
            raise UserError(
                f"the learner's process is gone (exit code {self._process.exitcode}); nothing that the robot did is "
                "lost: the same command with --resume goes on"
            ) from error


def cores() -> list[int]:
    """Those that this thread may use; none where the system does not tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def pin(chosen: Sequence[int]) -> None:
    """Keeps this thread, and those that it starts from now on, to these cores; does nothing without any."""
    if chosen:
        os.sched_setaffinity(0, chosen)


def give_way() -> None:
    """Lets this thread, and those that it starts from now on, run only while nothing else wants its core.

    Being nice is not enough: a robot's process that wakes up on the same core would wait for some milliseconds.
    """
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    else:
        os.nice(19)


def _work(
    connection: Connection, build: Callable[[], Finetuner], seeds: Any, which: Any, simulated: Any, allowed: list[int]
) -> None:
    """What the process does until the other side of the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the one that plays, which then ends this one
    pin(allowed)
    give_way()
    rows = jax.tree.map(jnp.asarray, simulated)
    try:
        updates = Updates(build(), jnp.asarray(seeds), jnp.asarray(which), lambda: rows)
        connection.send(None)
        while True:
            agent, parts, count, phase = connection.recv()
            connection.send(jax.device_get(updates(agent, parts, count, phase)))
    except (EOFError, ConnectionError):
        return
    except UserError as error:
        connection.send(error)
    except Exception:
        connection.send(traceback.format_exc())
