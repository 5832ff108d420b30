"""Domain randomisation as it is mostly done: every parameter uniform in its range, on its own.

Also for what is between a policy's command and what a robot does.
"""

import itertools
from collections.abc import Iterator, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from envs import effects as env_effects
from envs.base import NOTHING, Domain, Env, Theta, Value, World, misnamed
from envs.types import Array, Key, UserError


def uniform(env: Env, params: Mapping[str, Value] = NOTHING, effects: Mapping[str, Value] = NOTHING) -> Domain:
    """Domain parameters from their training ranges and the simulator's own effects, but for those named here.

    params: by name a value or a range [low, high]. effects: see `envs.effects.make_range`. Raises UserError for unknown
    names and impossible values.
    """
    ranges = parameter_ranges(env, params)
    low, high = ranges.T
    shared = env_effects.make_range(env, {**env.training, **effects})
    volume = np.log(np.where(low < high, high - low, 1.0)).sum()

    def sample(state: tuple, key: Key, n: int) -> Theta:
        share = np.asarray(jax.random.uniform(key, (n, len(low))), np.float64)
        return Theta(low + (high - low) * share, jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), shared))

    def log_prob(state: tuple, theta: Theta) -> Array:
        # Worlds keep float32: what was drawn from a range lies in it up to rounding.
        margin = 1e-6 * np.maximum(np.abs(low), np.abs(high))
        inside = ((theta.params >= low - margin) & (theta.params <= high + margin)).all()
        return jnp.where(inside, -volume, -jnp.inf)

    return Domain(init=lambda: (), sample=sample, log_prob=log_prob, update=lambda state, theta, returns: state)


def sample_worlds(
    env: Env, key: Key, n: int, *, params: Mapping[str, Value] = NOTHING, effects: Mapping[str, Value] = NOTHING
) -> World:
    """Worlds [n] of a task, uniform in the training ranges but for what is named, see `uniform`."""
    domain = uniform(env, params, effects)
    return env.make_worlds(domain.sample(domain.init(), key, n))


def parameter_ranges(env: Env, chosen: Mapping[str, Value]) -> np.ndarray:
    """[n_params, 2] low and high of every parameter: the training range unless `chosen` says a value or a range.

    Raises UserError, which names parameter, value and bound.
    """
    ranges = {p.name: (p.low, p.high) for p in env.parameters}
    bounds = {p.name: p.bounds for p in env.parameters}
    for name, value in chosen.items():
        if name not in ranges:
            raise misnamed(env, name)
        array = env_effects.numbers(value)
        pair = np.broadcast_to(array, (2,)) if array.shape in ((), (2,)) else np.array([np.nan])
        if not np.isfinite(pair).all() or pair[0] > pair[1]:
            raise UserError(f"parameter '{name}' needs a value or a range [low, high], got {value}")
        low, high = bounds[name]
        if pair[0] < low or pair[1] > high:
            side = f"at least {low:g}" if pair[0] < low else f"at most {high:g}"
            raise UserError(f"parameter '{name}' must be {side}, got {value}")
        ranges[name] = (float(pair[0]), float(pair[1]))
    for theta in _corners(ranges):
        if problem := env.check(theta):
            raise UserError(f"{env.name}: {problem}")
    return np.array(list(ranges.values())).reshape(-1, 2)


def _corners(ranges: Mapping[str, tuple[float, float]]) -> Iterator[dict[str, float]]:
    """Thetas at both ends of the ranges, of any two parameters at a time; the others at their low ends."""
    lowest = {name: low for name, (low, _) in ranges.items()}
    varying = [name for name, (low, high) in ranges.items() if low < high]
    for names in itertools.combinations(varying, min(2, len(varying))):
        for ends in itertools.product(*(ranges[name] for name in names)):
            yield lowest | dict(zip(names, ends, strict=True))


def with_actuators(env: Env) -> Env:
    """The task with actuators and sensors that differ between episodes, each effect uniform in a range.

    `env.actuators` names ranges. Other effects get: scale 0.7 to 1.4 for each command entry, bias -0.15 to 0.15 of the
    command range [-1, 1], rotation -0.3 to 0.3 rad (Cartesian commands only), latency 0 to 0.6 control periods, jitter
    0 to 0.1 control periods.
    """
    n, period = env.act_dim, env.control_dt
    ranges: dict[str, Value] = {
        "action_scale": [[0.7] * n, [1.4] * n],
        "action_bias": [[-0.15] * n, [0.15] * n],
        "action_rotation": [-0.3, 0.3] if env.cartesian else 0.0,
        "latency": [0.0, 0.6 * period],
        "latency_jitter": [0.0, 0.1 * period],
    }
    return env._replace(training={**env.training, **ranges, **env.actuators})
