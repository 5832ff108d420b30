"""A prior examines rollouts on a real system: what `sgft_jax.diagnosis` measures, compiled, and its statistics."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.types import Array, Key, Transition
from sgft_jax import diagnosis
from sgft_jax.diagnosis import HORIZONS, Lateness, Rollouts
from sgft_jax.models.config import network_of
from sgft_jax.models.distortion import Distortion, Identified, Seen, command_interface, none, residuals, undone
from sgft_jax.stacking import member
from sgft_jax.types import SimulatedData, Task

_STATES, _OFFSETS = 256, 32  # visited states that are looked at, and ways to act that are tried in each
_AT_ONCE = 32  # of these states, which bounds memory


class Look(NamedTuple):
    """Measurements of one prior on n rollouts, before statistics; the functions of `diagnosis` make them.

    known: the identified distortion; nats: [] its evidence. values, returns, valid: [n, T]. best: [states, horizon] of
    `headroom`. surprise: [n * T] of `surprises`. errors, plain_errors: [n, windows, HORIZONS] model errors with and
    without the distortion; windows: [n, windows] bool, those that count. late: of `lateness`. expected, change:
    [n * T, measured_dim] predicted and measured change of a step. On simulated rollouts only `late` uses the
    distortion. Arrays are JAX's within a program and NumPy's after it.
    """

    known: Distortion
    nats: Any
    values: Any
    returns: Any
    valid: Any
    best: Any
    surprise: Any
    errors: Any
    plain_errors: Any
    windows: Any
    late: Lateness
    expected: Any
    change: Any


class Examiner:
    """Examines rollouts of priors with one card on real systems of one task; its programs are compiled once.

    Everything has a leading axis of members: priors, or rollouts that a prior looks at. One program examines them all.
    """

    def __init__(self, card: Mapping[str, Any], task: Task) -> None:
        def look(real: bool) -> Any:
            return jax.jit(jax.vmap(functools.partial(_look, card, task, real=real)))

        self.task, self._simulated, self._real = task, look(False), look(True)
        self._start = jax.jit(jax.vmap(functools.partial(_start, card, task)))

    def control(self, params: Any, simulated: Rollouts) -> "Control":
        """What real rollouts are compared with. params: [P, ...] of the priors. simulated: [P, n], of their exploring
        policies.
        """
        begun = self._start(params, simulated)
        unknown = jnp.zeros(simulated.success.shape[0])
        return Control(begun, jax.device_get(self._simulated(params, begun, simulated, unknown)))

    def examine(self, params: Any, control: "Control", real: Rollouts, counts: Sequence[int]) -> "list[Examined]":
        """What the first `count` real rollouts of each member say, for each of the counts.

        params, control: [M, ...], of the prior that looks at each. real: [M, n]. Arrays keep their shapes from call to
        call, or everything is compiled again.
        """
        n = real.valid.shape[1]
        looks = []
        for count in counts:
            some = real._replace(valid=jnp.asarray(real.valid) & (jnp.arange(n)[None, :, None] < count))
            looks.append(jax.device_get(self._real(params, control.begun, some, control.seen.late.share)))
        return [self._of(i, counts, looks, control.seen, np.asarray(real.success)) for i in range(len(real.success))]

    def _of(self, i: int, counts: Sequence[int], looks: Sequence[Look], seen: Look, success: np.ndarray) -> "Examined":
        """What was found of member i; looks, seen: [M, ...]."""
        simulated, *real = (member(look, i) for look in (seen, *looks))
        statistics = [
            describe(look, simulated, success[i, :count], turns=self.task.cartesian)
            for count, look in zip(counts, real, strict=True)
        ]
        return Examined(statistics, {"real": _points(real[-1]), "simulated": _points(simulated)})


class Control(NamedTuple):
    """What priors see in simulation, [P, ...]. begun: identification before anything real is seen. seen: the rest."""

    begun: Identified
    seen: Look


class Examined(NamedTuple):
    """Of one member. statistics: JSON data for each number of rollouts, see `describe`. points: by "real" (of the
    last of these) and "simulated", V_sim and return [n] of visited states.
    """

    statistics: list[dict[str, Any]]
    points: dict[str, tuple[np.ndarray, np.ndarray]]


def _points(look: Look) -> tuple[np.ndarray, np.ndarray]:
    return look.values[look.valid], look.returns[look.valid]


def _start(card: Mapping[str, Any], task: Task, params: Any, simulated: Rollouts) -> Identified:
    rows, valid = simulated.flat()
    order = jnp.argsort(~valid, stable=True)  # valid ones first

    def draw(key: Key, n: int) -> Transition:
        which = order[jax.random.randint(key, (n,), 0, jnp.maximum(valid.sum(), 1))]
        return jax.tree.map(lambda x: x[which], rows)

    interface = command_interface(network_of(card), task)
    return interface.prepare(interface.start(params, jax.random.key(0)), SimulatedData(draw, jnp.zeros(1)))


def _look(
    card: Mapping[str, Any], task: Task, params: Any, begun: Identified, rollouts: Rollouts, usual: Array, *, real: bool
) -> Look:
    """usual: see `diagnosis.lateness`. real: False for simulated rollouts.

    What identification finds in these is what the models have learned to expect of other systems in their domain.
    """
    beliefs = diagnosis.beliefs_of(params, card, task)
    rows, valid = rollouts.flat()
    nothing = none(task.act_dim, task.measured_dim)
    known = command_interface(network_of(card), task).refit(begun, Seen(rows, valid)).distortion
    meant = rollouts._replace(transitions=jax.vmap(functools.partial(undone, known))(rollouts.transitions))
    judged, acted = (meant, known) if real else (rollouts, nothing)
    flat, _ = judged.flat()
    first = member(params.dynamics, 0)

    def change(obs: Array, action: Array) -> Array:
        return (beliefs.after(first, obs, action) - obs)[: task.measured_dim]

    key_states, key_offsets = jax.random.split(jax.random.key(0))
    which = jax.random.categorical(key_states, jnp.where(valid, 0.0, -jnp.inf), shape=(_STATES,))
    offsets = diagnosis.draw_offsets(key_offsets, _OFFSETS, task.act_dim)
    best = jax.lax.map(
        lambda obs: diagnosis.headroom(beliefs, acted, obs, offsets, HORIZONS[-1]), flat.obs[which], batch_size=_AT_ONCE
    )
    values, returns = diagnosis.promises(beliefs, judged)
    errors, windows = diagnosis.model_errors(beliefs, judged)
    return Look(
        known=known,
        nats=diagnosis.evidence(residuals(change, rows, nothing), residuals(change, rows, known), valid, begun.spread),
        values=values,
        returns=returns,
        valid=rollouts.valid,
        best=best,
        surprise=diagnosis.surprises(beliefs, flat),
        errors=errors,
        plain_errors=diagnosis.model_errors(beliefs, rollouts)[0],
        windows=windows,
        late=diagnosis.lateness(change, meant, begun.spread, usual),
        expected=jax.vmap(change)(flat.obs, flat.action),
        change=(flat.next_obs - flat.obs)[:, : task.measured_dim],
    )


def describe(real: Look, simulated: Look, success: np.ndarray, *, turns: bool) -> dict[str, Any]:
    """The statistics of `Look`s at real and at simulated rollouts, as JSON data; docs/diagnose.md explains them.

    success: [n] of the real ones. turns: see `diagnosis.parts`.
    """
    margin = 1.48 * float(np.median(np.abs(simulated.surprise[simulated.valid.reshape(-1)])))
    ahead = np.array(HORIZONS) - 1
    return {
        "rollouts": len(success),
        "success": float(success.mean()),
        "horizons": list(HORIZONS),
        "value": {
            **diagnosis.honesty(*((look.values, look.returns, look.valid) for look in (real, simulated))),
            "margin": margin,
            "real": [diagnosis.guidance(real.best[:, i], margin) for i in ahead],
            "simulated": [diagnosis.guidance(simulated.best[:, i], margin) for i in ahead],
        },
        "model_error": {
            "real": _mean(real.plain_errors, real.windows),
            "identified": _mean(real.errors, real.windows),
            "simulated": _mean(simulated.errors, simulated.windows),
        },
        "identified": {
            **diagnosis.parts(real.known, turns=turns),
            "nats": float(real.nats),
            "simulated": diagnosis.parts(simulated.known, turns=turns),
        },
        "delay": {
            "share": float(real.late.share - simulated.late.share),
            "nats": float(real.late.nats),
            "at_limit": not diagnosis.SHARES[0] < float(real.late.share) < diagnosis.SHARES[-1],
        },
        "noise": {"real": _noise(real), "simulated": _noise(simulated)},
    }


def _mean(errors: np.ndarray, windows: np.ndarray) -> list[float]:
    """[HORIZONS] over the windows that count; nan where no episode lasts so long."""
    return errors[windows].mean(axis=0).tolist() if windows.any() else [float("nan")] * len(HORIZONS)


def _noise(look: Look) -> list[float]:
    held = look.valid.reshape(-1)
    return diagnosis.noise(look.expected[held], look.change[held]).tolist()
