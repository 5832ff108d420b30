"""Checks of options that people set: each raises UserError, one line with the option, its value and what it must be.

For the `__post_init__` of a config, e.g. `checks.positive(self, "lr", "tau")`. A field that is None is not checked, of
a tuple every entry is. Imports neither JAX nor MuJoCo.
"""

import math
import struct
from collections.abc import Callable, Iterator
from typing import Any

from envs.types import UserError

MOST = 2**31 - 1  # what counts anything: devices count in 32 bits
_LARGEST_BATCH = 2**20  # rows
_WIDEST = 2**16  # units of a layer, and what else there are a few of


def finite(config: Any, *names: str) -> None:
    """Neither infinite nor NaN, also as float32."""
    _check(config, names, lambda x: math.isfinite(_float32(x)), "finite")


def positive(config: Any, *names: str) -> None:
    """Finite and above 0, also as float32."""
    _check(config, names, lambda x: 0 < _float32(x) < math.inf, "a positive number")


def not_negative(config: Any, *names: str) -> None:
    """Finite, also as float32, and at least 0."""
    _check(config, names, lambda x: 0 <= _float32(x) < math.inf, "0 or a positive number")


def share(config: Any, *names: str) -> None:
    """From 0 to 1, both allowed."""
    _check(config, names, lambda x: 0 <= x <= 1, "from 0 to 1")


def below_one(config: Any, *names: str) -> None:
    """From 0 up to, but not, 1: a discount factor."""
    _check(config, names, lambda x: 0 <= x < 1, "at least 0 and less than 1")


def at_least(config: Any, minimum: int, *names: str, most: int = MOST) -> None:
    """No less than the minimum, and no more than can be counted."""
    _check(config, names, lambda x: x >= minimum, f"at least {minimum}")
    _check(config, names, lambda x: x <= most, f"at most {most}")


def few(config: Any, minimum: int, *names: str) -> None:
    """The same of what nobody has many of, such as layers, units and models."""
    at_least(config, minimum, *names, most=_WIDEST)


def rows(config: Any, *names: str) -> None:
    """At least one, and no more than a batch can have."""
    at_least(config, 1, *names, most=_LARGEST_BATCH)


def layers(config: Any, *names: str) -> None:
    """At least one layer, each at least one unit wide."""
    for name in names:
        if not getattr(config, name):
            raise refusal(name, "empty", "one or more layers of at least 1 unit")
    few(config, 1, *names)


def refusal(name: str, value: Any, wanted: str) -> UserError:
    """The error of an option whose value is not what it must be."""
    return UserError(f"option {name.replace('_', '-')} is {value}: must be {wanted}")


def _float32(value: float) -> float:
    """What is left of a number on a device."""
    try:
        return struct.unpack("f", struct.pack("f", value))[0]
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _check(config: Any, names: tuple[str, ...], holds: Callable[[float], bool], wanted: str) -> None:
    for name in names:
        for value in _entries(getattr(config, name)):
            if not holds(value):
                raise refusal(name, value, wanted)


def _entries(value: Any) -> Iterator[float]:
    if isinstance(value, tuple):
        yield from value
    elif value is not None:
        yield value
