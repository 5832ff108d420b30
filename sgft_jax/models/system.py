"""Estimation of system parameters from real steps, by a model that reads the parameters. Pure.

A system is [k] numbers in [-1, 1] with which observations end, see `envs.observations`.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.types import Array, Key, Transition
from sgft_jax.models.robust import most_probable

_BELIEF = 3**-0.5  # std of a number uniform in [-1, 1]
_STARTS = 4  # of the search: the middle, and others drawn once
_SAMPLES, _STD = 16, (0.02, 0.5)  # DROPO: systems of a candidate, and how far apart they may be
_POPULATION, _ELITES, _ITERATIONS = 64, 8, 20  # of the cross-entropy search

Predict = Callable[[Array, Array], Array]  # (obs [obs_dim], action [act_dim]) -> [d] what a step changes, raw units


class Estimate(NamedTuple):
    """mean: [k] estimated parameters in [-1, 1]. std: [k] their uncertainty; 0 where the fit gives none."""

    mean: Array
    std: Array


def append_system(obs: Array, system: Array) -> Array:
    """The observation [obs_dim] whose last k entries are replaced by the parameters `system` [k]."""
    return jnp.concatenate([obs[: obs.shape[0] - system.shape[0]], system])


def unknown(size: int) -> Estimate:
    """The estimate before any data: 0, the middle of every range."""
    return Estimate(jnp.zeros(size), jnp.zeros(size))


def residuals(predict: Predict, rows: Transition, system: Array) -> Array:
    """[n, d] what the model leaves unexplained of real steps [n] in that system [k]."""

    def one(row: Transition) -> Array:
        change = predict(append_system(row.obs, system), row.action)
        return (row.next_obs - row.obs)[: change.shape[0]] - change

    return jax.vmap(one)(rows)


def most_probable_system(predict: Predict, rows: Transition, held: Array, spread: Array, size: int) -> Estimate:
    """The most probable system of steps [n], of which those `held` [n] count.

    spread: [d] std of the model's own residuals in simulation, the least that real ones have.
    """
    drawn = np.random.default_rng(0).uniform(-0.7, 0.7, (_STARTS - 1, size))
    starts = jnp.concatenate([jnp.zeros((1, size)), jnp.asarray(drawn, jnp.float32)])
    change = (rows.next_obs - rows.obs)[:, : spread.shape[0]]

    def missed(system: Array) -> Array:
        return residuals(predict, rows, system)

    estimate = most_probable(missed, starts, jnp.full(size, _BELIEF), change, held, spread, bound=1.0)
    return Estimate(estimate.point, jnp.zeros(size))


def dropo(predict: Predict, rows: Transition, held: Array, spread: Array, size: int) -> Estimate:
    """The normal distribution over systems under which steps [n] are most likely.

    Each candidate is a mean and a std of every number. Systems drawn from it predict every step, and a Gaussian with
    their mean and covariance, plus `spread`'s, tells how likely the real one is. Source: DROPO (Tiboni et al. 2023),
    which asks the simulator and searches with CMA-ES. Here the models predict, and the search is the cross-entropy
    method. All candidates, and all fits, draw the same random numbers.
    """
    normal = jnp.clip(jnp.asarray(np.random.default_rng(1).normal(size=(_SAMPLES, size)), jnp.float32), -2.0, 2.0)
    low, high = np.log(_STD)

    def described(point: Array) -> Estimate:
        mean, log_std = jnp.split(point, 2)
        return Estimate(jnp.clip(mean, -1.0, 1.0), jnp.exp(jnp.clip(log_std, low, high)))

    def cost(point: Array) -> Array:
        mean, std = described(point)
        drawn = jnp.clip(mean[None] + std[None] * normal, -1.0, 1.0)
        missed = jax.vmap(lambda system: residuals(predict, rows, system))(drawn) / spread[None, None]
        centre = missed.mean(axis=0)
        around = missed - centre[None]
        with jax.default_matmul_precision("highest"):
            covariance = jnp.einsum("sni,snj->nij", around, around) / _SAMPLES + jnp.eye(spread.shape[0])[None]
            factor = jnp.linalg.cholesky(covariance)
            white = jax.vmap(lambda f, c: jax.scipy.linalg.solve_triangular(f, c, lower=True))(factor, centre)
        log_det = jnp.log(jnp.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        return jnp.sum(jnp.where(held, 0.5 * jnp.sum(white**2, axis=1) + log_det, 0.0))

    def improve(search: tuple[Array, Array], key: Key) -> tuple[tuple[Array, Array], None]:
        mean, std = search
        points = mean[None] + std[None] * jax.random.normal(key, (_POPULATION, 2 * size))
        costs = jax.vmap(cost)(points)
        elite = points[jnp.argsort(costs)[:_ELITES]]
        return (elite.mean(axis=0), 0.7 * elite.std(axis=0) + 0.3 * std), None

    middle, half = (low + high) / 2, (high - low) / 2
    start = jnp.concatenate([jnp.zeros(size), jnp.full(size, middle)])
    wide = jnp.concatenate([jnp.full(size, _BELIEF), jnp.full(size, half / 2)])
    (best, _), _ = jax.lax.scan(improve, (start, wide), jax.random.split(jax.random.key(0), _ITERATIONS))
    return described(best)
