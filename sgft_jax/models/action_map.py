"""How commands move the end effector, fitted to a few rollouts, and the commands that undo a difference. Pure."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from sgft_jax.types import Array


class ActionMap(NamedTuple):
    """A control step moves the end effector by `matrix @ action + offset`.

    matrix: [k, act_dim], offset: [k], in units of the observation.
    """

    matrix: Array
    offset: Array

    def move(self, action: Array) -> Array:
        """How far [k] an action [act_dim] moves it."""
        return jnp.dot(self.matrix, action, precision="highest") + self.offset


class Correction(NamedTuple):
    """The command `clip(matrix @ action + offset, -1, 1)` in place of an action. matrix: [act_dim, act_dim]."""

    matrix: Array
    offset: Array

    def apply(self, action: Array) -> Array:
        """The command [act_dim] for an action [act_dim]."""
        # Less precise products of a GPU would round actions that nothing corrects.
        return jnp.clip(jnp.dot(self.matrix, action, precision="highest") + self.offset, -1.0, 1.0)


def action_map(
    moves: Array, actions: Array, valid: Array, *, around: ActionMap | None = None, ridge: float = 0.1
) -> ActionMap:
    """The map that explains steps best, by ridge least squares.

    Steps that hit something, or the end of the workspace, tell nothing of commands: rows that a fit misses by more than
    three times the median are left out of the next one, three times.

    moves: [T, k], how far each step moved the end effector. actions: [T, act_dim]. valid: [T] bool, which rows count.
    around: the map to believe in where the rows say nothing; default: that nothing moves. ridge: how much, in rows of
        one unit of action in every direction.
    """
    still = ActionMap(jnp.zeros((moves.shape[1], actions.shape[1])), jnp.zeros(moves.shape[1]))
    known, slack = still if around is None else around, 1e-3 * jnp.abs(moves).max()
    found = _least_squares(moves, actions, valid, known, ridge)
    for _ in range(3):
        missed = jnp.linalg.norm(moves - jax.vmap(found.move)(actions), axis=1)
        kept = valid & (missed <= 3 * jnp.nanmedian(jnp.where(valid, missed, jnp.nan)) + slack)
        found = _least_squares(moves, actions, kept, known, ridge)
    return found


def _least_squares(moves: Array, actions: Array, kept: Array, known: ActionMap, ridge: float) -> ActionMap:
    columns = jnp.where(kept[:, None], jnp.concatenate([actions, jnp.ones_like(actions[:, :1])], axis=1), 0.0)
    with jax.default_matmul_precision("highest"):
        gram = columns.T @ columns + ridge * jnp.eye(columns.shape[1])
        change = jnp.linalg.solve(gram, columns.T @ (moves - jax.vmap(known.move)(actions))).T
    return ActionMap(known.matrix + change[:, :-1], known.offset + change[:, -1])


def correction(real: ActionMap, sim: ActionMap) -> Correction:
    """The command that moves the real system as the action moves the simulated one, as far as it can."""
    with jax.default_matmul_precision("highest"):
        inverse = jnp.linalg.pinv(real.matrix, rtol=1e-2)
        return Correction(inverse @ sim.matrix, inverse @ (sim.offset - real.offset))


def meaning(real: ActionMap, sim: ActionMap, command: Array) -> Array:
    """The action [act_dim] that moves the simulated system as `command` moves the real one; it may exceed [-1, 1]."""
    with jax.default_matmul_precision("highest"):
        inverse = jnp.linalg.pinv(sim.matrix, rtol=1e-2)
        return inverse @ (real.move(command) - sim.offset)


def no_correction(act_dim: int) -> Correction:
    """What changes no action."""
    return Correction(jnp.eye(act_dim), jnp.zeros(act_dim))
