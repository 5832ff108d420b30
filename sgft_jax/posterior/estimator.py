"""A network that reads rollouts and says which systems may have made them: a posterior learned in simulation. Pure.

The simulator makes as many (system, rollouts) pairs as one likes, so the network is trained to give the true system of
each the highest density: neural posterior estimation (Papamakarios and Murray 2016; in robotics BayesSim, Ramos et al.
2019). What is chaotic in contacts, and where objects really were, is averaged over by training.

Each number of a system, in the unit interval, has a histogram that depends on the rollouts and on the numbers before
it. So a density may have any shape within the cube, is exact, and can be drawn from.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from flax import linen as nn

from envs.base import Env
from envs.types import Array, Key, PyTree, Transition

_WIDTH, _HEADS, _STEPS, _ROLLOUTS = 128, 4, 3, 2  # of the encoder: units, heads, layers over steps and over rollouts
_BINS, _HIDDEN = 256, 256  # of a histogram, and units of the network that fills it
_WAVES = 6  # pairs of sine and cosine by which a number is read
_RANKS = 20  # intervals of ranks, whose density is fitted
_SCALE = 4.0  # std of a measurement within which its waves tell places apart
_HALF = 64  # points of the posterior of half of the rollouts
_MANY = 4.0  # rollouts, for scale
MOST = 10  # rollouts that are read together
_FARTHEST = 10.0  # std: beyond it a number is cut off
_LEAST = 1e-4  # raw units: std of a measurement


class Rollout(NamedTuple):
    """What a real rollout of T steps left.

    measured: [T + 1, measured_dim] at the start and after each step. action: [T, act_dim] as commanded.
    valid: [T] bool. success: [] bool.
    """

    measured: Array
    action: Array
    valid: Array
    success: Array


class Statistics(NamedTuple):
    """mean, std: [measured_dim] of measurements. change: [measured_dim] std of what a step changes."""

    mean: Array
    std: Array
    change: Array


class Estimator(NamedTuple):
    """What a trained network needs: its params and the statistics of what it reads.

    ranks: [MOST, d, intervals] log density of the true numbers' ranks in their histograms, after 1, 2, ... rollouts.
    usual: [MOST] the `contradiction` of halves that 95 % of the simulator's systems do not exceed. `learning.finish`
    fits both.
    """

    params: PyTree
    statistics: Statistics
    ranks: Array
    usual: Array


class _Block(nn.Module):
    """A layer of a transformer over [n, width], of which [n] bool count."""

    @nn.compact
    def __call__(self, x: Array, counts: Array) -> Array:
        attention = nn.MultiHeadDotProductAttention(_HEADS)
        read = nn.LayerNorm()(x)
        x = x + attention(read, mask=jnp.broadcast_to(counts, (1, len(x), len(x))))
        hidden = nn.gelu(nn.Dense(2 * x.shape[-1])(nn.LayerNorm()(x)))
        return x + nn.Dense(x.shape[-1])(hidden)


class _Encoder(nn.Module):
    """Tokens of rollouts [k, T, f], valid [k, T], success [k], counts [k] -> [2 * width + 1] what they say."""

    @nn.compact
    def __call__(self, tokens: Array, valid: Array, success: Array, counts: Array) -> Array:
        steps = tokens.shape[1]
        x = nn.Dense(_WIDTH)(tokens) + self.param("time", nn.initializers.normal(0.1), (1, steps, _WIDTH))
        for _ in range(_STEPS):
            x = nn.vmap(_Block, variable_axes={"params": None}, split_rngs={"params": False})()(x, valid)
        mean = jnp.sum(x * valid[..., None], axis=1) / jnp.maximum(valid.sum(1), 1)[:, None]
        most = jnp.max(jnp.where(valid[..., None], x, -1e3), axis=1)
        summary = jnp.concatenate([mean, most, success[:, None]], axis=1)
        y = nn.Dense(_WIDTH)(nn.gelu(nn.Dense(2 * _WIDTH)(summary)))
        for _ in range(_ROLLOUTS):
            y = _Block()(y, counts)
        total = jnp.sum(y * counts[:, None], axis=0)
        n = jnp.maximum(counts.sum(), 1)
        return jnp.concatenate([total / n, total / _MANY, jnp.log(n)[None]])


class _Head(nn.Module):
    """(context, numbers before this one [d], the others 0, which number it is [d]) -> [bins] logits."""

    @nn.compact
    def __call__(self, context: Array, before: Array, which: Array) -> Array:
        x = jnp.concatenate([context, _waves(before), which])
        for _ in range(2):
            x = nn.gelu(nn.LayerNorm()(nn.Dense(_HIDDEN)(x)))
        return nn.Dense(_BINS)(x)


def rollout_of(env: Env, rows: Transition, valid: Array, success: Array) -> Rollout:
    """A recorded episode, without what observations hold beside measurements. rows, valid: [T]."""
    measured = jnp.concatenate([rows.obs[:1], rows.next_obs])[:, : env.measured_dim]
    return Rollout(measured, rows.action, valid, success)


def blank(k: int, steps: int, measured: int, act_dim: int) -> Rollout:
    """Room for k rollouts of so many steps, measurements and actions."""
    return Rollout(
        jnp.zeros((k, steps + 1, measured)),
        jnp.zeros((k, steps, act_dim)),
        jnp.zeros((k, steps), bool),
        jnp.zeros(k, bool),
    )


def at_half_precision(estimator: Estimator) -> Estimator:
    """The same in numbers that half precision has, which are what a prior's file holds."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float16).astype(jnp.float32), estimator)


def without_estimator(params: PyTree) -> PyTree:
    """A prior's params without the estimator that they may have: megabytes that most have no use for."""
    return params if getattr(params, "estimator", None) is None else params._replace(estimator=None)


def shaped(steps: int, measured: int, act_dim: int, d: int) -> Estimator:
    """Zeros of the shapes that an estimator has for rollouts of so many steps, measurements and actions."""
    rollouts = jax.tree.map(lambda x: x[None], blank(MOST, steps, measured, act_dim))
    shapes = jax.eval_shape(lambda: init(jax.random.key(0), rollouts, d))
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


def init(key: Key, rollouts: Rollout, d: int) -> Estimator:
    """A fresh estimator of systems with d unknowns. rollouts: [n, k], which say in what range measurements are."""
    key_encoder, key_head = jax.random.split(key)
    statistics = _statistics(rollouts)
    inputs = _read(statistics, jax.tree.map(lambda x: x[0], rollouts), jnp.ones(rollouts.success.shape[1], bool))
    encoder = _Encoder().init(key_encoder, *inputs)
    nothing = jnp.zeros(d)
    head = _Head().init(key_head, _Encoder().apply(encoder, *inputs), nothing, nothing)
    most = rollouts.success.shape[1]
    return Estimator({"encoder": encoder, "head": head}, statistics, jnp.zeros((most, d, _RANKS)), jnp.zeros(most))


def log_density(estimator: Estimator, rollouts: Rollout, counts: Array, point: Array) -> Array:
    """[d] nats of each number of a point [d], given those before it. rollouts: [k], of which counts [k] bool count."""
    return at(histograms(estimator, rollouts, counts, point), point)


def histograms(estimator: Estimator, rollouts: Rollout, counts: Array, point: Array) -> Array:
    """[d, bins] nats of the density of each number, given those of a point [d] before it."""
    d, fill = len(point), _fill(estimator, rollouts, counts)
    before = jnp.where(jnp.tril(jnp.ones((d, d), bool), -1), point, 0.0)
    return jax.vmap(fill)(before, jnp.eye(d))


def at(histograms: Array, point: Array) -> Array:
    """[d] what histograms [d, bins] hold at a point [d]."""
    return histograms[jnp.arange(len(point)), _bin(point)]


def rank(histograms: Array, point: Array) -> Array:
    """[d] the probability of less than each number of a point [d]."""
    mass = jnp.exp(histograms) / _BINS
    return at(jnp.cumsum(mass, axis=1) - mass, point) + at(mass, point) * (point * _BINS - _bin(point))


def interval(rank: Array) -> Array:
    """Into which of `ranks` a rank falls."""
    return jnp.clip(jnp.floor(rank * _RANKS).astype(jnp.int32), 0, _RANKS - 1)


def _bin(point: Array) -> Array:
    return jnp.clip(jnp.floor(point * _BINS).astype(jnp.int32), 0, _BINS - 1)


def draw(estimator: Estimator, rollouts: Rollout, counts: Array, d: int, key: Key, n: int) -> Array:
    """[n, d] independent points of the posterior; arguments as of `log_density`."""
    fill = _fill(estimator, rollouts, counts)

    def number(point: Array, row: tuple[Array, Key]) -> tuple[Array, None]:
        which, key = row
        key_bin, key_share = jax.random.split(key)
        chosen = jax.random.categorical(key_bin, fill(point, which))
        return point + which * (chosen + jax.random.uniform(key_share)) / _BINS, None

    def one(key: Key) -> Array:
        return jax.lax.scan(number, jnp.zeros(d), (jnp.eye(d), jax.random.split(key, d)))[0]

    return jax.vmap(one)(jax.random.split(key, n))


def alternating(counts: Array) -> tuple[Array, Array]:
    """[k] bool, every other of the rollouts that count [k], and those between."""
    first = counts & (jnp.cumsum(counts) % 2 == 1)
    return first, counts & ~first


def contradiction(estimator: Estimator, rollouts: Rollout, halves: tuple[Array, Array], d: int, key: Key) -> Array:
    """[] nats by which systems are less probable to one half of the rollouts than to the other, from which they are
    drawn. Large where no system has made them all; small for one rollout.

    rollouts: [k]. halves: [k] bool each. d: numbers of a system.
    """

    def one_way(here: Array, there: Array, key: Key) -> Array:
        def nats(counts: Array, point: Array) -> Array:
            return log_density(estimator, rollouts, counts, point).sum()

        points = draw(estimator, rollouts, here, d, key, _HALF)
        of_points = jax.vmap(nats, (None, 0))
        return jnp.mean(of_points(here, points) - of_points(there, points))

    (first, second), keys = halves, jax.random.split(key)
    return (one_way(first, second, keys[0]) + one_way(second, first, keys[1])) / 2


def _fill(estimator: Estimator, rollouts: Rollout, counts: Array) -> Callable[[Array, Array], Array]:
    """What fills histograms: (numbers so far [d], which one is next [d]) -> [bins] nats of its density."""
    context = _Encoder().apply(estimator.params["encoder"], *_read(estimator.statistics, rollouts, counts))
    ranks = estimator.ranks[jnp.maximum(counts.sum(), 1) - 1]

    def fill(before: Array, which: Array) -> Array:
        # Ranks that are too often in the middle, say, are those of a network that is not sure enough.
        logits = jax.nn.log_softmax(cast(Array, _Head().apply(estimator.params["head"], context, before, which)))
        mass = jnp.exp(logits)
        right = logits + (which @ ranks)[interval(jnp.cumsum(mass) - mass / 2)]
        return jax.nn.log_softmax(right) + math.log(_BINS)

    return fill


def _statistics(rollouts: Rollout) -> Statistics:
    """Of rollouts [n, k]."""
    before, after = rollouts.measured[..., :-1, :], rollouts.measured[..., 1:, :]
    axes, valid = (0, 1, 2), rollouts.valid[..., None]
    mean, std, change = (
        after.mean(axes, where=valid),
        after.std(axes, where=valid),
        (after - before).std(axes, where=valid),
    )
    return Statistics(mean, jnp.maximum(std, _LEAST), jnp.maximum(change, _LEAST))


def _read(statistics: Statistics, rollouts: Rollout, counts: Array) -> tuple[Array, Array, Array, Array]:
    """What the encoder reads of rollouts [k]; the last three of it are theirs."""

    def token(before: Array, after: Array, action: Array, last: Array, valid: Array) -> Array:
        place = (before - statistics.mean) / statistics.std
        change = (after - before) / statistics.change
        numbers = jnp.concatenate([place, _waves(place / _SCALE), change, action, last])
        return jnp.where(valid, jnp.clip(numbers, -_FARTHEST, _FARTHEST), 0.0)

    action, measured = rollouts.action, rollouts.measured
    last = jnp.concatenate([jnp.zeros_like(action[:, :1]), action[:, :-1]], axis=1)
    tokens = jax.vmap(jax.vmap(token))(measured[:, :-1], measured[:, 1:], action, last, rollouts.valid)
    return tokens, rollouts.valid, rollouts.success.astype(jnp.float32), counts


def _waves(x: Array) -> Array:
    """Numbers [k] with their sines and cosines, [(2 * waves + 1) * k]."""
    angles = jnp.pi * jnp.outer(2.0 ** jnp.arange(_WAVES), x)
    return jnp.concatenate([x[None], jnp.sin(angles), jnp.cos(angles)]).ravel()
