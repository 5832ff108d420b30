"""What the precision of matrix products does to V_sim and to the rewards that it shapes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import envs
from envs.physics import Impl
from experiments import common
from experiments.algorithms import make_player, network_of
from experiments.evaluation import play_episodes, prior_policy
from sgft_jax.networks import Precision, make_value
from sgft_jax.types import Array, Prior, Transition, UserError
from sgft_jax.value import predict

EPISODES = 64


def errors(task: str, impl: Impl, prior: Path, precisions: Sequence[Precision]) -> list[dict[str, Any]]:
    """How far V_sim and shaped rewards are from those in float32, of each prior, on the policy's own transitions.

    value_error, shaped_error: root of the mean square of the difference. value_std, shaped_std: of what is computed in
    float32, over these transitions: what the errors are to be compared with. Raises UserError for a prior without
    V_sim as a network of its own.
    """
    env = envs.make(task, impl)
    priors, card = common.load_priors(common.prior_folders(prior, out=Path(), task=env.name, preset=""), env)
    if not isinstance(priors[0], Prior):
        raise UserError(f"{prior}: a prior of {card['algorithm']}; precisions are compared for those of SAC")
    player, network = make_player(card), make_value(env.obs_dim, network_of(card))
    pool, keys = common.training_worlds(env, None, jax.random.key(0), EPISODES), jax.random.key(1)

    def play(prior: Prior) -> tuple[Transition, Array]:
        policy = prior_policy(player, prior, explore=True)
        keys_play = jax.random.split(keys, EPISODES)
        played = play_episodes(env, pool, policy, player.init_carry(), keys_play, gamma=card["gamma"])
        return played.transitions, played.valid

    def judge(prior: Prior, rows: Transition, exact: Precision) -> tuple[Array, Array]:
        """V(s) and r + d V(s') - V(s), both [EPISODES, T]."""
        value = jax.vmap(jax.vmap(lambda obs: predict(network, prior.value, prior.normalizer, obs, exact=exact)))
        before = value(rows.obs)
        return before, rows.reward + rows.discount * value(rows.next_obs) - before

    found = []
    for seed, prior_now in enumerate(priors):
        rows, valid = jax.jit(play)(prior_now)
        exact = [x[valid] for x in jax.jit(judge, static_argnums=2)(prior_now, rows, "float32")]
        for name in precisions:
            rough = [x[valid] for x in jax.jit(judge, static_argnums=2)(prior_now, rows, name)]
            line: dict[str, Any] = {"task": task, "prior": seed, "precision": name}
            for what, a, b in zip(("value", "shaped"), rough, exact, strict=True):
                line |= {f"{what}_error": float(jnp.sqrt(jnp.mean((a - b) ** 2))), f"{what}_std": float(jnp.std(b))}
            found.append(line)
    return found
