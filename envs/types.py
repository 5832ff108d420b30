"""The nouns that tasks and everything above them share. Imports nothing of ours, and JAX for type checkers alone."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import jax

    Array = jax.Array
    Key = jax.Array
else:  # command lines read this module; JAX takes seconds to import
    Array = Key = Any

PyTree = Any


class UserError(Exception):
    """Bad input: one line that names the file, key or option and says how to fix it. Commands exit with code 2."""


def brief(error: BaseException) -> str:
    """What an error says, in one line: its first one, and the one in which MuJoCo says where in a scene."""
    first, *more = str(error).strip().splitlines() or ["no message"]
    return "; ".join([first.rstrip(":"), *(line for line in more[:1] if line.startswith(("Element", "Error=")))])


def unknown(kind: str, name: str, options: Iterable[str]) -> str:
    """What to tell someone who asked for a `kind` called `name` where only `options` exist."""
    listed = sorted(options)
    close = difflib.get_close_matches(name, listed, n=1)
    hint = f", did you mean {close[0]!r}?" if close else "."
    return f"{kind}: there is no {name!r}{hint} Choose from: {', '.join(listed)}"


class Transition(NamedTuple):
    """One step of experience as it is stored, or many of them with leading axes.

    obs: [obs_dim] observation before the action, raw units.
    action: [act_dim] in [-1, 1], as the policy chose it (before any effect of the system on it).
    reward: [] task reward of arriving in `next_obs`; transforms reshape rewards, storage never does.
    discount: [] gamma * (1 - terminated). A time limit never zeroes it.
    next_obs: [obs_dim] the true successor, also at the end of an episode.
    """

    obs: Array
    action: Array
    reward: Array
    discount: Array
    next_obs: Array


class Policy(NamedTuple):
    """How the parameters of a prior act, for one example.

    init_carry() -> carry. act(params, carry, obs, key, *, explore) -> (action, carry); `explore` may be traced.
    value(params, obs) -> []: V_sim, deterministic; None where an observation does not decide the value. Those of SAC
        take the system, too, see `models.value.make_v_sim`.
    model_error(params, obs [T + 1, obs_dim], actions [T, act_dim]) -> [T]: how far its model drifts from a trajectory,
        in standard deviations of the observation; None where the model does not predict observations.
    log_prob(params, obs, action) -> []: log density of an exploring action; None where it has none, or nobody wrote it.
    """

    init_carry: Callable[[], PyTree]
    act: Callable[..., tuple[Array, PyTree]]
    value: Callable[..., Array] | None = None
    model_error: Callable[[PyTree, Array, Array], Array] | None = None
    log_prob: Callable[[PyTree, Array, Array], Array] | None = None
