"""Identification of how a real system changes commands (scale, rotation, bias) and measurements (constant errors).

It runs while another part learns. The learner sees the simulator's actions and measurements; this module translates.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array, PyTree, Transition
from sgft_jax.models import distortion, dynamics
from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.distortion import Distortion
from sgft_jax.models.networks import make_dynamics
from sgft_jax.models.robust import spread_of
from sgft_jax.types import Batch, Normalizer, SimulatedData, Task

_SIMULATED = 2048  # rows that tell how far the model is off in simulation
_ROWS = 320  # real ones that are fitted, the first 8 rollouts or so; more of them add little
_EVIDENCE = 20.0  # nats by which a distortion must explain them better than none; neighbouring steps are alike

Model = Callable[[PyTree, Array, Array], Array]  # (params, obs, action) -> [measured_dim] what a step changes


class Identified(NamedTuple):
    """params: of the simulator's model. spread: [measured_dim] std of its residuals in simulation, raw units.

    distortion: the identified changes; none at all until the evidence exceeds 20 nats.
    """

    params: PyTree
    spread: Array
    distortion: Distortion


class Interface(NamedTuple):
    """Identification as pure functions.

    start(params of a prior, simulated) -> Identified, from simulated rows alone.
    refit(identified, rows [n], held [n] bool) -> Identified, fitted to the rows that `held` marks.
    meant(identified, batch) -> the batch, its real rows translated into the simulator's actions and measurements.
    """

    start: Callable[[PyTree, SimulatedData], Identified]
    refit: Callable[[Identified, Transition, Array], Identified]
    meant: Callable[[Identified, Batch], Batch]


def interface(model: Model, kept: Callable[[PyTree], PyTree], task: Task) -> Interface:
    """Identification for a task. model(params, obs, action) -> [measured_dim]; kept(prior's params) -> its params."""

    def start(params: PyTree, simulated: SimulatedData) -> Identified:
        simulator, rows = jax.tree.map(jnp.copy, kept(params)), simulated.draw(jax.random.key(0), _SIMULATED)
        nothing, held = distortion.none(task.act_dim, task.measured_dim), jnp.ones(_SIMULATED, bool)
        missed = distortion.residuals(lambda *x: model(simulator, *x), rows, nothing)
        change = (rows.next_obs - rows.obs)[:, : missed.shape[1]]
        return Identified(simulator, spread_of(missed, change, held), nothing)

    def refit(known: Identified, rows: Transition, held: Array) -> Identified:
        rows, held = jax.tree.map(lambda x: x[:_ROWS], (rows, held))
        options = {"turns": task.cartesian, "errors": task.sensor_errors}
        fitted, evidence = distortion.fit(lambda *x: model(known.params, *x), rows, held, known.spread, **options)
        nothing = distortion.none(task.act_dim, task.measured_dim)
        return known._replace(
            distortion=jax.tree.map(lambda a, b: jnp.where(evidence > _EVIDENCE, a, b), fitted, nothing)
        )

    def meant(known: Identified, batch: Batch) -> Batch:
        new = distortion.undone(known.distortion, batch)
        if (simulated := batch.is_sim) is None:
            return new
        return jax.tree.map(lambda a, b: jnp.where(simulated.reshape(-1, *[1] * (a.ndim - 1)), a, b), batch, new)

    return Interface(start, refit, meant)


def command_interface(network: NetworkConfig, task: Task) -> Interface:
    """Identification through one model of the prior's ensemble, as the simulator left it."""
    model = make_dynamics(task.obs_dim, task.act_dim, network)

    def change(kept: tuple[PyTree, Normalizer], obs: Array, action: Array) -> Array:
        member, statistics = kept
        after = dynamics.predict(model, member, statistics, obs, action)[0]
        return (after - obs)[: task.measured_dim]

    def kept(params: PyTree) -> tuple[PyTree, Normalizer]:
        return jax.tree.map(lambda x: x[:1], params.dynamics), params.normalizer

    return interface(change, kept, task)
