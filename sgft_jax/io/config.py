"""Configurations as data: frozen dataclasses to plain JSON and back, and where two of them differ."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sgft_jax.io.jsonfile import jsonable
from sgft_jax.types import UserError


def config_to_json(config: Any) -> dict[str, Any]:
    """A frozen dataclass, nested ones included, as plain JSON data with every field spelled out."""
    return {f.name: _to_json(getattr(config, f.name)) for f in dataclasses.fields(config)}


def config_from_json[T](cls: type[T], data: Mapping[str, Any], *, where: str = "") -> T:
    """The inverse of `config_to_json`, guided by the annotations of `cls`.

    where: dotted prefix for messages. Raises UserError naming the first field that is unknown, missing or of the wrong
    type.
    """
    if not isinstance(data, Mapping):
        raise UserError(f"{where or cls.__name__}: expected an object with the fields of {cls.__name__}, got {data!r}")
    hints = typing.get_type_hints(cls)
    names = {f.name for f in dataclasses.fields(typing.cast(Any, cls)) if f.init}
    if unknown := sorted(set(data) - names):
        raise UserError(f"{where}{unknown[0]}: {cls.__name__} has no such field; it has {', '.join(sorted(names))}")
    if missing := sorted(names - set(data)):
        raise UserError(f"{where}{missing[0]}: missing from {cls.__name__}")
    return cls(**{name: _from_json(hints[name], value, f"{where}{name}") for name, value in data.items()})


def differences(old: Any, new: Any, *, name: str = "") -> list[tuple[str, Any, Any]]:
    """(dotted name, old, new) of every leaf that differs between two pieces of JSON data."""
    if isinstance(old, dict) and isinstance(new, dict):
        found: list[tuple[str, Any, Any]] = []
        for key in [*old, *(k for k in new if k not in old)]:
            found += differences(old.get(key), new.get(key), name=f"{name}.{key}" if name else key)
        return found
    return [] if old == new else [(name, old, new)]


def _to_json(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return config_to_json(value)
    if isinstance(value, (tuple, list)):
        return [_to_json(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): _to_json(v) for k, v in value.items()}
    return jsonable(value)


def _from_json(hint: Any, value: Any, where: str) -> Any:
    """`value` as the annotation `hint` wants it: dataclass, tuple, dict, optional or union, Literal, path or number."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _from_json(arguments[0], value, where)
    if origin in (typing.Union, types.UnionType):
        return _from_union(arguments, value, where)
    if origin is typing.Literal:
        return _checked(value in arguments, hint, value, where)
    if origin in (tuple, list):
        _checked(isinstance(value, list), hint, value, where)
        repeated = origin is list or arguments[-1] is Ellipsis
        kinds = [arguments[0]] * len(value) if repeated else list(arguments)
        _checked(len(kinds) == len(value), hint, value, where)
        return origin(_from_json(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(kinds, value, strict=True)))
    if origin is dict:
        _checked(isinstance(value, dict), hint, value, where)
        return {k: _from_json(arguments[1], v, f"{where}.{k}") for k, v in value.items()}
    if dataclasses.is_dataclass(hint):
        return config_from_json(typing.cast(type, hint), value, where=f"{where}.")
    return _scalar(hint, value, where)


def _from_union(kinds: tuple[Any, ...], value: Any, where: str) -> Any:
    """The first member that fits; dataclasses differ by the names of their fields."""
    failure = None
    for kind in kinds:
        try:
            return _from_json(kind, value, where)
        except UserError as error:
            failure = failure if kind is types.NoneType else error
    raise failure or UserError(f"{where}: {value!r} does not fit")


def _scalar(hint: Any, value: Any, where: str) -> Any:
    if hint is types.NoneType:
        return _checked(value is None, "null", value, where)
    if hint is float:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        _checked(number or value in ("nan", "inf", "-inf"), hint, value, where)
        return float(value)
    if hint is int:
        return _checked(isinstance(value, int) and not isinstance(value, bool), hint, value, where)
    if hint in (bool, str):
        return _checked(isinstance(value, hint), hint, value, where)
    if hint is Path:
        return Path(_checked(isinstance(value, str), hint, value, where))
    raise TypeError(f"{where}: configurations cannot hold {hint}")


def _checked(fits: bool, hint: Any, value: Any, where: str) -> Any:
    if not fits:
        raise UserError(f"{where}: expected {hint.__name__ if isinstance(hint, type) else hint}, got {value!r}")
    return value
