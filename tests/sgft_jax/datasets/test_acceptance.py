"""Whether sets that were made anew may stand for D4RL's, against bands by hand."""

import dataclasses

import pytest

from sgft_jax.datasets import logs
from sgft_jax.datasets.logs import Facts

NONE = Facts("", "d4rl", 0, "", "stored", 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0)


def passed(name, *, mean_length=1000.0, **facts):
    """By criterion."""
    found = logs.judge(name, dataclasses.replace(NONE, **facts), mean_length=mean_length)
    return {verdict.criterion: verdict.passed for verdict in found}


@pytest.mark.parametrize(
    ("mean", "good"),
    [(4531.0, False), (4532.0, True), (5008.0, True), (5009.0, False)],  # 4770.3 less or more 5 %, 238.5
)
def test_the_mean_of_a_medium_set(mean, good):
    assert passed("halfcheetah-medium", return_mean=mean) == {"mean return": good}


def test_a_walker_is_judged_by_spread_and_falls_too():
    """Bands: 2,709 to 2,995; 821 to 1,369; 714 to 966 steps."""
    found = passed("walker2d-medium", return_mean=2900.0, return_std=800.0, mean_length=1000.0)
    assert found == {"mean return": True, "std of returns": False, logs.LENGTH: False}
    assert all(passed("walker2d-medium", return_mean=2852.0, return_std=1100.0, mean_length=840.0).values())


def test_what_a_learner_left_is_judged_by_its_size():
    assert passed("halfcheetah-medium-replay", transitions=151_000) == {"transitions": False}
    assert passed("walker2d-medium-replay", transitions=377_000) == {"transitions": True}
    (verdict,) = logs.judge("halfcheetah-medium-replay", dataclasses.replace(NONE, transitions=250_000), mean_length=0)
    assert str(verdict) == "pass: transitions 250,000, accepted from 151,500 to 252,500"


def test_other_sets_are_not_judged():
    assert passed("halfcheetah-") == {} and passed("hopper-medium") == {}
