"""The best policy by real evidence: windows of rollouts, and what an explosion counts as."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sgft_jax.train import evidence

AGENT = SimpleNamespace(export=lambda agent: agent, trial=None)
BOOM = None  # a rollout that exploded, after two steps of -1
judge = jax.jit(lambda *given: evidence.judged(AGENT, *given))


def best_of(*scores, part=-2.0, best=None):
    """After rollouts with these scores, which are returns; the i-th is played by policy i."""
    best = evidence.nothing_known(jnp.full(1, -1.0), 1) if best is None else best
    for score in scores:
        i, total = best.count, jnp.full(1, part if score is BOOM else score)
        best = judge(best, i.astype(jnp.float32), total, total, jnp.array([score is BOOM]), i[0])
    return best


@pytest.mark.heavy
def test_where_rewards_are_costs_an_explosion_is_no_success():
    """Whole rollouts cost 12, one that explodes has cost 2 until then."""
    best = best_of(*[-12] * 5, *[BOOM] * 8)
    assert best.params == 4 and best.score == -12
    assert best_of(*[BOOM] * 5, *[-12] * 5).params == 9  # also if the explosions came first
    assert best_of(BOOM, BOOM, *[-12] * 3).params == 4 and best_of(*[BOOM] * 3, -12).score == -12


def test_an_explosion_counts_as_the_worst_that_is_known():
    best = best_of(-12, BOOM, -10, -14, BOOM)
    np.testing.assert_allclose(best.score, (-12 - 10 - 3 * 14) / 5)
    np.testing.assert_allclose(best_of(-20, best=best).score, (-12 - 10 - 14 - 2 * 20) / 5)  # known later counts, too
    mixed = best_of(10, 12, 11, 10, 12, BOOM, part=-50.0)  # what it had earned is known as well
    assert mixed.worst.tolist() == [[-50, -50]] and mixed.params == 4
    assert best_of(*[BOOM] * 6, part=3.0).score == 3


def test_success_is_told_apart_by_returns_of_whole_rollouts():
    """Two windows of the same successes: an explosion is a failure that has cost little until then."""
    best, no = evidence.nothing_known(jnp.full(1, -1.0), 1), jnp.zeros(1)
    for i, (score, total, exploded) in enumerate([(0, -9, 0)] * 5 + [(0, -1, 1)] * 5):
        given = (jnp.full(1, float(x)) for x in (i, score, total))
        best = judge(best, *given, jnp.array([bool(exploded)]), jnp.int32(i))
    assert best.params == 4 and best.score == no and best.total == -9


@pytest.mark.parametrize("scores", [[1], [1, 2], [1, 2, 3, 4]])
def test_few_rollouts_are_evidence_for_who_has_played_them(scores):
    best = best_of(*scores)
    assert best.params == best.age == len(scores) - 1 and best.score == np.mean(scores)


def test_of_few_rollouts_the_best_ones_decide_and_five_outweigh_them():
    assert best_of(3, 1).params == 0 and best_of(1, 4, 2, 0).params == 1
    assert best_of(1, 1, 1).params == 2  # as good, and seen more often
    assert best_of(9, 9, 0, 0).params == 1 and best_of(9, 9, 0, 0, 0).params == 4
    assert np.isneginf(best_of().score) and best_of().params == -1


def test_a_rollout_by_nobody_known_is_in_the_windows_of_those_after_it():
    best = evidence.judged(
        AGENT, best_of(1), None, jnp.full(1, 5.0), jnp.full(1, 5.0), jnp.zeros(1, bool), jnp.int32(9)
    )
    assert best.params == 0 and best.score == 1
    assert best_of(3, best=best).score == 3 and best_of(3, best=best).params == 2


def test_evidence_is_of_the_policy_that_was_tried_not_of_the_one_that_is_deployed():
    tries = SimpleNamespace(export=lambda agent: agent, trial=lambda agent: agent + 10)
    numbers = jnp.ones(1), jnp.ones(1), jnp.zeros(1, bool), jnp.int32(0)
    assert evidence.judged(tries, best_of(), jnp.full(1, 3.0), *numbers).params == 13


def evaluate(best, scores, totals, age, since=0):
    """One member's evaluation of a policy that is called by its age; None: an episode that exploded."""
    best = evidence.nothing_known({"w": jnp.zeros((1, 2))}, 1, len(scores)) if best is None else best
    exploded = jnp.array([[score is BOOM for score in scores]])
    score = jnp.array([[-jnp.inf if score is BOOM else score for score in scores]])
    params = {"w": jnp.full((1, 2), float(age))}
    return evidence.evaluated(best, params, score, jnp.array([totals], float), exploded, jnp.array([age]), since)


def test_of_evaluations_the_higher_score_wins_then_the_higher_return():
    first = evaluate(None, [0.0, 1.0], [3, 3], 1)
    for scores, totals, age in [
        ([1.0, 1.0], [-9, -9], 2),
        ([1.0, 0.0], [3, 4], 2),
        ([1.0, 0.0], [3, 3], 1),
        ([0.0, 1.0], [2, 3], 1),
        ([0.0, 0.0], [9, 9], 1),
    ]:
        best = evaluate(first, scores, totals, 2)
        assert best.age == age and best.params["w"].tolist() == [[age, age]]
    assert evaluate(first, [0.0, 0.0], [0, 0], 2, since=2).age == 2, "an early evaluation does not compete"


def test_of_evaluations_one_that_explodes_is_not_the_better_one():
    """Whole episodes cost 12 or 13; one that explodes has cost less until then and counts as the worst known."""
    whole = evaluate(None, [-11, -13], [-11, -13], 1)
    for scores, totals in [([BOOM, BOOM], [-2, -2]), ([BOOM, -11], [-11, -11]), ([-12, BOOM], [-12, -12])]:
        assert evaluate(whole, scores, totals, 2).age == 1
        assert evaluate(evaluate(None, scores, totals, 2), [-11, -13], [-11, -13], 1).age == 1
    half = evaluate(evaluate(None, [-10, BOOM], [-10, -12], 2), [-11, -13], [-11, -13], 1)
    assert half.age == 2 and half.score == -11.5 and half.worst.tolist() == [[-13, -13]]
    same = evaluate(None, [BOOM, BOOM], [-12, -12], 2)
    assert evaluate(same, [-12, -12], [-12, -12], 1).age == 1  # at the same cost, whole
