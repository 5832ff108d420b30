"""Impure: gaps, how a "real" system differs from the simulator, as data. Reads TOML and JSON files, writes TOML.

A gap names only what differs; everything else stays as in training. `params` fixes domain parameters (or gives them
another range), also outside the training range; `effects` distorts commands and measurements, see `envs.base.Effects`;
`commands` are errors of commands that the simulator never has, see `envs.base.COMMANDS`; `drift` says how much further
off sensors are with every rollout of fine-tuning, raw units by entry name, added to `obs_bias`.
`scene` names another scene than the simulated one, see `envs.make`: a towel where the simulator has a puck. `families`
says which kinds of difference were drawn, see `envs.gap_distribution`, and `stratum` how often the simulator's policies
succeed there, see `experiments.gaps`; only tables read them.
"""

import itertools
import json
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from envs import extend
from envs.base import COMMANDS, WHOLE, Effects, Env, Numbers, Value, World
from envs.files import parse_json, read_json, read_toml
from envs.types import Array, Key, UserError, unknown

__all__ = [
    "Gap",
    "by_scene",
    "changes",
    "drifts",
    "expand",
    "find",
    "from_dict",
    "load",
    "presets",
    "read_file",
    "title",
    "to_toml",
    "usual",
    "worlds",
]

SIM = "sim"  # names the gap in which nothing differs: the real system is the training domain itself
_TABLES = ("params", "effects", "commands", "drift")
_KEYS = frozenset({*_TABLES, "scene", "families", "stratum"})
_FILE = re.compile(r"(.*\.(?:toml|json))(?::(.+))?")  # a file, or one gap of a file


class Gap(NamedTuple):
    """A named difference between simulator and reality: parameter or effect name -> value or range.

    Ranges are [low, high], of vectors [[low, ...], [high, ...]]; a vector may be a table by entry name, see
    `envs.effects.make_range`. Every episode draws its effects from their ranges. families: of a gap that was drawn.
    stratum: "solved", "partial" or "failed" of one that was measured too. commands: how they err.
    drift: raw units by which sensors are further off with every rollout, by entry name.
    """

    name: str
    params: dict[str, Value]
    effects: dict[str, Value]
    scene: str = ""
    families: tuple[str, ...] = ()
    stratum: str = ""
    commands: Mapping[str, float] = MappingProxyType({})
    drift: Mapping[str, Numbers] = MappingProxyType({})

    @property
    def table(self) -> dict[str, Any]:
        """For files, every field by its name: `commands` and `drift` where there are any, as in files of before."""
        return {name: x for name, x in self._asdict().items() if x or name not in ("commands", "drift")}


def presets(task: str, *, variants: bool = True) -> dict[str, Gap]:
    """The gaps that come with a task, by name; none if it has no file of them.

    variants: also those of envs/gaps/variants/, each another one of the task changed in a detail. Comparisons leave
    them out unless they are named.
    """
    folder = resources.files("envs") / "gaps"
    files = [folder / f"{task}.toml", *([folder / "variants" / f"{task}.toml"] if variants else [])]
    tables = [tomllib.loads(file.read_text()).items() for file in files if file.is_file()]
    return {name: _parse(name, table, where=f"{task}.toml [{name}]") for name, table in itertools.chain(*tables)}


def read_file(path: str | Path) -> dict[str, Gap]:
    """The gaps of a .toml/.json file by name. Raises UserError naming file and key.

    A file holds either one gap, called like the file, or a table for each of several, called like the tables. Run
    folders are called so too, so a name must be one of a folder.
    """
    path = Path(path)
    table = read_json(path) if path.suffix == ".json" else read_toml(path)
    if not _holds_several(table):
        return {path.stem: _parse(extend.folder_name(f"{path}: the name", path.stem), table, where=str(path))}
    for name in table:
        extend.folder_name(f"{path}: the gap", name)
    return {name: _parse(name, gap, where=f"{path} [{name}]") for name, gap in table.items()}


def find(task: str, source: str) -> Gap:
    """The gap called SIM, one that comes with a task, by name, or that of a file; its values are not checked.

    source: a name, "file.toml", or "file.toml:name" for one of several in a file. Raises UserError if there is none.
    """
    if source == SIM:
        return Gap(SIM, {}, {})
    if match := _FILE.fullmatch(source):
        path, name = match.groups()
        content = read_file(path)
        if name is None and len(content) > 1:
            raise UserError(f"{path} holds {len(content)} gaps; name one of them, e.g. {path}:{next(iter(content))}")
        name = name or next(iter(content))
        if name not in content:
            raise UserError(unknown(f"gap in {path}", name, content))
        return content[name]
    if "/" in source:
        folder = "is a folder; name a gap, or a .toml or .json file"
        raise UserError(f"{source}: {folder if Path(source).is_dir() else 'no such folder'}")
    if source in (known := presets(task)):
        return known[source]
    if known:
        raise UserError(f"{unknown(f'gap of {task}', source, [*known, SIM])}; or give a .toml or .json file")
    raise UserError(f"{task} has no gap {source!r}: it comes with none; give a .toml or .json file, or {SIM}")


def usual(task: str) -> str:
    """The gap to fine-tune a task on where nobody says which: `default`, else its first one, else SIM."""
    known = presets(task)
    return "default" if "default" in known else next(iter(known), SIM)


def expand(sources: Iterable[str]) -> tuple[str, ...]:
    """Sources of one gap each, see `find`: a file that holds several becomes "file.toml:name" of every one of them."""
    single: list[str] = []
    for source in sources:
        match = _FILE.fullmatch(source)
        content = {} if match is None or match[2] else read_file(source)
        single += [f"{source}:{name}" for name in content] if len(content) > 1 else [source]
    return tuple(single)


def by_scene[T](systems: Iterable[T], scene: Callable[[T], str]) -> list[list[T]]:
    """Real systems in the groups that one program can step: those of one scene, in the order of the first ones."""
    groups: dict[str, list[T]] = {}
    for system in systems:
        groups.setdefault(scene(system), []).append(system)
    return list(groups.values())


def title(source: str) -> str:
    """What folders call the gap of that source, see `find`: the name of one of several, else that of the file."""
    match = _FILE.fullmatch(source)
    return source if match is None else match[2] or Path(match[1]).stem


def load(env: Env, source: str, overrides: Sequence[str] = ()) -> Gap:
    """The gap that `find` finds, changed by overrides such as "latency=0.05". Raises UserError naming file and key."""
    gap = find(env.name, source)
    params, effects, commands = dict(gap.params), dict(gap.effects), dict[str, Any](gap.commands)
    for name, value in changes(overrides).items():
        (effects if name in Effects._fields else commands if name in COMMANDS else params)[name] = value
    words = ["=".join(part.strip() for part in text.partition("=")[::2]) for text in overrides]
    gap = gap._replace(name="+".join([gap.name, *words]), params=params, effects=effects, commands=commands)
    _check(env, gap)
    return gap


def from_dict(env: Env, name: str, table: Mapping[str, Any]) -> Gap:
    """A gap from {"params": {...}, "effects": {...}, "scene": ...}, what a file of it would hold. Raises UserError."""
    gap = _parse(name, dict(table), where=f"gap '{name}'")
    _check(env, gap)
    return gap


def worlds(env: Env, gap: Gap, key: Key, n: int = 256) -> World:
    """The real system of a gap as a pool of worlds [n], or [1] where its domain parameters do not vary."""
    from envs.commands import given
    from envs.domains import parameter_ranges, sample_worlds

    low, high = parameter_ranges(env, gap.params).T
    pool = sample_worlds(env, key, n if (low < high).any() else 1, params=gap.params, effects=gap.effects)
    return given(env, pool, gap.commands) if gap.commands else pool


def drifts(env: Env, real_gaps: Sequence[Gap]) -> Array | None:
    """[gaps, measured_dim] raw units by which sensors are further off with every rollout; None where none drifts."""
    if not any(gap.drift for gap in real_gaps):
        return None
    import jax.numpy as jnp

    from envs.effects import make_range

    try:
        ranges = [make_range(env, {"obs_bias": gap.drift}) for gap in real_gaps]
    except UserError as error:
        raise UserError(f"'drift' is a rate of 'obs_bias': {error}") from None
    if any((ends.low.obs_bias != ends.high.obs_bias).any() for ends in ranges):
        raise UserError("'drift' needs numbers, not ranges")
    return jnp.stack([ends.low.obs_bias for ends in ranges])


def to_toml(listed: Iterable[Gap]) -> str:
    """Gaps as the text of a file that holds several, for people too. `read_file` gives back the same gaps."""
    lines: list[str] = []
    for gap in listed:
        values = {name: getattr(gap, name) for name in ("stratum", "scene", "families", *_TABLES)}
        lines += ["", f"[{_key(gap.name)}]", *(f"{name} = {_inline(value)}" for name, value in values.items() if value)]
    return "\n".join([*lines[1:], ""])


def _key(name: str) -> str:
    return name if re.fullmatch(r"[\w-]+", name, re.ASCII) else json.dumps(name)


def _inline(value: Any) -> str:
    """What is not a table reads the same in TOML as in JSON."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{_key(name)} = {_inline(item)}' for name, item in value.items())} }}"
    return json.dumps(value)


def _holds_several(table: Any) -> bool:
    if not isinstance(table, dict) or not table or set(table) & _KEYS:
        return False
    return all(isinstance(gap, dict) and not set(gap) - _KEYS for gap in table.values())


def _parse(name: str, table: Any, *, where: str) -> Gap:
    if not isinstance(table, dict) or set(table) - _KEYS:
        odd = sorted({*table} - _KEYS)[0] if isinstance(table, dict) else type(table).__name__
        raise UserError(
            f"{where}: unexpected '{odd}'; a gap has tables 'params', 'effects', 'commands' and 'drift', and may name "
            "a 'scene', 'families' and a 'stratum'"
        )
    families = table.get("families", [])
    if not isinstance(families, list) or not all(isinstance(family, str) for family in families):
        raise UserError(f"{where}: 'families' must be a list of names, got {families!r}")
    words = {key: table.get(key, "") for key in ("scene", "stratum")}
    if odd := [key for key, word in words.items() if not isinstance(word, str)]:
        raise UserError(f"{where}: '{odd[0]}' must be a name, got {words[odd[0]]!r}")
    tables = {section: table.get(section, {}) for section in _TABLES}
    for section, values in tables.items():
        if not isinstance(values, dict):
            raise UserError(f"{where}: '{section}' must be a table of names and numbers, got {values!r}")
        for key, value in values.items():
            if not _is_value(value):
                raise UserError(f"{where}: '{key}' must be a number or a list of numbers, got {value!r}")
    _check_commands(where, tables["commands"])
    return Gap(name, **tables, families=tuple(families), **words)


def _is_value(value: Any) -> bool:
    if isinstance(value, dict | list):
        parts = value.values() if isinstance(value, dict) else value
        return bool(value) and all(not isinstance(part, dict) and _is_value(part) for part in parts)
    return isinstance(value, int | float) and not isinstance(value, bool)


def changes(overrides: Sequence[str]) -> dict[str, Value]:
    """What overrides such as "latency=0.05" set, by name. Raises UserError where one sets nothing, or two the same."""
    values: dict[str, Any] = {}
    for text in overrides:
        name, _, value = (part.strip() for part in text.partition("="))
        try:
            parsed = parse_json(value, text[:60])
        except UserError:
            parsed = None
        if not name or not _is_value(parsed):
            raise UserError(f"{text[:60]!r} does not set anything; write name=number or name=[number,number]")
        if name in values:
            raise UserError(f"{text[:60]!r}: {name!r} is set twice; set it once")
        values[name] = parsed
    return values


def _check_commands(where: str, values: Mapping[str, Any]) -> None:
    """Raises UserError for unknown names and impossible values."""
    for name, value in values.items():
        if name not in COMMANDS:
            raise UserError(f"{where}: {unknown("error of 'commands'", name, COMMANDS)}")
        whole = name in WHOLE
        if not isinstance(value, int | float) or not 0 <= value <= COMMANDS[name] or (whole and value != int(value)):
            number = "a whole number" if whole else "one number"
            raise UserError(f"{where}: '{name}' must be {number} from 0 to {COMMANDS[name]:.10g}, got {value}")


def _check(env: Env, gap: Gap) -> None:
    """Raises UserError for unknown names and impossible values."""
    from envs.commands import make_commands
    from envs.domains import uniform

    _check_commands(f"gap '{gap.name}'", gap.commands)
    try:
        uniform(env, gap.params, gap.effects)
        if gap.commands:
            make_commands(env, gap.commands)
        if gap.drift:
            drifts(env, [gap])
    except UserError as error:
        raise UserError(f"gap '{gap.name}': {error}") from None
