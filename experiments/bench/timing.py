"""How a jitted function is timed: compiled ahead, called once to warm up, then the fastest of several calls."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax


class Compiled(NamedTuple):
    """call(*arguments), which waits for its results. compile_s: of tracing and compiling. memory_mb: megabytes that XLA
    sets aside for one call: arguments, results, temporaries; Warp's own worlds are not in it. seconds: of the fastest
    call, nan where it was not measured.
    """

    call: Callable[..., Any]
    compile_s: float
    memory_mb: float
    seconds: float = math.nan


def ahead(function: Callable[..., Any], arguments: Sequence[Any], *, donate: Sequence[int] = ()) -> Compiled:
    """The function compiled for arguments like these. donate: positions of those that a call consumes."""
    start = time.perf_counter()
    compiled: Any = jax.jit(function, donate_argnums=donate).lower(*arguments).compile()
    compile_s, sizes = time.perf_counter() - start, compiled.memory_analysis()
    total = sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    memory_mb = (total - sizes.alias_size_in_bytes) / 1e6
    return Compiled(lambda *args: jax.block_until_ready(compiled(*args)), compile_s, memory_mb)


def measure(function: Callable[..., Any], arguments: Sequence[Any], *, repeats: int) -> Compiled:
    """Times jax.jit(function)(*arguments), the same work in every call."""
    made = ahead(function, arguments)
    return made._replace(seconds=fastest(lambda: made.call(*arguments), repeats=repeats))


def fastest(call: Callable[[], Any], *, repeats: int) -> float:
    """Seconds of the fastest of `repeats` calls, after one that does not count."""
    return fastest_in_turns([call], repeats=repeats)[0]


def fastest_in_turns(calls: Sequence[Callable[[], Any]], *, repeats: int) -> list[float]:
    """The same of several calls, made in turns: whatever else the machine does slows all of them alike."""
    for call in calls:
        call()
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(repeats):
        for call, seconds in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - start)
    return [min(seconds) for seconds in times]
