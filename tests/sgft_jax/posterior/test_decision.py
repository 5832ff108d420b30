"""The policy that particles expect most of is deployed, and only where it is clearly better."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

from envs.base import EffectRange, Theta, World
from envs.effects import distort, make_range
from sgft_jax.posterior.candidates import Candidates, Unknown
from sgft_jax.posterior.decision import correction, decide

TOY = toy.make()
UNKNOWNS = (
    Unknown("mass", 0, 0.5, 2.0),
    Unknown("action_scale", 0, 0.5, 1.2),
    Unknown("action_scale", 1, 0.5, 1.2),
    Unknown("action_bias", 1, -0.3, 0.3),
    Unknown("action_rotation", 0, -1.0, 1.0),
    Unknown("obs_bias", 2, -0.1, 0.1),
)


def test_a_correction_undoes_commands_and_measurements():
    point = jnp.array([0.1, 0.3, 0.8, 0.7, 0.9, 1.0])
    undo = correction(TOY, UNKNOWNS, point)
    named = {"action_scale": [0.71, 1.06], "action_bias": [0.0, 0.12], "action_rotation": 0.8}
    effects = make_range(TOY, named).low
    action = jnp.array([0.3, -0.2])
    np.testing.assert_allclose(distort(effects, undo.command(action)), action, atol=1e-5)
    np.testing.assert_allclose(undo.offset, [0, 0, 0.1, 0], atol=1e-6)


def where(point, place):
    """A world whose bias of the first command is the point's only number."""
    effects = make_range(TOY, {}).low
    effects = effects._replace(action_bias=effects.action_bias.at[0].set(point[0]))
    return World(Theta(jnp.array([1.0, 0.3]), EffectRange(effects, effects)), {})


NOWHERE = jnp.zeros((0, 2))
SYSTEMS = Candidates((Unknown("action_bias", 0, 0.0, 1.0),), jnp.zeros(1), where, NOWHERE, NOWHERE)


def choose(particles, acting=(0.0, 0.3, 0.6), noise=0.0):
    """An episode succeeds where what acts undoes the bias to within a tenth; noise: how often chance decides."""

    def play(acts, world, key):
        chance, luck = jax.random.uniform(key, (2,))
        right = jnp.abs(acts - world.theta.effects.low.action_bias[0]) < 0.1
        return jnp.where(chance < noise, luck < 0.5, right)

    points = jnp.array(particles)[:, None]
    return decide(play, jnp.array(acting), SYSTEMS, points, jax.random.key(0), episodes=4)


def test_the_candidate_of_the_highest_expected_success_is_chosen():
    decision = choose([0.3] * 20 + [0.6] * 12)
    assert decision.chosen == 1 and decision.promised == pytest.approx(20 / 32)
    assert choose([0.3] * 12 + [0.6] * 20).chosen == 2


def test_the_prior_stays_where_nothing_is_better():
    assert choose([0.0] * 32).chosen == 0
    assert choose([0.9] * 32).chosen == 0  # where all fail


def test_the_prior_stays_where_nothing_is_clearly_better():
    assert choose([0.0] * 15 + [0.3] * 17).chosen == 0
    assert choose([0.0] * 32, noise=1.0).chosen == 0  # chance alone
