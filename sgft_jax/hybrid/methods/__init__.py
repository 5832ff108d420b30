"""The methods that learn from a fixed set of real data and a simulator: every file here is one."""

import importlib
import pkgutil

from envs.types import UserError, unknown
from sgft_jax.types import HybridMethod

_ORDER = ("h2oplus", "h2oplus-edac", "h2o", "darc", "sac", "iql", "cql", "rebrac", "edac")  # of tables and figures
_FILES = [module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__) if module.name != "options"]
NAMES = tuple(sorted(_FILES, key=lambda name: (_ORDER.index(name) if name in _ORDER else len(_ORDER), name)))


def get_method(name: str) -> HybridMethod:
    """The method of that name; UserError lists what exists and guesses what was meant."""
    if name not in NAMES:
        raise UserError(unknown("method", name, NAMES))
    return importlib.import_module(f"sgft_jax.hybrid.methods.{name.replace('-', '_')}").METHOD
