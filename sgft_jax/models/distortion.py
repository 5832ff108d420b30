"""What a real system makes of commands and measurements, fitted to real steps through the simulator's model. Pure.

Identification (of scale, rotation and bias of commands, and of constant errors of measurements) runs while another part
learns. The learner sees the simulator's actions and measurements; this module translates.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.types import Array, Key, PyTree, Transition
from sgft_jax.models import dynamics
from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.networks import make_dynamics
from sgft_jax.models.robust import most_probable, spread_of
from sgft_jax.types import Batch, Metrics, Normalizer, SimulatedData, Task

_TURN, _SCALE, _BIAS = 0.6, 0.4, 0.2  # std of the rotation (rad), log-scales and biases before any data
FURTHEST = 2.0  # std of a sensor's error
_EARNED, _TIMES = 20.0, 1.5  # nats of evidence that errors of sensors must add to the commands', and times
_STARTS = (-1.4, -0.7, 0.0, 0.7, 1.4)  # rad; from elsewhere the search may end in another turn

_SIMULATED = 2048  # rows that tell how far the model is off in simulation
_ROWS = 320  # real ones that are fitted, the first 8 rollouts or so; more of them add little
_EVIDENCE = 20.0  # nats by which a distortion must explain them better than none; neighbouring steps are alike


class Distortion(NamedTuple):
    """A real system that gets a command acts as the simulated one would on the action `matrix @ command + bias`.

    matrix: [act_dim, act_dim]. bias: [act_dim]. offset: [measured_dim], by how much it measures more than there is.
    """

    matrix: Array
    bias: Array
    offset: Array

    def meaning(self, command: Array) -> Array:
        """The action [act_dim] that a command stands for; it may exceed [-1, 1]."""
        # Less precise products of a GPU would round commands that nothing distorts.
        return jnp.dot(self.matrix, command, precision="highest") + self.bias

    def command(self, action: Array) -> Array:
        """The command [act_dim] in [-1, 1] that comes closest to standing for an action."""
        with jax.default_matmul_precision("highest"):
            return jnp.clip(jnp.linalg.inv(self.matrix) @ (action - self.bias), -1.0, 1.0)

    def seen(self, obs: Array) -> Array:
        """An observation [obs_dim] as the simulator would have made it: measurements without their offset, then the
        actions that the previous commands stand for, if it ends with any.
        """
        measured, commands = jnp.split(obs, [self.offset.shape[0]])
        meant = jax.vmap(self.meaning)(commands.reshape(-1, self.bias.shape[0]))
        return jnp.concatenate([measured - self.offset, meant.ravel()])


def undone[Rows: (Batch, Transition)](distortion: Distortion, rows: Rows) -> Rows:
    """Real rows [n] in the simulator's terms: commands as the actions that they cause, measurements without errors."""
    seen = jax.vmap(distortion.seen)
    action = jax.vmap(distortion.meaning)(rows.action)
    return rows._replace(obs=seen(rows.obs), action=action, next_obs=seen(rows.next_obs))


def none(act_dim: int, measured_dim: int) -> Distortion:
    """The distortion of a system that changes nothing: identity matrix, no bias, no sensor errors."""
    return Distortion(jnp.eye(act_dim), jnp.zeros(act_dim), jnp.zeros(measured_dim))


def turned_and_scaled(rotation: Array, log_scale: Array, bias: Array, offset: Array) -> Distortion:
    """Commands rotated in the xy plane, then scaled, then offset, as by `envs.effects.distort`.

    rotation: [] rad. log_scale, bias: [act_dim]. offset: [measured_dim].
    """
    matrix = jnp.eye(bias.shape[0])
    if bias.shape[0] > 1:
        c, s = jnp.cos(rotation), jnp.sin(rotation)
        matrix = matrix.at[:2, :2].set(jnp.array([[c, -s], [s, c]]))
    return Distortion(jnp.exp(log_scale)[:, None] * matrix, bias, offset)


Predict = Callable[[Array, Array], Array]  # (obs [obs_dim], action [act_dim]) -> [k] what a step changes, raw units


def residuals(predict: Predict, rows: Transition, distortion: Distortion) -> Array:
    """[n, k] what the model leaves unexplained of real steps [n], if that is what the system does."""

    def one(row: Transition) -> Array:
        change = predict(distortion.seen(row.obs), distortion.meaning(row.action))
        return row.next_obs[: change.shape[0]] - row.obs[: change.shape[0]] - change

    return jax.vmap(one)(rows)


def fit(
    predict: Predict, rows: Transition, held: Array, spread: Array, *, turns: bool, errors: tuple[float, ...]
) -> tuple[Distortion, Array]:
    """The most probable distortion, and how much better than none it explains the rows, nats [].

    Scales, biases and a rotation are few enough for one rollout with one-sided actions, where a free matrix is not
    determined. The model knows about contacts and limits, so steps that hit something need no special care;
    they are what tells the constant errors of sensors. Where something else is wrong with contacts, errors of sensors
    explain some of it too. So they count only if they add half to what the commands explain: on gaps of three tasks
    true errors did, and of the others a few hardly (docs/rules.md).

    predict: the simulator's model. rows: [n], with actions that are commands. held: [n] bool, which of them count.
    spread: [k] std of the model's own residuals in simulation, the least that real ones have. turns: the first two
    actions are x and y of a frame that may be rotated. errors: [measured_dim] std of the constant errors of
    sensors before any data; none is ever believed to be more than twice that large.
    """
    search = functools.partial(_fit, predict, rows, held, spread, turns=turns)
    commands, explained = search(errors=(0.0,) * len(errors))
    if not any(errors):
        return commands, explained
    both, more = search(errors=errors)
    earned = more > jnp.maximum(explained + _EARNED, _TIMES * explained)
    return jax.tree.map(lambda a, b: jnp.where(earned, a, b), (both, more), (commands, explained))


def _fit(
    predict: Predict, rows: Transition, held: Array, spread: Array, *, turns: bool, errors: tuple[float, ...]
) -> tuple[Distortion, Array]:
    """See `fit`; errors of sensors count wherever they explain anything."""
    act_dim = rows.action.shape[-1]
    wrong = np.flatnonzero(errors)  # sensors that may be; their offsets count in units of the error
    n = 1 + 2 * act_dim
    belief = jnp.array([_TURN if turns else 1e-4, *[_SCALE] * act_dim, *[_BIAS] * act_dim, *[1.0] * len(wrong)])
    bound = jnp.array([*[jnp.inf] * n, *[FURTHEST] * len(wrong)])

    def described(p: Array) -> Distortion:
        offset = jnp.zeros(len(errors)).at[wrong].set(p[n:] * np.array(errors)[wrong])
        return turned_and_scaled(p[0], p[1 : 1 + act_dim], p[1 + act_dim : n], offset)

    def missed(p: Array) -> Array:
        return residuals(predict, rows, described(p))

    starts = jnp.zeros((len(_STARTS) if turns else 1, n + len(wrong)))
    starts = starts.at[:, 0].set(jnp.array(_STARTS)) if turns else starts
    change = (rows.next_obs - rows.obs)[:, : spread.shape[0]]
    guessed = range(n, n + len(wrong))
    estimate = most_probable(missed, starts, belief, change, held, spread, bound=bound, guessed=guessed)
    return described(estimate.point), estimate.evidence


# --- identification ---------------------------------------------------------------------------------------------------


Model = Callable[[PyTree, Array, Array], Array]  # (params, obs, action) -> [measured_dim] what a step changes


class Identified(NamedTuple):
    """params: of the simulator's model. spread: [measured_dim] std of its residuals in simulation, raw units.

    distortion: the identified changes; none at all until the evidence exceeds 20 nats.
    """

    params: PyTree
    spread: Array
    distortion: Distortion


class Seen(NamedTuple):
    """What has been seen of a real system: rows [n] that are kept, which of them are `held` [n] bool, and of the last
    rollout its rows [T], which of them are valid [T], and whether it succeeded [].
    """

    rows: Transition
    held: Array
    rollout: tuple[Transition, Array, Array] | None = None


class Interface(NamedTuple):
    """Identification as pure functions. What is known of a system, such as `Identified`, has a `distortion`.

    start(params of a prior, key) -> what is known before any row. prepare(known, simulated) -> the same with the
    spread. refit(known, seen) -> what is known then. report(known) -> metrics.
    """

    start: Callable[[PyTree, Key], Any]
    prepare: Callable[[Any, SimulatedData], Any]
    refit: Callable[[Any, Seen], Any]
    report: Callable[[Any], Metrics] = lambda known: {}


def translated(distortion: Distortion, batch: Batch) -> Batch:
    """The batch, its real rows in the simulator's actions and measurements."""
    new = undone(distortion, batch)
    if (simulated := batch.is_sim) is None:
        return new
    return jax.tree.map(lambda a, b: jnp.where(simulated.reshape(-1, *[1] * (a.ndim - 1)), a, b), batch, new)


def interface(model: Model, kept: Callable[[PyTree], PyTree], task: Task) -> Interface:
    """Identification for a task. model(params, obs, action) -> [measured_dim]; kept(prior's params) -> its params."""

    def start(params: PyTree, key: Key) -> Identified:
        del key
        unknown = jnp.zeros(task.measured_dim)
        return Identified(jax.tree.map(jnp.copy, kept(params)), unknown, none(task.act_dim, task.measured_dim))

    def prepare(known: Identified, simulated: SimulatedData) -> Identified:
        rows, held = simulated.draw(jax.random.key(0), _SIMULATED), jnp.ones(_SIMULATED, bool)
        missed = residuals(lambda *x: model(known.params, *x), rows, none(task.act_dim, task.measured_dim))
        change = (rows.next_obs - rows.obs)[:, : missed.shape[1]]
        return known._replace(spread=spread_of(missed, change, held))

    def refit(known: Identified, seen: Seen) -> Identified:
        rows, held = jax.tree.map(lambda x: x[:_ROWS], (seen.rows, seen.held))
        options = {"turns": task.cartesian, "errors": task.sensor_errors}
        fitted, evidence = fit(lambda *x: model(known.params, *x), rows, held, known.spread, **options)
        nothing = none(task.act_dim, task.measured_dim)
        return known._replace(
            distortion=jax.tree.map(lambda a, b: jnp.where(evidence > _EVIDENCE, a, b), fitted, nothing)
        )

    return Interface(start, prepare, refit)


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
