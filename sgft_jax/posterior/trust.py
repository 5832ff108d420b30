"""Whether to deploy what simulation promises: real rollouts count for and against its promises. Pure.

Two policies are compared: the prior as it is, which stays for good, and what the posterior chooses. Either the
simulator is right about them, then a rollout succeeds as often as it promised, or it says nothing, then only what a
policy did in real rollouts counts. Every rollout changes how probable the first is (Bayes' rule), by how well it was
promised. So under a misfit promises fade to the policies' own records, and simulation can neither veto nor promote.

tests/sgft_jax/posterior/test_trust.py states the errors, for simulators of several biases.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array

_RIGHT = 0.8  # probability that a simulator is right, before any rollout
_SURE = 0.05  # no promise is surer than this of success or failure
_WON, _LOST = (1.0, 0.5), (0.5, 1.0)  # imagined rollouts of the prior and of what is chosen
_CLEARLY = 0.02  # by how much what is chosen must be expected to be better


class Trust(NamedTuple):
    """log_odds: [] that the simulator is right. won, lost: [2] real rollouts of the prior and of what is chosen."""

    log_odds: Array
    won: Array
    lost: Array


def begin() -> Trust:
    """Before any rollout."""
    return Trust(jnp.log(_RIGHT / (1.0 - _RIGHT)), jnp.array(_WON), jnp.array(_LOST))


def told(trust: Trust, chosen: Array, promised: Array, success: Array) -> Trust:
    """After a rollout. chosen: [] bool, whether what is chosen played it. promised: [] the success that was promised
    for it, nan where nothing was. success: [] bool.
    """
    which, success = jnp.asarray(chosen, jnp.int32), jnp.asarray(success, bool)
    usual = _records(trust)[which]
    sure = jnp.where(jnp.isnan(promised), usual, jnp.clip(promised, _SURE, 1.0 - _SURE))
    gain = jnp.where(success, jnp.log(sure / usual), jnp.log((1.0 - sure) / (1.0 - usual)))
    row = jax.nn.one_hot(which, 2)
    return Trust(trust.log_odds + gain, trust.won + row * success, trust.lost + row * ~success)


def expected(trust: Trust, promised: Array) -> Array:
    """[2] the success to expect of the prior and of what is chosen. promised: [2] by the simulator."""
    right = jax.nn.sigmoid(trust.log_odds)
    return right * promised + (1.0 - right) * _records(trust)


def deploys(trust: Trust, promised: Array) -> Array:
    """[] bool: whether to deploy what is chosen instead of the prior. promised: [2] as of `expected`."""
    prior, chosen = expected(trust, promised)
    return chosen > prior + _CLEARLY


def _records(trust: Trust) -> Array:
    """[2] by real rollouts alone."""
    return trust.won / (trust.won + trust.lost)
