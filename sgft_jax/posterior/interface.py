"""How fine-tuning uses the posterior: every rollout says anew behind which correction the policy acts. Pure.

The candidates play in the simulator what the prior's policy would do there, see `decision`; real rollouts say how far
to trust what they promise, and so whether the prior as it is, behind a correction, or what learns is deployed, see
`trust`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env
from envs.types import Array, Key, Policy, PyTree, Transition, UserError
from sgft_jax.models.distortion import Distortion, Interface, Seen, none
from sgft_jax.posterior.candidates import Candidates, unknowns_of
from sgft_jax.posterior.decision import CANDIDATES, JUDGES, choose, judged
from sgft_jax.posterior.estimator import MOST, Estimator, Rollout, blank, contradiction, draw, rollout_of
from sgft_jax.posterior.trust import AS_IS, CORRECTED, LEARNED, POLICIES, Trust, begin, choice, expected, faded, told
from sgft_jax.stacking import member, stack
from sgft_jax.types import Finetuner, Metrics, SimulatedData


class Believed(NamedTuple):
    """What is known of one real system.

    params: of the policy that plays in simulation, without an estimator. rollouts: [MOST] the last ones, and `count` []
    how many there have been. judges: [JUDGES, d] systems that may be the real one. distortion: what the policy that
    is chosen corrects, and the one that learns. contradicted: [] bool, whether rollouts contradict each other more than
    those of the simulator's systems do. promised: [3] the success that simulation promises for the policies of
    `trust`, nan for those that it has not tried. key: of all choices.
    """

    params: PyTree
    estimator: Estimator
    rollouts: Rollout
    count: Array
    judges: Array
    distortion: Distortion
    contradicted: Array
    promised: Array
    key: Key


class Deployed(NamedTuple):
    """agent: the state of what learns, or adapts. first: params of the simulator's policy. which: [] the policy of
    `trust` that is deployed.
    """

    agent: PyTree
    first: PyTree
    trust: Trust
    which: Array


def posterior_interface(env: Env, systems: Candidates, policy: Policy) -> Interface:
    """Identification by the estimator of a prior. env: the task in the simulator, as the policy observes it."""
    nothing = none(env.act_dim, env.measured_dim)
    room = blank(MOST, env.episode_length, env.measured_dim, env.act_dim)

    def start(params: PyTree, key: Key) -> Believed:
        if params.estimator is None:
            raise UserError("this prior has no estimator of systems; `python -m experiments.estimate` makes it")
        acting, judges = _acting(params), jnp.zeros((JUDGES, len(systems.unknowns)))
        promised, contradicted = jnp.full(3, jnp.nan, jnp.float32), jnp.zeros((), bool)
        return Believed(acting, params.estimator, room, jnp.int32(0), judges, nothing, contradicted, promised, key)

    def refit(known: Believed, seen: Seen) -> Believed:
        if seen.rollout is None:  # of a log, which does not tell success
            return known
        last, place = rollout_of(env, *seen.rollout), known.count % MOST
        rollouts = jax.tree.map(lambda rows, row: rows.at[place].set(row), known.rollouts, last)
        known = known._replace(rollouts=rollouts, count=known.count + 1)
        counts, (key_points, key_choice) = jnp.arange(MOST) < known.count, _keys(known)
        points = draw(known.estimator, rollouts, counts, len(systems.unknowns), key_points, CANDIDATES + JUDGES)
        distortion, promised = choose(env, systems, policy, known.params, points, key_choice)
        nats = contradiction(known.estimator, rollouts, counts, len(systems.unknowns), key_choice)
        return known._replace(
            judges=points[CANDIDATES:],
            distortion=distortion,
            contradicted=(known.count > 1) & (nats > known.estimator.usual[jnp.minimum(known.count, MOST) - 1]),
            promised=jnp.append(promised, jnp.nan),
        )

    return Interface(start, lambda known, simulated: known, refit)


def deployed(inner: Finetuner, env: Env, systems: Candidates, policy: Policy, *, learns: bool) -> Finetuner:
    """The same fine-tuning, of which only that is deployed which simulation and real rollouts say is best.

    inner: identifies by `posterior_interface`; its exported params act by `policy`. learns: whether it also learns.
    `learn` must follow each rollout once, as in `finetuning.finetune`. Metrics: posterior/deployed, the number of the
    policy of `trust`, the success that is expected of each, and posterior/contradicted, 1 where no system of the
    simulator is the real one.
    """
    nothing = none(env.act_dim, env.measured_dim)

    def init(params: PyTree, key: Key) -> Deployed:
        agent = inner.init(params, key)
        # A copy: the caller may donate the state, and the prior must survive that.
        return Deployed(agent, jax.tree.map(jnp.copy, inner.export(agent)), begin(), jnp.int32(AS_IS))

    def prepare(state: Deployed, simulated: SimulatedData | None) -> Deployed:
        return state._replace(agent=inner.prepare(state.agent, simulated))

    def export(state: Deployed) -> PyTree:
        corrected = state.first._replace(distortion=state.agent.interface.distortion)
        return member(stack([state.first, corrected, inner.export(state.agent)]), state.which)

    def act(state: Deployed, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, PyTree]:
        # Only what learns explores: the others are promised as they are.
        return policy.act(export(state), carry, obs, key, explore=explore & (state.which == LEARNED))

    def observe(state: Deployed, rows: Transition, valid: Array, score: Array | None) -> Deployed:
        if score is None:  # none of the policies has played
            return state._replace(agent=inner.observe(state.agent, rows, valid, None))
        trust = told(state.trust, state.which, state.agent.interface.promised, score > 0.5)
        agent = inner.observe(state.agent, rows, valid, score)
        trust = trust._replace(contradicted=agent.interface.contradicted)
        # What learns acts behind the correction too, unless the prior as it is should do better without it.
        which, known = choice(trust, agent.interface.promised), agent.interface
        distortion = jax.tree.map(lambda a, b: jnp.where(which == CORRECTED, a, b), known.distortion, nothing)
        return Deployed(agent._replace(interface=known._replace(distortion=distortion)), state.first, trust, which)

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
        if offline:  # no rollout has been played
            return state._replace(agent=agent), metrics
        known, trust = agent.interface, faded(state.trust)
        if learns:
            acting, key_choice = _acting(inner.export(agent)), _keys(known)[1]
            promise = judged(env, systems, policy, acting, known.judges, key_choice)
            known = known._replace(promised=known.promised.at[LEARNED].set(promise))
        which = choice(trust, known.promised)
        metrics |= {f"posterior/{n}": x for n, x in zip(POLICIES, expected(trust, known.promised), strict=True)}
        facts = {"deployed": which, "contradicted": trust.contradicted}
        metrics |= {f"posterior/{name}": x.astype(jnp.float32) for name, x in facts.items()}
        return Deployed(agent._replace(interface=known), state.first, trust, which), metrics

    changed = {"init": init, "prepare": prepare, "act": act, "observe": observe, "learn": learn, "export": export}
    return inner._replace(init_carry=policy.init_carry, guarded=True, estimates=True, **changed)


def entry_of(env: Env) -> dict[str, Any]:
    """What the card of a prior says of an estimator for a task. Raises UserError for one not judged by success."""
    if env.score != "success":
        raise UserError(f"the posterior promises success, and {env.name} is judged by its return; take another method")
    unknowns = [unknown._asdict() for unknown in unknowns_of(env)]
    return {"unknowns": unknowns, "steps": env.episode_length, "measured": env.measured_dim}


def _acting(params: PyTree) -> PyTree:
    """What a policy acts by."""
    return params._replace(estimator=None, critic=None, value=None, dynamics=None)


def _keys(known: Believed) -> Array:
    """[2] of the points that are drawn after the last rollout, and of the choice."""
    return jax.random.split(jax.random.fold_in(known.key, known.count))
