"""What a prior is worth to fine-tuning: V_sim against returns, the model against trajectories."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Env, Theta, Varying, World
from envs.mesh import split_vmap, whole
from envs.rollout import Episode, play_episode
from envs.types import Array, Key, Policy, PyTree
from sgft_jax.models import value
from sgft_jax.train.fleet import over_members
from sgft_jax.train.value_fit import Held, hold, replays

HORIZON = 10  # steps ahead that the model is judged at: twice the longest branches worth imagining
_WORLDS = 16  # in which the policy plays on from the same observation


class Report(NamedTuple):
    """Open-loop errors of one prior's model.

    model_error, still_error: [horizon] RMS error, in standard deviations of the observation, of the model's open-loop
    prediction 1, 2, ... steps ahead, and of predicting that nothing changes.
    """

    model_error: Array
    still_error: Array


def make_report(
    env: Env, policy: Policy, pool: World, prior: PyTree, key: Key, *, gamma: float, trajectories: int
) -> Report:
    """Measures one prior on that many fresh trajectories of its exploring policy in the worlds it has learned in."""
    act = functools.partial(policy.act, prior, explore=True)
    play = functools.partial(play_episode, env, pool, act, policy.init_carry(), gamma=gamma)
    played = split_vmap(play)(jax.random.split(key, trajectories))
    errors, windows = jax.vmap(lambda e: _model_errors(env, policy, prior, e))(played)
    weight = windows * ~played.exploded[:, None]
    model, still = (jnp.einsum("nw,nwh->h", weight, x) / jnp.maximum(weight.sum(), 1.0) for x in errors)
    return whole(Report(model, still))


def numbers(report: Report) -> dict[str, Any]:
    """A report (NumPy arrays) as JSON data: what stands in summary.json and on the card."""
    if not report.model_error.size:
        return {}
    return {
        "dynamics/error": report.model_error.tolist(),
        "dynamics/error_if_nothing_moved": report.still_error.tolist(),
    }


# --- V_sim ------------------------------------------------------------------------------------------------------------


class Judges(NamedTuple):
    """What measures V_sim of M members, jitted; see `hold` and `replays` in `sgft_jax.train.value_fit`.

    hold(pools [M, W], params [M, ...], keys [M]). replays(worlds [M, n, w], params, obs [M, n, obs_dim], keys).
    system: what V_sim can be told.
    """

    hold: Any
    replays: Any
    system: tuple[Varying, ...]


def make_judges(
    env: Env, system: tuple[Varying, ...], policy: Policy, gamma: float, *, episodes: int, members: int
) -> Judges:
    """They compile when they are first called, or before. episodes: fresh ones of each member."""
    holds = functools.partial(hold, env, system, policy, gamma, episodes)
    again = functools.partial(replays, env, policy, gamma)
    return Judges(jax.jit(over_members(holds, members)), jax.jit(over_members(again, members)), system)


def value_numbers(judges: Judges, env: Env, held: Held, pool: World, params: PyTree, key: Key, states: int) -> Any:
    """The numbers of one member's V_sim as JSON data. held: of it, NumPy arrays. pool: [W], its worlds. params: its.

    states: how many of these states are played again, in 16 worlds each; 0 leaves out what that tells.
    """
    intact = np.flatnonzero(held.intact)
    if not intact.size:
        return {}
    judged = {}
    for prefix, values in (("off_path_", held.value), *([("system_", held.told)] if judges.system else [])):
        quality = value.report(values[intact], held.returns[intact])
        judged |= {name.replace("value/", f"value/{prefix}"): x for name, x in quality.items()}
    if not states:
        return judged
    which = intact[:states]
    key_worlds, key_effects, key_rest = jax.random.split(key, 3)
    worlds = alike(env, pool, np.asarray(held.world)[which], held.obs[which[0]], key_worlds)
    size = len(which), _WORLDS + 1
    effects = jax.random.split(key_effects, size)
    keys = jnp.stack([effects.at[:, 0].set(effects[:, 1]), jax.random.split(key_rest, size)], axis=-1)
    inputs = worlds, params, jnp.asarray(held.obs[which]), keys
    returns, fine = judges.replays(*jax.tree.map(lambda x: x[None], inputs))
    whole_rows = np.asarray(returns)[0][np.asarray(fine)[0].all(axis=1)]
    return judged | (value.explainable(whole_rows) if len(whole_rows) > 1 else {})


def alike(env: Env, pool: World, own: np.ndarray, obs: Array, key: Key) -> World:
    """Worlds [n, 17] that look alike: twice the world `own` [n] of a pool, then 15 others with its visible parameters.

    obs: [obs_dim] some observation.
    """
    others = np.asarray(jax.random.randint(key, (len(own), _WORLDS - 1), 0, pool.theta.params.shape[0]))
    which = np.concatenate([own[:, None], others], axis=1)
    theta = jax.tree.map(np.asarray, pool.theta)
    visible = np.broadcast_to(_visible(env, theta, obs), (*which.shape, theta.params.shape[1]))
    params = np.where(visible, np.broadcast_to(theta.params[own][:, None], visible.shape), theta.params[which])
    flat = Theta(
        jnp.asarray(params.reshape(which.size, -1)), jax.tree.map(lambda x: x[which.reshape(-1)], theta.effects)
    )
    worlds = jax.tree.map(lambda x: x.reshape(*which.shape, *x.shape[1:]), env.make_worlds(flat))
    return jax.tree.map(lambda x: jnp.concatenate([x[:, :1], x], axis=1), worlds)


def _visible(env: Env, theta: Theta, obs: Array) -> np.ndarray:
    """[n_params] bool: whether sensors show a parameter, such as where a hole is: with another no state reads `obs`."""
    restore, size = env.restore, theta.params.shape[1]
    assert restore is not None  # checked before
    params = np.tile(theta.params[0], (size + 1, 1))
    params[range(size), range(size)] = theta.params[-1]
    effects = jax.tree.map(lambda x: np.broadcast_to(x[0], (size + 1, *x.shape[1:])), theta.effects)
    worlds = env.make_worlds(Theta(jnp.asarray(params), effects))
    read = np.asarray(jax.vmap(lambda world: restore(world, jnp.asarray(obs), jax.random.key(0)).true_obs)(worlds))
    return (np.abs(read[:-1] - read[-1:]) > 1e-4 * (1 + np.abs(read[-1:]))).any(axis=1)


# --- models -----------------------------------------------------------------------------------------------------------


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
