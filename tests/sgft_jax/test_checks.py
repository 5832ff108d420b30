"""Checks of options: what passes, what is refused, and in which words."""

import dataclasses
import math
from typing import Annotated, Any

import pytest

from envs.types import UserError
from sgft_jax import checks


@dataclasses.dataclass
class Config:
    learning_rate: Any = None


GOOD = [
    (checks.finite, [-1.0, 0.0, 1e30]),
    (checks.positive, [1e-30, 3]),
    (checks.not_negative, [0.0, 3]),
    (checks.share, [0.0, 0.5, 1.0]),
    (checks.below_one, [0.0, 0.999]),
]
BAD = [
    (checks.finite, [math.nan, math.inf, -math.inf]),
    (checks.positive, [math.nan, math.inf, 0.0, -1e-30]),
    (checks.not_negative, [math.nan, math.inf, -1e-30]),
    (checks.share, [math.nan, math.inf, -0.001, 1.001]),
    (checks.below_one, [math.nan, -0.001, 1.0, 2.0]),
]


@pytest.mark.parametrize(("check", "values"), GOOD)
def test_good_values_pass_alone_in_tuples_and_not_at_all(check, values):
    for value in [*values, tuple(values), None]:
        check(Config(value), "learning_rate")


@pytest.mark.parametrize(("check", "value"), [(check, value) for check, values in BAD for value in values])
def test_bad_values_are_refused_alone_and_in_tuples(check, value):
    for held in (value, (0.5, value)):
        with pytest.raises(UserError, match=f"^option learning-rate is {value}: must be "):
            check(Config(held), "learning_rate")


def test_the_whole_line():
    with pytest.raises(UserError) as refused:
        checks.positive(Config(-0.1), "learning_rate")
    assert str(refused.value) == "option learning-rate is -0.1: must be a positive number"


@dataclasses.dataclass
class Counted(checks.Checked):
    members: Annotated[Any, checks.least(2), checks.countable]


def test_counts():
    assert Counted(2).members == 2
    for value, words in ((1, "at least 2"), (math.nan, "at least 2"), (math.inf, "at most 2147483647")):
        with pytest.raises(UserError, match=f"must be {words}"):
            Counted(value)


@dataclasses.dataclass
class Layered(checks.Checked):
    hidden: checks.Layers


def test_layers():
    assert Layered((1, 1)).hidden == (1, 1)
    for value, words in (((), "empty: must be one or more layers"), ((8, 0), "0: must be at least 1"), ((-1,), "-1")):
        with pytest.raises(UserError, match=f"is {words}"):
            Layered(value)


# --- by the types of fields -------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Typed(checks.Checked):
    rate: checks.Positive = 1.0
    updates: checks.Updates | None = None
    models: Annotated[int, checks.least(2), checks.few] = 3
    free: float = -1.0


@dataclasses.dataclass(frozen=True)
class Overridden(Typed):
    rate: float = 2.0
    share: checks.Share = 0.5


@pytest.mark.parametrize("kind", [Typed, Overridden])
@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"rate": 0.0}, "option rate is 0.0: must be a positive number"),
        ({"updates": -1}, "option updates is -1: must be 0 or a positive number"),
        ({"models": 1}, "option models is 1: must be at least 2"),
        ({"models": 70_000}, "option models is 70000: must be at most 65536"),
    ],
)
def test_types_of_fields_say_what_they_must_be(kind, given, line):
    """Also where a class that derives from another gives a field a plain type and another default."""
    with pytest.raises(UserError) as refused:
        kind(**given)
    assert str(refused.value) == line
    assert kind(updates=0).updates == 0 and kind().updates is None


def test_a_class_adds_fields_to_those_that_it_derives_from():
    with pytest.raises(UserError, match="option share is 2: must be from 0 to 1"):
        Overridden(share=2)
