"""Text files from anybody: what is no plain, bounded, finite, UTF-8 text is refused in one line."""

import os
import time
from typing import Literal, TypedDict

import pytest

from envs import files
from envs.types import UserError

DEEP = "[" * 100_000


def refusal(function, *args, **options):
    with pytest.raises(UserError) as error:
        function(*args, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.json"


def test_what_is_no_plain_file_is_refused_without_waiting(path, tmp_path):
    os.mkfifo(path)
    assert refusal(files.read_text, path) == f"{path}: is no plain file"
    assert refusal(files.read_text, tmp_path) == f"{tmp_path}: cannot be read (is a directory)"
    assert refusal(files.read_text, tmp_path / "none") == f"{tmp_path / 'none'}: no such file"
    assert refusal(files.read_text, "/dev/zero") == "/dev/zero: is no plain file"
    assert refusal(files.read_text, "a\0b") == r"'a\x00b': is no name of a file"
    (loop := tmp_path / "loop").symlink_to(loop)
    assert "too many levels of symbolic links" in refusal(files.read_text, loop)


def test_large_files_and_other_encodings_are_refused(path):
    path.write_text("12345")
    assert files.read_text(path, limit=5) == "12345"
    assert "larger than 4 bytes" in refusal(files.read_text, path, limit=4)
    path.write_bytes("\ufeffa".encode("utf-16"))
    assert "is no UTF-8 text (byte 0); save it as UTF-8" in refusal(files.read_text, path)


def test_a_byte_order_mark_is_no_part_of_the_text(path):
    path.write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert files.read_json(path) == {"a": 1}
    path.write_bytes(b"\xef\xbb\xbfa = 1")
    assert files.read_toml(path) == {"a": 1}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": ', "Expecting value"),
        (DEEP, "nested too deeply"),
        (200 * "[" + 200 * "]", "nested too deeply"),
        ('{"a": NaN}', "NaN is no finite number"),
        ('{"a": -Infinity}', "-Infinity is no finite number"),
        ('{"a": 1e999}', "1e999 is no finite number"),
        ('{"a": 1, "a": 2}', "'a' stands there twice"),
        ("9" * 5000, "4300 digits"),
    ],
)
def test_json_that_no_reader_can_rely_on(path, text, words):
    path.write_text(text)
    message = refusal(files.read_json, path)
    assert message.startswith(f"{path}: not valid JSON (") and words in message


def test_a_key_that_stands_twice_is_named_soon_among_very_many():
    begun = time.process_time()
    pairs = [*((str(n), 1) for n in range(10_000)), ("b", 1), ("b", 2)]
    assert "'b' stands there twice" in refusal(
        files.parse_json, "{" + ",".join(f'"{k}": {v}' for k, v in pairs) + "}", "a"
    )
    assert time.process_time() - begun < 0.5


_DOTTED = ".".join(200 * ["a"]) + " = 1"


@pytest.mark.parametrize("text", ["a = ", f"a = {DEEP}", _DOTTED, "a = inf", "a = nan", "a = 1e999", "a = 1\na = 2"])
def test_toml_that_no_reader_can_rely_on(path, text):
    path.write_text(text)
    assert refusal(files.read_toml, path).startswith(f"{path}: not valid TOML (")


class Part(TypedDict):
    sizes: list[files.Size]


SCHEMA = {"task": str, "fps": files.Positive, "kind": Literal["a", "b"] | None, "part": Part}
GOOD = {"task": "push", "fps": 10, "kind": None, "part": {"sizes": [3]}, "more": "kept"}


def test_what_fits_a_schema_is_handed_on_as_it_is(path):
    assert files.checked(path, GOOD, SCHEMA, "mend it") is GOOD


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"task": 3}, "task is a whole number, not a text"),
        ({"fps": "fast"}, "fps is a text, not a number"),
        ({"fps": True}, "fps is true or false, not a number"),
        ({"fps": 0}, "fps: expected float > 0.0"),
        ({"kind": "c"}, "kind: invalid enum value 'c'"),
        ({"part": {}}, "lacks part.sizes"),
        ({"part": {"sizes": [1, 0]}}, "part.sizes[1]: expected int >= 1"),
        ({"part": {"sizes": [1.5]}}, "part.sizes[0] is a number, not a whole number"),
        ({"part": {"sizes": [10**30]}}, "part.sizes[0]: expected int <= 9007199254740992"),
    ],
)
def test_what_does_not_fit_is_named_with_its_place(path, change, words):
    assert refusal(files.checked, path, {**GOOD, **change}, SCHEMA, "mend it") == f"{path}: {words}; mend it"


def test_objects_that_are_none_or_lack_a_key(path):
    path.write_text("[1]")
    assert refusal(files.read_object, path, SCHEMA, "mend it") == f"{path}: is no JSON object; mend it"
    path.write_text("{}")
    assert refusal(files.read_object, path, SCHEMA, "mend it") == f"{path}: lacks task; mend it"
