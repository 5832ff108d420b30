"""What the precision of matrix products does to V_sim and to the rewards that it shapes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import envs
from envs.mujoco.worlds import Impl
from envs.pools import training_worlds
from experiments.algorithms import make_player, network_of
from experiments.evaluation import play_episodes, prior_policy
from experiments.options import prior_folders
from sgft_jax.io.priors import load_priors
from sgft_jax.models.networks import Precision, make_value
from sgft_jax.models.value import predict
from sgft_jax.types import Array, Prior, Transition, UserError

EPISODES = 64


def errors(task: str, impl: Impl, prior: Path, precisions: Sequence[Precision]) -> list[dict[str, Any]]:
    """How far V_sim and shaped rewards are from those in float32, of each prior, on the policy's own transitions.

    value_error, shaped_error: root of the mean square of the difference. value_std, shaped_std: of what is computed in
    float32, over these transitions: what the errors are to be compared with. Raises UserError for a prior without
    V_sim as a network of its own.
    """
    env = envs.make(task, impl)
    priors, card = load_priors(prior_folders(prior, out=prior, task=env.name, preset=""), env)
    if not isinstance(priors[0], Prior):
        raise UserError(f"{prior}: a prior of {card['algorithm']}; precisions are compared for those of SAC")
    player, network = make_player(card, env), make_value(env.obs_dim, network_of(card))
    pool = training_worlds(env, None, jax.random.key(0), EPISODES)
    keys = jax.random.split(jax.random.key(1), EPISODES)

    def play(prior: Prior) -> tuple[Transition, Array]:
        policy = prior_policy(player, prior, explore=True)
        played = play_episodes(env, pool, policy, player.init_carry(), keys, gamma=card["gamma"])
        return played.transitions, played.valid

    def judge(prior: Prior, rows: Transition, exact: Precision) -> tuple[Array, Array]:
        """V(s) and r + d V(s') - V(s), both [EPISODES, T]."""
        value = jax.vmap(jax.vmap(lambda obs: predict(network, prior.value, prior.normalizer, obs, exact=exact)))
        before = value(rows.obs)
        return before, rows.reward + rows.discount * value(rows.next_obs) - before

    played, judged = jax.jit(play), jax.jit(judge, static_argnums=2)
    found = []
    for number, own in enumerate(priors):
        rows, valid = played(own)
        reference = [x[valid] for x in judged(own, rows, "float32")]
        for name in precisions:
            line: dict[str, Any] = {"task": task, "prior": number, "precision": name}
            rough = [x[valid] for x in judged(own, rows, name)]
            for what, a, b in zip(("value", "shaped"), rough, reference, strict=True):
                line |= {f"{what}_error": float(jnp.sqrt(jnp.mean((a - b) ** 2))), f"{what}_std": float(jnp.std(b))}
            found.append(line)
    return found
