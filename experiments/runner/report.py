"""What a prior is worth to fine-tuning: V_sim against returns, the model against trajectories. Pure."""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env, World
from envs.mesh import split_vmap, whole
from envs.rollout import Episode, play_episode
from envs.types import Array, Key, Policy, PyTree
from sgft_jax.models import value

HORIZON = 10  # steps ahead that the model is judged at: twice the longest branches worth imagining


class Report(NamedTuple):
    """Measurements of one prior.

    values, returns: [trajectories * episode_length] V_sim of the states that the exploring policy visits, and the
    discounted returns that followed. counts: the same shape, bool, False in exploded episodes and after their end.
    model_error, still_error: [horizon] RMS error, in standard deviations of the observation, of the model's open-loop
    prediction 1, 2, ... steps ahead, and of predicting that nothing changes.
    """

    values: Array
    returns: Array
    counts: Array
    model_error: Array
    still_error: Array


def make_report(
    env: Env, policy: Policy, pool: World, prior: PyTree, key: Key, *, gamma: float, trajectories: int
) -> Report:
    """Measures one prior on that many fresh trajectories of its exploring policy in the worlds it has learned in.

    Trajectories run ceil(3 / (1 - gamma)) steps past the time limit, where 5 % of the discounted weight is left, and
    V_sim of the last state stands for the rest.
    """
    length = env.episode_length + math.ceil(3 / (1 - gamma))
    act = functools.partial(policy.act, prior, explore=True)
    play = functools.partial(play_episode, env, pool, act, policy.init_carry(), gamma=gamma, length=length)
    played = split_vmap(play)(jax.random.split(key, trajectories))
    values, returns = jax.vmap(lambda e: _values(env, policy, prior, e))(played)
    errors, windows = jax.vmap(lambda e: _model_errors(env, policy, prior, e))(played)
    intact = ~played.exploded[:, None]
    weight = windows * intact
    model, still = (jnp.einsum("nw,nwh->h", weight, x) / jnp.maximum(weight.sum(), 1.0) for x in errors)
    report = Report(
        values=values.reshape(-1),
        returns=returns.reshape(-1),
        counts=(intact & played.valid[:, : env.episode_length]).reshape(-1),
        model_error=model,
        still_error=still,
    )
    return whole(report)


def numbers(report: Report) -> dict[str, Any]:
    """A report (NumPy arrays) as JSON data: what stands in summary.json and on the card."""
    summary: dict[str, Any] = value.report(report.values[report.counts], report.returns[report.counts])
    if report.model_error.size:
        summary["dynamics/error"] = report.model_error.tolist()
        summary["dynamics/error_if_nothing_moved"] = report.still_error.tolist()
    return summary


def _values(env: Env, policy: Policy, prior: PyTree, episode: Episode) -> tuple[Array, Array]:
    """V_sim and Monte-Carlo returns [episode_length] of one episode."""
    rows, value_of = episode.transitions, policy.value
    assert value_of is not None  # checked before
    predict = functools.partial(value_of, prior)
    returns = value.discounted_returns(rows.reward, rows.discount, predict(rows.next_obs[-1]))
    return jax.vmap(predict)(rows.obs[: env.episode_length]), returns[: env.episode_length]


def _model_errors(env: Env, policy: Policy, prior: Any, episode: Episode) -> tuple[tuple[Array, Array], Array]:
    """Errors [windows, horizon] of the model and of standing still in one episode, and which windows [windows] count:
    those that end before the episode does.

    horizon is 0 where the model does not predict observations.
    """
    error, horizon = policy.model_error, min(HORIZON, env.episode_length)
    starts = jnp.arange(0, env.episode_length - horizon + 1, horizon)
    counts = episode.valid[starts + horizon - 1].astype(jnp.float32)
    if error is None:
        nothing = jnp.zeros((*starts.shape, 0))
        return (nothing, nothing), counts

    rows = episode.transitions

    def window(start: Array) -> tuple[Array, Array]:
        actions, after = (jax.lax.dynamic_slice_in_dim(x, start, horizon) for x in (rows.action, rows.next_obs))
        obs = jnp.concatenate([rows.obs[start][None], after])
        still = jax.vmap(lambda o: jnp.sqrt(jnp.mean(((obs[0] - o) / prior.normalizer.std) ** 2)))(obs[1:])
        return error(prior, obs, actions), still

    return jax.vmap(window)(starts), counts
