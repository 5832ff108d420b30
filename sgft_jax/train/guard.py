"""A guard: real training rollouts decide whether what learns is deployed, or a policy that is known to work.

The *reference* is at first the policy that a method begins with, the *challenger* is what learns. One of the two is
deployed: it plays the next training rollout and is what is evaluated and exported. Scores of training rollouts are the
only evidence, so a guard costs no real transition.

A rollout whose physics exploded, or that was broken off, is a failure. Where the score is a return it counts as the
worst one known, also of rollouts that come later. That may be close to the others, so explosions count by themselves,
too: a challenger whose share of them exceeds the reference's by more than a tenth is not deployed, and of two policies
that are expected to score the same it is the one that explodes less.

The rule compares means of scores, each with a few imagined rollouts as a prior. It is the same for success (a Beta
posterior) and for returns (a normal one), as it needs no scale but the worst and the best score known: 0 and 1 for
success, those seen so far for returns.

- Reference: the mean of its rollouts and, for success, of one imagined success: what the simulator promised.
- Challenger: the mean of its rollouts, each of which counts 0.8 times as much after every learning phase, because it
  has changed since, and of two imagined rollouts half way between the reference's mean and the best score. It is given
  credit as far as the reference falls short, and none where the reference never failed.
- The challenger is deployed if its mean is above the reference's, and not if they are equal.
- It becomes the reference, as it was when it played, if its rollouts alone and one more with the worst score have a
  mean above the reference's. No success rate above 5/6 is ever replaced, as the challenger's evidence is worth five
  rollouts at most.

What it guarantees: while the reference has never failed, nothing else is deployed. While its mean is above 0.84, one
failure of the challenger brings it back. Where the first rollouts fail, the challenger is deployed most of the time.
If the reference succeeds with probability 0.97 and the challenger with 0.8, what is deployed succeeds with 0.93 or
more after any of 20 rollouts, on average over runs, and with 0.9 or more whatever the challenger does. If they succeed
with 0.05 and 0.9, it is 0.88 from the third rollout on (tests/sgft_jax/test_guard.py).
What it does not guarantee: that a single run never falls, as a worse policy succeeds at times; anything about
differences smaller than the spread of returns; that an improvement on a reference that rarely fails is found soon;
that what works while exploring works as well without.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from envs.types import Array, Key, PyTree, Transition
from sgft_jax.types import Finetuner, Metrics, SimulatedData

__all__ = ["Evidence", "Guard", "Guarded", "evidence", "guarded", "learned", "means", "scored", "start"]

_FADE = 0.8  # of the challenger's evidence per learning phase
_CREDIT = 2.0  # imagined rollouts of the challenger
_ROUNDING = 1e-5  # relative difference of scores that says nothing
_TOLERATED = 0.1  # by how much its share of explosions may exceed the reference's


class Evidence(NamedTuple):
    """Weighted rollouts of one policy: the sum of their scores [] and of their weights []."""

    total: Array
    weight: Array


class Guard(NamedTuple):
    """reference, challenger: the evidence for either. worst, best: [] the extreme scores known.

    deployed: [] bool, whether the challenger is. replaced: [] bool, whether the last rollout made it the reference.
    exploded: the weights [] in the evidence for either of rollouts that exploded, whose scores the totals leave out.
    """

    reference: Evidence
    challenger: Evidence
    worst: Array
    best: Array
    deployed: Array
    replaced: Array
    exploded: tuple[Array, Array]


class Guarded(NamedTuple):
    """agent: the state of what learns. reference: params of the other policy. guard: what is known of both."""

    agent: PyTree
    reference: PyTree
    guard: Guard


# --- the rule ---------------------------------------------------------------------------------------------------------


def start(score: str) -> Guard:
    """Before the first rollout, which is the reference's. score: "success" or "return", as of an `Env`."""
    promised, worst, best = (1.0, 0.0, 1.0) if score == "success" else (0.0, jnp.inf, -jnp.inf)
    return Guard(
        Evidence(jnp.float32(promised), jnp.float32(promised)),
        Evidence(jnp.float32(0), jnp.float32(0)),
        jnp.float32(worst),
        jnp.float32(best),
        jnp.zeros((), bool),
        jnp.zeros((), bool),
        (jnp.float32(0), jnp.float32(0)),
    )


def scored(guard: Guard, score: Array, partial: Array | float = jnp.inf) -> Guard:
    """After a training rollout with this score [] by the policy that is deployed; -inf for one that exploded.

    partial: [] what that one scored until then. If the challenger becomes the reference, as it was in this rollout, its
    evidence counts for both.
    """
    exploded, by_challenger = jnp.isneginf(score), guard.deployed.astype(jnp.float32)
    played, counted = (1 - by_challenger, by_challenger), jnp.where(exploded, 0.0, score)
    guard = guard._replace(
        reference=_added(guard.reference, counted, played[0]),
        challenger=_added(guard.challenger, counted, played[1]),
        worst=jnp.minimum(guard.worst, jnp.where(exploded, partial, score)),
        best=jnp.maximum(guard.best, score),
        exploded=tuple(x + share * exploded for x, share in zip(guard.exploded, played, strict=True)),
    )
    reference, challenger = evidence(guard)
    proven = (challenger.total + guard.worst) / (challenger.weight + 1) > _mean(reference)
    replaced, (of_reference, of_challenger) = guard.deployed & proven & ~exploded, guard.exploded
    return guard._replace(
        reference=optax.tree.where(replaced, guard.challenger, guard.reference),
        replaced=replaced,
        exploded=(jnp.where(replaced, of_challenger, of_reference), of_challenger),
    )


def _added(evidence: Evidence, score: Array, weight: Array) -> Evidence:
    return Evidence(evidence.total + weight * score, evidence.weight + weight)


def learned(guard: Guard) -> Guard:
    """The challenger has changed, which ages its evidence; who is deployed is decided anew."""
    challenger = Evidence(*(_FADE * x for x in guard.challenger))
    guard = guard._replace(challenger=challenger, exploded=(guard.exploded[0], _FADE * guard.exploded[1]))
    (reference, expected), (of_reference, of_challenger) = means(guard), guard.exploded
    excess = of_challenger / (_CREDIT + challenger.weight) - of_reference / jnp.maximum(guard.reference.weight, 1e-6)
    equal = expected >= reference - _ROUNDING * jnp.abs(reference)
    better = (expected > reference) | (equal & (excess < 0))
    return guard._replace(deployed=better & (excess <= _TOLERATED))


def evidence(guard: Guard) -> tuple[Evidence, Evidence]:
    """That for the reference and the challenger, rollouts that exploded at the worst score known, 0 before any is."""
    worst = jnp.where(jnp.isfinite(guard.worst), guard.worst, 0.0)
    policies = zip((guard.reference, guard.challenger), guard.exploded, strict=True)
    reference, challenger = (Evidence(known.total + lost * worst, known.weight) for known, lost in policies)
    return reference, challenger


def means(guard: Guard) -> tuple[Array, Array]:
    """The scores [] that are expected of the reference and of the challenger."""
    for_reference, (total, weight) = evidence(guard)
    reference = _mean(for_reference)
    credit = (reference + jnp.maximum(guard.best, reference)) / 2
    # As a distance from the reference, so that without evidence or shortfall they are equal to the bit.
    return reference, reference + (_CREDIT * (credit - reference) + total - weight * reference) / (_CREDIT + weight)


def _mean(evidence: Evidence) -> Array:
    return evidence.total / jnp.maximum(evidence.weight, 1e-6)


# --- around a finetuner -----------------------------------------------------------------------------------------------


def guarded(inner: Finetuner, first: Callable[[PyTree, PyTree], PyTree], *, score: str) -> Finetuner:
    """The same fine-tuning, of which only that is deployed what the guard lets through.

    first(params of a prior, what the fresh agent exports) -> params of the first reference, for `inner.policy`.
    score: what rollouts are judged by, "success" or "return". `learn` must follow each rollout once, as in
    `finetuning.finetune`; what is learned before the first one, as from logs, deploys nothing. Metrics:
    guard/challenger, whether it is deployed next; guard/replaced; the expected scores.
    """
    kind = score

    def init(params: PyTree, key: Key) -> Guarded:
        agent = inner.init(params, key)
        # A copy: the caller may donate the state, and the prior must survive that.
        return Guarded(agent, jax.tree.map(jnp.copy, first(params, inner.export(agent))), start(kind))

    def prepare(state: Guarded, simulated: SimulatedData | None) -> Guarded:
        return state._replace(agent=inner.prepare(state.agent, simulated))

    def export(state: Guarded) -> PyTree:
        return optax.tree.where(state.guard.deployed, inner.export(state.agent), state.reference)

    def act(state: Guarded, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        return inner.policy.act(export(state), carry, obs, key, explore=explore)

    def observe(state: Guarded, rows: Transition, valid: Array, score: Array | None) -> Guarded:
        if score is None:  # neither of the two policies has played
            return state._replace(agent=inner.observe(state.agent, rows, valid, None))
        if kind == "success":  # an explosion is a failure like others
            guard = scored(state.guard, jnp.maximum(jnp.float32(score), 0.0))
        else:
            guard = scored(state.guard, jnp.float32(score), jnp.sum(rows.reward, where=valid))
        # What has played: `inner.observe` may change the policy too, as identification does.
        reference = optax.tree.where(guard.replaced, inner.export(state.agent), state.reference)
        return Guarded(inner.observe(state.agent, rows, valid, score), reference, guard)

    def learn(
        state: Guarded,
        key: Key,
        updates: int,
        simulated: SimulatedData | None = None,
        *,
        offline: bool = False,
        limit: Array | None = None,
    ) -> tuple[Guarded, Metrics]:
        agent, metrics = inner.learn(state.agent, key, updates, simulated, offline=offline, limit=limit)
        if offline:  # no rollout has been played
            return state._replace(agent=agent), metrics
        guard = learned(state.guard)
        expected = dict(zip(("guard/expected_reference", "guard/expected_challenger"), means(guard), strict=True))
        flags = {"guard/challenger": guard.deployed, "guard/replaced": guard.replaced}
        metrics |= expected | {name: x.astype(jnp.float32) for name, x in flags.items()}
        return Guarded(agent, state.reference, guard), metrics

    changed = {"init": init, "prepare": prepare, "act": act, "observe": observe, "learn": learn, "export": export}
    return inner._replace(init_carry=inner.policy.init_carry, guarded=True, **changed)
