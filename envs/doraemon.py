"""Domain randomisation that widens as fast as a policy succeeds (DORAEMON: Tiboni et al. 2024). On the host.

Every number that differs between episodes of the training domain, of parameters and effects alike, has a Beta
distribution over its range, on its own. They begin narrow around the nominal system. After each stage of training the
new ones have the largest entropy under which the policy still succeeds in half of the episodes, by importance weights,
within a trust region. Where it succeeds less often than that, they first turn to where it succeeds.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy import optimize, special

from envs.base import Domain, EffectRange, Env, Theta
from envs.observations import nominal_numbers, places, varying
from envs.types import Array, Key, UserError

_CONCENTRATION = 200.0  # a + b of the first distributions; both are at most as large
_RATE = 0.5  # of success
_STEP = 0.2  # nats from a distribution to the next, over all numbers: 20 of them are uniform after some 20 stages
_EDGE = 1e-6  # a point this close to an end of its range has an infinite density


class Betas(NamedTuple):
    """Distributions of d numbers, each over [0, 1]. a, b: [d]. reached: [] bool, whether the policy has ever succeeded
    often enough: before that nothing changes.
    """

    a: Array
    b: Array
    reached: Array


def doraemon(env: Env) -> Domain:
    """The domain of a task that is judged by success; its `update` takes success as returns. Raises UserError for a
    task that is judged by its return, or where nothing varies.
    """
    if env.score != "success":
        raise UserError(f"doraemon: widens with success, and {env.name} is judged by its return; leave it off")
    system = varying(env)
    where = places(env, system)
    low, high = (np.array([getattr(v, end) for v in system]) for end in ("low", "high"))
    flat, unravel = ravel_pytree(nominal_numbers(env))

    def init() -> Betas:
        mode = np.clip((np.asarray(flat)[where] - low) / (high - low), 0.0, 1.0)
        a = 1.0 + (_CONCENTRATION - 2.0) * mode
        return Betas(jnp.float32(a), jnp.float32(_CONCENTRATION - a), jnp.zeros((), bool))

    def sample(state: Betas, key: Key, n: int) -> Theta:
        def one(key: Key) -> Theta:
            point = jax.random.beta(key, state.a, state.b)
            params, drawn = unravel(flat.at[where].set(low + (high - low) * point))
            return Theta(params, EffectRange(drawn, drawn))

        return jax.vmap(one)(jax.random.split(key, n))

    def points_of(theta: Theta) -> Array:
        numbers = ravel_pytree((theta.params, theta.effects.low))[0]
        return jnp.clip((numbers[where] - low) / (high - low), _EDGE, 1.0 - _EDGE)

    def log_prob(state: Betas, theta: Theta) -> Array:
        of_points = jax.scipy.stats.beta.logpdf(points_of(theta), state.a, state.b)
        return of_points.sum() - np.log(high - low).sum()

    def update(state: Betas, theta: Theta, success: Array) -> Betas:
        points = np.asarray(jax.vmap(points_of)(theta), np.float64)
        return widened(state, points, np.asarray(success, np.float64))

    return Domain(init, sample, log_prob, update)


def entropy(betas: Betas) -> float:
    """Nats: 0 where all numbers are uniform, else less."""
    return _entropy(np.concatenate([betas.a, betas.b]).astype(np.float64))[0]


def widened(betas: Betas, points: np.ndarray, success: np.ndarray) -> Betas:
    """The next distributions. points: [n, d] drawn from `betas`. success: [n] of an episode at each of them, 0 or 1."""
    often = success.mean() >= _RATE
    if not (often or (betas.reached and success.any())):
        return betas
    now = np.concatenate([betas.a, betas.b]).astype(np.float64)
    rate, near = functools.partial(_rate, now, points, success), functools.partial(_divergence, now)
    trust = _within(near, -np.inf, _STEP)
    start = now
    if not often:
        start = _most(rate, now, [trust])
        if rate(start)[0] < _RATE:
            return _betas(start)
    best = _most(_entropy, start, [trust, _within(rate, _RATE, np.inf)])
    allowed = rate(best)[0] >= _RATE - 1e-3 and near(best)[0] <= _STEP + 1e-3
    return _betas(best if allowed and _entropy(best)[0] > _entropy(start)[0] else start)


Valued = Callable[[np.ndarray], tuple[float, np.ndarray]]  # numbers a, b [2 d] -> value, and its gradient [2 d]


def _most(goal: Valued, start: np.ndarray, constraints: Sequence[optimize.NonlinearConstraint]) -> np.ndarray:
    """[2 d] where a goal is largest, beginning at `start`."""
    bounds = optimize.Bounds(1.0, _CONCENTRATION)
    result = optimize.minimize(
        lambda x: -goal(x)[0],
        start,
        jac=lambda x: -goal(x)[1],
        bounds=bounds,
        constraints=constraints,
        method="trust-constr",
        options={"gtol": 1e-4, "xtol": 1e-6, "maxiter": 300},
    )
    return np.clip(result.x, 1.0, _CONCENTRATION)


def _within(function: Valued, low: float, high: float) -> optimize.NonlinearConstraint:
    slope: dict[str, Any] = {"jac": lambda x: function(x)[1]}  # SciPy's types know names of rules alone
    return optimize.NonlinearConstraint(lambda x: function(x)[0], low, high, **slope)


def _betas(x: np.ndarray) -> Betas:
    a, b = np.split(x, 2)
    return Betas(jnp.float32(a), jnp.float32(b), jnp.ones((), bool))


def _entropy(x: np.ndarray) -> tuple[float, np.ndarray]:
    """Of distributions x = (a, b) [2 d], nats."""
    a, b = np.split(x, 2)
    psi, slope = special.digamma, functools.partial(special.polygamma, 1)
    value = special.betaln(a, b) - (a - 1) * psi(a) - (b - 1) * psi(b) + (a + b - 2) * psi(a + b)
    both = (a + b - 2) * slope(a + b)
    return value.sum(), np.concatenate([both - (a - 1) * slope(a), both - (b - 1) * slope(b)])


def _divergence(now: np.ndarray, x: np.ndarray) -> tuple[float, np.ndarray]:
    """KL(now || x), nats."""
    (a, b), (c, d), psi = np.split(now, 2), np.split(x, 2), special.digamma
    value = special.betaln(c, d) - special.betaln(a, b) + (a - c) * psi(a) + (b - d) * psi(b)
    value += (c - a + d - b) * psi(a + b)
    both = psi(a + b) - psi(c + d)
    return value.sum(), np.concatenate([both + psi(c) - psi(a), both + psi(d) - psi(b)])


def _rate(now: np.ndarray, points: np.ndarray, success: np.ndarray, x: np.ndarray) -> tuple[float, np.ndarray]:
    """Success under x, by episodes under `now`."""
    logs = np.concatenate([np.log(points), np.log1p(-points)], axis=1)

    def normaliser(x: np.ndarray) -> float:
        return special.betaln(*np.split(x, 2)).sum()

    weights = np.exp(logs @ (x - now) - normaliser(x) + normaliser(now)) * success / len(success)
    a, b = np.split(x, 2)
    both = special.digamma(a + b)
    return weights.sum(), weights @ (logs - np.concatenate([special.digamma(a) - both, special.digamma(b) - both]))
