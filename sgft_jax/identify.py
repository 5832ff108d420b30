"""How a real system takes commands, fitted to its rollouts while it is learned: scale, rotation and bias of actions.

A learner behind a correction acts in the simulator's actions: it asks for a move, and the correction commands what
makes the real system move so.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sgft_jax.models import action_map
from sgft_jax.models.action_map import ActionMap, Correction
from sgft_jax.types import Array, Batch, SimulatedData, Task, Transition, UserError

_SIMULATED = 2048  # rows that tell the simulator's own map
_ROWS = 1024  # of the real system that are fitted, some 25 rollouts; more of them add little
_EVIDENCE = 20.0  # nats by which a distortion must explain the rows better than none; neighbouring steps are alike


class Identified(NamedTuple):
    """sim, real: how either system moves. spread: [k] std of what `sim` leaves unexplained in simulation.

    correction: the command for an action; it changes nothing until data say so.
    """

    sim: ActionMap
    real: ActionMap
    spread: Array
    correction: Correction


def place_of(task: Task) -> np.ndarray:
    """[k] which numbers of the observation actions move; raises UserError for a task where no entry says so."""
    if task.end_effector is None:
        raise UserError("identify: needs Cartesian actions `x_step`, which move what the observation's `x` measures")
    return np.array(task.end_effector)


def begin(simulated: SimulatedData, place: np.ndarray) -> Identified:
    """The real system taken for the simulated one. place: [k] numbers of the observation that actions move."""
    rows = simulated.draw(jax.random.key(0), _SIMULATED)
    moves = (rows.next_obs - rows.obs)[:, place]
    sim = action_map.action_map(moves, rows.action, jnp.ones(_SIMULATED, bool))
    spread = 1.48 * jnp.median(jnp.abs(moves - jax.vmap(sim.move)(rows.action)), axis=0)
    least = 0.01 * jnp.abs(moves).max()
    return Identified(sim, sim, jnp.maximum(spread, least), action_map.no_correction(rows.action.shape[-1]))


def refit(known: Identified, rows: Transition, held: Array, place: np.ndarray) -> Identified:
    """The same after more real rows [n], of which `held` [n] bool are there; their actions are commands."""
    rows, held = jax.tree.map(lambda x: x[:_ROWS], (rows, held))
    moves = (rows.next_obs - rows.obs)[:, place]
    found, evidence = action_map.distortion(moves, rows.action, held, known.sim, known.spread)
    real = found.seen_by(known.sim)
    new = known._replace(real=real, correction=action_map.correction(real, known.sim))
    old = known._replace(real=known.sim, correction=action_map.no_correction(rows.action.shape[-1]))
    return jax.tree.map(lambda a, b: jnp.where(evidence > _EVIDENCE, a, b), new, old)


def in_actions_of_the_simulator(known: Identified, batch: Batch, previous_actions: int) -> Batch:
    """Rows whose real commands are replaced by the actions that they stand for."""
    seen = jax.vmap(lambda obs: known.correction.undo_in(obs, previous_actions))
    meant = batch._replace(
        action=jax.vmap(known.correction.undo)(batch.action), obs=seen(batch.obs), next_obs=seen(batch.next_obs)
    )
    if (simulated := batch.is_sim) is None:
        return meant
    return jax.tree.map(lambda a, b: jnp.where(simulated.reshape(-1, *[1] * (a.ndim - 1)), a, b), batch, meant)
