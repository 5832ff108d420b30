"""What a diagnosis means: what fine-tuning will gain, by one formula of three numbers, and signs of the gap. Pure."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

AHEAD, LEVEL = 20, 0.9  # rollouts over which the gain is predicted; success that counts as solved
_SHORT = 40.0  # shortfall, in standard deviations, at which the imagined rollout of `inputs_of` is half a success
# From where on a sign counts. The numbers are ours: they separate the development gaps from the control `sim`.
_NATS = 20.0  # of evidence, as in `identify`
_EXPLAINED = 0.3  # of the models' error, by what was identified
_SCALE, _ROTATION, _BIAS = 0.15, 0.1, 0.08  # share, rad, share of the range of commands
_ERROR = 0.3  # of the std of a sensor's error
_DELAY = 0.15  # of a control period
_NOISE = 2.0  # times that in simulation
_NEAR, _LIMIT = 0.98, " or more (the limit of the fit)"  # share of the furthest that a fit believes in
_MODELS = 1.5  # times the error in simulation
_IMPROVABLE = 0.9  # of visited states, for a horizon that suffices
_SOLVED, _WORTH = 0.95, 0.05  # success from which on fine-tuning has little to gain, and gain that is worth it


class Coefficients(NamedTuple):
    """What `experiments.studies.diagnose_calibrate` fits; base, improvable and explained are never negative.

    The share of what is missing to full success that fine-tuning gains in AHEAD rollouts is
    base + improvable * (share of improvable states) + explained * (share of the models' error that identification
    removes).
    pace: rollouts after which all but a share 1/e of the gain is there.
    """

    base: float
    improvable: float
    explained: float
    pace: float


COEFFICIENTS = Coefficients(base=0.10, improvable=0.53, explained=0.63, pace=2.75)  # provisional, docs/diagnose.md


class Inputs(NamedTuple):
    """Of the formula, numbers in [0, 1] or arrays [m] of them.

    success: of the rollouts, see `inputs_of`. improvable: share of visited states in which some action keeps what V_sim
    promises. explained: share of the models' error four steps ahead that identification removes.
    """

    success: Any
    improvable: Any
    explained: Any


def inputs_of(diagnosis: Mapping[str, Any]) -> Inputs:
    """Of one diagnosis, see `examination.describe`.

    Success of n rollouts counts as (successes + p) / (n + 1), where p is 1 if rollouts return what V_sim promises and
    falls with their shortfall: after a few rollouts, how far they fall short says more than how many failed.
    """
    n, ahead = diagnosis["rollouts"], diagnosis["horizons"].index(4)
    likely = 1.0 / (1.0 + max(diagnosis["value"]["shortfall"], 0.0) / _SHORT)
    real, identified = (diagnosis["model_error"][name][ahead] for name in ("real", "identified"))
    return Inputs(
        success=(n * diagnosis["success"] + likely) / (n + 1),
        improvable=diagnosis["value"]["real"][0]["improvable"],
        explained=float(np.clip(1.0 - identified / max(real, 1e-9), 0.0, 1.0)),
    )


def gain(x: Inputs, c: Coefficients = COEFFICIENTS) -> Any:
    """Success after AHEAD rollouts minus zero-shot success; falls with success, grows with the other two."""
    share = c.base + c.improvable * x.improvable + c.explained * x.explained
    return (1.0 - x.success) * np.clip(share, 0.0, 1.0)


def success_after(x: Inputs, rollouts: Any, c: Coefficients = COEFFICIENTS) -> Any:
    """Expected success after that many rollouts; the gain comes exponentially at the pace."""
    return x.success + gain(x, c) * progress(rollouts, c.pace)


def progress(rollouts: Any, pace: Any, ahead: int = AHEAD) -> Any:
    """The share of the gain of `ahead` rollouts that is there after so many."""
    return -np.expm1(-np.asarray(rollouts) / pace) / -np.expm1(-ahead / pace)


def rollouts_until(x: Inputs, level: float = LEVEL, c: Coefficients = COEFFICIENTS) -> int | None:
    """The first number of rollouts after which that success is expected; None if it takes more than AHEAD."""
    reached = np.flatnonzero(success_after(x, np.arange(AHEAD + 1), c) >= level)
    return int(reached[0]) if reached.size else None


def choice(failed: int, rollouts: int) -> str:
    """The method for a policy that has failed so often: three or more of ten call for a guard (docs/diagnose.md)."""
    return "guarded" if 10 * failed >= 3 * rollouts else "sac"


# --- in words ---------------------------------------------------------------------------------------------------------


class Names(NamedTuple):
    """Of a task's numbers, for people. action: [act_dim]. sensors: [measured_dim] (name, unit). errors: [measured_dim]
    std of constant sensor errors. dt: s, control period. furthest: std of an error that a fit believes in at most.
    """

    action: Sequence[str]
    sensors: Sequence[tuple[str, str]]
    errors: Sequence[float]
    dt: float
    furthest: float = math.inf


class Sign(NamedTuple):
    """Of one kind of gap. strength: it counts from 1 on. words: what was found."""

    name: str
    strength: float
    words: str


def signs(diagnosis: Mapping[str, Any], names: Names) -> list[Sign]:
    """All kinds of gap that a diagnosis looks for, of one `examination.describe`."""
    known, late = _beyond_simulation(diagnosis["identified"]), diagnosis["delay"]
    ahead = diagnosis["horizons"].index(4)
    errors = {key: values[ahead] for key, values in diagnosis["model_error"].items()}
    times = errors["identified"] / max(errors["simulated"], 1e-9)
    explained = inputs_of(diagnosis).explained
    sure = min(diagnosis["identified"]["nats"] / _NATS, 1.0) * min(explained / _EXPLAINED, 1.0)
    scales, biases = (dict(zip(names.action, known[key], strict=True)) for key in ("scale", "bias"))
    scale, bias = max(abs(math.log(x)) for x in scales.values()), max(map(abs, biases.values()))
    far, off, turned, share = _each(scales, "{:.2f}"), _each(biases, "{:+.2f}"), known["rotation"], late["share"]
    limit, side = _LIMIT if late.get("at_limit") == 1 else "", "later" if share > 0 else "earlier"
    comes = f"{abs(share) * names.dt:.3f} s{limit} {side}"
    rest = (
        f"with all that identified, the models err {times:.1f} times as much as in simulation four steps ahead: "
        "something else differs, such as masses, friction, contacts or noise"
    )
    return [
        Sign(
            "command scale", sure * scale / math.log1p(_SCALE), f"the robot moves {far} times as far as in simulation"
        ),
        Sign("command rotation", sure * abs(turned) / _ROTATION, f"commands are turned by {turned:+.2f} rad"),
        Sign("command bias", sure * bias / _BIAS, f"commands are off by {off} of their range"),
        _sensor_error(known["sensor_errors"], diagnosis["identified"]["sensor_errors"], names),
        Sign(
            "delay", min(late["nats"] / _NATS, 1.0) * abs(share) / _DELAY, f"commands come {comes} than in simulation"
        ),
        _noise(diagnosis["noise"], names),
        Sign("what is left", times / _MODELS, rest),
    ]


def _beyond_simulation(identified: Mapping[str, Any]) -> dict[str, Any]:
    """What was identified, relative to what the same fit finds in simulation.

    Models of a domain with late or weak actuators expect such ones, so that a simulator without seems to overshoot.
    """
    usual = identified["simulated"]

    def less(name: str) -> list[float]:
        return [a - b for a, b in zip(identified[name], usual[name], strict=True)]

    return {
        "scale": [a / b for a, b in zip(identified["scale"], usual["scale"], strict=True)],
        "rotation": identified["rotation"] - usual["rotation"],
        "bias": less("bias"),
        "sensor_errors": less("sensor_errors"),
    }


def _sensor_error(offsets: Sequence[float], fitted: Sequence[float], names: Names) -> Sign:
    """offsets: beyond what the same fit finds in simulation."""
    sizes = [(abs(x) / std if std else 0.0) for x, std in zip(offsets, names.errors, strict=True)]
    wrong = [
        f"{name} by {_measure(x, unit)}" + _LIMIT * (abs(raw) >= _NEAR * names.furthest * std)
        for size, x, raw, std, (name, unit) in zip(sizes, offsets, fitted, names.errors, names.sensors, strict=True)
        if size >= _ERROR
    ]
    return Sign("sensor error", max(sizes, default=0.0) / _ERROR, f"sensors are off: {', '.join(wrong)}")


def _noise(diagnosis: Mapping[str, Sequence[float]], names: Names) -> Sign:
    sensors = zip(diagnosis["real"], diagnosis["simulated"], names.sensors, strict=True)
    times, real, usual, (name, unit) = max((x / max(usual, 1e-9), x, usual, sensor) for x, usual, sensor in sensors)
    words = f"noise of {name} is {_measure(real, unit, '')}, {_measure(usual, unit, '')} in simulation"
    return Sign("noise", times / _NOISE, words)


def _each(values: Mapping[str, float], form: str) -> str:
    """One number where all are alike, else each with its name."""
    words = {name: form.format(value) for name, value in values.items()}
    if len(set(words.values())) == 1:
        return next(iter(words.values()))
    return ", ".join(f"{word} ({name})" for name, word in words.items())


def _measure(value: float, unit: str, sign: str = "+") -> str:
    """A length in mm, anything else in its unit."""
    return f"{1000 * value:{sign}.1f} mm" if unit == "m" else f"{value:{sign}.3g} {unit}".rstrip()


def verdict(diagnosis: Mapping[str, Any], names: Names, c: Coefficients = COEFFICIENTS) -> list[str]:
    """What kind of gap it looks like, whether fine-tuning helps, which horizon, how many rollouts: a line for each.

    diagnosis: see `examination.describe`. c: of the formula.
    """
    x = inputs_of(diagnosis)
    kind, worth = _kind(signs(diagnosis, names)), _worth(diagnosis["success"], x, c)
    return [kind, _guide(diagnosis["value"]), worth, _horizon(diagnosis), _how_long(x, c)]


def _kind(signs_of_gap: Sequence[Sign]) -> str:
    counted = sorted((sign for sign in signs_of_gap if sign.strength >= 1.0), key=lambda sign: -sign.strength)
    if not counted:
        return "gap: nothing stands out against simulation"
    return f"gap: {', '.join(sign.name for sign in counted)}. In words: {'; '.join(sign.words for sign in counted)}"


def _guide(value: Mapping[str, Any]) -> str:
    share, usual = (100 * value[where][0]["improvable"] for where in ("real", "simulated"))
    trust = "rollouts return what it promises"
    if (short := value["shortfall"]) >= 1.0:
        trust = f"rollouts fall short of it by {short:.1f} standard deviations of what it is off by in simulation"
    return (
        f"V_sim: in {share:.0f} % of the visited states some action keeps what it promises ({usual:.0f} % in "
        f"simulation); {trust}; rank correlation with returns {value['rank_correlation']:.2f}"
    )


def _worth(success: float, x: Inputs, c: Coefficients) -> str:
    """success: share of the rollouts, without the doubt that `inputs_of` adds."""
    points, after = 100 * gain(x, c), 100 * success_after(x, AHEAD, c)
    before = f"from about {100 * x.success:.0f}"  # what failed in a few rollouts may succeed in the next ones
    words = f"{points:+.0f} points expected in {AHEAD} rollouts, {before} to {after:.0f} %"
    if success >= _SOLVED:
        return f"fine-tuning: little to gain ({points:+.0f} points expected); keep the policy, or use sac"
    if points >= 100 * _WORTH:
        return f"fine-tuning: worth it, {words}"
    return f"fine-tuning: little hope ({words}); a simulator with what differs, see above, helps more"


def _horizon(diagnosis: Mapping[str, Any]) -> str:
    shares = [states["improvable"] for states in diagnosis["value"]["real"]]
    enough = [h for h, share in zip(diagnosis["horizons"], shares, strict=True) if share >= _IMPROVABLE]
    if enough:
        share = shares[diagnosis["horizons"].index(enough[0])]
        return f"horizon of SGFT: H = {enough[0]} is enough, {100 * share:.0f} % of the states are improvable with it"
    best = max(range(len(shares)), key=shares.__getitem__)
    return (
        f"horizon of SGFT: H = {diagnosis['horizons'][best]}, with which {100 * shares[best]:.0f} % of the states are "
        "improvable; no horizon up to 8 suffices, so methods without V_sim, such as guarded and sac, may do better"
    )


def _how_long(x: Inputs, c: Coefficients) -> str:
    n = rollouts_until(x, LEVEL, c)
    if n is None:
        return f"time: {100 * LEVEL:.0f} % are not expected within {AHEAD} rollouts"
    return f"time: {100 * LEVEL:.0f} % expected {f'after {n} rollout{"s" * (n > 1)}' if n else 'now'}"
