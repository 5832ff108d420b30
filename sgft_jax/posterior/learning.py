"""How the estimator learns: from rollouts of simulated systems that are known. Pure."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env
from envs.types import Array, Key, Policy, PyTree
from sgft_jax.math import optim
from sgft_jax.models.distortion import none
from sgft_jax.posterior.candidates import Candidates
from sgft_jax.posterior.decision import correction, play
from sgft_jax.posterior.estimator import (
    MOST,
    Estimator,
    Rollout,
    alternating,
    contradiction,
    histograms,
    init,
    interval,
    log_density,
    rank,
    rollout_of,
)

TOGETHER = (1, 2, 4, MOST)  # how many an update reads; each number in its turn
_BATCH = 1024  # rollouts of an update
_RATE, _WARMUP, _GRADIENT = 5e-4, 500, 1.0  # Adam's, the updates until it is reached, and the largest norm
_NEAR = 0.7  # share of corrections that are nearly right
_NEARLY, _WRONG = 0.12, 0.5  # std of what corrections miss, in units of the cube
_STAYS = 0.5  # share of systems where things stay in one place, which may be any of a real system
_EXPLORES = 0.5  # share of systems where rollouts explore, and of these rollouts

_USUAL = 0.95  # share of systems whose rollouts contradict each other less than that
_EVEN = 10.0  # imagined true numbers in each interval

_OPTIMISER = optim.adam(_GRADIENT)


class Lessons(NamedTuple):
    """points: [n, d] systems. rollouts: [n, MOST] in each."""

    points: Array
    rollouts: Rollout


class Learning(NamedTuple):
    """An estimator that learns. fresh: what it began with, beside its params."""

    fit: optim.Fit
    fresh: Estimator

    @property
    def estimator(self) -> Estimator:
        """As it is now."""
        return self.fresh._replace(params=self.fit.params)


def simulate(env: Env, systems: Candidates, policy: Policy, params: PyTree, key: Key, n: int) -> Lessons:
    """Rollouts in n systems of the prior, by the policy behind corrections as they may be deployed: none, one that is
    nearly right, or one that is wrong.

    Rollouts of a system are as much alike as those of a robot are: its share without a correction is anything from
    none to all, and so is how much of what corrections miss is the same in all. Else ten rollouts of one policy would
    tell the estimator more than there is to know. In half of the systems things stay where no training has them, or
    their places would pass for errors of sensors.
    """
    key_points, key_play = jax.random.split(key)
    points = systems.draw(key_points, n)

    def record(point: Array, key: Key) -> Rollout:
        key_plain, key_alike, key_miss, key_explores, key_stays, key_place, *keys = jax.random.split(key, 6 + MOST)
        plain, alike = jax.random.uniform(key_plain), jax.random.uniform(key_alike)
        explores = _EXPLORES * jax.random.bernoulli(key_explores, _EXPLORES)
        lasting = jnp.sqrt(alike) * jax.random.normal(key_miss, point.shape)
        stays, place = jax.random.bernoulli(key_stays, _STAYS), systems.place(key_place)

        def rollout(key: Key) -> Rollout:
            key_kind, key_near, key_miss, key_explore, key_world, key_episode = jax.random.split(key, 6)
            miss = lasting + jnp.sqrt(1.0 - alike) * jax.random.normal(key_miss, point.shape)
            std = jnp.where(jax.random.bernoulli(key_near, _NEAR), _NEARLY, _WRONG)
            undo = correction(env, systems.unknowns, jnp.clip(point + std * miss, 0.0, 1.0))
            nothing, is_plain = none(env.act_dim, env.measured_dim), jax.random.bernoulli(key_kind, plain)
            deployed = params._replace(distortion=jax.tree.map(functools.partial(jnp.where, is_plain), nothing, undo))
            explore = jax.random.bernoulli(key_explore, explores)
            anywhere, there = systems.episode(point, key_world), systems.episode(point, key_world, place)
            world = jax.tree.map(functools.partial(jnp.where, stays), there, anywhere)
            episode = play(env, policy, deployed, world, key_episode, explore=explore)
            return rollout_of(env, episode.transitions, episode.valid, episode.success)

        return jax.vmap(rollout)(jnp.stack(keys))

    return Lessons(points, jax.vmap(record)(points, jax.random.split(key_play, n)))


def begin(key: Key, lessons: Lessons) -> Learning:
    """Before the first update."""
    return resume(init(key, lessons.rollouts, lessons.points.shape[1]))


def resume(estimator: Estimator) -> Learning:
    """An estimator that goes on learning. What `finish` fitted starts anew."""
    fresh = estimator._replace(params=(), ranks=jnp.zeros_like(estimator.ranks))
    return Learning(optim.start(_OPTIMISER, estimator.params), fresh)


def learn(learning: Learning, lessons: Lessons, key: Key, *, together: int, updates: int, total: int) -> Learning:
    """After `updates` more that read so many rollouts together, of `total` for each number of `TOGETHER`."""
    size, whole = max(1, _BATCH // together), total * len(TOGETHER)
    counts = jnp.ones(together, bool)

    def update(learning: Learning, key: Key) -> tuple[Learning, None]:
        key_systems, key_rollouts = jax.random.split(key)
        systems = jax.random.randint(key_systems, (size,), 0, len(lessons.points))
        keys = jax.random.split(key_rollouts, size)
        which = jax.vmap(lambda key: jax.random.permutation(key, MOST)[:together])(keys)
        rollouts = jax.tree.map(lambda x: x[systems[:, None], which], lessons.rollouts)
        step = optim.steps_of(learning.fit)
        rate = _RATE * optim.warmup_factor(step, min(_WARMUP, whole / 10)) * optim.cosine_factor(step, whole)

        def loss(params: PyTree) -> tuple[Array, None]:
            estimator = learning.fresh._replace(params=params)
            nats = jax.vmap(lambda *x: log_density(estimator, x[0], counts, x[1]))(rollouts, lessons.points[systems])
            return -nats.sum(axis=1).mean(), None

        return learning._replace(fit=optim.minimise(_OPTIMISER, loss, learning.fit, rate)[0]), None

    return jax.lax.scan(update, learning, jax.random.split(key, updates))[0]


def finish(estimator: Estimator, lessons: Lessons, key: Key) -> Estimator:
    """The same with what lessons tell that it has not learned from: how sure of each number it may be, and how much
    rollouts of one system contradict each other.
    """
    n, d = lessons.points.shape
    right = estimator._replace(ranks=_ranks(estimator, lessons))

    def nats(row: tuple[Rollout, Key], counts: Array) -> Array:
        return contradiction(right, row[0], alternating(counts), d, row[1])

    contradictions = _by_number(nats, (lessons.rollouts, jax.random.split(key, n)))
    return right._replace(usual=jnp.quantile(contradictions, _USUAL, axis=0))


def _ranks(estimator: Estimator, lessons: Lessons) -> Array:
    """[MOST, d, intervals] log density of these systems' ranks, by which histograms are recalibrated (Kuleshov et al.
    2018).
    """

    def ranks(row: tuple[Array, Rollout], counts: Array) -> Array:
        return rank(histograms(estimator, row[1], counts, row[0]), row[0])

    intervals = interval(_by_number(ranks, (lessons.points, lessons.rollouts)))
    share = _EVEN + jax.nn.one_hot(intervals, estimator.ranks.shape[-1]).sum(axis=0)
    return jnp.log(share / share.mean(axis=-1, keepdims=True))


def _by_number(value: Callable[[Any, Array], Array], rows: PyTree) -> Array:
    """[n, MOST, ...] value(row, which rollouts count) of rows [n], after 1, 2, ... rollouts."""

    def of_row(row: Any) -> Array:
        return jax.lax.map(lambda number: value(row, jnp.arange(MOST) < number), 1 + jnp.arange(MOST))

    return jax.lax.map(of_row, rows, batch_size=64)
