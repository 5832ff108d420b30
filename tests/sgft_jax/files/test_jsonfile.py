import dataclasses
import json
import math
from pathlib import Path
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from envs.files import read_json
from sgft_jax.files import disk
from sgft_jax.files.disk import differences, jsonable, write_json


class Pair(NamedTuple):
    a: int
    b: tuple[float, ...]


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (jnp.float32(0.1), 0.1),  # and not 0.10000000149011612
        (np.float32(2.0), 2.0),
        (np.array([[1, 2]]), [[1, 2]]),
        (jnp.array([0.1, jnp.nan, -jnp.inf]), [0.1, "nan", "-inf"]),
        (jnp.array(1.5, jnp.bfloat16), 1.5),
        (np.bool_(True), True),
        (np.int64(3), 3),
        (math.inf, "inf"),
        (Pair(1, (2.0, math.nan)), {"a": 1, "b": [2.0, "nan"]}),
        ({"p": Path("x/y"), "n": None, 3: True}, {"p": "x/y", "n": None, "3": True}),
        (np.zeros((0, 2), np.float32), []),
    ],
)
def test_jsonable(value, plain):
    assert jsonable(value) == plain
    json.dumps(jsonable(value), allow_nan=False)


def test_jsonable_refuses_what_it_does_not_know():
    with pytest.raises(TypeError, match="a object cannot be written"):
        jsonable({"x": object()})


def test_write_is_atomic_and_readable(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert read_json(path) == {"a": 1}
    write_json(path, {"a": 2})
    assert read_json(path) == {"a": 2}
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


def test_a_write_that_fails_leaves_nothing_behind(tmp_path, monkeypatch):
    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(disk.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_json(tmp_path / "x.json", {"a": 1})
    assert not list(tmp_path.iterdir())


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
    seed: int = 0
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


def test_every_kind_of_field_becomes_plain_data():
    assert json.loads(json.dumps(jsonable(RICH), allow_nan=False)) == {
        "task": "hammer",
        "network": {"hidden": [64], "activation": "silu"},
        "target_entropy": -3.0,
        "schedule": {"start": 2.0, "end": "inf"},
        "gap": {"friction": 0.5},
        "ranges": [["mass", 0.1], ["damping", 2.0]],
        "prior": "runs/prior",
        "seed": 3,
        "resume": True,
    }


def test_every_field_is_spelled_out():
    assert jsonable(Config())["network"] == {"hidden": [256, 256], "activation": "relu"}
    assert set(jsonable(Config())) == {f.name for f in dataclasses.fields(Config)}


def test_differences_name_the_leaves():
    old, new = jsonable(Config()), jsonable(RICH)
    assert differences(old, old) == []
    assert differences({"a": {"b": 1, "c": [2]}}, {"a": {"b": 1, "c": [3]}, "d": 4}) == [
        ("a.c", [2], [3]),
        ("d", None, 4),
    ]
    assert ("network.activation", "relu", "silu") in differences(old, new)
