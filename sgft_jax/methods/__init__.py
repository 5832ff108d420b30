"""The methods: every file here is one. `get_method` finds them by name, or a method of your own by its file."""

import importlib
import pkgutil
import re
from functools import cache

from sgft_jax import extend
from sgft_jax.types import Method, UserError, unknown

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
    method = extend.load("method", name, "METHOD").METHOD
    if not isinstance(method, Method):
        raise UserError(f"method {name}: METHOD is a {type(method).__name__}, not a sgft_jax.Method")
    if method.name in NAMES or not re.fullmatch(r"[\w-]+", method.name):
        raise UserError(f"method {name}: the name {method.name!r} is taken or names no folder; choose another")
    return method


def all_methods() -> dict[str, Method]:
    """Every method that comes with the package, by name."""
    return {name: get_method(name) for name in NAMES}
