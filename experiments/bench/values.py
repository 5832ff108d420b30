"""What the precision of matrix products does to V_sim and to the rewards that it shapes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import envs
from envs.mujoco.worlds import Impl
from envs.pools import training_worlds
from experiments.options import prior_folders
from experiments.stacking import member, stack
from sgft_jax.io.priors import algorithm_of, load_priors
from sgft_jax.learners.sac import SACParams
from sgft_jax.models.networks import Precision, make_value
from sgft_jax.models.value import predict
from sgft_jax.policies import make_policy, network_of
from sgft_jax.systems.simulated import Simulated
from sgft_jax.types import Array, Transition, UserError

EPISODES = 64


def errors(task: str, impl: Impl, prior: Path, precisions: Sequence[Precision]) -> list[dict[str, Any]]:
    """How far V_sim and shaped rewards are from those in float32, of each prior, on the policy's own transitions.

    value_error, shaped_error: root of the mean square of the difference. value_std, shaped_std: of what is computed in
    float32, over these transitions: what the errors are to be compared with. Raises UserError for a prior without
    V_sim as a network of its own.
    """
    env = envs.make(task, impl)
    priors = load_priors(prior_folders(prior, out=prior, task=env.name, preset=""), env)
    card = priors[0].card
    if (algorithm := algorithm_of(card)) != "sac":
        raise UserError(f"{prior}: a prior of {algorithm}; precisions are compared for those of SAC")
    network = make_value(env.obs_dim, network_of(card))
    pools = stack([training_worlds(env, None, jax.random.key(0), EPISODES)])
    system = Simulated(env, pools, jnp.zeros(len(priors), jnp.int32), gamma=card["gamma"])
    keys = jnp.broadcast_to(jax.random.split(jax.random.key(1), EPISODES), (len(priors), EPISODES))
    played = system.play(make_policy(card, env), stack([each.params for each in priors]), keys, explore=True)

    def judge(params: SACParams, rows: Transition, exact: Precision) -> tuple[Array, Array]:
        """V(s) and r + d V(s') - V(s), both [EPISODES, T]."""
        value = jax.vmap(jax.vmap(lambda obs: predict(network, params.value, params.normalizer, obs, exact=exact)))
        before = value(rows.obs)
        return before, rows.reward + rows.discount * value(rows.next_obs) - before

    judged = jax.jit(judge, static_argnums=2)
    found = []
    for number, own in enumerate(priors):
        rows, valid = member((played.transitions, played.valid), number)
        reference = [x[valid] for x in judged(own.params, rows, "float32")]
        for name in precisions:
            line: dict[str, Any] = {"task": task, "prior": number, "precision": name}
            rough = [x[valid] for x in judged(own.params, rows, name)]
            for what, a, b in zip(("value", "shaped"), rough, reference, strict=True):
                line |= {f"{what}_error": float(jnp.sqrt(jnp.mean((a - b) ** 2))), f"{what}_std": float(jnp.std(b))}
            found.append(line)
    return found
