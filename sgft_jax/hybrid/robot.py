"""What else the wheel-legged robot is judged by: how long it stands, and how well it keeps its speed. Pure.

H2O+ calls a robot that is within 0.2 m of its place standing (arXiv 2309.12716, real-world experiments). Its episodes
last longer than ours, whose end bounds all times here.
"""

from collections.abc import Callable, Mapping

import numpy as np

from envs.locomotion.wheel_forward import SPEED
from envs.locomotion.wheel_legged import FALLEN

PLACE = 0.2  # m


def standing(next_obs: np.ndarray, valid: np.ndarray, *, dt: float) -> dict[str, np.ndarray]:
    """Of episodes of `wheel-legged`: next_obs [..., T, 4], valid [..., T], dt: s of a step.

    upright_s: [...] s until it pitches by more than 30 degrees. in_place_s: [...] s until it does or is more than 0.2 m
    from x = 0, whichever is first.
    """
    place, pitch = next_obs[..., 0], next_obs[..., 2]
    upright = valid & (np.abs(pitch) <= FALLEN)
    return {"upright_s": _until(upright, dt), "in_place_s": _until(upright & (np.abs(place) <= PLACE), dt)}


def rolling(next_obs: np.ndarray, valid: np.ndarray, *, dt: float) -> dict[str, np.ndarray]:
    """Of episodes of `wheel-legged-forward`: next_obs [..., T, 3], valid [..., T], dt: s of a step.

    upright_s: as in `standing`. speed_error: [...] m/s, root mean square of v - 0.2 m/s while it is upright; that of
    the first step for a robot that is never upright.
    """
    speed, pitch = next_obs[..., 0], next_obs[..., 1]
    upright = np.cumprod(valid & (np.abs(pitch) <= FALLEN), axis=-1).astype(bool)
    counted = upright.copy()
    counted[..., 0] = True
    squares = np.where(counted, (speed - SPEED) ** 2, 0.0).sum(-1) / counted.sum(-1)
    return {"upright_s": _until(upright, dt), "speed_error": np.sqrt(squares)}


def _until(holds: np.ndarray, dt: float) -> np.ndarray:
    """[...] s until `holds` [..., T] is false for the first time."""
    return np.cumprod(holds, axis=-1).sum(-1) * dt


MEASURES: Mapping[str, Callable[..., dict[str, np.ndarray]]] = {
    "wheel-legged": standing,
    "wheel-legged-forward": rolling,
}
