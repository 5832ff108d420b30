"""How a jitted function is timed: compiled ahead, called once to warm up, then the fastest of several calls."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax


class Timing(NamedTuple):
    """seconds: of the fastest call. compile_s: of tracing and compiling. memory_mb: see `compiled_memory`."""

    seconds: float
    compile_s: float
    memory_mb: float


def measure(function: Callable[..., Any], arguments: Sequence[Any], *, repeats: int) -> Timing:
    """Times jax.jit(function)(*arguments), the same work in every call."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_s = time.perf_counter() - start
    call = lambda: jax.block_until_ready(compiled(*arguments))  # noqa: E731
    return Timing(fastest(call, repeats=repeats), compile_s, compiled_memory(compiled))


def fastest(call: Callable[[], Any], *, repeats: int) -> float:
    """Seconds of the fastest of `repeats` calls, after one that does not count."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def compiled_memory(compiled: Any) -> float:
    """Megabytes that XLA sets aside for one call: arguments, results, temporaries. Warp's own worlds are not in it."""
    sizes = compiled.memory_analysis()
    total = sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return (total - sizes.alias_size_in_bytes) / 1e6
