"""Promises of simulators that are right, and of some that are not: what is lost, and what is gained."""

import functools

import jax
import jax.numpy as jnp
import pytest

from sgft_jax.posterior import trust

RUNS, ROLLOUTS = 10_000, 20


@functools.partial(jax.jit, static_argnames="runs")
def fates(bias, std, *, runs=RUNS):
    """Success [runs] of the prior and of what is chosen, and [runs, rollouts] of what is deployed.

    Success rates are uniform. bias: [2] of the simulator's promises for them. std: of further errors, which stay the
    same over a run; promises differ a little from rollout to rollout.
    """

    def run(key):
        key_true, key_error, key_first, key_steps = jax.random.split(key, 4)
        true = jax.random.uniform(key_true, (2,))
        wrong = bias + std * jax.random.normal(key_error, (2,))

        def step(known, key):
            key_promise, key_play = jax.random.split(key)
            promised = jnp.clip(true + wrong + 0.03 * jax.random.normal(key_promise, (2,)), 0.0, 1.0)
            chosen = trust.deploys(known, promised)
            which = chosen.astype(jnp.int32)
            success = jax.random.bernoulli(key_play, true[which])
            return trust.told(known, chosen, promised[which], success), true[which]

        begun = trust.told(trust.begin(), False, jnp.float32(jnp.nan), jax.random.bernoulli(key_first, true[0]))
        _, played = jax.lax.scan(step, begun, jax.random.split(key_steps, ROLLOUTS))
        return *true, played

    return jax.vmap(run)(jax.random.split(jax.random.key(0), runs))


# bias for the prior and for what is chosen, std; then at most: runs that are 20 points below the prior at the end, at
# any time; at least: share of the possible gain, over all rollouts
CASES = [
    ((0.0, 0.0), 0.0, 0.001, 0.005, 0.95),
    ((0.0, 0.0), 0.1, 0.005, 0.015, 0.90),
    ((0.0, 0.0), 0.3, 0.02, 0.065, 0.74),
    ((0.3, 0.3), 0.1, 0.005, 0.035, 0.77),
    ((-0.3, -0.3), 0.1, 0.005, 0.01, 0.89),
    ((0.0, 0.3), 0.0, 0.02, 0.095, 0.80),
    ((0.0, 0.3), 0.3, 0.025, 0.125, 0.74),
    ((0.0, -0.3), 0.1, 0.005, 0.01, 0.72),
]


@pytest.mark.parametrize(("bias", "std", "end", "ever", "gain"), CASES)
def test_falls_are_rare_and_gains_are_kept(bias, std, end, ever, gain):
    prior, chosen, played = fates(jnp.array(bias), std)
    fell = prior[:, None] - played > 0.2
    assert fell[:, -1].mean() <= end and fell.any(axis=1).mean() <= ever
    possible = jnp.maximum(chosen - prior, 0.0)
    assert (played.mean(axis=1) - prior).mean() / possible.mean() >= gain


def test_one_failure_brings_a_good_prior_back():
    """The simulator thinks little of a prior that succeeds, and promises much for what fails."""
    known = trust.told(trust.begin(), False, jnp.float32(jnp.nan), True)
    promised = jnp.array([0.5, 0.95])
    assert trust.deploys(known, promised)
    assert not trust.deploys(trust.told(known, True, promised[1], False), promised)


def test_a_promise_that_is_kept_is_trusted_more():
    known, promised = trust.begin(), jnp.array([0.1, 0.9])
    kept = trust.told(known, True, promised[1], True)
    assert kept.log_odds > known.log_odds and trust.expected(kept, promised)[1] > trust.expected(known, promised)[1]


def test_without_a_promise_only_the_record_changes():
    known = trust.told(trust.begin(), False, jnp.float32(jnp.nan), True)
    assert known.log_odds == trust.begin().log_odds
    assert known.won.tolist() == [2.0, 0.5] and known.lost.tolist() == [0.5, 1.0]


def test_equal_promises_leave_the_prior():
    assert not trust.deploys(trust.begin(), jnp.array([0.8, 0.8]))
