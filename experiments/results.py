"""What finished runs say: learning curves read from disk, and their summary with intervals. Reads files."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sgft_jax.analysis.stats import area_under, first_dip, iqm_interval, transitions_to
from sgft_jax.io.log import EVAL, read_jsonl
from sgft_jax.types import UserError

LEVELS = (90, 98)  # per cent of success: nearly always, and as good as always


class Curve(NamedTuple):
    """Evaluations of one fine-tuning run on the real system; the first one is zero-shot.

    rollouts, transitions: [n]. robot_minutes: [n] at the control rate, resets excluded. success, returns: [seeds, n],
    the task's own, never reshaped.
    """

    rollouts: np.ndarray
    transitions: np.ndarray
    robot_minutes: np.ndarray
    success: np.ndarray
    returns: np.ndarray


def read_curve(folder: Path) -> Curve:
    """The learning curve of a fine-tuning run; raises UserError if it holds no evaluation yet."""
    records = read_jsonl(folder / EVAL)
    if not records:
        raise UserError(f"{folder / EVAL}: holds no evaluation yet")
    column = lambda name: np.array([r[name] for r in records])  # noqa: E731
    return Curve(column("rollouts"), column("step"), column("robot_minutes"), column("success").T, column("return").T)


def reached(curve: Curve, percent: int) -> int | None:
    """Real transitions until the mean over seeds first shows that success; None = never."""
    return transitions_to(curve.transitions, curve.success.mean(0), percent / 100)


def left_behind(curve: Curve) -> int:
    """Seeds that end below the first of `LEVELS`: a mean over seeds hides them, an interquartile one even more."""
    return int((curve.success[:, -1] < LEVELS[0] / 100).sum())


def dip(curve: Curve) -> float:
    """How far success of the mean over seeds ever fell below zero-shot, from 0 to 1."""
    return first_dip(curve.success.mean(0))


def area(curve: Curve, rollouts: int) -> np.ndarray:
    """[seeds] mean success from zero-shot to the last evaluation after at most so many rollouts, from 0 to 1."""
    inside = curve.rollouts <= rollouts
    return area_under(curve.transitions[inside], curve.success[:, inside])


def describe_run(curve: Curve) -> dict[str, Any]:
    """The figures of a run for machines.

    zero_shot, final: success and return, interquartile mean over seeds with its 95 % bootstrap interval, and mean.
    dip: how far success of a seed, and of the mean over seeds, ever fell below zero-shot.
    to_90, to_98: real transitions of each seed until an evaluation first shows that success in per cent (null = never),
    and the same for the mean curve.
    """
    return {
        "zero_shot": _point(curve, 0),
        "final": _point(curve, -1),
        "dip": {"mean": dip(curve), "worst_seed": max(first_dip(s) for s in curve.success)},
        **{f"to_{percent}": _transitions(curve, percent) for percent in LEVELS},
        "seeds": int(curve.success.shape[0]),
    }


def _transitions(curve: Curve, percent: int) -> dict[str, Any]:
    seeds = [transitions_to(curve.transitions, success, percent / 100) for success in curve.success]
    return {"seeds": seeds, "mean_curve": reached(curve, percent)}


def _point(curve: Curve, i: int) -> dict[str, Any]:
    return {
        "rollouts": int(curve.rollouts[i]),
        "transitions": int(curve.transitions[i]),
        "robot_minutes": float(curve.robot_minutes[i]),
        "success": _interval(curve.success[:, i]),
        "return": _interval(curve.returns[:, i]),
    }


def _interval(values: np.ndarray) -> dict[str, float]:
    band = iqm_interval(values)
    return {"iqm": float(band.estimate), "low": float(band.low), "high": float(band.high), "mean": float(values.mean())}
