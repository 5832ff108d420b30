"""Impure: the one way in for text files, whoever wrote them: plain files of a bounded size, UTF-8, every value finite.

Imports no JAX. Whatever is wrong with a file is a `UserError` with one line that names it.
"""

import functools
import json
import math
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, TypedDict, cast

import msgspec
from msgspec import Meta

from envs.types import UserError

LIMIT = 64 * 2**20  # bytes; no card, table or configuration comes near
_DEPTH = 100  # of lists and objects within each other; what reads them may recurse
_LARGEST = 2**53  # every whole number below is a float too

# Kinds of numbers for schemas.
Count = Annotated[int, Meta(ge=0, le=_LARGEST)]
Size = Annotated[int, Meta(ge=1, le=_LARGEST)]
Positive = Annotated[float, Meta(gt=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
Schema = type | Mapping[str, Any]  # a `msgspec.Struct`, a `TypedDict`, or types by key

_WORDS = dict(str="a text", int="a whole number", float="a number", object="an object", array="a list")
_WORDS |= {"bool": "true or false", "null": "null"}


def read_text(path: Path | str, *, limit: int = LIMIT) -> str:
    """The text of a plain file, without a byte order mark. limit: bytes; a larger file is refused."""
    return decoded(read_bytes(path, limit=limit), path)


def read_bytes(path: Path | str, *, limit: int = LIMIT) -> bytes:
    """The content of a plain file. limit: bytes; a larger file is refused."""
    # A named pipe would wait for its other end.
    with readable(path), open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise UserError(f"{path}: is no plain file")
        content = file.read(limit + 1)
    if len(content) > limit:
        raise UserError(f"{path}: is larger than {limit:,} bytes, more than such a file can need")
    return content


@contextmanager
def readable(path: Path | str) -> Iterator[None]:
    """Around what opens a file or folder; raises UserError where there is none, or none that can be read."""
    try:
        yield
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:  # a name that is too long, a folder that is closed
        raise UserError(f"{path}: cannot be read ({(error.strerror or str(error)).lower()})") from None
    except ValueError:  # a zero byte
        raise UserError(f"{str(path)!r}: is no name of a file") from None


def decoded(content: bytes, path: Path | str) -> str:
    """UTF-8 text without a byte order mark; `path` names it in errors."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is no UTF-8 text (byte {error.start}); save it as UTF-8") from None


def read_json(path: Path | str, *, limit: int = LIMIT) -> Any:
    """The content of a JSON file."""
    return parse_json(read_text(path, limit=limit), path)


def read_toml(path: Path | str) -> dict[str, Any]:
    """The content of a TOML file."""
    return _parsed(lambda text: tomllib.loads(text, parse_float=_finite), read_text(path), path, "TOML")


def parse_json(text: str | bytes, where: Path | str) -> Any:
    """What a JSON text says; `where` names it in errors. Keys that come twice and numbers beyond floats are refused."""
    strict = {"parse_float": _finite, "parse_constant": _finite, "object_pairs_hook": _unique}
    return _parsed(functools.partial(json.loads, **strict), text, where, "JSON")


def read_object(path: Path | str, schema: Schema, fix: str) -> dict[str, Any]:
    """A JSON object that fits a schema; keys that the schema does not name are kept. fix: what the user can do."""
    return checked(path, read_json(path), schema, fix)


def checked(where: Path | str, data: Any, schema: Schema, fix: str) -> Any:
    """`data` as it is, if it fits the schema. fix: what the user can do where it does not."""
    try:
        msgspec.convert(data, kind_of(schema))
    except msgspec.ValidationError as error:
        raise UserError(f"{where}: {_in_words(str(error))}; {fix}") from None
    return data


def kind_of(schema: Schema) -> Any:
    """A schema as a type, which costs less where many are checked against it."""
    return cast(Any, TypedDict)("Object", dict(schema)) if isinstance(schema, Mapping) else schema


def _parsed[T](parse: Callable[[Any], T], text: Any, where: Path | str, language: str) -> T:
    try:
        parsed = parse(text)
        _check_depth(parsed)
        return parsed
    except RecursionError:
        raise UserError(f"{where}: not valid {language} (nested too deeply)") from None
    except ValueError as error:  # of either parser, or of a number with thousands of digits
        raise UserError(f"{where}: not valid {language} ({str(error).partition('; use sys')[0]})") from None


def _check_depth(value: Any) -> None:
    """Raises RecursionError, as parsers do; dotted keys of TOML nest without one."""
    level = [value]
    for _ in range(_DEPTH):
        tables = (part.values() if isinstance(part, dict) else part for part in level if isinstance(part, dict | list))
        if not (level := [part for table in tables for part in table]):
            return
    raise RecursionError


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text} is no finite number")
    return number


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        keys = set[str]()
        twice = next(key for key, _ in pairs if key in keys or keys.add(key))
        raise ValueError(f"{twice!r} stands there twice")
    return table


def _in_words(message: str) -> str:
    """What msgspec says, as a sentence that begins with the key."""
    complaint, _, place = message.partition(" - at `$")
    key = place.rstrip("`").removeprefix(".")
    if missing := re.fullmatch(r"Object missing required field `(.+)`", complaint):
        return f"lacks {'.'.join(filter(None, [key, missing[1]]))}"
    if kinds := re.fullmatch(r"Expected `(.+)`, got `(\w+)`", complaint):
        wanted = " or ".join(_WORDS.get(kind, kind) for kind in kinds[1].split(" | "))
        return f"{key} is {_WORDS.get(kinds[2], kinds[2])}, not {wanted}" if key else "is no JSON object"
    plain = complaint.replace("`", "")
    return f"{key}: {plain[:1].lower()}{plain[1:]}" if key else plain
