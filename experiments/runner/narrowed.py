"""Impure: what the rollouts of a run of `posterior` tell of its real system, beside what is true of it."""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, World
from envs.mujoco.worlds import choose_impl
from envs.types import Array, Key
from experiments.runner.diagnose_run import names_of
from experiments.runner.finetune_args import FinetuneArgs, priors_of
from experiments.runner.options import episodes_of
from sgft_jax.io.priors import load_prior, variant
from sgft_jax.io.real import Played
from sgft_jax.posterior.candidates import Unknown, unknowns_of, values
from sgft_jax.posterior.estimator import MOST, Estimator, Rollout, blank, draw, rollout_of
from sgft_jax.stacking import member

_DRAWS = 1000  # points of a posterior that say how wide it is
_SHOWN = 6
_WORDS = {
    "action_scale": "scale of",
    "action_bias": "bias of",
    "action_rotation": "rotation of commands",
    "obs_bias": "sensor error of",
}


class Narrowed(NamedTuple):
    """The unknowns [k] that rollouts tell most of. names: with units. truth: [k]. intervals: [n + 1, k, 2], 80 % of the
    posterior after 0 to n rollouts; sensor errors of lengths in mm.
    """

    names: list[str]
    truth: np.ndarray
    intervals: np.ndarray


def narrowed(run: FinetuneArgs, home: Path) -> Narrowed:
    """Of the first seed and real system of a run in a folder."""
    prior = load_prior(priors_of(run)[0])
    env = envs.make(run.task, choose_impl(run.impl), **variant(prior.card))
    unknowns, key = unknowns_of(env), jax.random.key(run.seed)
    played = episodes_of(home, run.seed)[:MOST]
    points = _drawn(prior.params.estimator, _read(env, played), len(played), len(unknowns), key)
    numbers = np.asarray(jax.vmap(jax.vmap(functools.partial(values, unknowns)))(points))
    std = np.asarray(points.std(axis=1))
    best = np.argsort(std[-1] / std[0])[:_SHOWN]
    labels = [_label(env, unknowns[i]) for i in best]
    scale = np.array([scale for _, scale in labels])
    bounds = np.moveaxis(np.quantile(numbers[..., best], (0.1, 0.9), axis=1), 0, -1)
    world = member(gaps.worlds(env, gaps.load(env, run.real[0]), jax.random.key(0), 1), 0)
    known = truth(env, world, [unknowns[i] for i in best])
    return Narrowed([name for name, _ in labels], scale * known, scale[:, None] * bounds)


def truth(env: Env, world: World, unknowns: Sequence[Unknown]) -> np.ndarray:
    """[k] what is true of a real system."""
    theta = world.theta
    params = dict(zip((p.name for p in env.parameters), theta.params, strict=True))

    def value(unknown: Unknown) -> float:
        if unknown.name in params:
            return float(params[unknown.name])
        return float(np.ravel(getattr(theta.effects.low, unknown.name))[unknown.index])

    return np.array([value(unknown) for unknown in unknowns])


def _read(env: Env, played: Sequence[Played]) -> Rollout:
    """Stored episodes as the estimator reads them, [MOST]."""
    steps, rollouts = env.episode_length, blank(MOST, env.episode_length, env.measured_dim, env.act_dim)
    for i, episode in enumerate(played):
        missing = steps - len(episode.rows.reward)
        rows = jax.tree.map(lambda x, n=missing: np.pad(x, [(0, n), *[(0, 0)] * (x.ndim - 1)]), episode.rows)
        rollout = rollout_of(env, rows, jnp.arange(steps) < steps - missing, jnp.asarray(episode.success))
        rollouts = jax.tree.map(lambda room, x, i=i: room.at[i].set(x), rollouts, rollout)
    return rollouts


def _drawn(estimator: Estimator, rollouts: Rollout, count: int, d: int, key: Key) -> Array:
    """[count + 1, draws, d] points of the prior over unknowns, then of the posteriors after 1, 2, ... rollouts."""

    @jax.jit
    def after(number: Array) -> Array:
        return draw(estimator, rollouts, jnp.arange(MOST) < number, d, key, _DRAWS)

    before = jax.random.uniform(key, (_DRAWS, d))
    return jnp.stack([before, *(after(jnp.int32(n + 1)) for n in range(count))])


def _label(env: Env, unknown: Unknown) -> tuple[str, float]:
    """An unknown with its unit, for people, and what its numbers are multiplied by."""
    words = _WORDS.get(unknown.name, unknown.name.replace("_", " "))
    units = {p.name: p.unit for p in env.parameters} | {"action_rotation": "rad", "latency": "s"}
    unit, scale, names = units.get(unknown.name, ""), 1.0, names_of(env)
    if unknown.name in ("action_scale", "action_bias"):
        words = f"{words} {names.action[unknown.index]}"
    elif unknown.name == "obs_bias":
        label, unit = names.sensors[unknown.index]
        words, unit, scale = f"{words} {label}", *(("mm", 1000.0) if unit == "m" else (unit, 1.0))
    return f"{words}, {unit}" if unit else words, scale
