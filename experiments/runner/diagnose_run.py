"""Impure: a diagnosis of one real system by every prior. `experiments.diagnose` is its command."""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env
from envs.gaps import Gap
from envs.rollout import Episode
from envs.types import Transition, UserError
from experiments.runner import cli, options
from experiments.runner.cli import columns
from experiments.runner.gaps_run import systems
from experiments.runner.narrowed import Narrowed, likely, narrowed, posterior, readable, table
from experiments.runner.progress import doing
from experiments.runner.real_systems import REMOTE, advice, connect, is_robot, is_stepped, title
from experiments.runner.recorded import RecordedSystem
from experiments.runner.training import play
from sgft_jax import api, stacking
from sgft_jax.algorithms import make_policy
from sgft_jax.analysis import figures, tables
from sgft_jax.analysis.reading import last_start
from sgft_jax.diagnosis import Rollouts, honesty, promises
from sgft_jax.files.disk import jsonable, write_json, written
from sgft_jax.io.priors import digest, load_priors, variant_of
from sgft_jax.io.real import RealStore
from sgft_jax.io.runs import read_config
from sgft_jax.math import stats
from sgft_jax.methods import get_method
from sgft_jax.posterior.candidates import candidates
from sgft_jax.posterior.estimator import MOST, without_estimator
from sgft_jax.posterior.interface import MAKE, Inference, check_estimator, infer
from sgft_jax.posterior.trust import AS_IS, CORRECTED
from sgft_jax.systems.simulated import drifted
from sgft_jax.types import Prior

if TYPE_CHECKING:
    from experiments.diagnose import DiagnoseArgs

_PLAYED = 4  # rollouts of every prior on a gap, unless the user says otherwise
_SEED = 2**31 + 7  # of all of them
_RANGE = 1.001  # of commands, with room for rounding
_PICTURE = "posterior.png"
_READ = (*Transition._fields, "valid", "success")  # arrays of a recorded rollout


class Evidence(NamedTuple):
    """Rollouts [n] of every member, and which prior looks at each. words: what was played where. gap: the real system,
    where one knows.
    """

    real: list[Rollouts]
    which: list[int]
    words: str
    gap: Gap | None = None


class Inferred(NamedTuple):
    """points: [n, draws, d] of all members' posteriors, `after` so many rollouts [n]. inference: [M] after all."""

    after: list[int]
    points: np.ndarray
    inference: Inference


def diagnose(
    args: "DiagnoseArgs", folders: list[Path], task: str, recorded: Path | None, home: Path
) -> tuple[dict[str, Any], list[str]]:
    """The diagnosis as JSON data and as lines for people. In `home` it leaves the numbers, and a picture where there is
    an estimator.
    """
    env, priors = load(task, args.impl, folders)
    seen = recorded_in(env, priors, recorded, args.rollouts) if recorded else _played(env, priors, args, home)
    members, labels = [priors[p] for p in seen.which], [str(folders[p]) for p in seen.which]
    inferred = _infer(env, members, seen.real, args.seed) if priors[0].card.get("estimator") else None
    home.mkdir(parents=True, exist_ok=True)
    for name in (_PICTURE, _systems(home)):
        (home / name).unlink(missing_ok=True)  # of an earlier diagnosis
    facts: dict[str, Any] = {"task": env.name, "data": seen.words}
    with doing("writing down what rollouts say", 10, once=True):
        looks = [_look(env, prior, rollouts) for prior, rollouts in zip(members, seen.real, strict=True)]
        if inferred is None:
            lines = ["Which system it is stays open: no estimator" + f"; {MAKE}" * (env.score == "success"), ""]
        else:
            promised = [_promise(stacking.member(inferred.inference, i)) for i in range(len(members))]
            looks = [look | promise for look, promise in zip(looks, promised, strict=True)]
            known = narrowed(env, inferred.points, inferred.after, seen.gap)
            lines = [_misfit(looks), *_draw(known, home), *_leave_systems(env, home, inferred.inference)]
            facts["unknowns"] = known._asdict()
    facts = jsonable(facts | {"priors": [{"prior": label, **look} for label, look in zip(labels, looks, strict=True)]})
    write_json(home / "diagnosis.json", facts)
    lines = [f"{env.name}: {seen.words}", *_rows(labels, looks), "", *lines, f"numbers: {home / 'diagnosis.json'}"]
    if env.score == "success" and not (recorded and read_config(recorded)):  # in a run others have played, too
        success = np.concatenate([x.success for x in {id(x): x for x in seen.real}.values()])  # each policy's once
        real, chosen = REMOTE if recorded else args.real, {"task": task, "prior": args.prior or folders[0].parent}
        lines.append(advice(int((~success).sum()), len(success), real, **chosen, out=args.out))
    return facts, lines


def load(task: str, impl: Any, folders: Sequence[Path]) -> tuple[Env, list[Prior]]:
    """The task as these priors see it, and the priors; raises UserError for those without V_sim, or with an estimator
    of other systems.
    """
    env = envs.make(task, impl, **variant_of(folders))
    priors = load_priors(folders, env, estimators=True)
    for prior in priors:
        api.check_prior(prior, get_method("sgft"), env)
        if prior.card.get("estimator"):
            check_estimator(prior.card, env)
    return env, priors


def _infer(env: Env, members: Sequence[Prior], real: Sequence[Rollouts], seed: int) -> Inferred:
    """What the rollouts of every member say, by its prior's estimator, and what it promises of corrections."""
    n, key = min(real[0].valid.shape[0], MOST), jax.random.fold_in(jax.random.key(_SEED), seed)
    after = sorted({0, *(2**i for i in range(n.bit_length())), n})
    read = [readable(env, rollouts) for rollouts in real]
    with doing("building systems that it may be", 10, once=True):
        possible = candidates(env)
    judge = jax.jit(functools.partial(infer, env, possible, make_policy(members[0].card, env)))
    with doing("trying corrections in these systems", 40 + 15 * len(members), once=True):
        points = [posterior(env, prior.params.estimator, x, after, key) for prior, x in zip(members, read, strict=True)]
        inferences = [
            judge(without_estimator(prior.params), prior.params.estimator, x, jnp.int32(n), key)
            for prior, x in zip(members, read, strict=True)
        ]
        return Inferred(after, np.concatenate(points, axis=1), jax.device_get(stacking.stack(inferences)))


def _look(env: Env, prior: Prior, rollouts: Rollouts) -> dict[str, Any]:
    """Success of a prior's rollouts, and what they make of its V_sim, as JSON data."""
    value = make_policy(prior.card, env).value
    assert value is not None  # as `load` has asked
    values, returns = promises(functools.partial(value, prior.params), rollouts)
    success = np.asarray(rollouts.success)
    honest = honesty(np.asarray(values), np.asarray(returns), np.asarray(rollouts.valid))
    return {"rollouts": len(success), "succeeded": int(success.sum()), "V_sim": honest}


def _promise(inference: Inference) -> dict[str, Any]:
    """What the rollouts of one member say of the system, as JSON data."""
    promised = {"as it is": inference.promised[AS_IS], "corrected": inference.promised[CORRECTED]}
    contradiction = {"nats": inference.nats, "usual": inference.usual, "contradicted": inference.contradicted}
    return {"promised": promised, "contradiction": contradiction, "current": int(inference.current.sum())}


def _draw(known: Narrowed, home: Path) -> list[str]:
    """The picture of what is known, and the same as lines."""
    picture = figures.shrinking(home / _PICTURE, *known, title="Which system is it?")
    heading = "Which system is it? 80 % intervals of what rollouts tell most of:"
    return ["", heading, "", table(known), "", f"picture: {picture}"]


def _systems(home: Path) -> str:
    """What the file there is called that holds these systems. Pretraining calls its own folder like it."""
    return f"like-{home.name}.toml"


def _leave_systems(env: Env, home: Path, inference: Inference) -> list[str]:
    """Leaves the systems that may be the real one as a gap, unless some member's rollouts [M] are of none."""
    path = home / _systems(home)
    if inference.contradicted.any():
        return []
    with written(path) as part:
        gap = likely(env, np.concatenate(inference.points), path.stem)
        part.write_text(gaps.to_toml([gap]), encoding="utf-8")
    preset = "cpu" if jax.default_backend() == "cpu" else None
    train = options.command("pretrain", task=env.name, preset=preset, real=path)
    return [cli.as_typed(f"these systems: {path}; a policy for them: {train}")]


# --- rollouts ---------------------------------------------------------------------------------------------------------


def _played(env: Env, priors: list[Prior], args: "DiagnoseArgs", home: Path) -> Evidence:
    """Zero-shot rollouts of every prior, on a gap or a real system."""
    count, where, gap = args.rollouts or _PLAYED, title(args.real), None
    if is_stepped(args.real):
        real = _play_real(env, args, priors, count, home)
    else:
        gap, where = gaps.load(env, args.real), f"the gap {where}"
        real = _play(env, gap, priors, count, args.seed)
    who = "one prior" if len(priors) == 1 else f"each of {len(priors)} priors"
    words = f"{tables.rollouts(count)} of {who}, just played zero-shot on {where}"
    return Evidence(real, list(range(len(priors))), words, gap)


def recorded_in(env: Env, priors: list[Prior], home: Path, most: int | None) -> Evidence:
    """Rollouts that a folder holds."""
    real, which = read(home, env, priors, most)
    return Evidence(real, which, f"{tables.rollouts(real[0].valid.shape[0])} recorded in {home}")


def _play(env: Env, gap: Gap, priors: list[Prior], n: int, seed: int) -> list[Rollouts]:
    """Rollouts [n] of every prior on a gap, whose sensors may drift from one to the next."""
    keys = jax.random.split(jax.random.fold_in(jax.random.key(_SEED), seed), n)
    with doing(f"playing {tables.rollouts(n)} of each prior", 30, once=True):
        system, members = systems(env, [gap], priors, max(n, 64))
        policy = make_policy(priors[0].card, system.env)
        if system.drift is None:
            return _of_members(play(system, policy, members, keys[0], n), len(priors))
        played = [play(drifted(system, i), policy, members, key, 1) for i, key in enumerate(keys)]
        return _of_members(jax.tree.map(lambda *x: np.concatenate(x, axis=1), *played), len(priors))


def _play_real(env: Env, args: "DiagnoseArgs", priors: list[Prior], n: int, home: Path) -> list[Rollouts]:
    """Rollouts [n] of every prior on a robot or an environment, each of them kept on disk in `home`."""
    system = connect(env, [args.real], (), members=len(priors), gamma=priors[0].card["gamma"], home=args.out)
    try:
        store = RealStore(home)  # after the connection, which may fail
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(_SEED), args.seed), len(store))
        members = stacking.stack([prior.params for prior in priors])
        rhythm = 1 if is_robot(args.real) else None
        kept = RecordedSystem(system, [store], done=len(store), explore=False, sync_every=rhythm)
        with doing(f"playing {tables.rollouts(n)} of each prior"):
            played = play(kept, make_policy(priors[0].card, env), members, key, n)
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
    if any(np.abs(arrays["action"][arrays["valid"].astype(bool)]).max(initial=0.0) > _RANGE for arrays in stored):
        raise UserError(f"{home / 'real'}: holds actions beyond [-1, 1], the range of commands")
    joined = {name: jnp.stack([arrays[name] for arrays in stored], axis=1) for name in _READ}
    if not joined["valid"].any():
        raise UserError(f"{home / 'real'}: holds no valid step")
    rows = Transition(*(joined[name] for name in Transition._fields))
    both = Rollouts(rows, joined["valid"].astype(bool), joined["success"].astype(bool))
    real, config, p = [stacking.member(both, s) for s in range(len(both.success))], read_config(home), len(priors)
    if config:
        known = last_start(home).get("priors", [])
        bare = [Prior(without_estimator(prior.params), prior.card) for prior in priors]  # as most methods begin
        if known and known not in ([digest(prior) for prior in some] for some in (priors, bare)):
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


def _rows(labels: Sequence[str], looks: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line for each prior."""
    head = ["prior", "success %", "V_sim promises", "returned", "rank"]
    promised = "promised" in looks[0]
    rows = [(*head, "simulation promises %: as it is", "corrected") if promised else tuple(head)]
    for label, look in zip(labels, looks, strict=True):
        success = tables.number(stats.success_interval(look["succeeded"], look["rollouts"]))
        value = [f"{x:.2f}" for x in look["V_sim"].values()]
        rows.append((label, success, *value, *(f"{100 * x:.0f}" for x in look.get("promised", {}).values())))
    return columns(rows)


def _misfit(looks: Sequence[Mapping[str, Any]]) -> str:
    """Whether one of the simulator's systems may have made the rollouts."""
    nats, usual, contradicted = (
        np.mean([look["contradiction"][key] for look in looks]) for key in ("nats", "usual", "contradicted")
    )
    if looks[0]["rollouts"] < 2:
        return "One rollout does not tell whether any of the simulator's systems made it: play two."
    numbers = f"halves of them contradict each other by {nats:.0f} nats (95 % of its systems: below {usual:.0f})"
    if contradicted >= 0.5:
        return f"None of the simulator's systems made these rollouts: {numbers}. Neither intervals nor promises hold."
    if (current := min(look["current"] for look in looks)) < min(looks[0]["rollouts"], MOST):
        later = f"Promises are of the last {current}, intervals of all."
        return f"The system changes: earlier rollouts contradict later ones. {later}"
    return f"One of the simulator's systems may have made these rollouts: {numbers}. Warps can stay unseen."
