"""What a prior is worth to fine-tuning: V_sim against returns, the model against trajectories. Pure."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env, World
from envs.rollout import Episode
from experiments.evaluation import play_episodes, prior_policy
from sgft_jax.mesh import whole
from sgft_jax.models import value
from sgft_jax.players import Player
from sgft_jax.types import Array, Key, PyTree

HORIZON = 10  # steps ahead that the model is judged at: twice the longest branches worth imagining


class Report(NamedTuple):
    """Measurements of one prior.

    values, returns: [trajectories * episode_length] V_sim of the states that the exploring policy visits, and the
    discounted returns that followed. counts: the same shape, bool, False in exploded episodes.
    model_error, still_error: [horizon] RMS error, in standard deviations of the observation, of the model's open-loop
    prediction 1, 2, ... steps ahead, and of predicting that nothing changes.
    """

    values: Array
    returns: Array
    counts: Array
    model_error: Array
    still_error: Array


def make_report(
    env: Env, player: Player, pool: World, prior: PyTree, key: Key, *, gamma: float, trajectories: int
) -> Report:
    """Measures one prior on that many fresh trajectories of its exploring policy in the worlds it has learned in.

    Trajectories run ceil(3 / (1 - gamma)) steps past the time limit, where 5 % of the discounted weight is left, and
    V_sim of the last state stands for the rest.
    """
    length = env.episode_length + math.ceil(3 / (1 - gamma))
    policy, keys = prior_policy(player, prior, explore=True), jax.random.split(key, trajectories)
    played = play_episodes(env, pool, policy, player.init_carry(), keys, gamma=gamma, length=length)
    values, returns = jax.vmap(lambda e: _values(env, player, prior, e))(played)
    model, still = jax.vmap(lambda e: _model_errors(env, player, prior, e))(played)
    intact = ~played.exploded[:, None]
    average = lambda x: jnp.where(intact, x, 0.0).sum(0) / jnp.maximum(intact.sum(), 1)  # noqa: E731
    report = Report(
        values=values.reshape(-1),
        returns=returns.reshape(-1),
        counts=jnp.broadcast_to(intact, values.shape).reshape(-1),
        model_error=average(model),
        still_error=average(still),
    )
    return whole(report)


def numbers(report: Report) -> dict[str, Any]:
    """A report (NumPy arrays) as JSON data: what stands in summary.json and on the card."""
    quality = value.report(jnp.asarray(report.values[report.counts]), jnp.asarray(report.returns[report.counts]))
    found: dict[str, Any] = {name: float(x) for name, x in quality.items()}
    if report.model_error.size:
        found["dynamics/error"] = report.model_error.tolist()
        found["dynamics/error_if_nothing_moved"] = report.still_error.tolist()
    return found


def _values(env: Env, player: Player, prior: PyTree, episode: Episode) -> tuple[Array, Array]:
    """V_sim and Monte-Carlo returns [episode_length] of one episode."""
    rows = episode.transitions
    predict = lambda obs: player.value(prior, obs)  # noqa: E731
    returns = value.discounted_returns(rows.reward, rows.discount, predict(rows.next_obs[-1]))
    return jax.vmap(predict)(rows.obs[: env.episode_length]), returns[: env.episode_length]


def _model_errors(env: Env, player: Player, prior: Any, episode: Episode) -> tuple[Array, Array]:
    """Errors [horizon] of the model and of standing still, averaged over the windows that fit into one episode.

    [0] where the model does not predict observations.
    """
    if player.model_error is None:
        return jnp.zeros(0), jnp.zeros(0)
    error, horizon = player.model_error, min(HORIZON, env.episode_length)
    starts = jnp.arange(0, env.episode_length - horizon + 1, horizon)

    def window(start: Array) -> tuple[Array, Array]:
        cut = lambda x: jax.lax.dynamic_slice_in_dim(x, start, horizon)  # noqa: E731
        rows = episode.transitions
        obs = jnp.concatenate([rows.obs[start][None], cut(rows.next_obs)])
        still = jax.vmap(lambda o: jnp.sqrt(jnp.mean(((obs[0] - o) / prior.normalizer.std) ** 2)))(obs[1:])
        return error(prior, obs, cut(rows.action)), still

    return jax.tree.map(lambda x: x.mean(0), jax.vmap(window)(starts))
