"""Gaps: how a "real" system differs from the simulator, as data. Reads TOML and JSON files.

A gap names only what differs; everything else stays as in training. `params` fixes domain parameters (or gives them
another range), also outside the training range; `effects` distorts commands and measurements, see `envs.base.Effects`.
`scene` names another scene than the simulated one, see `envs.make`: a towel where the simulator has a puck.
"""

import json
import tomllib
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from envs.base import Effects, Env, World
from sgft_jax.types import Key, UserError

Value = float | list[float]


class Gap(NamedTuple):
    """A named difference between simulator and reality: parameter or effect name -> value, [low, high] or vector."""

    name: str
    params: dict[str, Value]
    effects: dict[str, Value]
    scene: str = ""


def presets(task: str) -> dict[str, Gap]:
    """The gaps that come with a task, by name; none if it has no file of them."""
    file = resources.files("envs") / "gaps" / f"{task}.toml"
    tables = tomllib.loads(file.read_text()) if file.is_file() else {}
    return {name: _parse(name, table, where=f"{task}.toml [{name}]") for name, table in tables.items()}


def load(env: Env, source: str, overrides: Sequence[str] = ()) -> Gap:
    """A gap from a preset name or a .toml/.json file, changed by overrides such as "latency=0.05".

    A file holds two tables, `params` and `effects`, and the name of a `scene`; all may be missing. Raises UserError
    naming file and key.
    """
    if source.endswith((".toml", ".json")):
        gap = _from_file(Path(source))
    else:
        known = presets(env.name)
        if source not in known:
            raise UserError(
                f"{env.name} has no gap '{source}'; it has: {', '.join(known) or 'none'}; or give a .toml or .json file"
            )
        gap = known[source]
    for text in overrides:
        gap = _override(env, gap, text)
    _check_names(env, gap)
    return gap


def worlds(env: Env, gap: Gap, key: Key, n: int = 256) -> World:
    """The real system of a gap as a pool of worlds [n], or [1] where nothing in it varies."""
    fixed = {name for name, value in gap.params.items() if not isinstance(value, list) or value[0] == value[1]}
    varies = any(p.name not in fixed and (p.name in gap.params or p.low < p.high) for p in env.parameters)
    return env.sample_worlds(key, n if varies else 1, params=gap.params, effects=gap.effects)


def _from_file(path: Path) -> Gap:
    try:
        data = path.read_text()
        table = json.loads(data) if path.suffix == ".json" else tomllib.loads(data)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from None
    except ValueError as error:  # both decoders raise subclasses of it
        raise UserError(f"{path}: not valid {path.suffix[1:].upper()}: {error}") from None
    return _parse(path.stem, table, where=str(path))


def _parse(name: str, table: Any, *, where: str) -> Gap:
    if not isinstance(table, dict) or set(table) - {"params", "effects", "scene"}:
        odd = (
            sorted(set(table) - {"params", "effects", "scene"})[0] if isinstance(table, dict) else type(table).__name__
        )
        raise UserError(
            f"{where}: unexpected '{odd}'; a gap has two tables, 'params' and 'effects', and may name a 'scene'"
        )
    scene = table.get("scene", "")
    if not isinstance(scene, str):
        raise UserError(f"{where}: 'scene' must be a name, got {scene!r}")
    for section in (table.get(name, {}) for name in ("params", "effects")):
        for key, value in section.items() if isinstance(section, dict) else [("params/effects", section)]:
            if not _is_value(value):
                raise UserError(f"{where}: '{key}' must be a number or a list of numbers, got {value!r}")
    return Gap(name, table.get("params", {}), table.get("effects", {}), scene)


def _is_value(value: Any) -> bool:
    numbers = value if isinstance(value, list) and value else [value]
    return all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers)


def _override(env: Env, gap: Gap, text: str) -> Gap:
    name, equals, value = (part.strip() for part in text.partition("="))
    try:
        parsed = json.loads(value)
    except ValueError:
        parsed = None
    if not equals or parsed is None or not _is_value(parsed):
        raise UserError(f"'{text}' does not set anything; write name=number or name=[number,number]")
    changed = Gap(f"{gap.name}+{name}={value}", dict(gap.params), dict(gap.effects), gap.scene)
    (changed.effects if name in Effects._fields else changed.params)[name] = parsed
    return changed


def _check_names(env: Env, gap: Gap) -> None:
    for kind, given, known in (
        ("domain parameter", gap.params, [p.name for p in env.parameters]),
        ("effect", gap.effects, list(Effects._fields)),
    ):
        for name in given:
            if name not in known:
                raise UserError(f"gap '{gap.name}': {env.name} has no {kind} '{name}'; it has: {', '.join(known)}")
