"""Environments whose functions are one compiled program each: outside of `jit` every operation would be compiled alone,
and an environment that is made again would be compiled again.
"""

import functools
from collections.abc import Callable

import jax

import envs
from envs.base import Env


@functools.cache
def _jit(function: Callable) -> Callable:
    """The same function is the same program."""
    return function if hasattr(function, "lower") else jax.jit(function)


def compiled(env: Env) -> Env:
    """The same environment; of the same functions the same programs."""
    names = ("reset", "step", "restore", "reward", "terminated", "success")
    functions: dict[str, Callable] = {name: getattr(env, name) for name in names}
    return env._replace(**{name: _jit(function) for name, function in functions.items() if function is not None})


@functools.cache
def make(task: str, impl: str = "c", scene: str = "") -> Env:
    """`envs.make`, once for all tests of a process."""
    return compiled(envs.make(task, impl, scene))
