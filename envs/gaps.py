"""Gaps: how a "real" system differs from the simulator, as data. Reads TOML and JSON files.

A gap names only what differs; everything else stays as in training. `params` fixes domain parameters (or gives them
another range), also outside the training range; `effects` distorts commands and measurements, see `envs.base.Effects`.
`scene` names another scene than the simulated one, see `envs.make`: a towel where the simulator has a puck.
"""

import json
import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from envs.base import Effects, Env, Value, World
from sgft_jax.types import Key, UserError, unknown

SIM = "sim"  # names the training domain itself where a gap could stand


class Gap(NamedTuple):
    """A named difference between simulator and reality: parameter or effect name -> value or range.

    Ranges are [low, high], of vectors [[low, ...], [high, ...]]. Every episode draws its effects from their ranges.
    """

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
    elif source in (known := presets(env.name)):
        gap = known[source]
    else:
        raise no_such_gap(env.name, source)
    seen = set()
    for text in overrides:
        gap, name = _override(gap, text)
        if name in seen:
            raise UserError(f"'{text}': '{name}' is set twice; set it once")
        seen.add(name)
    _check(env, gap)
    return gap


def no_such_gap(task: str, name: str) -> UserError:
    """What to tell someone who named a gap that the task does not come with."""
    if known := presets(task):
        return UserError(f"{unknown(f'gap of {task}', name, known)}; or give a .toml or .json file")
    return UserError(f"{task} has no gap {name!r}: it comes with none; give a .toml or .json file")


def from_dict(env: Env, name: str, table: Mapping[str, Any]) -> Gap:
    """A gap from {"params": {...}, "effects": {...}, "scene": ...}, what a file would hold. Raises UserError."""
    gap = _parse(name, dict(table), where=f"gap '{name}'")
    _check(env, gap)
    return gap


def worlds(env: Env, gap: Gap, key: Key, n: int = 256) -> World:
    """The real system of a gap as a pool of worlds [n], or [1] where its domain parameters do not vary."""
    from envs.domains.uniform import parameter_ranges, sample_worlds

    low, high = parameter_ranges(env, gap.params).T
    return sample_worlds(env, key, n if (low < high).any() else 1, params=gap.params, effects=gap.effects)


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
        odd = sorted({*table} - {"params", "effects", "scene"})[0] if isinstance(table, dict) else type(table).__name__
        raise UserError(
            f"{where}: unexpected '{odd}'; a gap has two tables, 'params' and 'effects', and may name a 'scene'"
        )
    gap = Gap(name, table.get("params", {}), table.get("effects", {}), table.get("scene", ""))
    if not isinstance(gap.scene, str):
        raise UserError(f"{where}: 'scene' must be a name, got {gap.scene!r}")
    for section, values in (("params", gap.params), ("effects", gap.effects)):
        if not isinstance(values, dict):
            raise UserError(f"{where}: '{section}' must be a table of names and numbers, got {values!r}")
        for key, value in values.items():
            if not _is_value(value):
                raise UserError(f"{where}: '{key}' must be a number or a list of numbers, got {value!r}")
    return gap


def _is_value(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(map(_is_value, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def _override(gap: Gap, text: str) -> tuple[Gap, str]:
    """The gap with what the text sets, and the name of that."""
    name, equals, value = (part.strip() for part in text.partition("="))
    try:
        parsed = json.loads(value)
    except ValueError:
        parsed = None
    if not equals or parsed is None or not _is_value(parsed):
        raise UserError(f"'{text}' does not set anything; write name=number or name=[number,number]")
    changed = Gap(f"{gap.name}+{name}={value}", dict(gap.params), dict(gap.effects), gap.scene)
    (changed.effects if name in Effects._fields else changed.params)[name] = parsed
    return changed, name


def _check(env: Env, gap: Gap) -> None:
    """Raises UserError for unknown names and impossible values."""
    from envs.domains.uniform import uniform

    try:
        uniform(env, gap.params, gap.effects)
    except UserError as error:
        raise UserError(f"gap '{gap.name}': {error}") from None
