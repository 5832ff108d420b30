"""Distributions of gaps, as data, and drawing from them.

A distribution is a TOML file with a table for each family of differences. A table holds items, domain parameters and
effects by name, with what they are drawn from, uniformly:

    latency = [0.0, 0.1]                                 one number; of a vector the same for all its axes
    action_bias = { each = [-0.3, 0.3] }                 a number for each axis of a vector
    action_scale = { common = [0.4, 1], each = [0.4, 1] }    either, at even odds
    obs_bias = { puck_xy = [-0.02, 0.02] }               a number for each axis of these entries, nothing for the others

A gap draws one to four of the families and of each of these one to all of its items, any number as likely as another.
"""

import tomllib
import zlib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs import gaps
from envs.base import Effects, Entry, Env, Value, entries_of, misnamed
from envs.gaps import Gap
from sgft_jax.types import UserError, unknown

MOST_FAMILIES = 4
ATTEMPTS = 100  # to draw a gap that is possible
DIGITS = 3  # that a drawn number keeps, so that a file says exactly what was drawn and a person can read it
_COMMON, _EACH = "common", "each"


class Distribution(NamedTuple):
    """Families by name; a family is items by name and how each is drawn: {how: (low, high)}.

    how: "common", "each" or an entry's name, see above. source: the file, for messages.
    """

    source: str
    families: Mapping[str, Mapping[str, Mapping[str, tuple[float, float]]]]


def load(env: Env, path: Path | None = None) -> Distribution:
    """The distribution of a file, by default that which comes with the task. Raises UserError naming file and item."""
    file = resources.files("envs") / "gaps" / "distributions" / f"{env.name}.toml" if path is None else path
    source = f"{env.name}.toml" if path is None else str(path)
    try:
        tables = tomllib.loads(file.read_text())
    except OSError:
        missing = f"{env.name} comes with no distribution of gaps; name a file of one"
        raise UserError(missing if path is None else f"{path}: no such file") from None
    except ValueError as error:
        raise UserError(f"{source}: not valid TOML: {error}") from None
    if not tables:
        raise UserError(f"{source}: has no family; write a table for each, with items and their ranges")
    families = {}
    for family, items in tables.items():
        if not isinstance(items, dict) or not items:
            raise UserError(f"{source}: '{family}' must be a table of items and their ranges, got {items!r}")
        families[family] = {name: _item(env, name, given, f"{source} [{family}]") for name, given in items.items()}
    return Distribution(source, families)


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
            return gaps.from_dict(env, name, _table(env, distribution, rng))
        except UserError as error:
            refused = error
    raise UserError(f"{distribution.source}: {ATTEMPTS} gaps drawn in a row are impossible; the last: {refused}")


def _table(env: Env, distribution: Distribution, rng: np.random.Generator) -> dict[str, Any]:
    """A gap as a file would hold it."""
    chosen = _some(rng, list(distribution.families), MOST_FAMILIES)
    table: dict[str, Any] = {"families": chosen, "params": {}, "effects": {}}
    for family in chosen:
        items = distribution.families[family]
        for name in _some(rng, list(items), len(items)):
            kind = "effects" if name in Effects._fields else "params"
            table[kind][name] = _value(rng, items[name], entries_of(env, name))
    return table


def _some(rng: np.random.Generator, names: list[str], most: int) -> list[str]:
    """One to `most` of the names, in their order."""
    count = rng.integers(1, min(most, len(names)), endpoint=True)
    return [names[i] for i in sorted(rng.choice(len(names), count, replace=False))]


def _value(rng: np.random.Generator, ways: Mapping[str, tuple[float, float]], entries: tuple[Entry, ...]) -> Value:
    """What a gap says of an item."""
    if not set(ways) & {_COMMON, _EACH}:
        sizes = {e.name: e.size for e in entries}
        return {name: _numbers(rng, ends, sizes[name]) for name, ends in ways.items()}
    way = list(ways)[rng.integers(len(ways))]
    return _numbers(rng, ways[way], 1 if way == _COMMON else sum(e.size for e in entries))


def _numbers(rng: np.random.Generator, ends: tuple[float, float], size: int) -> float | list[float]:
    drawn = [float(f"{x:.{DIGITS}g}") for x in rng.uniform(*ends, size)]
    return drawn if size > 1 else drawn[0]


def _item(env: Env, name: str, given: Any, where: str) -> dict[str, tuple[float, float]]:
    """How an item is drawn. Raises UserError for an unknown name and for what is no range."""
    if name not in Effects._fields and name not in [p.name for p in env.parameters]:
        raise UserError(f"{where}: {misnamed(env, name)}")
    ways, entries = given if isinstance(given, dict) else {_COMMON: given}, [e.name for e in entries_of(env, name)]
    allowed = [_COMMON, *([_EACH, *entries] if entries else [])]
    for way, ends in ways.items():
        if way not in allowed:
            raise UserError(f"{where} {unknown(name, way, allowed)}")
        if not _is_range(ends):
            raise UserError(f"{where}: '{name}' needs a range [low, high], got {ends!r}")
    if not ways or (set(ways) & {_COMMON, _EACH} and set(ways) & set(entries)):
        raise UserError(f"{where}: '{name}' needs ranges of '{_COMMON}' and '{_EACH}', or of entries, got {given!r}")
    return {way: (float(low), float(high)) for way, (low, high) in ways.items()}


def _is_range(ends: Any) -> bool:
    numbers = isinstance(ends, list) and all(isinstance(x, int | float) and not isinstance(x, bool) for x in ends)
    return numbers and len(ends) == 2 and bool(np.isfinite(ends).all()) and ends[0] <= ends[1]
