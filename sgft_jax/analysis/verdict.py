"""What a diagnosis means, in words and as strengths of signs. Pure."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from sgft_jax.analysis import prediction
from sgft_jax.analysis.prediction import AHEAD, COEFFICIENTS, LEVEL, Coefficients, Inputs

# From where on a sign counts. The numbers are ours: they separate the development gaps from the control `sim`.
_NATS = 20.0  # of evidence, as in `identify`
_EXPLAINED = 0.3  # of the models' error, by what was identified
_SCALE, _ROTATION, _BIAS = 0.15, 0.1, 0.08  # share, rad, share of the range of commands
_ERROR = 0.3  # of the std of a sensor's error
_DELAY = 0.15  # of a control period
_NOISE = 2.0  # times that in simulation
_MODELS = 1.5  # times the error in simulation
_IMPROVABLE = 0.9  # of visited states, for a horizon that suffices
_SOLVED, _WORTH = 0.95, 0.05  # success from which on fine-tuning has little to gain, and gain that is worth it


class Names(NamedTuple):
    """Of a task's numbers, for people. action: [act_dim]. sensors: [measured_dim] (name, unit). errors: [measured_dim]
    std of constant sensor errors. dt: s, control period.
    """

    action: Sequence[str]
    sensors: Sequence[tuple[str, str]]
    errors: Sequence[float]
    dt: float


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
    explained = prediction.inputs_of(diagnosis).explained
    sure = min(diagnosis["identified"]["nats"] / _NATS, 1.0) * min(explained / _EXPLAINED, 1.0)
    scales, biases = (dict(zip(names.action, known[key], strict=True)) for key in ("scale", "bias"))
    scale, bias = max(abs(math.log(x)) for x in scales.values()), max(map(abs, biases.values()))
    far, off, turned, share = _each(scales, "{:.2f}"), _each(biases, "{:+.2f}"), known["rotation"], late["share"]
    comes = f"{abs(share) * names.dt:.3f} s {'later' if share > 0 else 'earlier'}"
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
        _sensor_error(known["sensor_errors"], names),
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


def _sensor_error(offsets: Sequence[float], names: Names) -> Sign:
    sizes = [(abs(x) / std if std else 0.0) for x, std in zip(offsets, names.errors, strict=True)]
    wrong = [
        f"{name} by {_measure(x, unit)}"
        for size, x, (name, unit) in zip(sizes, offsets, names.sensors, strict=True)
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

    diagnosis: see `examination.describe`. c: of the prediction.
    """
    x = prediction.inputs_of(diagnosis)
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
    gain = 100 * prediction.gain(x, c)
    after = 100 * prediction.success_after(x, AHEAD, c)
    words = f"{gain:+.0f} points expected in {AHEAD} rollouts, to {after:.0f} %"
    if success >= _SOLVED:
        return f"fine-tuning: little to gain ({gain:+.0f} points expected); keep the policy, or use a guarded method"
    if gain >= 100 * _WORTH:
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
        "improvable; no horizon up to 8 suffices, so methods without V_sim (guarded, sac, mbpo) may do better"
    )


def _how_long(x: Inputs, c: Coefficients) -> str:
    n = prediction.rollouts_until(x, LEVEL, c)
    if n is None:
        return f"time: {100 * LEVEL:.0f} % are not expected within {AHEAD} rollouts"
    return f"time: {100 * LEVEL:.0f} % expected {f'after {n} rollout{"s" * (n > 1)}' if n else 'now'}"
