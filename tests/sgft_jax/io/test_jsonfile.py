import json
import math
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from sgft_jax.io.jsonfile import jsonable, read_json, write_json
from sgft_jax.types import UserError


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
    assert [p.name for p in tmp_path.iterdir() if not p.name.startswith(".")] == ["x.json"]


def test_read_says_what_is_wrong(tmp_path):
    with pytest.raises(UserError, match=r"x.json: no such file"):
        read_json(tmp_path / "x.json")
    (tmp_path / "x.json").write_text('{"a": ')
    with pytest.raises(UserError, match=r"x.json: not valid JSON"):
        read_json(tmp_path / "x.json")
