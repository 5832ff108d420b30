"""Impure: a diagnosis of one real system by every prior. `experiments.diagnose` is its command."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env
from envs.gaps import SIM, Gap
from envs.rollout import Episode
from envs.types import Transition, UserError
from experiments.runner.cli import columns
from experiments.runner.gaps_run import systems
from experiments.runner.progress import doing
from experiments.runner.real_systems import REMOTE, advice, connect, is_robot, is_stepped, title
from experiments.runner.recorded import RecordedSystem
from experiments.runner.training import play
from sgft_jax import api, stacking
from sgft_jax.algorithms import make_policy
from sgft_jax.analysis import figures, tables, verdict
from sgft_jax.analysis.reading import last_start
from sgft_jax.analysis.verdict import Names
from sgft_jax.diagnosis import Rollouts
from sgft_jax.examination import Examined, Examiner
from sgft_jax.files.disk import jsonable, write_json
from sgft_jax.io.priors import digest, load_priors, variant_of
from sgft_jax.io.real import RealStore
from sgft_jax.io.runs import read_config
from sgft_jax.math import stats
from sgft_jax.methods import get_method
from sgft_jax.models.distortion import FURTHEST
from sgft_jax.types import Prior

if TYPE_CHECKING:
    from experiments.diagnose import DiagnoseArgs

SIMULATED, PLAYED = 32, 4  # rollouts of every prior in simulation, and on a gap unless the user says otherwise
_SEED = 2**31 + 7  # of all of them
_READ = (*Transition._fields, "valid", "success")  # arrays of a recorded rollout


def diagnose(
    args: "DiagnoseArgs", folders: list[Path], task: str, recorded: Path | None
) -> tuple[dict[str, Any], list[str]]:
    """The diagnosis as JSON data and as lines for people; writes the picture and the numbers."""
    env, priors = load(task, args.impl, folders)
    home = args.out / "diagnose" / env.name
    if recorded is not None:
        real, which = read(recorded, env, priors, args.rollouts)
        simulated = play_simulated(env, priors, args.seed)
        count = real[0].valid.shape[0]
        name = "_".join(recorded.parts[-3:] if read_config(recorded) else recorded.parts[-1:])
        what = f"{_rollouts(count)} recorded in {recorded}"
    else:
        count, name, which = args.rollouts or PLAYED, title(args.real), list(range(len(priors)))
        if is_stepped(args.real):
            real = _play_real(env, args, priors, count, home / name)
            simulated = play_simulated(env, priors, args.seed)
        else:
            real, simulated = _play_both(env, gaps.load(env, args.real), priors, count, args.seed)
        where = name if is_stepped(args.real) else f"the gap {name}"
        who = "one prior" if len(priors) == 1 else f"each of {len(priors)} priors"
        what = f"{_rollouts(count)} of {who}, just played zero-shot on {where}"
    labels = [str(folders[p]) for p in which]
    with doing("examining the rollouts", 40, once=True):
        examined, mean = _examine(env, priors, real, simulated, which)
    names = names_of(env)
    signs, header = verdict.signs(mean[-1], names), f"{env.name}: {what}"
    findings = {
        "task": env.name,
        "data": what,
        "priors": [{"prior": label, "found": one.statistics} for label, one in zip(labels, examined, strict=True)],
        "mean": mean,
        "signs": jsonable(signs),
        "verdict": verdict.verdict(mean[-1], names),
        "prediction": predicted(mean[-1]),
    }
    home /= name
    home.mkdir(parents=True, exist_ok=True)
    picture = figures.diagnosis(home / "diagnosis.png", mean[-1], signs, _points(examined), title=header)
    write_json(home / "diagnosis.json", findings)
    lines = [header, *_lines(labels, examined, mean[-1]), "", *findings["verdict"], ""]
    lines += [f"picture: {picture}", f"numbers: {home / 'diagnosis.json'}"]
    if env.score == "success" and not (recorded and read_config(recorded)):  # in a run others have played, too
        n, real = mean[-1]["rollouts"], REMOTE if recorded else args.real
        chosen = {"task": task, "prior": args.prior or folders[0].parent, "out": args.out}
        lines.append(advice(n - round(n * mean[-1]["success"]), n, real, **chosen))
    return jsonable(findings), lines


def _examine(
    env: Env, priors: Sequence[Prior], real: Sequence[Rollouts], simulated: Sequence[Rollouts], which: Sequence[int]
) -> tuple[list[Examined], list[dict[str, Any]]]:
    """What real rollouts tell, by each prior that looks at them, and the means after 1, 2, 4, ... and all rollouts.

    simulated: of every prior. which: the prior that looks at each of `real`.
    """
    examiner, n = Examiner(priors[0].card, env), real[0].valid.shape[0]
    counts = sorted({*(2**i for i in range(n.bit_length())), n})
    params = stacking.stack([prior.params for prior in priors])
    control = examiner.control(params, stacking.stack(simulated))
    chosen, usual = (stacking.member(x, jnp.array(which)) for x in (params, control))
    examined = examiner.examine(chosen, usual, stacking.stack(real), counts)
    same = all(rollouts is real[0] for rollouts in real)
    return examined, [average([one.statistics[i] for one in examined], same=same) for i in range(len(counts))]


def load(task: str, impl: Any, folders: Sequence[Path]) -> tuple[Env, list[Prior]]:
    """The task as these priors see it, and the priors; raises UserError for those without V_sim or models."""
    env = envs.make(task, impl, **variant_of(folders))
    priors = load_priors(folders, env)
    for prior in priors:
        api.check_prior(prior, get_method("sgft"), env)
    return env, priors


def names_of(env: Env) -> Names:
    """What people call the numbers of a task."""
    action, sensors = ([label for e in entries for label in e.labels] for entries in (env.action, env.measured))
    units = [e.unit for e in env.measured for _ in range(e.size)]
    return Names(action, list(zip(sensors, units, strict=True)), env.sensor_errors, env.control_dt, FURTHEST)


def average(diagnoses: Sequence[Mapping[str, Any]], *, same: bool) -> dict[str, Any]:
    """The mean of every number of several diagnoses; their rollouts are added up unless they are the same ones."""
    mean = jax.tree.map(lambda *x: x[0] if len(set(x)) == 1 else float(np.mean(x)), *diagnoses)
    return mean if same else {**mean, "rollouts": sum(diagnosis["rollouts"] for diagnosis in diagnoses)}


def predicted(diagnosis: Mapping[str, Any]) -> dict[str, Any]:
    """The prediction for one diagnosis, as JSON data."""
    x = verdict.inputs_of(diagnosis)
    return {
        "inputs": jsonable(x),
        "gain": float(verdict.gain(x)),
        "rollouts": verdict.AHEAD,
        "until": {"level": verdict.LEVEL, "rollouts": verdict.rollouts_until(x)},
    }


# --- rollouts ---------------------------------------------------------------------------------------------------------


def _play(env: Env, reals: Sequence[Gap], priors: list[Prior], n: int, seed: int) -> list[Rollouts]:
    """Exploring rollouts [n] of every prior on every gap: [gaps * priors], all priors on the first gap first."""
    key = jax.random.fold_in(jax.random.key(_SEED), seed)
    with doing(f"playing {_rollouts(n)} of each prior", 30, once=True):
        system, members = systems(env, reals, priors, max(n, 64))
        policy = make_policy(priors[0].card, system.env)
        return _of_members(play(system, policy, members, key, n, explore=True), len(reals) * len(priors))


def play_simulated(env: Env, priors: list[Prior], seed: int) -> list[Rollouts]:
    """Exploring rollouts [SIMULATED] of every prior where nothing differs."""
    return _play(env, [gaps.find(env.name, SIM)], priors, SIMULATED, seed)


def _play_both(env: Env, gap: Gap, priors: list[Prior], n: int, seed: int) -> tuple[list[Rollouts], list[Rollouts]]:
    """Rollouts [n] of every prior on a gap, and [SIMULATED] in simulation; one program plays both where it can."""
    if gap.scene:
        return _play(env, [gap], priors, n, seed), play_simulated(env, priors, seed)
    both = _play(env, [gap, gaps.find(env.name, SIM)], priors, max(n, SIMULATED), seed)
    real, simulated = both[: len(priors)], both[len(priors) :]
    return jax.tree.map(lambda x: x[:n], real), jax.tree.map(lambda x: x[:SIMULATED], simulated)


def _play_real(env: Env, args: "DiagnoseArgs", priors: list[Prior], n: int, home: Path) -> list[Rollouts]:
    """Exploring rollouts [n] of every prior on a robot or an environment, each of them kept on disk in `home`."""
    system = connect(env, [args.real], (), members=len(priors), gamma=priors[0].card["gamma"], home=args.out)
    try:
        store = RealStore(home)  # after the connection, which may fail
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(_SEED), args.seed), len(store))
        members = stacking.stack([prior.params for prior in priors])
        kept = RecordedSystem(system, [store], done=len(store), sync_every=1 if is_robot(args.real) else None)
        with doing(f"playing {_rollouts(n)} of each prior"):
            played = play(kept, make_policy(priors[0].card, env), members, key, n, explore=True)
    finally:
        system.close()
    return _of_members(played, len(priors))


def _of_members(played: Episode, count: int) -> list[Rollouts]:
    """Of episodes [members, n], what a diagnosis reads of each member."""
    rollouts = Rollouts(played.transitions, played.valid, played.success)
    return [stacking.member(rollouts, i) for i in range(count)]


def read(home: Path, env: Env, priors: Sequence[Prior], most: int | None) -> tuple[list[Rollouts], list[int]]:
    """The recorded rollouts [n] of every member, at most so many, and which prior looks at each.

    Of a run every seed has its prior. What was recorded without a run is looked at by all priors, or by one each.
    Raises UserError where rollouts are not those of the task, or priors not those of the run.
    """
    store = RealStore(home)
    stored = [store.rollout(i) for i in range(min(len(store), most or len(store)))]
    for i, arrays in enumerate(stored):
        _check(home / "real", i, arrays, stored[0], env)
    joined = {name: jnp.stack([arrays[name] for arrays in stored], axis=1) for name in _READ}
    if not joined["valid"].any():
        raise UserError(f"{home / 'real'}: holds no valid step")
    rows = Transition(*(joined[name] for name in Transition._fields))
    both = Rollouts(rows, joined["valid"].astype(bool), joined["success"].astype(bool))
    real, config, p = [stacking.member(both, s) for s in range(len(both.success))], read_config(home), len(priors)
    if config:
        known = last_start(home).get("priors", [])
        if known and known != [digest(prior) for prior in priors]:
            raise UserError(f"{home}: began with other priors than these; name them with --prior")
        return real, [(config.get("seed", 0) + s) % p for s in range(len(real))]
    if len(real) == 1:
        real *= p
    if len(real) != p:
        raise UserError(
            f"{home}: holds rollouts of {len(real)} policies; name one prior for each with --prior, not {p}"
        )
    return real, list(range(p))


def _check(
    folder: Path, number: int, arrays: Mapping[str, np.ndarray], first: Mapping[str, np.ndarray], env: Env
) -> None:
    path = folder / f"rollout-{number:06d}.npz"
    sizes = {"obs": env.obs_dim, "next_obs": env.obs_dim, "action": env.act_dim}
    for name, size in sizes.items():
        if arrays[name].ndim != 3 or arrays[name].shape[-1] != size:
            raise UserError(
                f"{path}: {name} has shape {list(arrays[name].shape)}, these priors of {env.name} need "
                f"[seeds, steps, {size}]"
            )
    if arrays["obs"].shape != first["obs"].shape:
        raise UserError(f"{path}: has another number of seeds or steps than the first rollout")


# --- for people -------------------------------------------------------------------------------------------------------


def _points(examined: Sequence[Examined]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """All priors' V_sim and returns, at most 1,000 of each kind."""
    points = {}
    for where in ("real", "simulated"):
        value, returns = (np.concatenate([one.points[where][i] for one in examined]) for i in (0, 1))
        some = np.random.default_rng(0).permutation(len(value))[:1000]
        points[where] = (value[some], returns[some])
    return points


def _rollouts(n: int) -> str:
    return f"{n} rollout{'s' * (n > 1)}"


def _lines(labels: Sequence[str], examined: Sequence[Examined], mean: dict[str, Any]) -> list[str]:
    """One line for each prior, and one for their mean."""
    rows = [("prior", "success %", "improvable %", "V_sim short by", "rank", "model error -> identified (sim)", "gain")]
    diagnoses = [(label, one.statistics[-1]) for label, one in zip(labels, examined, strict=True)]
    if len(examined) > 1:
        diagnoses.append(("mean", mean))
    for label, diagnosis in diagnoses:
        n, value, ahead = diagnosis["rollouts"], diagnosis["value"], diagnosis["horizons"].index(4)
        four = {where: f"{errors[ahead]:.2f}" for where, errors in diagnosis["model_error"].items()}
        success = tables.number(stats.success_interval(round(n * diagnosis["success"]), n))
        improvable, short = f"{100 * value['real'][0]['improvable']:.0f}", f"{value['shortfall']:.1f} sd"
        model = f"{four['real']} -> {four['identified']} ({four['simulated']})"
        gain = f"{100 * verdict.gain(verdict.inputs_of(diagnosis)):+.0f}"
        rows.append((label, success, improvable, short, f"{value['rank_correlation']:.2f}", model, gain))
    return columns(rows)
