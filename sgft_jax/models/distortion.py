"""What a real system makes of commands, fitted to real steps through a model of the simulator. Pure."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sgft_jax.models.robust import most_probable
from sgft_jax.types import Array, Transition

_TURN, _SCALE, _BIAS = 0.6, 0.4, 0.2  # std of the rotation (rad), log-scales and biases before any data
_STARTS = (-1.4, -0.7, 0.0, 0.7, 1.4)  # rad; from elsewhere the search may end in another turn


class Distortion(NamedTuple):
    """A real system that gets a command acts as the simulated one would on the action `matrix @ command + bias`.

    matrix: [act_dim, act_dim]. bias: [act_dim].
    """

    matrix: Array
    bias: Array

    def meaning(self, command: Array) -> Array:
        """The action [act_dim] that a command stands for; it may exceed [-1, 1]."""
        # Less precise products of a GPU would round commands that nothing distorts.
        return jnp.dot(self.matrix, command, precision="highest") + self.bias

    def command(self, action: Array) -> Array:
        """The command [act_dim] in [-1, 1] that comes closest to standing for an action."""
        with jax.default_matmul_precision("highest"):
            return jnp.clip(jnp.linalg.inv(self.matrix) @ (action - self.bias), -1.0, 1.0)

    def meaning_in(self, obs: Array, previous_actions: int) -> Array:
        """An observation [obs_dim] that ends with so many commands, with the actions that they stand for."""
        if previous_actions == 0:
            return obs
        act_dim = self.bias.shape[0]
        measured, commands = jnp.split(obs, [obs.shape[0] - previous_actions * act_dim])
        return jnp.concatenate([measured, jax.vmap(self.meaning)(commands.reshape(-1, act_dim)).ravel()])


def none(act_dim: int) -> Distortion:
    """Commands are taken as they are meant."""
    return Distortion(jnp.eye(act_dim), jnp.zeros(act_dim))


def turned_and_scaled(rotation: Array, log_scale: Array, bias: Array) -> Distortion:
    """Rotated in the xy plane, then scaled, then offset, as `envs.effects.distort`.

    rotation: [] rad. log_scale, bias: [act_dim].
    """
    matrix = jnp.eye(bias.shape[0])
    if bias.shape[0] > 1:
        c, s = jnp.cos(rotation), jnp.sin(rotation)
        matrix = matrix.at[:2, :2].set(jnp.array([[c, -s], [s, c]]))
    return Distortion(jnp.exp(log_scale)[:, None] * matrix, bias)


Predict = Callable[[Array, Array], Array]  # (obs [obs_dim], action [act_dim]) -> [k] what a step changes, raw units


def residuals(predict: Predict, rows: Transition, distortion: Distortion, previous_actions: int) -> Array:
    """[n, k] what the model leaves unexplained of real steps [n], if that is what commands mean."""

    def one(row: Transition) -> Array:
        change = predict(distortion.meaning_in(row.obs, previous_actions), distortion.meaning(row.action))
        return row.next_obs[: change.shape[0]] - row.obs[: change.shape[0]] - change

    return jax.vmap(one)(rows)


def fit(
    predict: Predict, rows: Transition, held: Array, spread: Array, *, turns: bool, previous_actions: int = 0
) -> tuple[Distortion, Array]:
    """The most probable distortion, and how much better than none it explains the rows, nats [].

    Scales, biases and a rotation are few enough for one rollout with one-sided actions, where a free matrix is not
    determined. The model knows about contacts and limits, so steps that hit something need no special care.

    predict: the simulator's model. rows: [n], with actions that are commands. held: [n] bool, which of them count.
    spread: [k] std of the model's own residuals in simulation, the least that real ones have. turns: the first two
    actions are x and y of a frame that may be rotated. previous_actions: with which observations end.
    """
    act_dim = rows.action.shape[-1]
    belief = jnp.concatenate([jnp.array([_TURN if turns else 1e-4]), *(jnp.full(act_dim, x) for x in (_SCALE, _BIAS))])

    def described(p: Array) -> Distortion:
        return turned_and_scaled(p[0], p[1 : 1 + act_dim], p[1 + act_dim :])

    def missed(p: Array) -> Array:
        return residuals(predict, rows, described(p), previous_actions)

    starts = jnp.zeros((len(_STARTS) if turns else 1, 1 + 2 * act_dim))
    starts = starts.at[:, 0].set(jnp.array(_STARTS)) if turns else starts
    change = (rows.next_obs - rows.obs)[:, : spread.shape[0]]
    found = most_probable(missed, starts, belief, change, held, spread)
    return described(found.point), found.evidence
