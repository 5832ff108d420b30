"""A noisy controller that keeps the wheel-legged robot upright; its logs resemble those that H2O+ learned from.

A linear-quadratic controller of the nominal robot aims at a place that wanders, and a correlated torque disturbs it. In
the gap `robot` its log has about the statistics of the published one (H2O+, arXiv 2309.12716, 83 s of a standing
robot), see docs/hybrid.md: the numbers here were chosen for that.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from envs.locomotion import wheel_legged as robot
from envs.locomotion.planar import GRAVITY
from envs.types import Array, Key, Policy

COST = np.diag([4.0, 1.0, 1.0, 1.0])  # of x (m), v (m/s), pitch (rad), its speed (rad/s), squared
TORQUE_COST = 1.0  # of N m, squared
WANDER, WANDER_TIME = 0.2, 15.0  # m, std of the place that is aimed at; s, how long it takes to forget
SHAKE, SHAKE_TIME = 0.65, 0.08  # N m, s: of the torque that disturbs


class Hand(NamedTuple):
    """aim: [] m, where the robot should be, were it not for wander [] m. shake: [] N m."""

    aim: Array
    wander: Array
    shake: Array


def operator(speed: float) -> Policy:
    """One who wants the robot of `wheel-legged` to roll at that speed, m/s; its parameters are a `gain` [4]."""

    def act(gain: Array, carry: Hand, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, Hand]:
        noise = jax.random.normal(key, (2,))
        wander = _wandered(carry.wander, noise[0], std=WANDER, time=WANDER_TIME)
        shake = _wandered(carry.shake, noise[1], std=SHAKE, time=SHAKE_TIME)
        error = obs - jnp.array([0.0, speed, 0.0, 0.0]).at[0].set(carry.aim + wander)
        torque = -gain @ error + shake
        hand = Hand(carry.aim + speed * robot.CONTROL_DT, wander, shake)
        return jnp.clip(torque / robot.TORQUE, -1.0, 1.0)[None], hand

    return Policy(lambda: Hand(jnp.zeros(()), jnp.zeros(()), jnp.zeros(())), act)


def _wandered(value: Array, noise: Array, *, std: float, time: float) -> Array:
    """The next value of a process with that stationary std that forgets in `time` s (Ornstein and Uhlenbeck)."""
    kept = np.exp(-robot.CONTROL_DT / time)
    return kept * value + std * np.sqrt(1 - kept**2) * noise


def nominal_gain() -> np.ndarray:
    """[4] N m for each m, m/s, rad, rad/s: torque = -gain . (x, v, pitch, its speed) of the nominal robot."""
    theta = {p.name: p.nominal for p in robot.PARAMETERS}
    mass, arm = theta["mass"] - robot.WHEEL_MASS, theta["com_height"]
    inertia = mass * ((2 * robot.BODY_HALF[0]) ** 2 + (2 * robot.BODY_HALF[2]) ** 2) / 12
    # Mass matrix of x and pitch when upright; wheels that roll add their inertia.
    across = mass * arm
    matrix = [[theta["mass"] + robot.WHEEL_INERTIA / robot.WHEEL_RADIUS**2, across], [across, inertia + mass * arm**2]]
    inverse = np.linalg.inv(matrix)
    drift, push = np.zeros((4, 4)), np.zeros((4, 1))  # of x, pitch, and their speeds
    drift[:2, 2:] = np.eye(2)
    drift[2:, 1] = inverse @ [0.0, mass * GRAVITY * arm]
    push[2:, 0] = inverse @ [1 / robot.WHEEL_RADIUS, -1.0]
    order = [0, 2, 1, 3]  # from x, v, pitch, its speed
    cost = COST[np.ix_(order, order)]
    solved = scipy.linalg.solve_continuous_are(drift, push, cost, np.array([[TORQUE_COST]]))
    return (push.T @ solved / TORQUE_COST)[0][order]
