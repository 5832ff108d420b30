"""Fits of a few numbers to real steps, through a model that is not right about every one of them. Pure."""

from collections.abc import Callable, Sequence
from math import inf
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sgft_jax.types import Array

_GUESSES, _FOLLOWED = 128, 6  # begins of a search over entries with many valleys, and how many of them are followed
_DEGREES = 3.0  # of freedom of Student's t: no model is right about every step


class Found(NamedTuple):
    """point: [p], the most probable one. evidence: [] nats by which it explains the rows better than 0 does."""

    point: Array
    evidence: Array


def robust_std(values: Array, held: Array) -> Array:
    """[k] 1.48 times the median size of values [n, k] over the rows `held` [n]; 0 where there is none."""
    sizes = jnp.where(held[:, None], jnp.abs(values), jnp.nan)
    return jnp.nan_to_num(1.48 * jnp.nanmedian(sizes, axis=0))


def student_cost(missed: Array, held: Array, scale: Array) -> Array:
    """[] nats of residuals [n, k] of the rows `held` [n] under Student's t with this scale [k], but for constants."""
    square = jnp.sum((missed / scale[None]) ** 2, axis=1)
    each = 0.5 * (_DEGREES + missed.shape[1]) * jnp.log1p(square / _DEGREES)
    return jnp.sum(jnp.where(held, each, 0.0))


def spread_of(missed: Array, change: Array, held: Array) -> Array:
    """[k] std of a model's residuals [n, k] in simulation, never below 1 % of what a step changes [n, k]."""
    return jnp.maximum(robust_std(missed, held), 0.01 * robust_std(change, held)) + 1e-6


def most_probable(
    missed: Callable[[Array], Array],
    starts: Array,
    belief: Array,
    change: Array,
    held: Array,
    spread: Array,
    *,
    bound: float | Array = inf,
    guessed: Sequence[int] = (),
) -> Found:
    """The point that explains steps best, by Gauss and Newton under Student's t, whose scale is fitted along.

    missed(point [p]) -> [n, k] residuals. starts: [s, p] where the search begins. belief: [p] std of the point around 0
    before any data. change: [n, k] what the steps changed. held: [n] bool, which of them count. spread: [k] the least
    std that residuals have. bound: on the size of every entry, [] or [p]. guessed: entries of the point in which the
    cost may have many valleys; the search begins at many values of these, uniform in their bounds.
    """
    weight_of = lambda square: (_DEGREES + spread.shape[0]) / (_DEGREES + square)  # noqa: E731

    def counted(p: Array) -> Array:
        return jnp.where(held[:, None], missed(p), 0.0)

    def cost(p: Array, scale: Array) -> Array:
        return student_cost(counted(p), held, scale) + 0.5 * jnp.sum((p / belief) ** 2)

    def step(p: Array, scale: Array) -> Array:
        """Of Gauss and Newton, with the weights that make least squares Student's t."""
        residual, slope = counted(p) / scale[None], jax.jacfwd(counted)(p) / scale[None, :, None]
        heavy = weight_of(jnp.sum(residual**2, axis=1))[:, None, None] * slope
        with jax.default_matmul_precision("highest"):
            curvature = jnp.einsum("tki,tkj->ij", heavy, slope) + jnp.diag(belief**-2)
            downhill = -jnp.einsum("tki,tk->i", heavy, residual) - p * belief**-2
            p = p + jnp.clip(jnp.linalg.solve(curvature, downhill), -0.3, 0.3)
        return jnp.clip(p, -bound, bound)

    def search(p: Array, scale: Array) -> Array:
        return jax.lax.fori_loop(0, 8, lambda _, p: step(p, scale), p)

    def lowest(points: Array, scale: Array, n: int = 1) -> Array:
        """The n points [n, p] of [s, p] that cost least."""
        return points[jnp.argsort(jax.vmap(cost, (0, None))(points, scale))[:n]]

    def guess(p: Array, scale: Array, key: Array) -> Array:
        """The best valley that many guesses lead to, the point itself among them."""
        if not guessed:
            return search(p, scale)
        entries = jnp.array(guessed)
        size = jnp.broadcast_to(bound, p.shape)[entries]
        drawn = size[None] * jax.random.uniform(key, (_GUESSES, len(guessed)), minval=-1.0, maxval=1.0)
        begins = jnp.concatenate([p[None], jnp.tile(p, (_GUESSES, 1)).at[:, entries].set(drawn)])
        ends = jax.vmap(search, (0, None))(lowest(begins, scale, _FOLLOWED), scale)
        return lowest(ends, scale)[0]

    scale = jnp.maximum(0.3 * robust_std(change, held), spread)
    best = lowest(jax.vmap(search, (0, None))(starts, scale), scale)[0]
    for key in jax.random.split(jax.random.key(0), 2):
        scale = jnp.maximum(robust_std(missed(best), held), spread)
        best = guess(best, scale, key)
    return Found(best, cost(jnp.zeros_like(best), scale) - cost(best, scale))
