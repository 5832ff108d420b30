"""Someone who keeps the wheel-legged robot up by hand: an optimal controller that wanders and shakes."""

import jax
import jax.numpy as jnp
import numpy as np
from test_wheel_legged import NOMINAL, by_hand

from envs.locomotion import wheel_operator
from envs.locomotion.wheel_operator import Hand, nominal_gain, operator


def test_the_gain_is_that_of_the_riccati_equation():
    """For the upright robot of Lagrange's equations: it is stable, and Kalman's identity holds at every frequency.

    |1 + K (iw - A)^-1 B|^2 = 1 + |Q^(1/2) (iw - A)^-1 B|^2 for one input of cost 1 is true of optimal gains alone.
    """
    mass, arm, _, (a, b, c) = by_hand(NOMINAL)
    gain = nominal_gain()
    inverse = np.linalg.inv([[a, b], [b, c]])
    turn, push = inverse @ [0.0, mass * 9.81 * arm], inverse @ [1 / 0.065, -1.0]
    drift = np.array([[0, 1, 0, 0], [0, 0, turn[0], 0], [0, 0, 0, 1], [0, 0, turn[1], 0]])
    closed = drift - np.outer([0, push[0], 0, push[1]], gain)
    assert (np.linalg.eigvals(closed).real < -0.5).all()
    for frequency in (0.1, 1.0, 3.0, 10.0, 30.0):  # rad/s
        state = np.linalg.solve(1j * frequency * np.eye(4) - drift, [0, push[0], 0, push[1]])
        cost = np.vdot(state, np.array([4.0, 1.0, 1.0, 1.0]) * state).real
        np.testing.assert_allclose(abs(1 + gain @ state) ** 2, 1 + cost, rtol=1e-6)


def test_the_aim_moves_and_noise_has_the_spread_that_it_says(key):
    """After 5 s at 0.2 m/s the aim is 1 m ahead; over many starts wander and shake have their stationary spread."""
    policy = operator(0.2)

    def step(carry, key):
        return policy.act(jnp.zeros(4), carry, jnp.zeros(4), key, explore=True)[1], None

    def play(start, key):
        return jax.lax.scan(step, start, jax.random.split(key, 1000))[0]

    draw = np.random.default_rng(0).normal(size=(2, 400))
    start = Hand(jnp.zeros(400), 0.2 * jnp.asarray(draw[0], jnp.float32), 0.65 * jnp.asarray(draw[1], jnp.float32))
    end = jax.jit(jax.vmap(play))(start, jax.random.split(key, 400))
    np.testing.assert_allclose(end.aim, 1.0, rtol=1e-4)
    np.testing.assert_allclose([end.wander.std(), end.shake.std()], [0.2, 0.65], rtol=0.1)
    # it forgets: over 5 s of a memory of 15 s the correlation is exp(-1/3) = 0.72, over 60 memories of a shake none
    np.testing.assert_allclose(np.corrcoef(start.wander, end.wander)[0, 1], 0.72, atol=0.08)
    assert abs(np.corrcoef(start.shake, end.shake)[0, 1]) < 0.15


def test_an_action_is_the_torque_over_its_bound(key):
    """At x = 0.1 m ahead of a place that does not shake or wander yet, the torque is -gain[0] * 0.1 N m."""
    gain = jnp.asarray(nominal_gain(), jnp.float32)
    still = operator(0.0)
    quiet = wheel_operator.Hand(jnp.zeros(()), jnp.zeros(()), jnp.zeros(()))
    acts = jax.vmap(lambda key: still.act(gain, quiet, jnp.array([0.1, 0.0, 0.0, 0.0]), key, explore=True)[0])
    found = acts(jax.random.split(key, 20_000))[:, 0]
    np.testing.assert_allclose(found.mean(), -gain[0] * 0.1 / 3, atol=3e-3)
    assert float(still.act(gain, quiet, jnp.array([0.0, 0.0, 1.0, 0.0]), key, explore=True)[0][0]) == 1.0
