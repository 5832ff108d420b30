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

    def undo(self, command: Array) -> Array:
        """The action [act_dim] that a command stands for; it may exceed [-1, 1]."""
        with jax.default_matmul_precision("highest"):
            return jnp.linalg.pinv(self.matrix) @ (command - self.offset)

    def undo_in(self, obs: Array, previous_actions: int) -> Array:
        """An observation [obs_dim] that ends with so many commands, with the actions that they stand for."""
        if previous_actions == 0:
            return obs
        act_dim = self.offset.shape[0]
        measured, commands = jnp.split(obs, [obs.shape[0] - previous_actions * act_dim])
        return jnp.concatenate([measured, jax.vmap(self.undo)(commands.reshape(-1, act_dim)).ravel()])


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


class Distortion(NamedTuple):
    """How a real system takes an action: rotated in the xy plane, scaled, then offset; see `envs.base.Effects`.

    rotation: [] rad. log_scale, bias: [act_dim].
    """

    rotation: Array
    log_scale: Array
    bias: Array

    def seen_by(self, sim: ActionMap) -> ActionMap:
        """The map of a system that is the simulated one behind this distortion."""
        c, s = jnp.cos(self.rotation), jnp.sin(self.rotation)
        turn = jnp.eye(len(self.bias)).at[:2, :2].set(jnp.array([[c, -s], [s, c]]))
        with jax.default_matmul_precision("highest"):
            matrix = sim.matrix @ (jnp.exp(self.log_scale)[:, None] * turn)
            return ActionMap(matrix, sim.offset + sim.matrix @ self.bias)


_BELIEF = Distortion(jnp.float32(0.6), jnp.float32(0.4), jnp.float32(0.2))  # std of each before any data
_STARTS = (-1.4, -0.7, 0.0, 0.7, 1.4)  # rad; from elsewhere the search may end in another turn
_DEGREES = 3.0  # of freedom of Student's t: steps that hit something say little of commands


def distortion(moves: Array, actions: Array, valid: Array, sim: ActionMap, spread: Array) -> tuple[Distortion, Array]:
    """The most probable distortion [..] and how much better than none it explains the rows, nats [].

    With few and one-sided actions a free matrix is not determined; five or seven numbers, around none, are. Residuals
    have Student's t distribution, whose scale is fitted along.

    moves, actions, valid: as for `action_map`. sim: how the simulated system moves. spread: [k] std of what it leaves
    unexplained in simulation, the least that a real system leaves.
    """
    act_dim = actions.shape[1]
    belief = jnp.concatenate([jnp.full(n, std) for n, std in zip((1, act_dim, act_dim), _BELIEF, strict=True)])
    unpack = lambda p: Distortion(p[0], p[1 : 1 + act_dim], p[1 + act_dim :])  # noqa: E731

    def missed(p: Array) -> Array:
        return jnp.where(valid[:, None], moves - jax.vmap(unpack(p).seen_by(sim).move)(actions), 0.0)

    def cost(p: Array, scale: Array) -> Array:
        square = jnp.sum((missed(p) / scale) ** 2, axis=1)
        each = 0.5 * (_DEGREES + moves.shape[1]) * jnp.log1p(square / _DEGREES)
        return jnp.sum(jnp.where(valid, each, 0.0)) + 0.5 * jnp.sum((p / belief) ** 2)

    def step(p: Array, scale: Array) -> Array:
        residual, slope = missed(p) / scale, jax.jacfwd(missed)(p) / scale[:, None]
        weight = (_DEGREES + moves.shape[1]) / (_DEGREES + jnp.sum(residual**2, axis=1))
        with jax.default_matmul_precision("highest"):
            heavy = weight[:, None, None] * slope
            curvature = jnp.einsum("tki,tkj->ij", heavy, slope) + jnp.diag(belief**-2)
            downhill = -jnp.einsum("tki,tk->i", heavy, residual) - p * belief**-2
            return p + jnp.clip(jnp.linalg.solve(curvature, downhill), -0.3, 0.3)

    def search(p: Array, scale: Array) -> Array:
        return jax.lax.fori_loop(0, 15, lambda _, p: step(p, scale), p)

    typical = lambda x: 1.48 * jnp.nanmedian(jnp.where(valid[:, None], jnp.abs(x), jnp.nan), axis=0)  # noqa: E731
    starts = jnp.zeros((len(_STARTS), 1 + 2 * act_dim)).at[:, 0].set(jnp.array(_STARTS))
    scale = jnp.maximum(0.3 * jnp.nan_to_num(typical(moves)), spread)
    found = jax.vmap(search, (0, None))(starts, scale)
    best = found[jnp.argmin(jax.vmap(cost, (0, None))(found, scale))]
    for _ in range(2):
        scale = jnp.maximum(jnp.nan_to_num(typical(missed(best))), spread)
        best = search(best, scale)
    return unpack(best), cost(jnp.zeros_like(best), scale) - cost(best, scale)


def correction(real: ActionMap, sim: ActionMap) -> Correction:
    """The command that moves the real system as the action moves the simulated one, as far as it can."""
    with jax.default_matmul_precision("highest"):
        inverse = jnp.linalg.pinv(real.matrix, rtol=1e-2)
        return Correction(inverse @ sim.matrix, inverse @ (sim.offset - real.offset))


def no_correction(act_dim: int) -> Correction:
    """What changes no action."""
    return Correction(jnp.eye(act_dim), jnp.zeros(act_dim))
