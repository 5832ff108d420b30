"""The methods: every file here but `options.py` is one. `get_method` finds them by name, or the user's by its file."""

import dataclasses
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Literal, get_args, overload

from envs import extend
from envs.types import UserError, unknown
from sgft_jax.algorithms import PRETRAINED
from sgft_jax.methods.options import ActorCriticOptions
from sgft_jax.train.options import LoopOptions
from sgft_jax.types import Family, Finetuner, Fixed, FixedKind, HybridAgent, Method, Online

__all__ = ["all_methods", "get_method"]

Kind = Literal["online", "fixed"]

# Of tables and figures: the ones to try first stand first, what is not listed last.
_ORDER = (
    *("guarded", "posterior", "sgft-sac", "sgft-relabel", "sgft-mpc", "sgft-tdmpc2", "sgft", "tdmpc2", "mbpo", "sysid"),
    *("recurrent", "asymmetric"),
    *("h2oplus", "h2oplus-edac", "h2o", "darc", "sac", "rlpd", "wsrl", "sac-online", "iql", "cql", "rebrac", "edac"),
    *("sac-reset", "pbrs", "pbrs-branch", "frozen-critic", "sgft-tdmpc2-code", "sgft-parts"),
)
_FILES = (module.name for module in pkgutil.iter_modules(__path__) if module.name != "options")
_METHODS: Mapping[str, Method] = {
    method.name: method
    for method in sorted(
        (importlib.import_module(f"{__name__}.{file}").METHOD for file in _FILES),
        key=lambda method: (_ORDER.index(method.name) if method.name in _ORDER else len(_ORDER), method.name),
    )
}
NAMES = tuple(name for name, method in _METHODS.items() if method.online)  # of those that fine-tune
FIXED_NAMES = tuple(name for name, method in _METHODS.items() if method.fixed)
DEFAULT = "guarded"
# What is for a kind, the arguments of `build`, and what it returns
_KINDS: Mapping[str, tuple[type, str, str, type]] = {
    "online": (Online, "fine-tuning", "config, prior, task", Finetuner),
    "fixed": (Fixed, "learning from a fixed set of data or a simulator", "config, task", HybridAgent),
}


@overload
def get_method(name: str, kind: Literal["online"] = "online") -> Online: ...
@overload
def get_method(name: str, kind: Literal["fixed"]) -> Fixed: ...
@cache
def get_method(name: str, kind: Kind = "online") -> Online | Fixed:
    """How the method of that name learns, or the `METHOD` of the user's Python file or module (docs/extending.md).

    kind: "online" is fine-tuning; "fixed" is learning from a fixed set of real data, a simulator or both.
    UserError lists what exists and guesses what was meant, or says what is wrong with the file.
    """
    names = NAMES if kind == "online" else FIXED_NAMES
    if name in names:
        return _named(_METHODS[name], kind)
    if not extend.is_source(name):
        raise UserError(f"{unknown('method', name, names)}; or name a file, e.g. my_{name}.py")
    module = extend.load("method", name, "METHOD")
    try:
        return _named(_checked(name, module.METHOD, kind), kind)
    except UserError as error:
        place = extend.line_of(module, "METHOD")
        raise UserError(": ".join(filter(None, [f"method {name}", place, str(error)]))) from error


def all_methods() -> dict[str, Online]:
    """Every method of fine-tuning that comes with the package, by name."""
    return {name: get_method(name) for name in NAMES}


def _named(method: Method, kind: Kind) -> Online | Fixed:
    way = method.online if kind == "online" else method.fixed
    assert way is not None
    return way._replace(name=method.name)


# --- methods of the user ----------------------------------------------------------------------------------------------


def _checked(source: str, method: Any, kind: Kind) -> Method:
    """The method of a user's file, whose `build` says where it fails; raises UserError for fields of other types."""
    if not isinstance(method, Method):
        raise UserError(f"METHOD is a {type(method).__name__}, not a sgft_jax.Method")
    if not isinstance(method.name, str):
        raise UserError(f"name is {method.name!r}, not a text")
    (expected, purpose, arguments, made), way = _KINDS[kind], getattr(method, kind)
    if way is None:
        raise UserError(f"{method.name} has nothing for {purpose}: `{kind}` is None")
    if not isinstance(way, expected):
        raise UserError(f"{kind} is a {type(way).__name__}, not a sgft_jax.{expected.__name__}")
    _check_fields(way)
    extend.folder_name("the name", method.name)
    if method.name in _METHODS:
        raise UserError(f"the name {method.name!r} is taken; choose another")
    if isinstance(way, Online):
        _check_config(source, way.config)
    else:
        _check_presets(way.presets)
    return method._replace(**{kind: way._replace(build=_checked_build(source, way.build, arguments, made))})


def _check_fields(way: Online | Fixed) -> None:
    words = {"family": get_args(Family), "prior": PRETRAINED, "kind": get_args(FixedKind)}
    flags = ("needs_prior", "zero_shot", "sees_system", "blind_actor", "by_data")
    for field, value in way._asdict().items():
        if field in words and value not in words[field]:
            raise UserError(f"{field} is {value!r}; choose from {', '.join(words[field])}")
        if field in flags and not isinstance(value, bool):
            raise UserError(f"{field} is {value!r}, not True or False")
        if field in ("description", "source") and not isinstance(value, str):
            raise UserError(f"{field} is {value!r}, not a text")


def _check_config(source: str, config: Any) -> None:
    if not (isinstance(config, type) and issubclass(config, LoopOptions) and dataclasses.is_dataclass(config)):
        raise UserError(f"config is {config!r}, not a dataclass that derives from LoopOptions or a method's Config")
    extend.guard("method", source, config)()


def _check_presets(presets: Any) -> None:
    if not isinstance(presets, Mapping) or not presets or not all(isinstance(name, str) for name in presets):
        raise UserError(f"presets is {presets!r}, not settings by name, of which there is at least one")
    for name, config in presets.items():
        if not isinstance(config, ActorCriticOptions):
            raise UserError(
                f"preset {name!r} is {config!r}, not an object of a dataclass that derives from ActorCriticOptions"
            )
        if type(config) is not type(next(iter(presets.values()))):
            raise UserError(f"preset {name!r} is of another dataclass than the first")


def _checked_build(source: str, build: Any, arguments: str, made: type) -> Callable[..., Any]:
    """`build`, which names file and line where it fails, or what it returns where that is not what it should make."""
    try:
        inspect.signature(build).bind(*arguments.split(", "))
    except (TypeError, ValueError) as error:
        raise UserError(f"build must be called as build({arguments}): {error}") from error

    def checked(*args: Any) -> Any:
        result = extend.guard("method", source, build)(*args)
        if not isinstance(result, made):
            raise UserError(f"method {source}: build returns a {type(result).__name__}, not a sgft_jax.{made.__name__}")
        return result

    return checked
