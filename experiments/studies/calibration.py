"""Impure: how well diagnoses of finished runs predict what these have gained. `diagnose_calibrate` is its command."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from envs.types import UserError
from experiments.runner.cli import columns
from experiments.runner.diagnose_run import load, play_simulated, read
from experiments.runner.options import prior_folders, task_of_rollouts
from sgft_jax import stacking
from sgft_jax.analysis import prediction, tables
from sgft_jax.analysis.prediction import AHEAD, Cases, Inputs
from sgft_jax.analysis.reading import read_curve
from sgft_jax.examination import Examiner
from sgft_jax.files.disk import jsonable
from sgft_jax.io.runs import read_config

if TYPE_CHECKING:
    from experiments.studies.diagnose_calibrate import CalibrateArgs

COUNTS = (1, 2, 4)  # rollouts that a prediction is made from


def calibrate(args: "CalibrateArgs", runs: list[Path], checked: list[Path]) -> tuple[dict[str, Any], list[str]]:
    """How well gains are predicted, as JSON data and as lines for people.

    The runs to check on are predicted from `runs`; without any, every second gap is from the others.
    """
    if not checked and len({(curve.task, curve.gap) for curve in map(read_curve, runs)}) < 2:
        raise UserError("--runs: these runs are on one gap; name runs on others too, or some with --check")
    cases = gather(args, runs)
    coefficients = prediction.fit(cases[-1])
    if checked:
        fitted, held = cases, gather(args, checked)
        words = f"{len(checked)} other runs, predicted from {len(runs)}"
    else:
        out = prediction.held_out(cases[-1].gaps)
        fitted, held = ([case.of(members) for case in cases] for members in (~out, out))
        words = f"every second gap of {len(runs)} runs, predicted from the other gaps"
    fits = [prediction.gain(new.inputs, prediction.fit(old)) for old, new in zip(fitted, held, strict=True)]
    final = held[-1]
    lines = {f"prediction after {n} rollouts": (fit, case) for n, fit, case in zip(COUNTS, fits, held, strict=True)}
    lines["the same, coefficients of this version"] = (prediction.gain(final.inputs), final)
    lines["100 - zero-shot (50 episodes or so)"] = (1.0 - final.zero_shot, final)
    lines[f"100 - success of the same {COUNTS[-1]} rollouts"] = (1.0 - final.played, final)
    bands = {name: prediction.agreement(*pair) for name, pair in lines.items()}
    rows = prediction.table(fits[-1], final)
    summary = {
        "runs": [str(run) for run in runs],
        "checked": [str(run) for run in checked],
        "members": len(final.gains),
        "coefficients": jsonable(coefficients),
        "rank_correlation": {name: jsonable(band) for name, band in bands.items()},
        "table": [dict(zip(("low", "high", "members", "predicted", "measured"), row, strict=True)) for row in rows],
    }
    return jsonable(summary), _lines(words, final, coefficients, bands, rows)


def _lines(
    words: str, cases: Cases, coefficients: prediction.Coefficients, bands: dict, rows: Sequence[tuple]
) -> list[str]:
    sizes = f"{len(cases.gains)} members, {len(set(cases.gaps))} gaps, {len(set(cases.priors))} priors"
    gain = f"mean gain in {AHEAD} rollouts or all there are {100 * cases.gains.mean():+.0f} points"
    correlations = [(name, tables.number(band, "correlation", digits=2)) for name, band in bands.items()]
    table = [
        (f"{100 * low:.0f} to {100 * high:.0f}", str(n), f"{100 * predicted:+.0f}", f"{100 * measured:+.0f}")
        for low, high, n, predicted, measured in rows
    ]
    values = ", ".join(f"{name} {value:.3f}" for name, value in coefficients._asdict().items())
    return [
        f"{words}: {sizes}; {gain}",
        "",
        *columns([("rank correlation with the gain", "[95 %, priors drawn first]"), *correlations]),
        "",
        *columns([("predicted gain, points", "members", "mean predicted", "mean measured"), *table]),
        "",
        f"coefficients from {COUNTS[-1]} rollouts of all of --runs: {values}",
    ]


def gather(args: "CalibrateArgs", runs: Sequence[Path]) -> list[Cases]:
    """The cases of finished runs, as diagnosed from each of the COUNTS of rollouts; one run at a time is in memory."""
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
            for i, found in enumerate(diagnosis.statistics):
                inputs[i].append(prediction.inputs_of(found))
                played[i].append(found["success"])
            success = curve.values[member, held]
            gained = round(success[-1] - success[0], 6)  # equal ones must tie
            names = (f"{env.name} {curve.gap}", f"{env.name} {folders[p]}")
            facts.append((success[0], gained, (curve.x[held], success), *names))
        if not args.json:
            print(f"diagnosed: {run}", flush=True)
    zero_shot, gains, curves, names, priors = zip(*facts, strict=True)
    rest = (np.array(zero_shot), np.array(gains), curves, np.array(names), np.array(priors))
    return [Cases(Inputs(*np.array(x).T), np.array(success), *rest) for x, success in zip(inputs, played, strict=True)]
