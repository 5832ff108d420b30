"""Files and folders that appear whole, whoever is killed at any moment; JSON; tables of anybody."""

import dataclasses
import gzip
import itertools
import json
import math
import os
from pathlib import Path
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from envs.files import read_json
from envs.types import UserError
from sgft_jax.files import disk
from sgft_jax.files.disk import (
    NEW,
    InUseError,
    Lock,
    differences,
    finite,
    jsonable,
    present,
    read_csv,
    replaced,
    whole,
    write_csv,
    write_json,
    written,
)

CHANGES = ("mkdir", "rename", "replace", "rmdir", "unlink")


class KilledError(BaseException):
    """Stands for SIGKILL: nothing that the process would still do on disk happens."""


def kill_at(monkeypatch, number):
    """From its `number`-th change on the process changes no folder any more; returns how many it has made."""
    made = itertools.count(1)

    def dying(change):
        def changed(*args, **kwargs):
            if next(made) >= number:
                raise KilledError
            return change(*args, **kwargs)

        return changed

    for name in CHANGES:
        monkeypatch.setattr(os, name, dying(getattr(os, name)))


def write(folder, content):
    with replaced(folder) as part:
        (part / "state").mkdir()
        (part / "state" / "numbers").write_text(content)
        (part / "manifest").write_text(content)


def content_of(folder):
    """What a reader finds; fails where the two files are not of one writer."""
    texts = {path.read_text() for path in (present(folder) / "state" / "numbers", present(folder) / "manifest")}
    assert len(texts) == 1
    return texts.pop()


def test_a_kill_at_any_moment_leaves_the_old_folder_or_the_new_one(tmp_path, monkeypatch):
    seen = []
    for number in itertools.count(1):
        folder = tmp_path / str(number) / "prior"
        write(folder, "old")
        (folder / "mine").write_text("stays")
        with monkeypatch.context() as patch:
            kill_at(patch, number)
            try:
                write(folder, "new")
            except KilledError:
                pass
            else:
                break
        seen.append(content_of(folder))
        write(folder, "later")
        assert content_of(folder) == "later" and (folder / "mine").read_text() == "stays"
        assert os.listdir(folder.parent) == ["prior"]
    assert seen == sorted(seen, reverse=True) and {"old", "new"} == set(seen)


def test_what_stands_beside_a_folder_is_nobodys_business(tmp_path):
    theirs = [tmp_path / name for name in (".tmp-notes", ".tmp-prior", f"{NEW}policy", ".hidden")]
    for folder in theirs:
        folder.mkdir()
        (folder / "mine.txt").write_text("not yours")
    (tmp_path / ".tmp-list").write_text("a file")
    (tmp_path / ".tmp-link").symlink_to(theirs[0])
    before = sorted(tmp_path.rglob("*"))
    write(tmp_path / "prior", "new")
    assert sorted(path for path in tmp_path.rglob("*") if tmp_path / "prior" not in (path, *path.parents)) == before


@pytest.mark.parametrize("name", ["prior", f"{NEW}prior"])
def test_a_file_or_a_link_in_the_way_stays(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match=f"/{name}: is no folder, and stands where one has to be written"):
        write(tmp_path / "prior", "new")
    assert os.listdir(tmp_path) == [name] and (tmp_path / name).read_text() == "mine"


def test_a_file_above_is_named_in_one_line(tmp_path):
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path / "file" / "prior", tmp_path / "file" / "a" / "prior"):
        with pytest.raises(UserError, match="prior: cannot be made, something else than a folder is in its way"):
            write(folder, "new")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for folder in (tmp_path / "loop", tmp_path / "loop" / "prior"):
        with pytest.raises(UserError, match=r"is no folder|something else than a folder"):
            write(folder, "new")


def test_a_link_stays_a_link(tmp_path):
    write(tmp_path / "here" / "prior", "old")
    (tmp_path / "prior").symlink_to(tmp_path / "here" / "prior")
    write(tmp_path / "prior", "new")
    assert (tmp_path / "prior").is_symlink() and content_of(tmp_path / "here" / "prior") == "new"
    assert sorted(os.listdir(tmp_path)) == ["here", "prior"] and os.listdir(tmp_path / "here") == ["prior"]


def test_an_error_leaves_the_old_folder_and_nothing_else(tmp_path):
    write(tmp_path / "prior", "old")
    with pytest.raises(OSError, match="full"), replaced(tmp_path / "prior") as part:
        (part / "state").mkdir()
        raise OSError("full")
    assert content_of(tmp_path / "prior") == "old" and os.listdir(tmp_path) == ["prior"]


def test_two_writers_of_one_folder_do_not_meet(tmp_path):
    with replaced(tmp_path / "prior") as part:
        (part / "manifest").write_text("first")
        with pytest.raises(InUseError, match="another process is writing to it"):
            write(tmp_path / "prior", "second")
        write(tmp_path / "other", "beside")
    assert (tmp_path / "prior" / "manifest").read_text() == "first" and content_of(tmp_path / "other") == "beside"
    Lock(tmp_path / "prior").release()


def test_a_file_is_the_old_one_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("old")
    with pytest.raises(ValueError, match="half"), written(path) as part:
        part.write_text("ne")
        raise ValueError("half")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with written(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


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


def test_a_table_comes_back_by_its_head(tmp_path):
    (tmp_path / "a.csv").write_bytes(b'\xef\xbb\xbfname,n\npush,1\n"a, ""b""\nc",\n')
    assert read_csv(tmp_path / "a.csv", needed=("n",)) == [{"name": "push", "n": "1"}, {"name": 'a, "b"\nc', "n": ""}]
    assert read_csv(tmp_path / "none.csv") == []


def test_a_compressed_table_comes_back_and_is_the_same_bytes_every_time(tmp_path):
    rows = [{"name": "push", "n": "1"}, {"name": 'a, "b"', "n": ""}]
    for name in ("a.csv.gz", "b.csv.gz", "c.csv"):
        write_csv(tmp_path / name, ("name", "n"), rows)
        assert read_csv(tmp_path / name) == rows
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()
    assert gzip.decompress((tmp_path / "a.csv.gz").read_bytes()) == (tmp_path / "c.csv").read_bytes()


@pytest.mark.parametrize("content", [b"name,n\n", b"", gzip.compress(b"name,n\n" * 9, mtime=0)[:-9]])
def test_what_is_no_gzip_file_is_refused(content, tmp_path):
    (tmp_path / "a.csv.gz").write_bytes(content)
    if content:
        with pytest.raises(UserError, match=r"a.csv.gz: is no gzip file .*; put it back as it was"):
            read_csv(tmp_path / "a.csv.gz")
    else:
        assert read_csv(tmp_path / "a.csv.gz") == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"name,n\npush\n", "row 1 has no n"),
        (b"name,n,more\npush,1\n", "row 1 has other columns than the head"),
        (b"name,n\npush,1,2\n", "row 1 has other columns than the head"),
        (b"name,n\npu\0sh,1\n", "is no table .a zero byte."),
        (b"name,n\n" + b"x" * 200_000 + b",1\n", "is no table .field larger than"),
        (b"name,n\n\xff,1\n", "is no UTF-8 text"),
    ],
)
def test_what_is_no_table_is_refused(content, words, tmp_path):
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(UserError, match=f"a.csv: {words}"):
        read_csv(tmp_path / "a.csv", needed=("name", "n"))


def test_cells_are_numbers_or_an_error():
    assert whole("n", "20") == 20 and whole("n", 3.0) == 3 and finite("x", "-1e3") == -1000
    for cell in ("-1", "0.5", "nan", "inf", "1e30", "", "a", "9" * 5000):
        with pytest.raises(ValueError):
            whole("n", cell)
    for cell in ("nan", "-inf", "1e999", "", "a"):
        with pytest.raises(ValueError):
            finite("x", cell)
