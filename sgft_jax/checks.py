"""Checks of options that people set: each raises UserError, one line with the option, its value and what it must be.

For the `__post_init__` of a config, e.g. `checks.positive(self, "lr", "tau")`. A field that is None is not checked, of
a tuple every entry is. Imports neither JAX nor MuJoCo.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

from sgft_jax.types import UserError


def finite(config: Any, *names: str) -> None:
    """Neither infinite nor NaN."""
    _check(config, names, math.isfinite, "finite")


def positive(config: Any, *names: str) -> None:
    """Finite and above 0."""
    _check(config, names, lambda x: 0 < x < math.inf, "a positive number")


def not_negative(config: Any, *names: str) -> None:
    """Finite and at least 0."""
    _check(config, names, lambda x: 0 <= x < math.inf, "0 or a positive number")


def share(config: Any, *names: str) -> None:
    """From 0 to 1, both allowed."""
    _check(config, names, lambda x: 0 <= x <= 1, "from 0 to 1")


def below_one(config: Any, *names: str) -> None:
    """From 0 up to, but not, 1: a discount factor."""
    _check(config, names, lambda x: 0 <= x < 1, "at least 0 and less than 1")


def at_least(config: Any, minimum: int, *names: str) -> None:
    """Finite and no less than the minimum."""
    _check(config, names, lambda x: minimum <= x < math.inf, f"at least {minimum}")


def layers(config: Any, *names: str) -> None:
    """At least one layer, each at least one unit wide."""
    for name in names:
        widths = getattr(config, name)
        if not widths or any(width < 1 for width in widths):
            raise refusal(name, " ".join(map(str, widths)) or "empty", "one or more layers of at least 1 unit")


def refusal(name: str, value: Any, wanted: str) -> UserError:
    """The error of an option whose value is not what it must be."""
    return UserError(f"option {name.replace('_', '-')} is {value}: must be {wanted}")


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
