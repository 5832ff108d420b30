"""How fine-tuning uses the posterior: every rollout says anew behind which correction the policy acts. Pure.

The candidates play in the simulator what the prior's policy would do there, see `decision`; real rollouts say how far
to trust what they promise, see `trust`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env
from envs.types import Array, Key, Policy, PyTree, UserError
from sgft_jax.models.distortion import Distortion, Interface, Seen, none
from sgft_jax.posterior.candidates import Candidates, unknowns_of
from sgft_jax.posterior.decision import CANDIDATES, JUDGES, choose
from sgft_jax.posterior.estimator import Estimator, Rollout, blank, draw, rollout_of
from sgft_jax.posterior.learning import MOST
from sgft_jax.posterior.trust import Trust, begin, deploys, expected, told


class Believed(NamedTuple):
    """What is known of one real system.

    params: of the policy that plays in simulation, without an estimator. rollouts: [MOST] the last ones, and `count` []
    how many there have been. trust: in simulation. deployed: [] bool, whether that is deployed which is chosen by
    simulation, instead of the prior as it is. distortion: what it corrects then, else nothing. promised: [2] the
    success that simulation promises for the prior and for what is chosen, nan before any rollout. key: of the next
    choice.
    """

    params: PyTree
    estimator: Estimator
    rollouts: Rollout
    count: Array
    trust: Trust
    deployed: Array
    distortion: Distortion
    promised: Array
    key: Key


def posterior_interface(env: Env, systems: Candidates, policy: Policy) -> Interface:
    """Identification by the estimator of a prior. env: the task in the simulator, as the policy observes it."""
    nothing = none(env.act_dim, env.measured_dim)
    room = blank(MOST, env.episode_length, env.measured_dim, env.act_dim)

    def start(params: PyTree, key: Key) -> Believed:
        if params.estimator is None:
            raise UserError("this prior has no estimator of systems; `python -m experiments.estimate` makes it")
        acting = params._replace(estimator=None, critic=None, value=None, dynamics=None)
        nan, no = jnp.full(2, jnp.nan), jnp.zeros((), bool)
        return Believed(acting, params.estimator, room, jnp.int32(0), begin(), no, nothing, nan, key)

    def refit(known: Believed, seen: Seen) -> Believed:
        if seen.rollout is None:  # of a log, which does not tell success
            return known
        key, key_points, key_choice = jax.random.split(known.key, 3)
        last, place = rollout_of(env, *seen.rollout), known.count % MOST
        rollouts = jax.tree.map(lambda rows, row: rows.at[place].set(row), known.rollouts, last)
        counts = jnp.arange(MOST) <= known.count
        points = draw(known.estimator, rollouts, counts, len(systems.unknowns), key_points, CANDIDATES + JUDGES)
        choice, promised = choose(env, systems, policy, known.params, points, key_choice)
        trust = told(known.trust, known.deployed, known.promised[known.deployed.astype(jnp.int32)], last.success)
        deployed = deploys(trust, promised)
        return known._replace(
            rollouts=rollouts,
            count=known.count + 1,
            trust=trust,
            deployed=deployed,
            distortion=jax.tree.map(lambda a, b: jnp.where(deployed, a, b), choice, nothing),
            promised=promised,
            key=key,
        )

    def report(known: Believed) -> dict[str, Array]:
        prior, chosen = expected(known.trust, known.promised)
        return {"posterior/deployed": known.deployed, "posterior/prior": prior, "posterior/chosen": chosen}

    return Interface(start, lambda known, simulated: known, refit, report)


def entry_of(env: Env) -> dict[str, Any]:
    """What the card of a prior says of an estimator for a task. Raises UserError for one not judged by success."""
    if env.score != "success":
        raise UserError(f"the posterior promises success, and {env.name} is judged by its return; take another method")
    unknowns = [unknown._asdict() for unknown in unknowns_of(env)]
    return {"unknowns": unknowns, "steps": env.episode_length, "measured": env.measured_dim}
