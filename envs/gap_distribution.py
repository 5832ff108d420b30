"""Impure: distributions of gaps, read from TOML files, and drawing from them.

A distribution is a TOML file with a table for each family of differences. A table holds items, domain parameters,
effects and errors of commands by name, with what they are drawn from, uniformly:

    latency = [0.0, 0.1]                                 one number; of a vector the same for all its axes
    action_bias = { each = [-0.3, 0.3] }                 a number for each axis of a vector
    action_scale = { common = [0.4, 1], each = [0.4, 1] }    either, at even odds
    obs_bias = { puck_xy = [-0.02, 0.02] }               a number for each axis of these entries, nothing for the others
    obs_bias = { puck_xy = { length = [0.005, 0.02] } }  a vector of that length in any direction, instead of a box
    drift = { puck_xy = { length = [0.001, 0.002] } }    likewise, of the sensors' drift
    scene = ["tilt+15", "patches-0"]                     one of these scenes
    together = true                                      all items of this family are drawn, not some of them

A gap draws one to four of the families and of each of these one to all of its items, any number as likely as another.
Where the file begins with `alone = true`, it has one family: gap i the i-th, and after the last the first again.
"""

import zlib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs import gaps
from envs.base import COMMANDS, WHOLE, Effects, Entry, Env, Value, entries_of, misnamed
from envs.files import read_toml
from envs.gaps import Gap
from envs.types import UserError, unknown

MOST_FAMILIES = 4
ATTEMPTS = 100  # to draw a gap that is possible
DIGITS = 3  # that a drawn number keeps, so that a file says exactly what was drawn and a person can read it
_COMMON, _EACH, _LENGTH, _TOGETHER, _ALONE = "common", "each", "length", "together", "alone"
_DRIFT, _SCENE = "drift", "scene"


class Range(NamedTuple):
    """Ends of a uniform draw: of each number, or of the length of the vector that they make."""

    low: float
    high: float
    of_length: bool = False


Item = Mapping[str, Range] | tuple[str, ...]


class Distribution(NamedTuple):
    """Families by name; a family is items by name and how each is drawn: {how: range}, or names of scenes.

    how: "common", "each" or an entry's name, see above. together: the families of which all items are drawn. alone:
    whether a gap has one family. source: the file, for messages.
    """

    source: str
    families: Mapping[str, Mapping[str, Item]]
    together: frozenset[str]
    alone: bool = False


def load(env: Env, path: Path | None = None) -> Distribution:
    """The distribution of a file, by default that which comes with the task. Raises UserError naming file and item."""
    file = resources.files("envs") / "gaps" / "distributions" / f"{env.name}.toml" if path is None else path
    source = f"{env.name}.toml" if path is None else str(path)
    if path is None and not file.is_file():
        raise UserError(f"{env.name} comes with no distribution of gaps; name a file of one")
    tables = read_toml(str(file))
    alone = _flag(tables, _ALONE, source)
    if not (tables := {family: table for family, table in tables.items() if family != _ALONE}):
        raise UserError(f"{source}: has no family; write a table for each, with items and their ranges")
    families, together = {}, set()
    for family, table in tables.items():
        items = {name: ranges for name, ranges in table.items() if name != _TOGETHER} if isinstance(table, dict) else {}
        if not items:
            raise UserError(f"{source}: '{family}' must be a table of items and their ranges, got {table!r}")
        families[family] = {name: _item(env, name, ranges, f"{source} [{family}]") for name, ranges in items.items()}
        together |= {family} if _flag(table, _TOGETHER, f"{source} [{family}]") else set()
    return Distribution(source, families, frozenset(together), alone)


def _flag(table: Mapping[str, Any], name: str, where: str) -> bool:
    if not isinstance(flag := table.get(name, False), bool):
        raise UserError(f"{where}: '{name}' must be true or false, got {flag!r}")
    return flag


def draw(env: Env, distribution: Distribution, seed: int, n: int) -> list[Gap]:
    """Gaps called "<task>-<seed>-<number>". The i-th is the same for every n.

    What the task refuses is drawn again. Raises UserError where that does not help.
    """
    return [_possible(env, distribution, seed, i) for i in range(n)]


def _possible(env: Env, distribution: Distribution, seed: int, number: int) -> Gap:
    rng = np.random.default_rng([zlib.crc32(env.name.encode()), seed, number])  # other tasks draw something else
    name, refused = f"{env.name}-{seed}-{number:02d}", None
    for _ in range(ATTEMPTS):
        try:
            return gaps.from_dict(env, name, _table(env, distribution, rng, number))
        except UserError as error:
            refused = error
    raise UserError(f"{distribution.source}: {ATTEMPTS} gaps drawn in a row are impossible; the last: {refused}")


def _table(env: Env, distribution: Distribution, rng: np.random.Generator, number: int) -> dict[str, Any]:
    """A gap as a file would hold it."""
    families = list(distribution.families)
    chosen = [families[number % len(families)]] if distribution.alone else _some(rng, families, MOST_FAMILIES)
    table: dict[str, Any] = {"families": chosen, "params": {}, "effects": {}, "commands": {}}
    for family in chosen:
        items = distribution.families[family]
        for name in list(items) if family in distribution.together else _some(rng, list(items), len(items)):
            value = _value(rng, name, items[name], entries_of(env, "obs_bias" if name == _DRIFT else name))
            kind = "effects" if name in Effects._fields else "commands" if name in COMMANDS else "params"
            (table if name in (_DRIFT, _SCENE) else table[kind])[name] = value
    return table


def _some(rng: np.random.Generator, names: list[str], most: int) -> list[str]:
    """One to `most` of the names, in their order."""
    count = rng.integers(1, min(most, len(names)), endpoint=True)
    return [names[i] for i in sorted(rng.choice(len(names), count, replace=False))]


def _value(rng: np.random.Generator, name: str, ways: Item, entries: tuple[Entry, ...]) -> Value | str:
    """What a gap says of an item."""
    if not isinstance(ways, Mapping):
        return ways[rng.integers(len(ways))]
    if name in WHOLE:
        return int(rng.integers(int(ways[_COMMON].low), int(ways[_COMMON].high), endpoint=True))
    if not set(ways) & {_COMMON, _EACH}:
        sizes = {e.name: e.size for e in entries}
        return {name: _numbers(rng, ranges, sizes[name]) for name, ranges in ways.items()}
    way = list(ways)[rng.integers(len(ways))]
    return _numbers(rng, ways[way], 1 if way == _COMMON else sum(e.size for e in entries))


def _numbers(rng: np.random.Generator, bounds: Range, size: int) -> float | list[float]:
    drawn = rng.uniform(bounds.low, bounds.high, 1 if bounds.of_length else size)
    if bounds.of_length:
        direction = rng.normal(size=size)
        drawn = drawn * direction / np.linalg.norm(direction)
    rounded = [float(f"{x:.{DIGITS}g}") for x in drawn]
    return rounded if size > 1 else rounded[0]


def _item(env: Env, name: str, table: Any, where: str) -> Item:
    """How an item is drawn. Raises UserError for an unknown name and for what is no range."""
    if name == _SCENE:
        if not isinstance(table, list) or not table or not all(isinstance(scene, str) for scene in table):
            raise UserError(f"{where}: 'scene' needs a list of names, got {table!r}")
        return tuple(table)
    if name not in (*Effects._fields, *COMMANDS, _DRIFT, *(p.name for p in env.parameters)):
        raise UserError(f"{where}: {misnamed(env, name)}")
    ways = table if isinstance(table, dict) else {_COMMON: table}
    entries = [e.name for e in entries_of(env, "obs_bias" if name == _DRIFT else name)]
    allowed = entries if name == _DRIFT else [_COMMON, *([_EACH, *entries] if entries else [])]
    for way in ways:
        if way not in allowed:
            raise UserError(f"{where} {unknown(name, way, allowed)}")
    if not ways or (set(ways) & {_COMMON, _EACH} and set(ways) & set(entries)):
        raise UserError(f"{where}: '{name}' needs ranges of '{_COMMON}' and '{_EACH}', or of entries, got {table!r}")
    return {way: _range(ends, f"{where}: '{name}'", named=way in entries) for way, ends in ways.items()}


def _range(table: Any, where: str, *, named: bool) -> Range:
    """named: of an entry, of which the length may be given."""
    of_length = named and isinstance(table, dict) and set(table) == {_LENGTH}
    ends = table[_LENGTH] if of_length else table
    if not _is_range(ends):
        raise UserError(f"{where} needs a range [low, high], got {table!r}")
    if of_length and ends[0] < 0:
        raise UserError(f"{where}: a length must not be negative, got {ends!r}")
    return Range(float(ends[0]), float(ends[1]), of_length)


def _is_range(ends: Any) -> bool:
    numbers = isinstance(ends, list) and all(isinstance(x, int | float) and not isinstance(x, bool) for x in ends)
    return numbers and len(ends) == 2 and bool(np.isfinite(ends).all()) and ends[0] <= ends[1]
