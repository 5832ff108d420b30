"""Tempered sequential Monte Carlo over the unit cube, for a likelihood that is itself an estimate. Pure.

Particles go from the prior, uniform, to the posterior of a tempered likelihood in stages. Each stage raises the
exponent as far as half of the particles stay effective, resamples them and moves each by differences of two others,
which fit the posterior's shape and reach its other modes (ter Braak 2006). A particle keeps the estimate with which it
was accepted, as pseudo-marginal methods need (Andrieu and Roberts 2009). `blackjax.smc` estimates a particle's
likelihood anew at each stage and for its weight, twice the replays, and so cannot keep it: hence these lines.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array, Key

_MOVES = 5  # of each particle in a stage
_STAGES = 40  # at most
_SPREAD = 2.38  # over the root of twice the dimension: the best step of differences in a Gaussian
_JUMP = 0.1  # share of moves by a whole difference, from mode to mode
_NUDGE = 1e-3  # std of what is added to a difference, so that no coordinate dies out
_RATE, _ADAPT = 0.25, 2.0  # the acceptance that steps are made for, and how fast their logarithm follows
_HALVINGS = 30  # of the search for the next exponent

Likelihood = Callable[[Array, Key], Array]  # (points [n, d], keys [n]) -> [n] estimated nats


class Particles(NamedTuple):
    """Equally weighted particles [n] of a tempered posterior.

    points: [n, d]. log_likelihood: [n] the kept estimates, not tempered. exponent: [] of the likelihood. ancestor: [n]
    which particle of the prior each descends from. acceptance: [] share of moves in the last stage. stages: [] count.
    scale: [] of the next moves.
    """

    points: Array
    log_likelihood: Array
    exponent: Array
    ancestor: Array
    acceptance: Array
    stages: Array
    scale: Array


class _Loop(NamedTuple):
    particles: Particles
    key: Key


def begin(likelihood: Likelihood, points: Array, key: Key) -> Particles:
    """Particles at points [n, d] drawn from the prior."""
    n, zero = len(points), jnp.zeros(())
    estimate = likelihood(points, jax.random.split(key, n))
    return Particles(points, estimate, zero, jnp.arange(n), zero, jnp.zeros((), jnp.int32), jnp.ones(()))


def sample(likelihood: Likelihood, particles: Particles, key: Key, *, exponent: float | Array) -> Particles:
    """The posterior whose likelihood has this exponent, from particles of a smaller one.

    It ends at a smaller exponent where `_STAGES` do not suffice.
    """

    def unfinished(loop: _Loop) -> Array:
        return (loop.particles.exponent < exponent) & (loop.particles.stages < _STAGES)

    def stage(loop: _Loop) -> _Loop:
        key, key_resample, key_move = jax.random.split(loop.key, 3)
        particles = _resampled(loop.particles, key_resample, jnp.asarray(exponent))
        return _Loop(_moved(likelihood, particles, key_move), key)

    return jax.lax.while_loop(unfinished, stage, _Loop(particles, key)).particles


def effective(log_weights: Array) -> Array:
    """[] how many equally weighted particles would be worth as much as these [n]."""
    weights = jax.nn.softmax(log_weights)
    return 1.0 / jnp.sum(weights**2)


def systematic(key: Key, log_weights: Array) -> Array:
    """[n] indices, each as often as its weight [n] says, up to one."""
    n = len(log_weights)
    ends = jnp.cumsum(jax.nn.softmax(log_weights))
    return jnp.clip(jnp.searchsorted(ends, (jnp.arange(n) + jax.random.uniform(key)) / n), 0, n - 1)


def _resampled(particles: Particles, key: Key, last: Array) -> Particles:
    """Particles of the next exponent, at most `last`."""
    log_likelihood, n = particles.log_likelihood, len(particles.log_likelihood)

    def halve(ends: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        low, high = ends
        middle = 0.5 * (low + high)
        enough = effective((middle - particles.exponent) * log_likelihood) >= n / 2
        return (jnp.where(enough, middle, low), jnp.where(enough, high, middle)), None

    whole = effective((last - particles.exponent) * log_likelihood) >= n / 2
    (low, _), _ = jax.lax.scan(halve, (particles.exponent, last), length=_HALVINGS)
    exponent = jnp.where(whole, last, low)
    chosen = systematic(key, (exponent - particles.exponent) * log_likelihood)
    points, kept, ancestor = particles.points[chosen], log_likelihood[chosen], particles.ancestor[chosen]
    return particles._replace(points=points, log_likelihood=kept, ancestor=ancestor, exponent=exponent)


def _moved(likelihood: Likelihood, particles: Particles, key: Key) -> Particles:
    """Particles after a stage's moves, which leave their distribution as it is."""
    n, d = particles.points.shape

    def move(before: Particles, key: Key) -> tuple[Particles, Array]:
        key_pairs, key_nudge, key_jump, key_estimate, key_accept = jax.random.split(key, 5)
        # Two others of each particle: shifts of the ring by two different numbers, the same for all.
        shifts = 1 + jax.random.choice(key_pairs, n - 1, (2,), replace=False)
        difference = jnp.roll(before.points, shifts[0], axis=0) - jnp.roll(before.points, shifts[1], axis=0)
        jump = jax.random.uniform(key_jump, (n, 1)) < _JUMP
        step = jnp.where(jump, 1.0, before.scale * _SPREAD / jnp.sqrt(2.0 * d)) * difference
        proposed = _reflected(before.points + step + _NUDGE * jax.random.normal(key_nudge, (n, d)))
        estimate = likelihood(proposed, jax.random.split(key_estimate, n))
        gain = before.exponent * (estimate - before.log_likelihood)
        accepted = jnp.log(jax.random.uniform(key_accept, (n,))) < gain
        rate = accepted.mean()
        after = before._replace(
            points=jnp.where(accepted[:, None], proposed, before.points),
            log_likelihood=jnp.where(accepted, estimate, before.log_likelihood),
            scale=before.scale * jnp.exp(_ADAPT * (rate - _RATE)),
        )
        return after, rate

    after, rates = jax.lax.scan(move, particles, jax.random.split(key, _MOVES))
    return after._replace(acceptance=rates.mean(), stages=particles.stages + 1)


def _reflected(points: Array) -> Array:
    """Points folded back into the unit cube, which keeps moves symmetric."""
    folded = jnp.mod(points, 2.0)
    return jnp.where(folded > 1.0, 2.0 - folded, folded)
