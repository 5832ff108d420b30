"""What rollouts tell of a real system's unknowns, for people, beside what is true of it. Pure."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs import gaps
from envs.base import Env, World
from envs.domains import parameter_ranges
from envs.effects import make_range
from envs.gaps import Gap
from envs.rollout import real_env
from envs.types import Array, Key, UserError
from sgft_jax.analysis import tables
from sgft_jax.diagnosis import Rollouts
from sgft_jax.posterior import candidates
from sgft_jax.posterior.candidates import Unknown, unknowns_of, values
from sgft_jax.posterior.estimator import MOST, Estimator, Rollout, blank, draw, rollout_of
from sgft_jax.stacking import member

_DRAWS = 1000  # points of a posterior that say how wide it is
_SHOWN = 6
_TAILS = (0.025, 0.1, 0.2, 0.3, 0.4, 0.5)  # shares outside of a box, to either side
_WORDS = {
    "action_scale": "scale of",
    "action_bias": "bias of",
    "action_rotation": "rotation of commands",
    "obs_bias": "sensor error of",
}


class Narrowed(NamedTuple):
    """The unknowns [k] that rollouts tell most of. after: [n] numbers of rollouts. names: with units. intervals:
    [n, k, 2], 80 % of the posterior after each of these numbers; sensor errors of lengths in mm. truth: [k], None where
    nobody knows it.
    """

    after: Sequence[int]
    names: list[str]
    intervals: np.ndarray
    truth: np.ndarray | None


def readable(env: Env, rollouts: Rollouts) -> Rollout:
    """The first recorded episodes as the estimator reads them, [MOST], steps that an episode of the task lacks cut."""
    room = blank(MOST, env.episode_length, env.measured_dim, env.act_dim)
    rows, valid, success = jax.tree.map(lambda x: x[:MOST], tuple(rollouts))
    rows, valid = jax.tree.map(lambda x: x[:, : env.episode_length], (rows, valid))
    read = jax.vmap(functools.partial(rollout_of, env))(rows, valid, success)
    return jax.tree.map(lambda room, x: room.at[tuple(map(slice, x.shape))].set(x), room, read)


def posterior(env: Env, estimator: Estimator, rollouts: Rollout, after: Sequence[int], key: Key) -> np.ndarray:
    """[n, draws, d] points that the first of rollouts [MOST] allow, `after` so many [n]; before any, those of the prior
    over unknowns.
    """
    unknowns = unknowns_of(env)
    before = candidates.draw(unknowns, candidates.nominal_of(env), key, _DRAWS)
    return np.stack([_drawn(estimator, rollouts, jnp.int32(n), key, len(unknowns)) if n else before for n in after])


@functools.partial(jax.jit, static_argnames="d")
def _drawn(estimator: Estimator, rollouts: Rollout, count: Array, key: Key, d: int) -> Array:
    return draw(estimator, rollouts, jnp.arange(MOST) < count, d, key, _DRAWS)


def narrowed(env: Env, points: np.ndarray, after: Sequence[int], gap: Gap | None) -> Narrowed:
    """Of points [n, draws, d] `after` ever more rollouts [n], the first before any. gap: the real system, where one
    knows.
    """
    unknowns = unknowns_of(env)
    numbers = np.asarray(jax.jit(jax.vmap(jax.vmap(functools.partial(values, unknowns))))(points))
    std = points.std(axis=1)
    best = np.argsort(std[-1] / std[0])[:_SHOWN]
    labels = [_label(env, unknowns[i]) for i in best]
    scale = np.array([scale for _, scale in labels])
    bounds = np.moveaxis(np.quantile(numbers[..., best], (0.1, 0.9), axis=1), 0, -1)
    known = None
    if gap is not None and not gap.scene:  # another scene has other parameters
        pool = gaps.worlds(real_env(env, [gap]), gap, jax.random.key(0), 1)
        known = scale * truth(env, member(pool, 0), [unknowns[i] for i in best])
    return Narrowed(after, [name for name, _ in labels], scale[:, None] * bounds, known)


def likely(env: Env, points: np.ndarray, name: str) -> Gap:
    """A box of systems around points [n, d], as a gap in which one can train: 95 % of each number, or less where some
    corner of that is impossible, as a peg wider than its hole. name: of the gap.
    """
    unknowns = unknowns_of(env)
    numbers = np.asarray(jax.vmap(functools.partial(values, unknowns))(jnp.asarray(points)))
    boxes = (np.quantile(numbers, [tail, 1.0 - tail], axis=0) for tail in _TAILS)
    possible = (gap for gap in (_box(env, unknowns, box[0], box[1], name) for box in boxes) if _is_possible(env, gap))
    return next(possible)


def _box(env: Env, unknowns: Sequence[Unknown], low: np.ndarray, high: np.ndarray, name: str) -> Gap:
    """Every unknown within low and high [d], vectors filled with what has no effect."""
    nothing = {name: np.asarray(x, np.float64) for name, x in make_range(env, {}).low._asdict().items()}
    ends = {u.name: np.stack([nothing.get(u.name, np.zeros(()))] * 2) for u in unknowns}
    for unknown, *pair in zip(unknowns, low, high, strict=True):
        place = (slice(None), unknown.index) if ends[unknown.name].ndim > 1 else slice(None)
        ends[unknown.name][place] = [float(f"{x:.4g}") for x in pair]
    tables = {key: pair.tolist() for key, pair in ends.items()}
    effects = {key: tables.pop(key) for key in nothing if key in tables}
    return Gap(name, tables, effects)


def _is_possible(env: Env, gap: Gap) -> bool:
    try:
        parameter_ranges(env, gap.params)
    except UserError:
        return False
    return True


def table(known: Narrowed) -> str:
    """Intervals after so many rollouts, and the truth where it is known, in Markdown."""
    head = ["", *map(tables.rollouts, known.after)]
    rows = [
        [name, *(f"{low:.3g} to {high:.3g}" for low, high in known.intervals[:, i])]
        for i, name in enumerate(known.names)
    ]
    if known.truth is not None:
        head.append("true")
        rows = [[*row, f"{true:.3g}"] for row, true in zip(rows, known.truth, strict=True)]
    return tables.markdown(head, rows)


def truth(env: Env, world: World, unknowns: Sequence[Unknown]) -> np.ndarray:
    """[k] what is true of a real system."""
    theta = world.theta
    params = dict(zip((p.name for p in env.parameters), theta.params, strict=True))

    def value(unknown: Unknown) -> float:
        if unknown.name in params:
            return float(params[unknown.name])
        return float(np.ravel(getattr(theta.effects.low, unknown.name))[unknown.index])

    return np.array([value(unknown) for unknown in unknowns])


def _label(env: Env, unknown: Unknown) -> tuple[str, float]:
    """An unknown with its unit, for people, and what its numbers are multiplied by."""
    words = _WORDS.get(unknown.name, unknown.name.replace("_", " "))
    units = {p.name: p.unit for p in env.parameters} | {"action_rotation": "rad", "latency": "s"}
    unit, scale = units.get(unknown.name, ""), 1.0
    if unknown.name in ("action_scale", "action_bias"):
        words = f"{words} {[label for entry in env.action for label in entry.labels][unknown.index]}"
    elif unknown.name == "obs_bias":
        label, unit = [(label, entry.unit) for entry in env.measured for label in entry.labels][unknown.index]
        words, unit, scale = f"{words} {label}", *(("mm", 1000.0) if unit == "m" else (unit, 1.0))
    return f"{words}, {unit}" if unit else words, scale
