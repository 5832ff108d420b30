"""Which of three policies to try, and which to deploy, by real rollouts and by what simulation promises. Pure.

The three are the prior as it is, which stays for good, the prior behind the correction that does best in simulation,
and behind the one that fits real steps best. Either the simulator is right about them, then a rollout succeeds as often
as it promised, which counts as four rollouts, or it says nothing, then only what a policy did in real rollouts counts.
Every rollout changes how probable the first is (Bayes' rule), by how well it was promised. So under a misfit promises
fade to the policies' own records, and simulation can neither veto nor promote; and the fit is tried where the others
fail, whatever simulation says. Where halves of the rollouts contradict each other, none of the simulator's systems is
the real one, and only records count at once.

What plays the next rollout is a trial. What is deployed follows from the same rule, among the prior as it is and what
has succeeded in a rollout: an untried promise costs a rollout, never the policy that works.

tests/sgft_jax/posterior/test_trust.py states the errors, for simulators of several biases.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array

AS_IS, CORRECTED, FITTED = range(3)
POLICIES = ("as_is", "corrected", "fitted")  # in metrics

_RIGHT, _MOST = 0.8, 0.9  # probability that a simulator is right, before any rollout and at most
_SURE = 0.15  # no promise is surer than this of success or failure
_WON, _LOST = 1.0, 0.5  # imagined rollouts of the prior as it is
_DOUBT, _HALF = 1.5, 0.5  # imagined rollouts behind a correction of a wrong simulator, half as good as these
_FITS, _CREDIT = 0.4, 1.0  # success behind a fit on development gaps that no system explains, and its imagined rollouts
_TIMES = 1.2  # what replaces a policy must be so many times as good: one that works has more to lose
_WORKS = 0.5  # a correction must promise so much: where none works in any system, none of them is the real one
_PROMISE = 4.0  # rollouts that a promise counts as, beside those that a policy has played


class Trust(NamedTuple):
    """log_odds: [] that the simulator is right. won, lost: [3] real rollouts of the policies."""

    log_odds: Array
    won: Array
    lost: Array


def begin() -> Trust:
    """Before any rollout."""
    return Trust(jnp.float32(math.log(_RIGHT / (1.0 - _RIGHT))), jnp.zeros(3), jnp.zeros(3))


def update(trust: Trust, deployed: Array, promised: Array, success: Array) -> Trust:
    """After a rollout. deployed: [] which policy played it. promised: [3] success, nan where nothing was. success: []
    bool.
    """
    usual, success = _records(trust)[deployed], jnp.asarray(success, bool)
    promise = promised[deployed]
    sure = jnp.where(jnp.isnan(promise), usual, jnp.clip(promise, _SURE, 1.0 - _SURE))
    gain = jnp.where(success, jnp.log(sure / usual), jnp.log((1.0 - sure) / (1.0 - usual)))
    row = jax.nn.one_hot(deployed, 3)
    return Trust(trust.log_odds + gain, trust.won + row * success, trust.lost + row * ~success)


def faded(trust: Trust, changed: Array) -> Trust:
    """After a change of the system, what the prior as it is did before counts half; corrections follow the change.
    changed: [] bool.
    """
    share = jnp.ones(3).at[AS_IS].set(jnp.where(changed, 0.5, 1.0))
    return trust._replace(won=share * trust.won, lost=share * trust.lost)


def expected(trust: Trust, promised: Array, contradicted: Array | bool = False) -> Array:
    """[3] the success to expect of the policies. promised: [3] by the simulator, nan where it has not tried one.
    contradicted: [] bool, whether no system of the simulator makes rollouts as they were.
    """
    right, records = jnp.minimum(jax.nn.sigmoid(trust.log_odds), _MOST), _records(trust)
    right = jnp.where(contradicted, 0.0, right)
    seen = _mean(trust, promised, _PROMISE)
    return jnp.where(jnp.isnan(promised), records, right * seen + (1.0 - right) * records)


def challenger(trust: Trust, promised: Array, contradicted: Array | bool = False) -> Array:
    """[] which policy plays the next rollout. Arguments as of `expected`; promised is nan where there is none."""
    known = jnp.where(jnp.isnan(promised), -1.0, expected(trust, promised, contradicted))
    helps = (known[CORRECTED] > _TIMES * known[AS_IS]) & (promised[CORRECTED] >= _WORKS)
    base = jnp.where(helps, CORRECTED, AS_IS)
    which = jnp.where(known[FITTED] > _TIMES * known[base], FITTED, base)
    return which.astype(jnp.int32)


def incumbent(trust: Trust, promised: Array, contradicted: Array | bool = False) -> Array:
    """[] which policy to deploy. Arguments as of `expected`."""
    succeeded = (trust.won > 0).at[AS_IS].set(True)
    return challenger(trust, jnp.where(succeeded, promised, jnp.nan), contradicted)


def _records(trust: Trust) -> Array:
    """[3] by real rollouts alone."""
    as_is = _mean(trust, _WON / (_WON + _LOST), _WON + _LOST)[AS_IS]
    corrected = _mean(trust, _HALF * as_is, _DOUBT)[CORRECTED]
    fitted = _mean(trust, _FITS, _CREDIT)[FITTED]
    return jnp.stack([as_is, corrected, fitted])


def _mean(trust: Trust, usual: Array | float, weight: float) -> Array:
    """[3] success in the policies' rollouts and in so many imagined ones. usual: [3] or [] that of the latter."""
    return (trust.won + weight * usual) / (trust.won + trust.lost + weight)
