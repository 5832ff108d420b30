"""What estimators learn from: rollouts as much alike as those of a robot."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

from envs.base import Parameter
from sgft_jax.posterior import learning
from sgft_jax.posterior.candidates import candidates

STAYING = Parameter("friction", "1/s", 4.0, 3.5, 4.5, 0.0, real=(2.0, 8.0), place=True)
N = 300


@pytest.fixture(scope="module")
def played():
    """Of N systems and `MOST` rollouts: biases that are corrected [N, MOST, 2], frictions and whether they explore."""
    env = toy.make()._replace(parameters=(toy.PARAMETERS[0], STAYING))

    def play(env, policy, params, world, key, *, explore):
        return SimpleNamespace(transitions=params.distortion.bias, valid=world.theta.params[1], success=explore)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learning, "play", play)
        patch.setattr(learning, "rollout_of", lambda env, *row: row)
        params, systems = _Params(None), candidates(env)
        lessons = jax.jit(lambda key: learning.simulate(env, systems, None, params, key, N))(jax.random.key(0))
    return lessons.points, *map(np.asarray, lessons.rollouts)


class _Params:
    """Nothing but a distortion."""

    def __init__(self, distortion):
        self.distortion = distortion

    def _replace(self, distortion):
        return _Params(distortion)


def test_systems_have_any_share_of_rollouts_without_a_correction(played):
    plain = (played[1] == 0).all(axis=-1).sum(axis=1)
    assert np.bincount(plain, minlength=learning.MOST + 1).min() > N / 40, "none, all, and every number between"
    assert plain.mean() == pytest.approx(learning.MOST / 2, abs=0.6)


def test_corrections_of_some_systems_hardly_change(played):
    spread = np.array([rows[(rows != 0).all(axis=1)][:, 0].std() for rows in played[1] if (rows != 0).all(1).sum() > 5])
    low, high = np.quantile(spread, [0.1, 0.9])
    assert high > 2 * low


def test_in_half_of_the_systems_things_stay_where_no_training_has_them(played):
    friction = played[2]
    stays = np.ptp(friction, axis=1) == 0
    assert stays.mean() == pytest.approx(0.5, abs=0.1)
    assert (friction[~stays] >= 3.5).all() and (friction[~stays] <= 4.5).all(), "training's range"
    beyond = (friction[stays, 0] < 3.5) | (friction[stays, 0] > 4.5)
    assert beyond.mean() == pytest.approx(5 / 6, abs=0.1)


def test_half_of_the_systems_never_explore(played):
    explores = played[3].mean(axis=1)
    assert (explores == 0).mean() == pytest.approx(0.5, abs=0.1)
    assert explores[explores > 0].mean() == pytest.approx(0.5, abs=0.1)


def test_points_are_those_of_the_prior(played):
    assert jnp.min(played[0]) >= 0 and jnp.max(played[0]) <= 1
