"""The algorithms that leave priors: every file here but `base.py` is one. Imports no JAX before it is used."""

import importlib
import pkgutil
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from envs.types import Policy, UserError, unknown
from sgft_jax.algorithms.base import Algorithm, Config, Recipe
from sgft_jax.types import Task

__all__ = ["make_policy"]

_FIRST = ("sac", "tdmpc2")  # where algorithms are listed; the others follow by name
_FILES = (module.name for module in pkgutil.iter_modules(__path__) if module.name != "base")
_ALGORITHMS: Mapping[str, Algorithm] = {
    file: importlib.import_module(f"{__name__}.{file}").ALGORITHM
    for file in sorted(_FILES, key=lambda file: (_FIRST.index(file) if file in _FIRST else len(_FIRST), file))
}
NAMES = tuple(_ALGORITHMS)
PRETRAINED = tuple(name for name, algorithm in _ALGORITHMS.items() if algorithm.recipe)
if TYPE_CHECKING:
    PretrainedName = str
else:
    PretrainedName = Literal[PRETRAINED]  # the choices of a command line


def get_algorithm(name: str) -> Algorithm:
    """The algorithm of that name; raises UserError for a name that is unknown."""
    if name not in NAMES:
        raise UserError(unknown("algorithm", name, NAMES))
    return _ALGORITHMS[name]


def algorithm_of(card: Mapping[str, Any]) -> Algorithm:
    """Which algorithm a prior is from; the first priors did not say, they were all SAC's."""
    return get_algorithm(card.get("algorithm", "sac"))


def make_policy(card: Mapping[str, Any], task: Task) -> Policy:
    """How the prior with this card acts. task: its task; policies that plan ask it for rewards.

    card: `algorithm`, `gamma`, `network` (SAC, recurrent SAC, actors alone), `head` (actors alone), `config` (TD-MPC2,
    recurrent SAC), and `plan` for a prior of SAC that plans.
    """
    return algorithm_of(card).policy(card, task)


def recipe_of(task: Task, config: Config) -> Recipe:
    """How the algorithm that a configuration names is pretrained."""
    recipe = get_algorithm(config.algorithm).recipe
    assert recipe is not None  # the type of `config.algorithm` has the names of those that are pretrained
    return recipe(task, config)
