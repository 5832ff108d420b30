"""What the wheel-legged robot is judged by, on episodes by hand."""

import numpy as np
import pytest

from sgft_jax.hybrid import robot

DT = 0.5  # s


def test_seconds_upright_and_in_place():
    """The first robot drifts beyond 0.2 m in its third step and comes back; the second falls in its fourth."""
    x = [[0.0, 0.19, -0.21, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0]]
    pitch = np.radians([[0.0, 29.0, -29.0, 0.0, 0.0], [0.0, 0.0, 0.0, -31.0, 0.0]])
    obs = np.zeros((2, 5, 4))
    obs[..., 0], obs[..., 2] = x, pitch
    valid = np.array([[True] * 5, [True] * 4 + [False]])  # the step of the fall is the last that counts
    found = robot.standing(obs, valid, dt=DT)
    assert found["upright_s"].tolist() == [2.5, 1.5] and found["in_place_s"].tolist() == [1.0, 1.5]


def test_the_error_of_the_speed_counts_while_it_is_upright():
    """0.3 and 0.1 m/s are 0.1 off. A robot that falls at once is judged by its first step."""
    obs = np.zeros((2, 3, 3))
    obs[..., 0] = [[0.3, 0.1, 9.0], [-0.8, 5.0, 5.0]]
    obs[..., 1] = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    valid = np.array([[True, True, True], [True, False, False]])
    found = robot.rolling(obs, valid, dt=DT)
    assert found["upright_s"].tolist() == [1.0, 0.0]
    assert found["speed_error"].tolist() == pytest.approx([0.1, 1.0])
