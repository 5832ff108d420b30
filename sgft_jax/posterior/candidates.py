"""What is not known of a real system, and the simulated systems that may be it. Pure, but for `candidates`.

A candidate is a point [d] of the unit cube: one number for each unknown.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import EffectRange, Effects, Env, Parameter, Theta, World
from envs.effects import make_range
from envs.patches import patches
from envs.types import Array, Key

_SCALE, _BIAS, _TURN = (0.35, 1.7), (-0.6, 0.6), (-1.0, 1.0)  # of commands; of their range [-1, 1]; rad
_LATENCY = 0.6  # control periods at most
_ERRORS = 2.5  # a constant error is at most so many of an entry's `error`
_KINDS = {"action_scale": 1, "action_bias": 1, "action_rotation": 1, "latency": 2, "obs_bias": 3}  # 0: parameters
_ANYWHERE = 0.5  # share of systems where a kind of errors is of any size
_NOISIEST = 2.0  # times training's noise of sensors
_WIDE = 3.0  # from low to high: from here on a number's logarithm is uniform


class Unknown(NamedTuple):
    """A number of a real system: of a domain parameter or an effect, at `index` where that is a vector.

    low, high: raw units.
    """

    name: str
    index: int
    low: float
    high: float

    @property
    def log(self) -> bool:
        """Whether its logarithm is uniform instead of the number itself."""
        return self.low > 0 and self.high >= _WIDE * self.low


class Candidates(NamedTuple):
    """Simulated systems of a task, at points [d] of the unit cube.

    nominal: [d] the point at which nothing differs. world(point [d], place [k]) -> World. place: [k] domain parameters
    of a real system, within real [k, 2], or drawn anew for every episode, within training [k, 2].
    """

    unknowns: tuple[Unknown, ...]
    nominal: Array
    world: Callable[[Array, Array], World]
    training: Array
    real: Array

    def draw(self, key: Key, n: int) -> Array:
        """[n, d] points from the prior."""
        return draw(self.unknowns, self.nominal, key, n)

    def place(self, key: Key) -> Array:
        """[k] a place of a real system that stays where it is."""
        return jax.random.uniform(key, (len(self.real),), minval=self.real[:, 0], maxval=self.real[:, 1])

    def episode(self, point: Array, key: Key, place: Array | None = None) -> World:
        """Where a simulated episode of a candidate takes place: [k], drawn anew if None. Its sensors are up to twice as
        noisy as training's.
        """
        key_place, key_noise = jax.random.split(key)
        low, high = self.training.T
        drawn = jax.random.uniform(key_place, low.shape, minval=low, maxval=high)
        world = self.world(point, drawn if place is None else place)
        effects = world.theta.effects.low
        noise = jax.random.uniform(key_noise, maxval=_NOISIEST) * effects.obs_noise
        return world._replace(theta=world.theta._replace(effects=exactly(effects._replace(obs_noise=noise))))


def draw(unknowns: tuple[Unknown, ...], nominal: Array, key: Key, n: int) -> Array:
    """[n, d] points from the prior over systems.

    Parameters are anywhere in their ranges. Errors of commands, latency and errors of sensors are each anywhere in half
    of the systems; in the others they are at most so far from nominal [d] as a share says that is drawn, too, for most
    robots do not err in every way at once.
    """
    kinds = np.array([_KINDS.get(u.name, 0) for u in unknowns])

    def one(key: Key) -> Array:
        key_point, key_anywhere, key_share = jax.random.split(key, 3)
        size = (1 + max(_KINDS.values()),)
        anywhere = jax.random.bernoulli(key_anywhere, _ANYWHERE, size).at[0].set(True)
        shares = jnp.where(anywhere, 1.0, jax.random.uniform(key_share, size))
        return nominal + shares[kinds] * (jax.random.uniform(key_point, nominal.shape) - nominal)

    return jax.vmap(one)(jax.random.split(key, n))


def nominal_of(env: Env) -> Array:
    """[d] the point at which nothing differs from the nominal system."""
    numbers = {p.name: p.nominal for p in env.parameters} | {"action_scale": 1.0}
    unknowns = unknowns_of(env)
    return point_of(unknowns, jnp.array([numbers.get(u.name, 0.0) for u in unknowns]))


def values(unknowns: tuple[Unknown, ...], point: Array) -> Array:
    """[d] raw units at a point [d]."""
    log, low, width = _axes(unknowns)
    numbers = low + width * point
    return jnp.where(log, jnp.exp(numbers), numbers)


def point_of(unknowns: tuple[Unknown, ...], numbers: Array) -> Array:
    """[d] the point of the cube that is nearest to raw units [d]."""
    log, low, width = _axes(unknowns)
    return jnp.clip((jnp.where(log, jnp.log(jnp.where(log, numbers, 1.0)), numbers) - low) / width, 0.0, 1.0)


def _axes(unknowns: tuple[Unknown, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[d] whether numbers are logarithms; where their axes begin, and how long they are."""
    log = np.array([u.log for u in unknowns])
    ends = (np.array([getattr(u, end) for u in unknowns]) for end in ("low", "high"))
    low, high = (np.where(log, np.log(np.where(log, end, 1.0)), end) for end in ends)
    return log, low, high - low


def unknowns_of(env: Env) -> tuple[Unknown, ...]:
    """Every unknown of a task, by the same rule for all tasks.

    Domain parameters but for places; of commands scale, constant bias, rotation (Cartesian ones) and latency; constant
    errors of the measurements that may have one. Not the noise of sensors, which is training's: a level to be found
    would grow to excuse wrong systems. Nothing else: what no unknown explains is what a misfit shows.
    """
    unknowns = [Unknown(p.name, 0, *real_range(p)) for p in env.parameters if not p.place]
    unknowns += [Unknown("action_scale", i, *_SCALE) for i in range(env.act_dim)]
    unknowns += [Unknown("action_bias", i, *_BIAS) for i in range(env.act_dim)]
    unknowns += [Unknown("action_rotation", 0, *_TURN)] if env.cartesian else []
    unknowns += [Unknown("latency", 0, 0.0, _LATENCY * env.control_dt)]
    unknowns += [Unknown("obs_bias", i, -_ERRORS * e, _ERRORS * e) for i, e in enumerate(env.sensor_errors)]
    return tuple(unknown for unknown in unknowns if unknown.low < unknown.high)


def real_range(parameter: Parameter) -> tuple[float, float]:
    """Where the value of a real system is looked for."""
    if parameter.real is not None:
        return parameter.real
    low, high, (least, most) = parameter.low, parameter.high, parameter.bounds
    if low > 0:
        return max(low / 2, least), min(2 * high, most)
    return max(low - (high - low) / 2, least), min(high + (high - low) / 2, most)


def candidates(env: Env) -> Candidates:
    """Simulated systems of a task, patched on the device. Impure: MuJoCo compiles a few hundred worlds, in seconds."""
    ranges = np.array([real_range(p) for p in env.parameters]).reshape(-1, 2)
    model = patches(env, ranges).model
    unknowns, names = unknowns_of(env), [p.name for p in env.parameters]
    nothing = make_range(env, {"obs_noise_prob": 1.0, "obs_noise": _noise(env)}).low
    defaults = jnp.array([p.nominal for p in env.parameters])
    where = np.array([i for i, p in enumerate(env.parameters) if p.place], int)
    training = np.array([(p.low, p.high) for p in env.parameters]).reshape(-1, 2)[where]

    def world(point: Array, place: Array) -> World:
        params, effects = defaults.at[where].set(place), nothing._asdict()
        for unknown, value in zip(unknowns, values(unknowns, point), strict=True):
            if unknown.name in Effects._fields:
                old = effects[unknown.name]
                effects[unknown.name] = old.at[unknown.index].set(value) if old.ndim else value
            else:
                params = params.at[names.index(unknown.name)].set(value)
        return World(Theta(params, exactly(Effects(**effects))), model(params))

    real = np.array([p.real or (p.low, p.high) for p in env.parameters]).reshape(-1, 2)[where]
    places = (jnp.asarray(box, jnp.float32) for box in (training, real))
    return Candidates(unknowns, nominal_of(env), world, *places)


def exactly(effects: Effects) -> EffectRange:
    """The range of these effects alone."""
    return EffectRange(effects, effects)


def _noise(env: Env) -> float:
    """Root mean square of the noise of training's sensors, raw units."""
    high = make_range(env, env.training).high
    return float(high.obs_noise * math.sqrt(high.obs_noise_prob))
