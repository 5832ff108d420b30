"""Which policy to deploy: each candidate plays simulated episodes of the systems that may be the real one. Pure.

Candidates are the prior as it is, and the prior behind what undoes a particle's errors of commands and sensors, or
behind corrections that come from elsewhere.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Env, World
from envs.rollout import Episode, play_episode
from envs.types import Array, Key, Policy, PyTree
from sgft_jax.models.distortion import Distortion, none, turned_and_scaled
from sgft_jax.posterior.candidates import Candidates, Unknown, values
from sgft_jax.stacking import join, member, stack

_FINALISTS = 4
_CLEARLY = 2.0  # standard errors of the difference by which a candidate beats the prior as it is
_LEAST = 0.02  # and at least so much

CANDIDATES, JUDGES = 16, 32  # points of the posterior whose corrections are tried, and in which they are tried
_EPISODES = 2  # that a finalist plays in each

Trial = Callable[[PyTree, World, Key], Array]  # (what acts, a world, key) -> [] bool, success of an episode there


class Decision(NamedTuple):
    """chosen: [] number of the candidate to deploy, 0 for the prior as it is. expected: [F] success of the finalists
    over particles, the prior's first. promised: [] of the chosen one.
    """

    chosen: Array
    expected: Array
    promised: Array


def correction(env: Env, unknowns: tuple[Unknown, ...], point: Array) -> Distortion:
    """What undoes the errors of commands and sensors of the system at a point [d]."""
    numbers, undo = values(unknowns, point), none(env.act_dim, env.measured_dim)
    rotation, log_scale = jnp.zeros(()), jnp.zeros(env.act_dim)
    for i, unknown in enumerate(unknowns):
        if unknown.name == "action_rotation":
            rotation = numbers[i]
        elif unknown.name == "action_scale":
            log_scale = log_scale.at[unknown.index].set(jnp.log(numbers[i]))
        elif unknown.name == "action_bias":
            undo = undo._replace(bias=undo.bias.at[unknown.index].set(numbers[i]))
        elif unknown.name == "obs_bias":
            undo = undo._replace(offset=undo.offset.at[unknown.index].set(numbers[i]))
    return turned_and_scaled(rotation, log_scale, undo.bias, undo.offset)


def play(env: Env, policy: Policy, params: PyTree, world: World, key: Key, *, explore: bool | Array = False) -> Episode:
    """An episode of a policy in a simulated world."""
    act = functools.partial(policy.act, params, explore=explore)
    return play_episode(env, jax.tree.map(lambda x: x[None], world), act, policy.init_carry(), key, gamma=1.0)


def choose(
    env: Env, candidates: Candidates, policy: Policy, params: PyTree, points: Array, key: Key, *others: Distortion
) -> tuple[Distortion, Array]:
    """Behind which correction to deploy a policy, and the success to expect of it as it is, behind that, and behind
    each of the others [2 + len(others)], by points [CANDIDATES + JUDGES, d] of a posterior.

    params: what the policy acts by, with a distortion that is replaced. others: corrections that are candidates too.
    """
    undo = jax.vmap(lambda point: correction(env, candidates.unknowns, point))(points[:CANDIDATES])
    acting = join([stack([none(env.act_dim, env.measured_dim), *others]), undo])

    def success(distortion: Distortion, world: World, key: Key) -> Array:
        return play(env, policy, params._replace(distortion=distortion), world, key).success

    known = 1 + len(others)
    decision = decide(success, acting, candidates, points[CANDIDATES:], key, episodes=_EPISODES, known=known)
    promised = jnp.concatenate([decision.expected[:1], decision.promised[None], decision.expected[1:known]])
    return member(acting, decision.chosen), promised


def decide(
    trial: Trial, acting: PyTree, candidates: Candidates, particles: Array, key: Key, *, episodes: int, known: int = 1
) -> Decision:
    """The candidate of the highest expected success; the prior as it is unless another is clearly better.

    acting: [J] candidates, the prior as it is first. particles: [I, d]. Everyone plays one episode in each particle;
    the first `known` and the best of the others go on with `episodes` fresh ones, by which they are judged, so that
    luck is not promised. All play the same episodes: their differences are paired.
    """
    key_first, key_final = jax.random.split(key)
    first = _table(trial, acting, candidates, particles, key_first, episodes=1)
    best = known + jax.lax.top_k(first[known:].mean(axis=1), min(_FINALISTS, len(first) - known))[1]
    finalists = jnp.concatenate([jnp.arange(known, dtype=best.dtype), best])
    table = _table(trial, member(acting, finalists), candidates, particles, key_final, episodes=episodes)
    gains = table - table[:1]
    error = gains.std(axis=1) / np.sqrt(len(particles))
    clear = gains.mean(axis=1) > jnp.maximum(_CLEARLY * error, _LEAST)
    expected = table.mean(axis=1)
    winner = jnp.argmax(jnp.where(clear, expected, -1.0).at[0].set(expected[0]))
    return Decision(finalists[winner], expected, expected[winner])


def _table(trial: Trial, acting: PyTree, candidates: Candidates, particles: Array, key: Key, *, episodes: int) -> Array:
    """[J, I] success of each candidate in each particle."""
    keys = jax.random.split(key, (len(particles), episodes))

    def of_particle(acts: PyTree, point: Array, keys: Key) -> Array:
        def episode(key: Key) -> Array:
            key_world, key_play = jax.random.split(key)
            return trial(acts, candidates.episode(point, key_world), key_play)

        return jax.vmap(episode)(keys).mean()

    return jax.vmap(jax.vmap(of_particle, (None, 0, 0)), (0, None, None))(acting, particles, keys)
