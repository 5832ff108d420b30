"""Checks of options that people set: each raises UserError, one line with the option, its value and what it must be.

What a field must be is part of its type: `lr: checks.Positive = 3e-4` in a dataclass that derives from `Checked`. A
field that is None is not checked, of a tuple every entry is, and there must be one. Imports neither JAX nor MuJoCo.
"""

import functools
import inspect
import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin

from envs.types import UserError

MOST = 2**31 - 1  # what counts anything: devices count in 32 bits


@dataclass(frozen=True)
class Rule:
    """What every number of a field must be, and the same in words; called with a config, it checks that field."""

    holds: Callable[[Any], bool]
    wanted: str

    def __call__(self, config: Any, name: str) -> None:
        """Raises UserError where the field is something else."""
        value = getattr(config, name)
        if value == ():
            raise refusal(name, "empty", "one or more layers of at least 1 unit")
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and not self.holds(number):
                raise refusal(name, number, self.wanted)


def refusal(name: str, value: Any, wanted: str) -> UserError:
    """The error of an option whose value is not what it must be."""
    return UserError(f"option {name.replace('_', '-')} is {value}: must be {wanted}")


def _float32(value: float) -> float:
    """What is left of a number on a device."""
    try:
        return struct.unpack("f", struct.pack("f", value))[0]
    except OverflowError:
        return math.inf if value > 0 else -math.inf


# Neither infinite nor NaN, also as float32
finite = Rule(lambda x: math.isfinite(_float32(x)), "finite")
positive = Rule(lambda x: 0 < _float32(x) < math.inf, "a positive number")
not_negative = Rule(lambda x: 0 <= _float32(x) < math.inf, "0 or a positive number")
share = Rule(lambda x: 0 <= x <= 1, "from 0 to 1")
below_one = Rule(lambda x: 0 <= x < 1, "at least 0 and less than 1")  # a discount factor


def least(minimum: int) -> Rule:
    """No less than the minimum."""
    return Rule(lambda x: x >= minimum, f"at least {minimum}")


def greatest(maximum: int) -> Rule:
    """No more than the maximum."""
    return Rule(lambda x: x <= maximum, f"at most {maximum}")


countable = greatest(MOST)
few = greatest(2**16)  # units of a layer, and what else nobody has many of, such as models
batch = greatest(2**20)  # rows

# Types of fields
Finite = Annotated[float, finite]
Positive = Annotated[float, positive]
NotNegative = Annotated[float, not_negative]
Share = Annotated[float, share]
BelowOne = Annotated[float, below_one]
Updates = Annotated[int, not_negative]  # how many, also none
Count = Annotated[int, least(1), countable]
Few = Annotated[int, least(1), few]
Rows = Annotated[int, least(1), batch]
Layers = Annotated[tuple[int, ...], least(1), few]  # widths; the only options that are tuples


class Checked:
    """A dataclass whose fields are checked when it is made: by their types, and by those of fields that they override.

    A subclass with a `__post_init__` of its own calls this one's. UserError says which field is wrong.
    """

    def __post_init__(self) -> None:
        for name, rule in _rules_of(type(self)):
            rule(self, name)


@functools.cache
def _rules_of(kind: type) -> tuple[tuple[str, Rule], ...]:
    hints = (pair for base in reversed(kind.__mro__) for pair in inspect.get_annotations(base).items())
    return tuple((name, rule) for name, hint in hints for rule in _rules_in(hint))


def _rules_in(hint: Any) -> Iterator[Rule]:
    if get_origin(hint) is Annotated:
        yield from (x for x in hint.__metadata__ if isinstance(x, Rule))
    else:
        for part in get_args(hint):
            yield from _rules_in(part)
