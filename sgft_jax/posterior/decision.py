"""Which policy to deploy: each candidate plays simulated episodes of the systems that may be the real one. Pure.

Candidates are the prior as it is, and the prior behind what undoes a particle's errors of commands and sensors.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Env, World
from envs.types import Array, Key, PyTree
from sgft_jax.models.distortion import Distortion, none, turned_and_scaled
from sgft_jax.posterior.candidates import Candidates, Unknown, values

_CLEARLY = 2.0  # standard errors of the difference by which a candidate beats the prior as it is
_LEAST = 0.02  # and at least so much

Play = Callable[[PyTree, World, Key], Array]  # (what acts, a world, key) -> [] bool, success of an episode there


class Decision(NamedTuple):
    """chosen: [] number of the candidate to deploy, 0 for the prior as it is. table: [J, I] expected success of each
    candidate in each particle. promised: [] mean of the chosen one over particles.
    """

    chosen: Array
    table: Array
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


def decide(
    play: Play, acting: PyTree, candidates: Candidates, particles: Array, key: Key, *, episodes: int
) -> Decision:
    """The candidate of the highest expected success; the prior as it is unless another is clearly better.

    acting: [J] candidates, the prior as it is first. particles: [I, d]. All candidates play the same episodes, so that
    their differences are paired.
    """
    keys = jax.random.split(key, (len(particles), episodes))

    def of_particle(acts: PyTree, point: Array, keys: Key) -> Array:
        def episode(key: Key) -> Array:
            key_world, key_play = jax.random.split(key)
            return play(acts, candidates.episode(point, key_world), key_play)

        return jax.vmap(episode)(keys).mean()

    table = jax.vmap(jax.vmap(of_particle, (None, 0, 0)), (0, None, None))(acting, particles, keys)
    gains = table - table[:1]
    error = gains.std(axis=1) / np.sqrt(len(particles))
    clear = gains.mean(axis=1) > jnp.maximum(_CLEARLY * error, _LEAST)
    chosen = jnp.argmax(jnp.where(clear, table.mean(axis=1), -1.0).at[0].set(table[0].mean()))
    return Decision(chosen, table, table[chosen].mean())
