"""Promises of simulators that are right, and of some that are not: what is lost, and what is gained."""

import functools

import jax
import jax.numpy as jnp
import pytest

from sgft_jax.posterior import trust
from sgft_jax.posterior.trust import AS_IS, CORRECTED, FITTED

RUNS, ROLLOUTS = 10_000, 20
NOTHING = jnp.full(3, jnp.nan)


@functools.partial(jax.jit, static_argnames="fits")
def fates(bias, std, *, fits):
    """Success [runs, 3] of the policies, and [runs, rollouts] of what plays and of what is deployed.

    Success rates are uniform. bias: [3] of the simulator's promises for them. std: of further errors, which stay the
    same over a run; promises differ a little from rollout to rollout.
    """

    def run(key):
        key_true, key_error, key_steps = jax.random.split(key, 3)
        true = jax.random.uniform(key_true, (3,))
        wrong = bias + std * jax.random.normal(key_error, (3,))

        def step(carry, key):
            known, which, promised = carry
            key_promise, key_play = jax.random.split(key)
            success = jax.random.bernoulli(key_play, true[which])
            known = trust.update(known, which, promised, success)
            promised = jnp.clip(true + wrong + 0.03 * jax.random.normal(key_promise, (3,)), 0.0, 1.0)
            promised = promised if fits else promised.at[FITTED].set(jnp.nan)
            which = trust.challenger(known, promised)
            return (known, which, promised), (true[which], true[trust.incumbent(known, promised)])

        start = trust.begin(), jnp.int32(AS_IS), NOTHING
        return true, jax.lax.scan(step, start, jax.random.split(key_steps, ROLLOUTS))[1]

    return jax.vmap(run)(jax.random.split(jax.random.key(0), RUNS))


# a fit is tried; bias for the prior as it is, behind a correction, and behind a fit, std; then of what plays, and of
# what is deployed: at most so many runs that are 20 points below the prior at the end, and at any time; at least this
# share of the possible gain, over all rollouts
CASES = [
    (False, (0.0, 0.0, 0.0), 0.0, (0.0005, 0.001, 0.78), (0.0005, 0.001, 0.73)),
    (False, (0.0, 0.0, 0.0), 0.1, (0.001, 0.003, 0.75), (0.001, 0.002, 0.71)),
    (False, (0.0, 0.0, 0.0), 0.3, (0.004, 0.03, 0.59), (0.004, 0.01, 0.56)),
    (False, (0.3, 0.3, 0.0), 0.1, (0.001, 0.01, 0.71), (0.001, 0.003, 0.67)),
    (False, (-0.3, -0.3, 0.0), 0.1, (0.001, 0.001, 0.41), (0.001, 0.001, 0.38)),
    (False, (0.0, 0.3, 0.0), 0.0, (0.004, 0.04, 0.84), (0.004, 0.012, 0.79)),
    (False, (0.0, 0.3, 0.0), 0.3, (0.006, 0.08, 0.72), (0.006, 0.027, 0.68)),
    (False, (0.0, -0.3, 0.0), 0.1, (0.001, 0.001, 0.36), (0.001, 0.001, 0.34)),
    (True, (0.0, 0.0, 0.0), 0.0, (0.001, 0.01, 0.87), (0.001, 0.003, 0.81)),
    (True, (0.0, 0.0, 0.0), 0.1, (0.001, 0.013, 0.85), (0.001, 0.004, 0.79)),
    (True, (0.0, 0.0, 0.0), 0.3, (0.008, 0.065, 0.72), (0.008, 0.02, 0.68)),
    (True, (0.3, 0.3, 0.3), 0.1, (0.003, 0.045, 0.76), (0.003, 0.01, 0.71)),
    (True, (-0.3, -0.3, -0.3), 0.1, (0.002, 0.01, 0.74), (0.002, 0.002, 0.69)),
    (True, (0.0, 0.0, 0.3), 0.3, (0.01, 0.105, 0.72), (0.01, 0.032, 0.68)),
    (True, (0.0, 0.3, 0.3), 0.3, (0.01, 0.13, 0.75), (0.01, 0.042, 0.71)),
    (True, (-0.6, -0.6, -0.6), 0.1, (0.006, 0.035, 0.48), (0.006, 0.006, 0.45)),
]


@pytest.mark.parametrize(("fits", "bias", "std", "plays", "deployed"), CASES)
def test_falls_are_rare_and_gains_are_kept(fits, bias, std, plays, deployed):
    true, runs = fates(jnp.array(bias), std, fits=fits)
    prior, best = true[:, AS_IS], true[:, : 2 + fits].max(axis=1)
    for success, (end, ever, gain) in zip(runs, (plays, deployed), strict=True):
        fell = prior[:, None] - success > 0.2
        assert fell[:, -1].mean() <= end and fell.any(axis=1).mean() <= ever
        assert (success.mean(axis=1) - prior).mean() / (best - prior).mean() >= gain


def after(*rollouts, promised=NOTHING):
    """(policy, success) of rollouts that were promised so much."""
    known = trust.begin()
    for which, success in rollouts:
        known = trust.update(known, which, promised, success)
    return known


def test_nothing_is_deployed_that_has_not_succeeded():
    promised = jnp.array([0.1, 0.9, 0.9])
    known = after((AS_IS, False), promised=promised)
    assert trust.challenger(known, promised) == CORRECTED and trust.incumbent(known, promised) == AS_IS
    failed, won = (trust.update(known, CORRECTED, promised, success) for success in (False, True))
    assert trust.incumbent(failed, promised) == AS_IS and trust.incumbent(won, promised) == CORRECTED


def test_one_failure_brings_a_good_prior_back():
    """The simulator thinks little of a prior that succeeds, and promises much for what fails."""
    promised = jnp.array([0.5, 0.95, jnp.nan])
    known = after((AS_IS, True))
    assert trust.challenger(known, promised) == CORRECTED
    assert trust.challenger(trust.update(known, CORRECTED, promised, False), promised) == AS_IS


def test_a_promise_that_is_kept_is_trusted_more():
    known, promised = trust.begin(), jnp.array([0.1, 0.9, jnp.nan])
    kept = trust.update(known, CORRECTED, promised, True)
    assert kept.log_odds > known.log_odds
    assert trust.expected(kept, promised)[CORRECTED] > trust.expected(known, promised)[CORRECTED]


def test_rollouts_count_beside_a_promise():
    """A prior of which simulation promises two in three, but that has never failed, stays."""
    promised = jnp.array([0.66, 0.93, jnp.nan])
    once, often = after((AS_IS, True), promised=promised), after(*[(AS_IS, True)] * 5, promised=promised)
    assert trust.challenger(trust.begin(), promised) == CORRECTED
    assert trust.challenger(once, promised) == trust.challenger(often, promised) == AS_IS
    assert trust.expected(often, promised)[AS_IS] > trust.expected(once, promised)[AS_IS] + 0.05


def test_a_prior_that_worked_before_the_system_changed_is_replaced_sooner():
    known, promised = (
        after(*[(AS_IS, True)] * 6, promised=jnp.array([0.95, 0.95, jnp.nan])),
        jnp.array([0.4, 0.95, jnp.nan]),
    )
    assert trust.challenger(known, promised) == AS_IS
    for changed, wanted in ((False, AS_IS), (True, CORRECTED)):
        later = trust.faded(trust.faded(known, jnp.array(changed)), jnp.array(changed))
        assert trust.challenger(later, promised) == wanted


def test_corrections_keep_their_record_when_the_system_changes():
    known = after((AS_IS, True), (CORRECTED, True), (CORRECTED, False))
    later = trust.faded(known, jnp.array(True))
    assert later.won.tolist() == [0.5, 1, 0] and later.lost.tolist() == [0, 1, 0]


def test_without_a_promise_only_the_record_changes():
    known = after((AS_IS, True))
    assert known.log_odds == trust.begin().log_odds
    assert known.won.tolist() == [1, 0, 0] and known.lost.tolist() == [0, 0, 0]


@pytest.mark.parametrize("fitted", [0.8, jnp.nan])
def test_equal_promises_leave_the_prior(fitted):
    assert trust.challenger(trust.begin(), jnp.array([0.8, 0.8, fitted])) == AS_IS


def test_a_fit_is_tried_where_the_others_fail_as_promised():
    """No system of the simulator does what the real one does, and in none of them works what works there."""
    promised = jnp.array([0.05, 0.05, 0.03])
    assert trust.challenger(after(*[(AS_IS, False)] * 3, promised=promised), promised) == FITTED


def test_where_no_correction_works_in_simulation_none_is_deployed():
    """The real system is none of these."""
    assert trust.challenger(after((AS_IS, False)), jnp.array([0.05, 0.45, jnp.nan])) == AS_IS


def test_simulation_vetoes_a_fit_while_its_promises_are_kept():
    promised = jnp.array([0.3, 0.9, 0.4])
    known = after((AS_IS, False), (CORRECTED, True), (CORRECTED, False), (CORRECTED, True), promised=promised)
    assert trust.challenger(known, promised) == CORRECTED


def test_rollouts_that_no_system_makes_leave_records_alone():
    promised = jnp.array([0.3, 0.95, 0.9])
    known = after((AS_IS, True), promised=promised)
    assert trust.challenger(known, promised) == CORRECTED
    assert trust.challenger(known, promised, jnp.array(True)) == AS_IS
