"""What real rollouts tell of a gap through a prior's eyes: is V_sim a guide there, are the models right, what differs?

Pure functions, each measures one thing; `sgft_jax.examination` puts them together.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.types import Array, Key, PyTree, Transition, UserError
from sgft_jax.math.stats import rank_correlation
from sgft_jax.models import dynamics, value
from sgft_jax.models.config import network_of
from sgft_jax.models.distortion import Distortion, none, residuals
from sgft_jax.models.networks import make_dynamics
from sgft_jax.models.robust import robust_std, student_cost
from sgft_jax.policies import sac_policy
from sgft_jax.types import Task

HORIZONS = (1, 2, 4, 8)  # steps ahead
SHARES = np.linspace(-0.5, 1.0, 61)  # of a command that may come from the step before
_STILL = 0.25  # the share of steps that move an entry least
_LARGEST, _KEPT_STD = 0.05, 0.871  # share of residuals left out there; std of a Gaussian without it


class Rollouts(NamedTuple):
    """Recorded episodes of T steps, [n, T, ...], with `valid` [n, T] and `success` [n]; see `envs.rollout.Episode`."""

    transitions: Transition
    valid: Array
    success: Array

    def flat(self) -> tuple[Transition, Array]:
        """Their steps one after another [n * T], and which of them are valid [n * T]."""
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (self.transitions, self.valid))


class Beliefs(NamedTuple):
    """What a prior predicts, as functions of one example, in the simulator's observations and actions.

    value(obs) -> []: V_sim. wish(obs) -> [act_dim]: the policy's mean action. models: [members, ...]; after(model, obs,
    action) -> [obs_dim]: the successor that one of them predicts. drift(obs [k + 1, obs_dim], actions [k, act_dim]) ->
    [k]: error of open-loop predictions, in standard deviations of the observation. reward, terminated: functions of
    (obs, action, next_obs). gamma: discount factor.
    """

    value: Callable[[Array], Array]
    wish: Callable[[Array], Array]
    models: PyTree
    after: Callable[[PyTree, Array, Array], Array]
    drift: Callable[[Array, Array], Array]
    reward: Callable[[Array, Array, Array], Array]
    terminated: Callable[[Array, Array, Array], Array]
    gamma: float


def beliefs_of(params: Any, card: Mapping[str, Any], task: Task) -> Beliefs:
    """Those of a prior of SAC. Raises UserError where the task's reward is no function of observations."""
    if task.reward is None or task.terminated is None:
        raise UserError("a diagnosis needs a task whose `reward` and `terminated` are functions of observations")
    sizes = (task.obs_dim, task.act_dim, network_of(card))
    policy, model = sac_policy(*sizes), make_dynamics(*sizes)
    assert policy.value is not None and policy.model_error is not None
    value_of, error_of, key = policy.value, policy.model_error, jax.random.key(0)

    def after(member: PyTree, obs: Array, action: Array) -> Array:
        one = jax.tree.map(lambda x: x[None], member)
        return dynamics.predict(model, one, params.normalizer, obs, action)[0]

    return Beliefs(
        value=lambda obs: value_of(params, obs),
        wish=lambda obs: policy.act(params._replace(distortion=None), (), obs, key, explore=False)[0],
        models=params.dynamics,
        after=after,
        drift=lambda obs, actions: error_of(params, obs, actions),
        reward=task.reward,
        terminated=task.terminated,
        gamma=card["gamma"],
    )


# --- V_sim ------------------------------------------------------------------------------------------------------------


def headroom(beliefs: Beliefs, known: Distortion, obs: Array, offsets: Array, horizon: int) -> Array:
    """[horizon] by how much the best of n ways to act for 1, 2, ... steps exceeds V_sim(obs), in units of reward.

    For H steps: max over offsets of E[sum_{t<H} gamma^t r_t + gamma^H V_sim(s_H)] - V_sim(s), the paper's V_H^* over
    sampled actions; H = 1 is Definition 1. A way to act adds one constant offset to every command of the policy, and
    clips it to [-1, 1]. E is the mean over the prior's models, which get the action that `known` says a command causes.

    obs: [obs_dim], in the simulator's terms. offsets: [n, act_dim].
    """
    start = beliefs.value(obs)

    def along(model: PyTree, offset: Array) -> Array:
        def step(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], Array]:
            obs, earned, weight = carry
            action = known.meaning(jnp.clip(known.command(beliefs.wish(obs)) + offset, -1.0, 1.0))
            after = beliefs.after(model, obs, action)
            earned = earned + weight * beliefs.reward(obs, action, after)
            weight = weight * beliefs.gamma * (1.0 - beliefs.terminated(obs, action, after).astype(jnp.float32))
            return (after, earned, weight), earned + weight * beliefs.value(after) - start

        return jax.lax.scan(step, (obs, jnp.float32(0), jnp.float32(1)), None, length=horizon)[1]

    of_offsets = jax.vmap(along, (None, 0))
    return jax.vmap(of_offsets, (0, None))(beliefs.models, offsets).mean(axis=0).max(axis=0)


def draw_offsets(key: Key, n: int, act_dim: int) -> Array:
    """[n, act_dim]: none, then uniform ones of all sizes up to the whole range of commands."""
    key_size, key_way = jax.random.split(key)
    size = jax.random.uniform(key_size, (n, 1), maxval=2.0).at[0].set(0.0)
    return size * jax.random.uniform(key_way, (n, act_dim), minval=-1.0, maxval=1.0)


def promises(beliefs: Beliefs, rollouts: Rollouts) -> tuple[Array, Array]:
    """V_sim [n, T] of visited states, and the discounted returns [n, T] that followed, V_sim standing for what comes
    after the last step.
    """

    def one(rows: Transition) -> tuple[Array, Array]:
        last = beliefs.value(rows.next_obs[-1])
        return jax.vmap(beliefs.value)(rows.obs), value.discounted_returns(rows.reward, rows.discount, last)

    return jax.vmap(one)(rollouts.transitions)


def surprises(beliefs: Beliefs, rows: Transition) -> Array:
    """[n] r + gamma V_sim(s') - V_sim(s) of steps [n]."""
    values = jax.vmap(beliefs.value)
    return rows.reward + rows.discount * values(rows.next_obs) - values(rows.obs)


def guidance(best: np.ndarray, margin: float) -> dict[str, float]:
    """Shares of states by what the best action does, [n] as `headroom` says.

    improvable: it keeps what V_sim promises, Definition 1 but for `margin`. improving: it exceeds that by the margin.
    """
    return {"improvable": float((best >= -margin).mean()), "improving": float((best > margin).mean())}


def honesty(real: tuple[np.ndarray, ...], simulated: tuple[np.ndarray, ...]) -> dict[str, float]:
    """V_sim against returns, each (values, returns, valid) [n, T] of real and of simulated rollouts.

    bias: mean of V_sim minus return. rank_correlation: Spearman's over visited states, 0 where one of them is
    constant. shortfall: by how much more a real rollout falls short of V_sim than a simulated one, in standard
    deviations over simulated rollouts.
    """
    promised, earned = (x[real[2]] for x in real[:2])
    fall, usual = (_by_rollout(*rollouts) for rollouts in (real, simulated))
    return {
        "bias": float((promised - earned).mean()),
        "rank_correlation": float(rank_correlation(np.stack([promised, earned], axis=1))),
        "shortfall": float((fall.mean() - usual.mean()) / max(usual.std(), 1e-9)),
    }


def _by_rollout(values: np.ndarray, returns: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """[n] mean of V_sim minus return over the valid steps of each rollout that has any."""
    counts = valid.sum(axis=1)
    return (np.where(valid, values - returns, 0.0).sum(axis=1) / np.maximum(counts, 1))[counts > 0]


# --- models -----------------------------------------------------------------------------------------------------------


def model_errors(beliefs: Beliefs, rollouts: Rollouts) -> tuple[Array, Array]:
    """Errors [n, windows, HORIZONS] of open-loop predictions, and which windows [n, windows] lie within an episode."""
    longest, length = HORIZONS[-1], rollouts.valid.shape[1]
    starts = jnp.arange(0, max(length - longest, 0) + 1, longest)
    steps = min(longest, length)

    def window(rows: Transition, start: Array) -> Array:
        cut = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, steps), rows)
        errors = beliefs.drift(jnp.concatenate([cut.obs[:1], cut.next_obs]), cut.action)
        return errors[jnp.minimum(jnp.array(HORIZONS), steps) - 1]

    def one(rows: Transition) -> Array:
        return jax.vmap(window, (None, 0))(rows, starts)

    return jax.vmap(one)(rollouts.transitions), rollouts.valid[:, starts + steps - 1]


# --- what differs -----------------------------------------------------------------------------------------------------


def parts(known: Distortion, *, turns: bool) -> dict[str, Any]:
    """The numbers behind a distortion: scale [act_dim], rotation (rad), bias [act_dim], sensor_errors [measured_dim].

    turns: whether the first two actions may be rotated.
    """
    matrix = np.asarray(known.matrix, np.float64)
    return {
        "scale": np.linalg.norm(matrix, axis=1).tolist(),
        "rotation": float(np.arctan2(-matrix[0, 1], matrix[0, 0])) if turns else 0.0,
        "bias": np.asarray(known.bias, np.float64).tolist(),
        "sensor_errors": np.asarray(known.offset, np.float64).tolist(),
    }


def evidence(without: Array, explained: Array, held: Array, spread: Array) -> Array:
    """[] nats by which residuals are likelier after an explanation than without it, under Student's t.

    without, explained: residuals [n, k]. held: [n] bool. spread: [k] their least std.
    """
    scale = jnp.maximum(robust_std(explained, held), spread)
    return student_cost(without, held, scale) - student_cost(explained, held, scale)


class Lateness(NamedTuple):
    """share: [] of a control period for which the previous command seems to stay in force. nats: [] by which it
    explains the steps better than the usual share.
    """

    share: Array
    nats: Array


def lateness(
    change: Callable[[Array, Array], Array], rollouts: Rollouts, spread: Array, usual: Array | float = 0.0
) -> Lateness:
    """Whether the previous action explains what a step changes better than the current one.

    The effective action is taken to be (1 - share) times the current and share times the previous one. Below 0: less
    late than the models expect. Steps without a predecessor do not count.

    change(obs, action) -> [k]. rollouts: with the simulator's actions. spread: [k], see `evidence`. usual: [] the share
        in simulation, which is not 0 for models that have learned from late actuators.
    """
    rows, valid = rollouts.transitions, rollouts.valid
    later = Rollouts(jax.tree.map(lambda x: x[:, 1:], rows), valid[:, 1:] & valid[:, :-1], rollouts.success)
    (now, held), before = later.flat(), rows.action[:, :-1].reshape(-1, rows.action.shape[-1])
    nothing = none(now.action.shape[-1], now.obs.shape[-1])

    def missed(share: Array) -> Array:
        return residuals(change, now._replace(action=now.action + share * (before - now.action)), nothing)

    shares, best = jnp.asarray(SHARES, jnp.float32), jnp.asarray(usual, jnp.float32)
    start = missed(best)
    for _ in range(2):  # the scale is that of the best share, and the other way round
        scale = jnp.maximum(robust_std(missed(best), held), spread)
        cost = functools.partial(student_cost, held=held, scale=scale)
        best = shares[jnp.argmin(jax.lax.map(lambda share, cost=cost: cost(missed(share)), shares))]
    return Lateness(best, evidence(start, missed(best), held, spread))


def noise(expected: np.ndarray, change: np.ndarray) -> np.ndarray:
    """[k] std of the noise of each sensor, from the steps that move it least.

    It is the rms of what the model leaves unexplained there, without the largest twentieth, corrected for that as if
    the rest were Gaussian. Sensors that are noisy now and then count by their share.

    expected: [n, k] what the model predicts. change: [n, k] what was measured, with the noise of two measurements.
    """
    still = np.abs(expected) <= np.quantile(np.abs(expected), _STILL, axis=0)
    squares = np.where(still, np.square(change - expected), np.nan)
    kept = np.where(squares <= np.nanquantile(squares, 1.0 - _LARGEST, axis=0), squares, np.nan)
    return np.sqrt(np.nanmean(kept, axis=0) / 2.0) / _KEPT_STD
