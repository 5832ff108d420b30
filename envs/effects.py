"""Effects on commands and measurements: from names and numbers to arrays, and what they do. Pure."""

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import EffectRange, Effects, Entry, Env, Numbers, Value, entries_of, misnamed
from envs.types import Array, Key, UserError, unknown

__all__ = ["distort", "draw", "make_range", "measure", "numbers", "ramp", "shake"]

_DEFAULTS = {"action_scale": 1.0, "obs_noise_prob": 1.0}
_NOT_NEGATIVE = ("latency", "latency_jitter", "obs_noise", "obs_noise_prob", "action_noise")
# Beyond these nothing is left of a command, in ranges of it, of a turn, in rad, or of a measurement kept in float32.
_MOST = {
    **dict.fromkeys(("action_scale", "action_bias", "action_noise"), 100.0),
    "action_rotation": 2 * np.pi,
    **dict.fromkeys(("obs_noise", "obs_bias"), 1e6),
}


def make_range(env: Env, values: Mapping[str, Value]) -> EffectRange:
    """Effects of that task from named values or ranges; what is not named has no effect. Scalars fill vectors.

    A range is [low, high] for a scalar and [[low, ...], [high, ...]] for a vector. A vector may also be named by the
    entries of the action or observation, e.g. {"goal_xz": [0.03, 0.0]}; entries without a name have no effect. Raises
    UserError, which names the effect and the bound, for what is no finite number, has another size or is impossible.
    """
    for name in values:
        if name not in Effects._fields:
            raise misnamed(env, name)
    low, high = ({}, {})
    for name in Effects._fields:
        default, entries = _DEFAULTS.get(name, 0.0), entries_of(env, name)
        value = values.get(name, default)
        if isinstance(value, Mapping):
            low[name], high[name] = _ends_by_entry(name, value, entries, default)
        else:
            low[name], high[name] = _ends(name, value, (sum(e.size for e in entries),) if entries else ())
    _check_possible(env, low, high)
    return EffectRange(*(Effects(**{k: jnp.asarray(v, jnp.float32) for k, v in end.items()}) for end in (low, high)))


def numbers(value: Value) -> np.ndarray:
    """A value or range as an array; one of shape [0, 0, 0], which fits nowhere, if it holds anything but numbers."""
    try:
        array = np.asarray(value)
    except (ValueError, TypeError):
        array = np.empty(0, object)
    return array.astype(np.float64) if array.dtype.kind in "iuf" else np.zeros((0, 0, 0))


def _ends_by_entry(
    name: str, values: Mapping[str, Numbers], entries: tuple[Entry, ...], default: float
) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of a vector whose parts are named."""
    names = [e.name for e in entries]
    if not names:
        raise UserError(f"effect '{name}' needs one value or a range [low, high], got {dict(values)}")
    for odd in values:
        if odd not in names:
            raise UserError(unknown(f"entry of effect '{name}'", odd, names))
    sizes = {e.name: () if e.size == 1 else (e.size,) for e in entries}
    parts = [_ends(f"{name}.{entry}", values.get(entry, default), shape) for entry, shape in sizes.items()]
    low, high = (np.concatenate([x.reshape(-1) for x in ends]) for ends in zip(*parts, strict=True))
    return low, high


def _ends(name: str, value: Numbers, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    values = numbers(value)
    if values.shape not in ((), shape, (2, *shape)):
        needs = f"{shape[0]} values" if shape else "one value"
        ends = "[[low, ...], [high, ...]]" if shape else "[low, high]"
        raise UserError(f"effect '{name}' needs {needs} or a range {ends}, got {value}")
    low, high = values if values.shape == (2, *shape) else (values, values)
    if not np.isfinite(values).all() or (low > high).any():
        raise UserError(f"effect '{name}' needs finite numbers, low before high, got {value}")
    return np.broadcast_to(low, shape), np.broadcast_to(high, shape)


def _check_possible(env: Env, low: Mapping[str, np.ndarray], high: Mapping[str, np.ndarray]) -> None:
    for name in _NOT_NEGATIVE:
        if (least := np.min(low[name])) < 0:
            raise UserError(f"effect '{name}' must not be negative, got {least:g}")
    for name, most in _MOST.items():
        if (size := np.max(np.abs([low[name], high[name]]))) > most:
            raise UserError(f"effect '{name}' must be at most {most:g} in size, got {size:g}")
    if high["obs_noise_prob"] > 1:
        raise UserError(f"effect 'obs_noise_prob' is a probability, at most 1, got {high['obs_noise_prob']:g}")
    latest = high["latency"] + high["latency_jitter"]
    if latest >= env.control_dt:
        raise UserError(
            f"effect 'latency' with 'latency_jitter' comes to {latest:g} s: it must be shorter than the control period "
            f"of {env.name}, {env.control_dt:g} s"
        )
    if not env.cartesian and (low["action_rotation"] or high["action_rotation"]):
        raise UserError(f"effect 'action_rotation' needs Cartesian actions, which {env.name} does not have")


def draw(effects: EffectRange, key: Key) -> Effects:
    """One episode's effects, uniform in the range; exactly the value where both ends are the same."""
    sizes = [x.size for x in effects.low]
    uniform = jnp.split(jax.random.uniform(key, (sum(sizes),)), np.cumsum(sizes)[:-1])
    return Effects(*(low + u.reshape(low.shape) * (high - low) for low, high, u in zip(*effects, uniform, strict=True)))


def distort(effects: Effects, action: Array) -> Array:
    """The action [act_dim] as the robot understands it: rotated in the xy plane if Cartesian, scaled, offset."""
    if len(action) > 1:
        c, s = jnp.cos(effects.action_rotation), jnp.sin(effects.action_rotation)
        action = action.at[:2].set(jnp.stack([c * action[0] - s * action[1], s * action[0] + c * action[1]]))
    return effects.action_scale * action + effects.action_bias


def shake(effects: Effects, command: Array, key: Key) -> Array:
    """The command [act_dim], distorted before, with its noise: clipped to [-1, 1] where there is any, else as it is."""
    noise = effects.action_noise
    noisy = jnp.clip(command + noise * jax.random.normal(key, command.shape), -1.0, 1.0)
    return jnp.where(noise > 0, noisy, command)


def measure(effects: Effects, true_obs: Array, key: Key) -> Array:
    """The observation [obs_dim] as the sensors report it: biased, and sometimes noisy, then as a whole vector."""
    key_gate, key_noise = jax.random.split(key)
    noisy = jax.random.bernoulli(key_gate, effects.obs_noise_prob)
    noise = effects.obs_noise * jax.random.normal(key_noise, true_obs.shape)
    return true_obs + effects.obs_bias + jnp.where(noisy, noise, 0.0)


def ramp(
    effects: Effects, previous: Array, target: Array, key: Key, *, dt: float, duration: float
) -> Callable[[Array], Array]:
    """(physics step i of the period) -> [nu] the control in force at its end.

    The control stays at `previous` [nu] for the latency, then moves linearly to `target` [nu] within `duration` s.
    dt: s, one physics step.
    """
    jitter = jax.random.uniform(key, minval=-1.0, maxval=1.0) * effects.latency_jitter
    start = jnp.maximum(effects.latency + jitter, 0.0)

    def control(i: Array) -> Array:
        progress = jnp.clip(((i + 1) * dt - start) / max(duration, 1e-9), 0.0, 1.0)
        return previous + progress * (target - previous)

    return control
