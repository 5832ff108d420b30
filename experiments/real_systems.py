"""What `--real` may name: gaps, or Gymnasium environments. Imports neither JAX nor Gymnasium before one is made."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from envs import gaps
from envs.gaps import Gap
from experiments.options import check_task
from sgft_jax import extend
from sgft_jax.types import UserError

if TYPE_CHECKING:
    from envs.base import Env
    from sgft_jax.systems.gymnasium import Gymnasium

TOGETHER = "Gymnasium environments and simulations cannot be played together; run them one after another"
GYMNASIUM = "gymnasium:"  # then a name for `gymnasium.make`, which may begin with the module that registers it


def is_gymnasium(real: str) -> bool:
    """Whether a real system is a Gymnasium environment and no gap."""
    return real.startswith(GYMNASIUM)


def title(real: str) -> str:
    """What folders call a real system: `gymnasium-HalfCheetah-v5`, or the name of the gap."""
    if not is_gymnasium(real):
        return gaps.title(real)
    return "gymnasium-" + re.sub(r"[^\w.-]", "-", real.removeprefix(GYMNASIUM).rpartition(":")[2])


def check(task: str, reals: Sequence[str], changes: Sequence[str] = ()) -> None:
    """Raises UserError where there is no such task or real system, or where they cannot be played by one command."""
    stepped = [real for real in reals if is_gymnasium(real)]
    check_task(task, [real for real in reals if not is_gymnasium(real)])
    if not stepped:
        return
    if len(stepped) < len(reals):
        raise UserError(f"--real {' '.join(reals)}: {TOGETHER}")
    if importlib.util.find_spec("gymnasium") is None:
        raise UserError(f"--real {stepped[0]}: Gymnasium is not installed; pip install 'sgft-jax[gymnasium]'")
    if GYMNASIUM in stepped:
        raise UserError(f"--real {GYMNASIUM}: name an environment, e.g. {GYMNASIUM}HalfCheetah-v5")
    keywords(changes)


def keywords(changes: Sequence[str]) -> dict[str, Any]:
    """What `--set` passes to `gymnasium.make`: JSON where it reads as such, else text; UserError for no name=value."""
    found: dict[str, Any] = {}
    for text in changes:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not name.isidentifier() or name in found:
            raise UserError(f"--set '{text}': write name=value, each name once")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = value
    return found


def described(env: Env, real: str, changes: Sequence[str]) -> Gap:
    """The gap, changed; of a Gymnasium environment nobody knows what differs, so that it is a name alone."""
    if not is_gymnasium(real):
        return gaps.load(env, real, changes)
    return Gap("+".join([real, *changes]), {}, {})


def connect(env: Env, reals: Sequence[str], changes: Sequence[str], *, members: int, gamma: float) -> Gymnasium:
    """So many environments of each name, all of the first one first. Raises UserError where one cannot be made."""
    from sgft_jax.systems.gymnasium import Gymnasium

    given = keywords(changes)
    return Gymnasium(env, [_make(real, given) for real in reals for _ in range(members)], gamma=gamma)


def _make(real: str, given: dict[str, Any]) -> Any:
    import gymnasium

    try:
        return extend.guard("--real", real, lambda name: gymnasium.make(name, **given))(real.removeprefix(GYMNASIUM))
    except UserError as error:
        if isinstance(error.__cause__, gymnasium.error.Error):  # no such name: where that was found out says nothing
            raise UserError(f"--real {real}: {str(error.__cause__).splitlines()[0]}") from error
        raise
