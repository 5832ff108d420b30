"""Fine-tuning by the posterior: every rollout says anew behind which correction the prior's policy acts. Pure.

The candidates play in the simulator what the policy would do there, see `decision`; real rollouts say how far to trust
what they promise, and so whether the prior as it is, behind the correction that does best in simulation, or behind the
one that fits real steps best is deployed, see `trust`.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env
from envs.types import Array, Key, Policy, PyTree, Transition, UserError
from sgft_jax.models.distortion import Distortion, Identified, Interface, Seen, none
from sgft_jax.posterior.candidates import Candidates, unknowns_of
from sgft_jax.posterior.decision import CANDIDATES, JUDGES, choose
from sgft_jax.posterior.estimator import MOST, Estimator, Rollout, alternating, blank, contradiction, draw, rollout_of
from sgft_jax.posterior.trust import (
    AS_IS,
    FITTED,
    POLICIES,
    Trust,
    begin,
    challenger,
    expected,
    faded,
    incumbent,
    update,
)
from sgft_jax.stacking import member, stack
from sgft_jax.types import Finetuner, Metrics, SimulatedData

_CHANGES = 2  # how often the rollouts that count are halved
MAKE = "`python -m experiments.estimate --prior PRIOR` makes it"


class Believed(NamedTuple):
    """What is known of one real system.

    params: of the policy that plays in simulation, without an estimator. rollouts: [MOST] the last ones, and `count` []
    how many there have been. distortion: what is corrected by the choice in simulation. fit: the correction that fits
    real steps best. contradicted: [] bool, whether rollouts contradict each other more than those of the simulator's
    systems do. changed: [] bool, whether the system is not what it was. promised: [3] the success that simulation
    promises for the policies of `trust`, nan for those that it has not tried. key: of all choices.
    """

    params: PyTree
    estimator: Estimator
    rollouts: Rollout
    count: Array
    distortion: Distortion
    fit: Identified
    contradicted: Array
    changed: Array
    promised: Array
    key: Key


class Inference(NamedTuple):
    """What rollouts say. points: [CANDIDATES + JUDGES, d] systems that may have made them. distortion: the correction
    that does best there. promised: [2 + n] success there of the prior as it is, behind that, and behind each of n other
    corrections.

    nats: [] by which every other rollout contradicts those between. usual: [] what 95 % of the simulator's systems do
    not exceed. contradicted: [] bool, whether these rollouts do, of which one never does. current: [MOST] bool, those
    that count: all, or where the system has changed, the later ones.
    """

    points: Array
    distortion: Distortion
    promised: Array
    nats: Array
    usual: Array
    contradicted: Array
    current: Array


class Deployed(NamedTuple):
    """agent: the state of what adapts. first: params of the simulator's policy. challenger: [] the policy of
    `trust` that plays the next rollout. incumbent: [] the one that is deployed.
    """

    agent: PyTree
    first: PyTree
    trust: Trust
    challenger: Array
    incumbent: Array


def infer(
    env: Env,
    systems: Candidates,
    policy: Policy,
    params: PyTree,
    estimator: Estimator,
    rollouts: Rollout,
    count: Array,
    key: Key,
    *others: Distortion,
) -> Inference:
    """What the first `count` [] of rollouts [MOST] say of a system, and which policy is best there.

    params: of the policy that plays in simulation. rollouts: of which later ones replace the first. others: corrections
    that are candidates beside those of the posterior.
    """
    counts, d = jnp.arange(MOST) < count, len(systems.unknowns)
    key_points, key_choice, key_halves, key_change = jax.random.split(key, 4)
    nats = contradiction(estimator, rollouts, alternating(counts), d, key_halves)
    usual = _usual(estimator, counts)
    contradicted = (count > 1) & (nats > usual)
    age = (count - 1 - jnp.arange(MOST)) % MOST
    current = jnp.where(contradicted, counts, _current(estimator, rollouts, counts, age, d, key_change))
    points = draw(estimator, rollouts, current, d, key_points, CANDIDATES + JUDGES)
    distortion, promised = choose(env, systems, policy, params, points, key_choice, *others)
    return Inference(points, distortion, promised, nats, usual, contradicted, current)


def _current(estimator: Estimator, rollouts: Rollout, counts: Array, age: Array, d: int, key: Key) -> Array:
    """[MOST] bool, the rollouts of a system as it is now: its later half as long as that contradicts the earlier one.

    age: [MOST] rollouts since each. Rollouts of one system have no order, so what is usual of other halves is of these.
    """
    for key_half in jax.random.split(key, _CHANGES):
        late = counts & (age < (counts.sum() + 1) // 2)
        nats = contradiction(estimator, rollouts, (counts & ~late, late), d, key_half)
        counts = jnp.where(nats > _usual(estimator, counts), late, counts)
    return counts


def _usual(estimator: Estimator, counts: Array) -> Array:
    """[] nats by which 95 % of the simulator's systems contradict themselves at most."""
    return estimator.usual[jnp.maximum(counts.sum(), 1) - 1]


def posterior_interface(env: Env, systems: Candidates, policy: Policy, fitting: Interface) -> Interface:
    """Identification by the estimator of a prior. env: the task in the simulator, as the policy observes it. fitting:
    identification by the prior's models.
    """
    nothing = none(env.act_dim, env.measured_dim)
    room = blank(MOST, env.episode_length, env.measured_dim, env.act_dim)

    def start(params: PyTree, key: Key) -> Believed:
        if params.estimator is None:
            raise UserError(f"these params have no estimator; {MAKE}")
        return Believed(
            params=params._replace(estimator=None, critic=None, value=None, dynamics=None),
            estimator=params.estimator,
            rollouts=room,
            count=jnp.int32(0),
            distortion=nothing,
            fit=fitting.start(params, key),
            contradicted=jnp.zeros((), bool),
            changed=jnp.zeros((), bool),
            promised=jnp.full(len(POLICIES), jnp.nan, jnp.float32),
            key=key,
        )

    def prepare(known: Believed, simulated: SimulatedData) -> Believed:
        return known._replace(fit=fitting.prepare(known.fit, simulated))

    def refit(known: Believed, seen: Seen) -> Believed:
        if seen.rollout is None:  # of a log, which does not tell success
            return known
        last, place = rollout_of(env, *seen.rollout), known.count % MOST
        rollouts = jax.tree.map(lambda rows, row: rows.at[place].set(row), known.rollouts, last)
        fit, count = fitting.refit(known.fit, seen), known.count + 1
        asked = env, systems, policy, known.params, known.estimator, rollouts, count
        inference = infer(*asked, jax.random.fold_in(known.key, count), fit.distortion)
        fitted = jnp.where(_equal(fit.distortion, nothing), jnp.nan, inference.promised[FITTED])
        return known._replace(
            rollouts=rollouts,
            count=count,
            distortion=inference.distortion,
            fit=fit,
            contradicted=inference.contradicted,
            changed=inference.current.sum() < jnp.minimum(count, MOST),
            promised=inference.promised.at[FITTED].set(fitted),
        )

    return Interface(start, prepare, refit)


def deployed(inner: Finetuner, policy: Policy) -> Finetuner:
    """The same fine-tuning, of which that is tried which simulation and real rollouts say is best, and deployed once it
    has succeeded.

    inner: identifies by `posterior_interface`; its exported params act by `policy`. `learn` must follow each rollout
    once, as in `finetuning.finetune`. Metrics: posterior/deployed and posterior/tried, numbers of policies of `trust`;
    the success that is expected of each; posterior/contradicted, 1 where no system of the simulator is the real one;
    posterior/changed, 1 where earlier rollouts are of another system.
    """

    def init(params: PyTree, key: Key) -> Deployed:
        agent = inner.init(params, key)
        # A copy: the caller may donate the state, and the prior must survive that.
        return Deployed(agent, jax.tree.map(jnp.copy, inner.export(agent)), begin(), *[jnp.int32(AS_IS)] * 2)

    def prepare(state: Deployed, simulated: SimulatedData | None) -> Deployed:
        return state._replace(agent=inner.prepare(state.agent, simulated))

    def params(state: Deployed, which: Array) -> PyTree:
        known = state.agent.interface
        behind = [state.first._replace(distortion=undo) for undo in (known.distortion, known.fit.distortion)]
        return member(stack([state.first, *behind]), which)

    def export(state: Deployed) -> PyTree:
        return params(state, state.incumbent)

    def trial(state: Deployed) -> PyTree:
        return params(state, state.challenger)

    def act(state: Deployed, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        del explore  # nothing learns from it, and what is promised does not
        return policy.act(trial(state), carry, obs, key, explore=False)

    def observe(state: Deployed, rows: Transition, valid: Array, score: Array | None) -> Deployed:
        agent = inner.observe(state.agent, rows, valid, score)
        if score is None:  # none of the policies has played
            return state._replace(agent=agent)
        known, promised = agent.interface, state.agent.interface.promised
        trust = update(faded(state.trust, known.changed), state.challenger, promised, score > 0.5)
        which = (rule(trust, known.promised, known.contradicted) for rule in (challenger, incumbent))
        return Deployed(agent, state.first, trust, *which)

    def learn(
        state: Deployed,
        key: Key,
        updates: int,
        simulated: SimulatedData | None = None,
        *,
        offline: bool = False,
        limit: Array | None = None,
    ) -> tuple[Deployed, Metrics]:
        agent, metrics = inner.learn(state.agent, key, updates, simulated, offline=offline, limit=limit)
        known = agent.interface
        successes = expected(state.trust, known.promised, known.contradicted)
        metrics |= {f"posterior/{name}": x for name, x in zip(POLICIES, successes, strict=True)}
        facts = {"deployed": state.incumbent, "tried": state.challenger}
        facts |= {"contradicted": known.contradicted, "changed": known.changed}
        metrics |= {f"posterior/{name}": x.astype(jnp.float32) for name, x in facts.items()}
        return state._replace(agent=agent), metrics

    changed = {"init": init, "prepare": prepare, "act": act, "observe": observe, "learn": learn, "export": export}
    return inner._replace(init_carry=policy.init_carry, trial=trial, guarded=True, estimates=True, **changed)


def entry_of(env: Env) -> dict[str, Any]:
    """What the card of a prior says of an estimator for a task. Raises UserError for one not judged by success."""
    if env.score != "success":
        raise UserError(f"the posterior promises success, and {env.name} is judged by its return; take another method")
    unknowns = [unknown._asdict() for unknown in unknowns_of(env)]
    return {"unknowns": unknowns, "steps": env.episode_length, "measured": env.measured_dim}


def check_estimator(card: Mapping[str, Any], env: Env) -> None:
    """Raises UserError where a prior's card names no estimator of this task's systems."""
    if not (entry := card.get("estimator")):
        raise UserError(f"the prior has no estimator; {MAKE}")
    if entry != entry_of(env):
        raise UserError(f"the prior's estimator knows other systems than {env.name}; {MAKE}")


def _equal(a: PyTree, b: PyTree) -> Array:
    """[] bool, of all numbers."""
    return jnp.all(jnp.array(jax.tree.leaves(jax.tree.map(jnp.array_equal, a, b))))
