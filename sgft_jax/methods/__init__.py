"""The methods: every file here is one. `get_method` finds them by name, or a method of your own by its file."""

import dataclasses
import importlib
import inspect
import pkgutil
from functools import cache
from typing import Any, get_args

from envs import extend
from envs.types import UserError, unknown
from sgft_jax.methods.options import LoopOptions
from sgft_jax.types import Algorithm, Family, Finetuner, Method, Prior, Task

# The order of tables and figures: the ones to try first stand first, what is not listed last.
_ORDER = (
    "guarded", "sgft-sac", "sgft-relabel", "sgft-mpc", "sgft-tdmpc2", "sgft", "tdmpc2", "mbpo", "sysid", "recurrent",
    "sac", "rlpd", "sac-online", "iql", "sac-reset", "pbrs", "pbrs-branch", "frozen-critic", "sgft-tdmpc2-code",
    "sgft-parts",
)  # fmt: skip
_FILES = [module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__) if module.name != "options"]
NAMES = tuple(sorted(_FILES, key=lambda name: (_ORDER.index(name) if name in _ORDER else len(_ORDER), name)))
DEFAULT = "guarded"


@cache
def get_method(name: str) -> Method:
    """The method of that name, or the `METHOD` of a Python file or module of your own (docs/extending.md).

    UserError lists what exists and guesses what was meant, or says what is wrong with the file.
    """
    if name in NAMES:
        return importlib.import_module(f"sgft_jax.methods.{name.replace('-', '_')}").METHOD
    if not extend.is_source(name):
        raise UserError(f"{unknown('method', name, NAMES)}; or name a file, e.g. my_{name}.py")
    module = extend.load("method", name, "METHOD")
    try:
        return _checked(name, module.METHOD)
    except UserError as error:
        place = extend.line_of(module, "METHOD")
        raise UserError(": ".join(filter(None, [f"method {name}", place, str(error)]))) from error


def _checked(source: str, method: Any) -> Method:
    """The method of a user's file, whose `build` says where it fails; raises UserError for fields of other types."""
    if not isinstance(method, Method):
        raise UserError(f"METHOD is a {type(method).__name__}, not a sgft_jax.Method")
    words = {"family": get_args(Family), "prior": get_args(Algorithm)}
    kinds = {"needs_prior": bool, "zero_shot": bool, "sees_system": bool}
    for field, value in method._asdict().items():
        if field in words and value not in words[field]:
            raise UserError(f"{field} is {value!r}; choose from {', '.join(words[field])}")
        if field not in ("config", "build", *words) and not isinstance(value, kinds.get(field, str)):
            raise UserError(f"{field} is {value!r}, not {'True or False' if field in kinds else 'a text'}")
    extend.folder_name("the name", method.name)
    if method.name in NAMES:
        raise UserError(f"the name {method.name!r} is taken; choose another")
    config = method.config
    if not (isinstance(config, type) and issubclass(config, LoopOptions) and dataclasses.is_dataclass(config)):
        raise UserError(f"config is {config!r}, not a dataclass that derives from LoopOptions or a method's Config")
    extend.guard("method", source, config)()
    try:
        inspect.signature(method.build).bind(config, None, None)
    except (TypeError, ValueError) as error:
        raise UserError(f"build must be called as build(config, prior, task): {error}") from error
    return method._replace(build=_named(source, method))


def _named(source: str, method: Method) -> Any:
    """`build`, which names file and line where it fails, or what it returns where that is no finetuner."""

    def build(config: Any, prior: Prior | None, task: Task) -> Finetuner:
        finetuner = extend.guard("method", source, method.build)(config, prior, task)
        if not isinstance(finetuner, Finetuner):
            raise UserError(f"method {source}: build returns a {type(finetuner).__name__}, not a sgft_jax.Finetuner")
        return finetuner

    return build


def all_methods() -> dict[str, Method]:
    """Every method that comes with the package, by name."""
    return {name: get_method(name) for name in NAMES}
