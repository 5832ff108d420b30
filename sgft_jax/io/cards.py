"""Impure: the card of a prior, `prior.json`, checked for all who read it. Imports no JAX.

A card is data. It names a task that comes with this code, or one that the user has named: never a file or a module.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict

from msgspec import Meta, Struct

import envs
from envs.files import Count, checked, read_json
from envs.types import UserError, unknown
from sgft_jax.files.folders import present

CARD = "prior.json"
SHIPPED = Path(__file__).parents[1] / "priors"  # those that come with the code, a folder for each task
_SHIPPED_BY_NAME = "shipped:"
_FIX = "take another prior, or pretrain again"
_Width = Annotated[int, Meta(ge=1, le=2**20)]  # no number of units, samples or models comes near


class _Network(Struct, forbid_unknown_fields=True):
    hidden: Annotated[list[_Width], Meta(min_length=1, max_length=100)]
    layer_norm: bool = False
    actor_layer_norm: bool = False
    activation: Literal["relu", "tanh", "silu", "elu"] = "relu"


class _Varying(Struct, forbid_unknown_fields=True):
    name: str
    index: Count
    low: float
    high: float


class _Gap(TypedDict):
    name: str
    params: dict[str, Any]
    effects: dict[str, Any]
    scene: str


class _Plan(Struct, forbid_unknown_fields=True):
    horizon: _Width = 1
    samples: _Width = 1
    noise: Annotated[float, Meta(ge=0)] = 0.0


class _Card(TypedDict):
    """What every card says."""

    task: str
    obs_dim: _Width
    act_dim: _Width
    gamma: Annotated[float, Meta(ge=0, lt=1)]
    algorithm: NotRequired[str]
    previous_actions: NotRequired[Count]
    system: NotRequired[list[_Varying]]
    ensemble_size: NotRequired[_Width]
    gap: NotRequired[_Gap | None]


class _OfSAC(_Card):
    network: _Network
    plan: NotRequired[_Plan | None]


class _OfActor(_Card):
    network: _Network
    head: Literal["affine", "gaussian", "deterministic"]


class _Memory(TypedDict):
    gru: _Width


class _OfRecurrent(_Card):
    network: _Network
    config: _Memory


class _Planner(TypedDict):
    horizon: _Width
    size: str
    plan_samples: _Width
    sgft: NotRequired[bool]


class _OfTDMPC2(_Card):
    config: _Planner


_SCHEMAS = {"sac": _OfSAC, "actor": _OfActor, "recurrent": _OfRecurrent, "tdmpc2": _OfTDMPC2}


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
    card = checked(path, read_json(path), _Card, _FIX)
    algorithm = card.get("algorithm", "sac")
    if algorithm not in _SCHEMAS:
        raise UserError(f"{path} says algorithm={algorithm!r}, which this version does not know; {_FIX}")
    checked(path, card, _SCHEMAS[algorithm], _FIX)
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
        raise UserError(
            f"{where}: is of the task {task!r}, which does not come with this code; if it is yours, name its file with "
            f"{option}"
        )
    return task
