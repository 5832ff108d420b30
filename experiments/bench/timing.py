"""How a jitted function is timed: compiled ahead, called once to warm up, then the fastest of several calls."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax


class Compiled(NamedTuple):
    """call(*arguments), which waits for its results. compile_s: of tracing and compiling. memory_mb: megabytes that XLA
    sets aside for one call: arguments, results, temporaries; Warp's own worlds are not in it.
    """

    call: Callable[..., Any]
    compile_s: float
    memory_mb: float


class Timing(NamedTuple):
    """seconds: of the fastest call; the rest as in `Compiled`."""

    seconds: float
    compile_s: float
    memory_mb: float


def ahead(function: Callable[..., Any], arguments: Sequence[Any]) -> Compiled:
    """The function compiled for arguments like these."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_s = time.perf_counter() - start
    return Compiled(lambda *given: jax.block_until_ready(compiled(*given)), compile_s, _memory(compiled))


def measure(function: Callable[..., Any], arguments: Sequence[Any], *, repeats: int) -> Timing:
    """Times jax.jit(function)(*arguments), the same work in every call."""
    made = ahead(function, arguments)
    return Timing(fastest(lambda: made.call(*arguments), repeats=repeats), made.compile_s, made.memory_mb)


def fastest(call: Callable[[], Any], *, repeats: int) -> float:
    """Seconds of the fastest of `repeats` calls, after one that does not count."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def _memory(compiled: Any) -> float:
    sizes = compiled.memory_analysis()
    total = sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return (total - sizes.alias_size_in_bytes) / 1e6
