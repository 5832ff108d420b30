"""What a real system makes of commands, fitted to real steps through a model of the simulator. Pure."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from sgft_jax.types import Array, Transition

_TURN, _SCALE, _BIAS = 0.6, 0.4, 0.2  # std of the rotation (rad), log-scales and biases before any data
_STARTS = (-1.4, -0.7, 0.0, 0.7, 1.4)  # rad; from elsewhere the search may end in another turn
_DEGREES = 3.0  # of freedom of Student's t: no model is right about every step


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


def robust_std(values: Array, held: Array) -> Array:
    """[k] 1.48 times the median size of values [n, k] over the rows `held` [n]; 0 where there is none."""
    sizes = jnp.where(held[:, None], jnp.abs(values), jnp.nan)
    return jnp.nan_to_num(1.48 * jnp.nanmedian(sizes, axis=0))


def fit(
    predict: Predict, rows: Transition, held: Array, spread: Array, *, turns: bool, previous_actions: int = 0
) -> tuple[Distortion, Array]:
    """The most probable distortion, and how much better than none it explains the rows, nats [].

    Scales, biases and a rotation are few enough for one rollout with one-sided actions, where a free matrix is not
    determined. The model knows about contacts and limits, so steps that hit something need no special care. Residuals
    have Student's t distribution; its scale is fitted along.

    predict: the simulator's model. rows: [n], with actions that are commands. held: [n] bool, which of them count.
    spread: [k] std of the model's own residuals in simulation, the least that real ones have. turns: the first two
    actions are x and y of a frame that may be rotated. previous_actions: with which observations end.
    """
    act_dim = rows.action.shape[-1]
    belief = jnp.concatenate([jnp.array([_TURN if turns else 1e-4]), *(jnp.full(act_dim, x) for x in (_SCALE, _BIAS))])
    weight_of = lambda square: (_DEGREES + spread.shape[0]) / (_DEGREES + square)  # noqa: E731

    def described(p: Array) -> Distortion:
        return turned_and_scaled(p[0], p[1 : 1 + act_dim], p[1 + act_dim :])

    def missed(p: Array) -> Array:
        return jnp.where(held[:, None], residuals(predict, rows, described(p), previous_actions), 0.0)

    def cost(p: Array, scale: Array) -> Array:
        square = jnp.sum((missed(p) / scale[None]) ** 2, axis=1)
        each = 0.5 * (_DEGREES + spread.shape[0]) * jnp.log1p(square / _DEGREES)
        return jnp.sum(jnp.where(held, each, 0.0)) + 0.5 * jnp.sum((p / belief) ** 2)

    def step(p: Array, scale: Array) -> Array:
        """Of Gauss and Newton, with the weights that make least squares Student's t."""
        residual, slope = missed(p) / scale[None], jax.jacfwd(missed)(p) / scale[None, :, None]
        heavy = weight_of(jnp.sum(residual**2, axis=1))[:, None, None] * slope
        with jax.default_matmul_precision("highest"):
            curvature = jnp.einsum("tki,tkj->ij", heavy, slope) + jnp.diag(belief**-2)
            downhill = -jnp.einsum("tki,tk->i", heavy, residual) - p * belief**-2
            return p + jnp.clip(jnp.linalg.solve(curvature, downhill), -0.3, 0.3)

    def search(p: Array, scale: Array) -> Array:
        return jax.lax.fori_loop(0, 8, lambda _, p: step(p, scale), p)

    starts = jnp.zeros((len(_STARTS) if turns else 1, 1 + 2 * act_dim))
    starts = starts.at[:, 0].set(jnp.array(_STARTS)) if turns else starts
    change = (rows.next_obs - rows.obs)[:, : spread.shape[0]]
    scale = jnp.maximum(0.3 * robust_std(change, held), spread)
    found = jax.vmap(search, (0, None))(starts, scale)
    best = found[jnp.argmin(jax.vmap(cost, (0, None))(found, scale))]
    for _ in range(2):
        scale = jnp.maximum(robust_std(missed(best), held), spread)
        best = search(best, scale)
    return described(best), cost(jnp.zeros_like(best), scale) - cost(best, scale)
