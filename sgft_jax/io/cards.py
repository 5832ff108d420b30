"""Impure: the card of a prior, `prior.json`, checked for all who read it. Imports no JAX.

A card is data. It names a task that comes with this code, or one that the user has named: never a file or a module.
"""

from pathlib import Path
from typing import Any

import envs
from envs.files import checked, read_json
from envs.types import UserError, unknown
from sgft_jax.algorithms import NAMES, algorithm_of
from sgft_jax.algorithms.base import Card
from sgft_jax.files.disk import present

CARD = "prior.json"
SHIPPED = Path(__file__).parents[1] / "priors"  # those that come with the code, a folder for each task
_SHIPPED_BY_NAME = "shipped:"
_FIX = "take another prior, or pretrain again"


def resolve_shipped(folder: str | Path) -> Path:
    """Where a prior is: `shipped:push` and `shipped:push/seed-0` lie in the package, all else is a path as it stands.

    Raises UserError where the package has no such prior.
    """
    if not str(folder).startswith(_SHIPPED_BY_NAME):
        return Path(folder)
    name = str(folder).removeprefix(_SHIPPED_BY_NAME).strip("/")
    priors = [path.parent for path in SHIPPED.glob(f"*/*/{CARD}")]
    names = {str(path.relative_to(SHIPPED)) for prior in priors for path in (prior, prior.parent)}
    if name not in names:
        raise UserError(unknown("shipped prior", name, names))
    return SHIPPED / name


def read_card(folder: Path) -> dict[str, Any]:
    """What `prior.json` in a folder says; raises UserError where it is no card of a prior, or of another version."""
    path = present(folder) / CARD
    card = checked(path, read_json(path), Card, _FIX)
    if (name := card.get("algorithm", "sac")) not in NAMES:
        raise UserError(f"{path} says algorithm={name!r}, which this version does not know; {_FIX}")
    checked(path, card, algorithm_of(card).card, _FIX)
    system = card.get("system", [])
    if odd := [entry["name"] for entry in system if not entry["low"] < entry["high"]]:
        raise UserError(f"{path}: the range of {odd[0]!r} in system is empty; {_FIX}")
    if card.get("previous_actions", 0) * card["act_dim"] + len(system) >= card["obs_dim"]:
        raise UserError(f"{path}: obs_dim={card['obs_dim']} leaves no measurement beside what it says; {_FIX}")
    return card


def known_task(where: Path | str, task: str, option: str = "--task") -> str:
    """The task that a file names, which must be one of ours or one that the user has named in this process already.

    where: the file. option: how the user names a file with a task. Raises UserError for any other.
    """
    if task not in envs.TASKS:
        advice = f"if it is yours, name its file with {option}"
        raise UserError(f"{where}: is of the task {task!r}, which does not come with this code; {advice}")
    return task
