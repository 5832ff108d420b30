"""Fits of a few numbers to real steps, through a model that is not right about every one of them. Pure."""

from collections.abc import Callable, Sequence
from math import inf
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array

_GUESSES, _FOLLOWED = 128, 6  # starting points where the cost has several minima; how many of the best are optimised
_DEGREES = 3.0  # of freedom of Student's t: no model is right about every step


class Estimate(NamedTuple):
    """point: [p] of highest posterior probability. evidence: [] nats by which it explains the rows better than 0."""

    point: Array
    evidence: Array


def robust_std(values: Array, held: Array) -> Array:
    """[k] 1.48 times the median size of values [n, k] over the rows `held` [n]; 0 where there is none."""
    sizes = jnp.where(held[:, None], jnp.abs(values), jnp.nan)
    return jnp.nan_to_num(1.48 * jnp.nanmedian(sizes, axis=0))


def student_cost(missed: Array, held: Array, scale: Array) -> Array:
    """[] negative log-likelihood, nats, of residuals [n, k] over the rows `held` [n] under Student's t of scale [k].

    Constants are left out.
    """
    square = jnp.sum((missed / scale[None]) ** 2, axis=1)
    losses = 0.5 * (_DEGREES + missed.shape[1]) * jnp.log1p(square / _DEGREES)
    return jnp.sum(jnp.where(held, losses, 0.0))


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
) -> Estimate:
    """Maximum a posteriori fit by Gauss-Newton steps under a Student t likelihood, whose scale is fitted too.

    missed(point [p]) -> [n, k] residuals. starts: [s, p] starting points. belief: [p] std of the Gaussian prior around
    0. change: [n, k] what the steps changed. held: [n] bool, rows that count. spread: [k] lower bound of the residuals'
    std. bound: of the size of every entry, [] or [p]. guessed: entries in which the cost may have several minima; the
    search also starts from values drawn uniformly within their bounds.
    """

    def weight_of(square: Array) -> Array:
        return (_DEGREES + spread.shape[0]) / (_DEGREES + square)

    def counted(p: Array) -> Array:
        return jnp.where(held[:, None], missed(p), 0.0)

    def cost(p: Array, scale: Array) -> Array:
        return student_cost(counted(p), held, scale) + 0.5 * jnp.sum((p / belief) ** 2)

    def step(p: Array, scale: Array) -> Array:
        """One Gauss-Newton step, with weights that turn least squares into the Student t likelihood."""
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
    return Estimate(best, cost(jnp.zeros_like(best), scale) - cost(best, scale))
