"""Fit the prediction of `experiments.diagnose` to finished fine-tuning runs, and measure how well it holds.

Without --check, the gains on every second gap are predicted from the others (docs/diagnose.md).
"""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from envs.types import UserError
from experiments.runner import cli
from experiments.runner.cli import Json
from experiments.runner.options import Impl, Out, prior_folders, seed_list, task_of_rollouts
from sgft_jax.analysis import tables
from sgft_jax.analysis.reading import read_curve
from sgft_jax.analysis.verdict import AHEAD, COEFFICIENTS, Coefficients, Inputs, gain, inputs_of, progress
from sgft_jax.files.disk import jsonable
from sgft_jax.io.runs import read_config
from sgft_jax.math.stats import Interval, bootstrap_interval, rank_correlation
from sgft_jax.presets import DEFAULT_PRESET

COUNTS = (1, 2, 4)  # rollouts that a prediction is made from
_BINS = (0.0, 0.05, 0.2, 0.5, 1.0)  # of predicted gain, for the calibration table
_PACES = np.linspace(0.5, 20.0, 79)


@dataclass(frozen=True)
class CalibrateArgs:
    """One fit of the prediction."""

    runs: tuple[Path, ...]
    """Finished fine-tuning runs to fit to: their folders, or folders that hold some."""
    check: tuple[Path, ...] = ()
    """Other runs, on which the fitted prediction is then checked."""
    task: str | None = None
    """A task by name, or a Python file with a task of your own; default: the task of each run."""
    prior: Path | None = None
    """Folder of a prior of SAC, or of several (prior/seed-*); default: those that the runs began with, else those of
    <out>/pretrain/<task>/<preset>."""
    json: Json = False
    out: Out = Path("runs")
    preset: str = DEFAULT_PRESET
    """Expert: pretraining preset whose priors to take where neither --prior nor a run names any."""
    seed: int = 0
    """Expert: another seed plays other simulated rollouts."""
    impl: Impl = "auto"


def main(args: CalibrateArgs) -> None:
    """Fits, checks and prints. Raises UserError where runs hold too little, or are in both lists."""
    runs, others = check(args)
    summary, lines = calibrate(args, runs, others)
    print(json.dumps(summary) if args.json else "\n".join(lines))


def check(args: CalibrateArgs) -> tuple[list[Path], list[Path]]:
    """The runs to fit to and those to check on; UserError where runs hold too little, or are in both lists."""
    seed_list(args.seed, 1)
    if not args.runs:
        raise UserError("--runs: name at least one finished fine-tuning run, or a folder that holds some")
    runs, others = find_runs("--runs", args.runs), find_runs("--check", args.check)
    if shared := set(runs) & set(others):
        raise UserError(f"--check: {min(shared)} is also in --runs; what was fitted cannot check the fit")
    return runs, others


def find_runs(option: str, folders: Sequence[Path]) -> list[Path]:
    """The folders of fine-tuning runs with recorded rollouts and a curve; raises UserError where there is none."""
    runs: dict[Path, None] = {}
    for folder in folders:
        inside = [path.parent for path in sorted(folder.rglob("eval.jsonl")) if (path.parent / "real").is_dir()]
        if not inside:
            raise UserError(
                f"{option} {folder}: holds no fine-tuning run with recorded rollouts (eval.jsonl and real/)"
            )
        runs |= dict.fromkeys(inside)
    return list(runs)


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


def calibrate(args: CalibrateArgs, runs: list[Path], checked: list[Path]) -> tuple[dict[str, Any], list[str]]:
    """How well gains are predicted, as JSON data and as lines for people.

    The runs to check on are predicted from `runs`; without any, every second gap is from the others.
    """
    if not checked and len({(curve.task, curve.gap) for curve in map(read_curve, runs)}) < 2:
        raise UserError("--runs: these runs are on one gap; name runs on others too, or some with --check")
    cases = gather(args, runs)
    coefficients = fit(cases[-1])
    if checked:
        fitted, held = cases, gather(args, checked)
        words = f"{len(checked)} other runs, predicted from {len(runs)}"
    else:
        out = held_out(cases[-1].gaps)
        fitted, held = ([case.of(members) for case in cases] for members in (~out, out))
        words = f"every second gap of {len(runs)} runs, predicted from the other gaps"
    fits = [gain(new.inputs, fit(old)) for old, new in zip(fitted, held, strict=True)]
    final = held[-1]
    lines = {f"prediction after {n} rollouts": (fit, case) for n, fit, case in zip(COUNTS, fits, held, strict=True)}
    lines["the same, coefficients of this version"] = (gain(final.inputs), final)
    lines["100 - zero-shot (50 episodes or so)"] = (1.0 - final.zero_shot, final)
    lines[f"100 - success of the same {COUNTS[-1]} rollouts"] = (1.0 - final.played, final)
    bands = {name: agreement(*pair) for name, pair in lines.items()}
    rows = table(fits[-1], final)
    summary = {
        "runs": [str(run) for run in runs],
        "checked": [str(run) for run in checked],
        "members": len(final.gains),
        "coefficients": jsonable(coefficients),
        "rank_correlation": {name: jsonable(band) for name, band in bands.items()},
        "table": [dict(zip(("low", "high", "members", "predicted", "measured"), row, strict=True)) for row in rows],
    }
    return jsonable(summary), _lines(words, final, coefficients, bands, rows)


def _lines(words: str, cases: Cases, coefficients: Coefficients, bands: dict, rows: Sequence[tuple]) -> list[str]:
    sizes = f"{len(cases.gains)} members, {len(set(cases.gaps))} gaps, {len(set(cases.priors))} priors"
    mean = f"mean gain in {AHEAD} rollouts or all there are {100 * cases.gains.mean():+.0f} points"
    correlations = [(name, tables.number(band, "correlation", digits=2)) for name, band in bands.items()]
    ranges = [
        (f"{100 * low:.0f} to {100 * high:.0f}", str(n), f"{100 * predicted:+.0f}", f"{100 * measured:+.0f}")
        for low, high, n, predicted, measured in rows
    ]
    values = ", ".join(f"{name} {value:.3f}" for name, value in coefficients._asdict().items())
    return [
        f"{words}: {sizes}; {mean}",
        "",
        *cli.columns([("rank correlation with the gain", "[95 %, priors drawn first]"), *correlations]),
        "",
        *cli.columns([("predicted gain, points", "members", "mean predicted", "mean measured"), *ranges]),
        "",
        f"coefficients from {COUNTS[-1]} rollouts of all of --runs: {values}",
    ]


def gather(args: CalibrateArgs, runs: Sequence[Path]) -> list[Cases]:
    """The cases of finished runs, as diagnosed from each of the COUNTS of rollouts; one run at a time is in memory."""
    import jax.numpy as jnp

    from experiments.runner.diagnose_run import load, play_simulated, read
    from sgft_jax import stacking
    from sgft_jax.examination import Examiner

    examiners: dict[Any, Any] = {}
    inputs: list[list[Inputs]] = [[] for _ in COUNTS]
    played: list[list[float]] = [[] for _ in COUNTS]
    facts: list[tuple[Any, ...]] = []
    for run in runs:
        config, curve, task = read_config(run), read_curve(run).of("success"), task_of_rollouts(run, args.task)
        begun, preset = Path(config["prior"]) if config.get("prior") else None, config.get("preset") or args.preset
        folders = prior_folders(args.prior or begun, out=args.out, task=task, preset=preset)
        key = (task, *folders)
        if key not in examiners:
            env, priors = load(task, args.impl, folders)
            examiner, simulated = Examiner(priors[0].card, env), play_simulated(env, priors, args.seed)
            params = stacking.stack([prior.params for prior in priors])
            examiners[key] = (env, priors, examiner, params, examiner.control(params, stacking.stack(simulated)))
        env, priors, examiner, *known = examiners[key]
        rollouts, which = read(run, env, priors, COUNTS[-1])
        if (count := rollouts[0].valid.shape[0]) < COUNTS[-1]:
            raise UserError(f"{run}: holds {count} recorded rollouts, a calibration needs {COUNTS[-1]}")
        held = curve.x <= AHEAD
        params, control = (stacking.member(x, jnp.array(which)) for x in known)
        examined = examiner.examine(params, control, stacking.stack(rollouts), COUNTS)
        for member, (diagnosis, p) in enumerate(zip(examined, which, strict=True)):
            for i, statistics in enumerate(diagnosis.statistics):
                inputs[i].append(inputs_of(statistics))
                played[i].append(statistics["success"])
            success = curve.values[member, held]
            gained = round(success[-1] - success[0], 6)  # equal ones must tie
            names = (f"{env.name} {curve.gap}", f"{env.name} {folders[p]}")
            facts.append((success[0], gained, (curve.x[held], success), *names))
        if not args.json:
            print(f"diagnosed: {run}", flush=True)
    zero_shot, gains, curves, names, priors = zip(*facts, strict=True)
    rest = (np.array(zero_shot), np.array(gains), curves, np.array(names), np.array(priors))
    return [Cases(Inputs(*np.array(x).T), np.array(success), *rest) for x, success in zip(inputs, played, strict=True)]


# --- the fit ----------------------------------------------------------------------------------------------------------


def fit(cases: Cases) -> Coefficients:
    """The coefficients by least squares, none negative, so that the formula stays monotone; the pace by search."""
    from scipy.optimize import nnls

    x = cases.inputs
    columns = np.stack([np.ones_like(x.success), x.improvable, x.explained], axis=1)
    shares, _ = nnls(columns * (1.0 - x.success)[:, None], cases.gains)
    return Coefficients(*map(float, shares), pace=_pace(cases))


def _pace(cases: Cases) -> float:
    """That which describes the curves best, of members that gained something."""
    gained = [curve for curve, more in zip(cases.curves, cases.gains, strict=True) if more > 0.1]
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


if __name__ == "__main__":
    cli.run_main(main, CalibrateArgs, __doc__ or "")
