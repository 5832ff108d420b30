import dataclasses
import json
import math
from pathlib import Path
from typing import Annotated, Literal

import pytest

from sgft_jax.io.config import config_from_json, config_to_json, differences
from sgft_jax.types import UserError


@dataclasses.dataclass(frozen=True)
class Network:
    hidden: tuple[int, ...] = (256, 256)
    activation: Literal["relu", "silu"] = "relu"


@dataclasses.dataclass(frozen=True)
class Fixed:
    value: float = 0.2


@dataclasses.dataclass(frozen=True)
class Decay:
    start: float = 1.0
    end: float = 0.1


@dataclasses.dataclass(frozen=True)
class Config:
    task: str = "hammer"
    network: Network = dataclasses.field(default_factory=Network)
    target_entropy: float | None = None
    schedule: Fixed | Decay = dataclasses.field(default_factory=Fixed)
    gap: dict[str, float] = dataclasses.field(default_factory=dict)
    ranges: tuple[tuple[str, float], ...] = ()
    prior: Path | None = None
    seed: Annotated[int, "positive"] = 0
    resume: bool = False


RICH = Config(
    network=Network((64,), "silu"),
    target_entropy=-3.0,
    schedule=Decay(2.0, math.inf),
    gap={"friction": 0.5},
    ranges=(("mass", 0.1), ("damping", 2.0)),
    prior=Path("runs/prior"),
    seed=3,
    resume=True,
)


@pytest.mark.parametrize("config", [Config(), RICH])
def test_round_trip_through_text(config):
    text = json.dumps(config_to_json(config), allow_nan=False)
    assert config_from_json(Config, json.loads(text)) == config


def test_every_field_is_spelled_out():
    assert config_to_json(Config())["network"] == {"hidden": [256, 256], "activation": "relu"}
    assert set(config_to_json(Config())) == {f.name for f in dataclasses.fields(Config)}


def test_an_int_in_the_file_fits_a_float():
    value = config_from_json(Fixed, {"value": 1}).value
    assert value == 1.0 and isinstance(value, float)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sed": 1}, "sed: Config has no such field; it has gap"),
        ({"seed": 1.5}, "seed: expected int, got 1.5"),
        ({"seed": True}, "seed: expected int, got True"),
        ({"task": 3}, "task: expected str, got 3"),
        ({"target_entropy": "low"}, "target_entropy: expected float, got 'low'"),
        ({"network": {"hidden": [1, "x"], "activation": "relu"}}, r"network.hidden\[1\]: expected int, got 'x'"),
        ({"network": {"hidden": [1], "activation": "tanh"}}, "network.activation: expected .*silu.*, got 'tanh'"),
        ({"network": {"hidden": [1]}}, "network.activation: missing from Network"),
        ({"network": 3}, "expected an object with the fields of Network, got 3"),
        ({"ranges": [["mass"]]}, r"ranges\[0\]: expected tuple"),
        ({"gap": {"friction": "x"}}, "gap.friction: expected float"),
    ],
)
def test_what_does_not_fit_is_named(change, words):
    with pytest.raises(UserError, match=words):
        config_from_json(Config, config_to_json(Config()) | change)


def test_differences_name_the_leaves():
    old, new = config_to_json(Config()), config_to_json(RICH)
    assert differences(old, old) == []
    assert differences({"a": {"b": 1, "c": [2]}}, {"a": {"b": 1, "c": [3]}, "d": 4}) == [
        ("a.c", [2], [3]),
        ("d", None, 4),
    ]
    assert ("network.activation", "relu", "silu") in differences(old, new)
