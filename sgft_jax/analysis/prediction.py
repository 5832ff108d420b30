"""What fine-tuning will gain, predicted from a diagnosis: one formula of three numbers, and its calibration. Pure."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import nnls

from sgft_jax.math.stats import Interval, bootstrap_interval, rank_correlation

AHEAD, LEVEL = 20, 0.9  # rollouts over which the gain is predicted; success that counts as solved
_SHORT = 40.0  # shortfall, in standard deviations, at which the imagined rollout of `inputs_of` is half a success
_BINS = (0.0, 0.05, 0.2, 0.5, 1.0)  # of predicted gain, for the calibration table
_PACES = np.linspace(0.5, 20.0, 79)


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


# --- calibration ------------------------------------------------------------------------------------------------------


class Cases(NamedTuple):
    """Finished runs of m members (a gap and a prior each).

    inputs: [m] of the formula. played: [m] success of the rollouts that these are from. zero_shot, gains: [m] success
    before fine-tuning, and what came on top. curves: success of every member at its evaluations [e], as (rollouts,
    success). gaps, priors: [m] names; the prior is the random factor.
    """

    inputs: Inputs
    played: np.ndarray
    zero_shot: np.ndarray
    gains: np.ndarray
    curves: Sequence[tuple[np.ndarray, np.ndarray]]
    gaps: np.ndarray
    priors: np.ndarray

    def of(self, held: np.ndarray) -> "Cases":
        """Those members, [m] bool."""
        arrays = ("played", "zero_shot", "gains", "gaps", "priors")
        chosen = {name: getattr(self, name)[held] for name in arrays}
        inputs, curves = Inputs(*(x[held] for x in self.inputs)), list(itertools.compress(self.curves, held))
        return self._replace(inputs=inputs, curves=curves, **chosen)


def fit(cases: Cases) -> Coefficients:
    """The coefficients by least squares, none negative, so that the formula stays monotone; the pace by search."""
    x = cases.inputs
    columns = np.stack([np.ones_like(x.success), x.improvable, x.explained], axis=1)
    shares, _ = nnls(columns * (1.0 - x.success)[:, None], cases.gains)
    return Coefficients(*map(float, shares), pace=_pace(cases))


def _pace(cases: Cases) -> float:
    """That which describes the curves best, of members that gained something."""
    gained = [curve for curve, gain in zip(cases.curves, cases.gains, strict=True) if gain > 0.1]
    if not gained:
        return COEFFICIENTS.pace
    missed = np.zeros(len(_PACES))
    for rollouts, success in gained:
        share = (success - success[0]) / (success[-1] - success[0])
        missed += np.square(progress(rollouts[:, None], _PACES, int(rollouts[-1])) - share[:, None]).sum(axis=0)
    return float(_PACES[np.argmin(missed)])


def held_out(gaps: np.ndarray) -> np.ndarray:
    """[m] bool: every second gap by name, to be predicted by one fit to the others.

    One fit for each gap would not do: a gap that gains much lowers the coefficients that its own prediction comes from,
    so that predictions of gaps that look alike would run against what they gain.
    """
    return np.isin(gaps, np.unique(gaps)[1::2])


def agreement(predicted: ArrayLike, cases: Cases) -> Interval:
    """Spearman's rank correlation of predicted [m] and measured gain; its 95 % interval draws priors, then members."""
    pairs = np.stack([np.asarray(predicted, np.float64), cases.gains], axis=1)
    return bootstrap_interval(pairs, statistic=rank_correlation, priors=cases.priors)


def table(predicted: np.ndarray, cases: Cases) -> list[tuple[float, float, int, float, float]]:
    """The calibration table: (low, high, members, mean predicted, mean measured gain) of each range that has any."""
    rows = []
    for low, high in itertools.pairwise(_BINS):
        inside = (predicted >= low) & ((predicted < high) | (high == _BINS[-1]))
        if inside.any():
            means = float(predicted[inside].mean()), float(cases.gains[inside].mean())
            rows.append((low, high, int(inside.sum()), *means))
    return rows
