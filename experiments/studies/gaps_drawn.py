"""Impure: draws gaps and measures them, with a table on disk that grows. `gaps_draw` is its command."""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

import envs
from envs import gap_distribution, gaps
from envs.base import Env
from envs.effects import make_range
from envs.files import read_json
from envs.gaps import SIM, Gap
from envs.observations import concealed, with_previous_actions
from envs.rollout import Episode, real_env
from envs.types import Key, PyTree, Transition, UserError
from experiments.runner.cli import columns
from experiments.runner.gaps_run import FINAL_SEED, episode_key, percent, rate, systems, train
from experiments.runner.training import play
from sgft_jax import api, stacking
from sgft_jax.algorithms import make_policy
from sgft_jax.files.disk import differences, jsonable, write_json
from sgft_jax.io.priors import digest, load_priors, variant_of
from sgft_jax.math import stats
from sgft_jax.methods import get_method
from sgft_jax.models.config import network_of
from sgft_jax.models.distortion import Distortion, Identified, Interface, Seen, command_interface, none
from sgft_jax.types import Prior, SimulatedData

if TYPE_CHECKING:
    from experiments.studies.gaps_draw import DrawArgs

SOLVED_AT_LEAST, FAILED_BELOW, TRIVIAL_AT_LEAST, ADMITTED_AT_LEAST = 0.8, 0.2, 0.9, 0.9
PLANNER = "sgft-mpc"
HALF = 10  # rollouts
PREVIOUS_ACTIONS = 2  # that the judge sees: a command that comes late is still in force, or was when the step began
_ROLLOUT_SEED = 2**31 + 6  # of the rollouts that distortions are fitted to
_MEASURED = {"zero_shot": ("zero_shot", "fit"), "plan": ("plan",), "judge": ("judge",)}  # of a line, by measurement
_MASTERED = {"zero_shot": "zero-shot", "fit": "after fit", "plan": "by plan", "judge": "after training"}
_ELSE = "choose another --out, or remove the table"
type Lines = dict[str, dict[str, Any]]  # of gaps by name, or of measurements
_SIMULATED = 8  # rollouts that tell how far the model is off in simulation; the real system is fitted to one


def run(args: "DrawArgs", seeds: list[int], folders: list[Path]) -> tuple[list[Gap], dict[str, Any]]:
    """Draws, writes and measures gaps; prints the table and returns both. folders: of the priors."""
    task = envs.name_of(args.task)
    env = concealed(envs.make(args.task, args.impl, **variant_of(folders)))
    drawn = gap_distribution.draw(env, gap_distribution.load(env, args.distribution), args.seed, args.count)
    path = args.out / "gaps" / task / f"seed-{args.seed}.toml"
    write_gaps(path, drawn)
    priors = load_priors(folders, env)
    everywhere = [gaps.find(task, SIM), *drawn]
    table = Table(path.with_suffix(".json"), {"task": task, "seed": args.seed}, everywhere)
    for what, settings in _settings(env, args, priors, seeds).items():
        table.settle(what, settings, again=args.overwrite)
    for missing in _together(env, [gap for gap in table.without("zero_shot", everywhere) if gap.name != SIM]):
        table.add(_zero_shot(env, missing, priors, args.episodes))
    for missing in _together(env, table.without("plan", everywhere) if args.plan else []):
        table.add(_plan(env, missing, priors, args.episodes))
    for missing in _together(env, table.to_judge(drawn) if args.judge else []):
        table.add(_judge(env, args, missing, seeds, path.with_suffix("") / missing[0].scene))
    print("\n".join(lines([gap.name for gap in everywhere], table.known)))
    print(f"gaps: {path}\ntable: {table.path}")
    return drawn, table.content


def _together(env: Env, drawn: Sequence[Gap]) -> list[list[Gap]]:
    """The gaps of each scene, as they are halfway where sensors drift: one program plays those of one scene."""
    return [[_halfway(env, gap) for gap in group] for group in gaps.by_scene(drawn, lambda gap: gap.scene)]


def _halfway(env: Env, gap: Gap) -> Gap:
    """The gap after half of a frozen test's rollouts."""
    if (rate := gaps.drifts(env, [gap])) is None:
        return gap
    ends = make_range(env, {"obs_bias": gap.effects.get("obs_bias", 0.0)})
    bias: Any = [(end.obs_bias + HALF * rate[0]).tolist() for end in ends]
    return gap._replace(effects={**gap.effects, "obs_bias": bias}, drift={})


def write_gaps(path: Path, drawn: Sequence[Gap]) -> None:
    """Writes drawn gaps as one file. It only grows: raises UserError if it holds others under these names."""
    old = list(gaps.read_file(path).values()) if path.exists() else []
    if odd := [gap.name for gap, now in zip(old, drawn, strict=False) if gap != now]:
        raise UserError(f"{path}: {odd[0]} is not what is drawn now; choose another --seed or --out")
    if len(drawn) > len(old):
        path.parent.mkdir(parents=True, exist_ok=True)
        head = f"# Drawn by python -m experiments.studies.gaps_draw --count {len(drawn)}"
        path.write_text(f"{head}\n\n{gaps.to_toml(drawn)}")


def _settings(env: Env, args: "DrawArgs", priors: Sequence[Prior], seeds: Sequence[int]) -> Lines:
    """What decides each of the measurements that are asked for, see `Table.settle`."""
    played = {"impl": env.impl, "episodes": args.episodes}
    policies = {**played, "priors": [digest(prior) for prior in priors]}
    training = {"preset": args.judge_preset, "config": args.config, "seeds": seeds}
    seen = {"previous_actions": env.previous_actions or PREVIOUS_ACTIONS}
    asked = {"zero_shot": policies}
    if args.plan:
        asked["plan"] = {**policies, "method": PLANNER, "options": get_method(PLANNER).config()}
    if args.judge:
        asked["judge"] = {**training, **seen, **played}
    return asked


class Table:
    """What is known of drawn gaps, on disk as soon as it is known.

    content: {**of, "about": settings by measurement, "gaps": by name the gap and what was measured on it}. of: what the
    table is of. Raises UserError for a table of something else, or of other gaps under these names.
    """

    def __init__(self, path: Path, of: Mapping[str, Any], gaps: Sequence[Gap]) -> None:
        self.path = path
        self.content = read_json(path) if path.exists() else {**of, "about": {}, "gaps": {}}
        if odd := differences({name: self.content.get(name) for name in of}, dict(of)):
            raise UserError(f"{path}: is a table of another {odd[0][0]}; {_ELSE}")
        if not isinstance(self.content.get("about"), dict):
            raise UserError(f"{path}: does not say how it was measured, an earlier version wrote it; {_ELSE}")
        for gap in gaps:
            line = self.known.setdefault(gap.name, {"gap": jsonable(gap.table)})
            if line["gap"] != jsonable(gap.table):
                raise UserError(f"{path}: its {gap.name} is another gap; {_ELSE}")
            line |= labels(line)

    def settle(self, what: str, settings: Mapping[str, Any], *, again: bool) -> None:
        """Says what decides a measurement. again: forget what other settings gave; else that raises UserError."""
        about, now = self.content["about"], jsonable(settings)
        if (old := about.get(what, now)) != now and not again:
            how = f"{what.replace('_', '-')} was measured with other {differences(old, now)[0][0]}, see its 'about'"
            raise UserError(f"{self.path}: {how}; --overwrite measures it again, another --out keeps both")
        if old != now:
            for line in self.known.values():
                for gone in _MEASURED[what]:
                    line.pop(gone, None)
                line |= labels(line)
        about[what] = now

    @property
    def known(self) -> dict[str, dict[str, Any]]:
        """A line for each gap, by name."""
        return self.content["gaps"]

    def without(self, what: str, drawn: Sequence[Gap]) -> list[Gap]:
        """Those of which this is not known yet."""
        return [gap for gap in drawn if what not in self.known[gap.name]]

    def to_judge(self, drawn: Sequence[Gap]) -> list[Gap]:
        """Those that nothing has mastered yet and on which no policy was trained: training is the dear measurement."""
        return [gap for gap in drawn if self.known[gap.name]["admitted"] is None]

    def add(self, lines: Mapping[str, Mapping[str, Any]]) -> None:
        """Writes what has been found of gaps, by name."""
        for name, line in lines.items():
            self.known[name] |= line
            self.known[name] |= labels(self.known[name])
        write_json(self.path, self.content)


def labels(line: Mapping[str, Any]) -> dict[str, Any]:
    """What follows from the measurements of a gap; None where they are missing.

    admitted: whether something masters the gap. mastered_by: the measurement that shows it.
    """
    success = line["zero_shot"]["success"] if "zero_shot" in line else None
    fit, mastered_by = line.get("fit"), _mastered_by(line)
    stratum = None
    if success is not None:
        stratum = "solved" if success >= SOLVED_AT_LEAST else "failed" if success < FAILED_BELOW else "partial"
    return {
        "stratum": stratum,
        "trivial": None if fit is None else fit["success"] >= TRIVIAL_AT_LEAST,
        "admitted": True if mastered_by else False if "judge" in line else None,
        "mastered_by": mastered_by,
    }


def _mastered_by(line: Mapping[str, Any]) -> str | None:
    """The first measurement in which a gap is mastered: one policy that succeeds shows that there is a way."""
    best = {what: max(policy["success"] for policy in line[what]["policies"]) for what in _MASTERED if what in line}
    return next((what for what, success in best.items() if success >= ADMITTED_AT_LEAST), None)


def lines(names: Sequence[str], known: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The table for people, success in per cent with 95 % intervals."""
    rows = [("gap", "families", "zero-shot %", "plan %", "after fit %", "trained there %", "stratum", "labels")]
    for name in names:
        line = known[name]
        zero, plan, fit, judge = (percent(line.get(what)) for what in ("zero_shot", "plan", "fit", "judge"))
        families = " ".join(line["gap"]["families"]) or "none"
        rows.append((name, families, zero, plan, fit, judge, line["stratum"], ", ".join(marks(line))))
    return columns(rows)


def marks(line: Mapping[str, Any]) -> list[str]:
    """The labels of a gap for people."""
    marks = ["trivial"] if line["trivial"] else []
    if line["mastered_by"]:
        marks.append(f"mastered {_MASTERED[line['mastered_by']]}")
    return [*marks, "not mastered"] if line["admitted"] is False else marks


# --- measurements -----------------------------------------------------------------------------------------------------


def _zero_shot(env: Env, drawn: Sequence[Gap], priors: list[Prior], episodes: int) -> Lines:
    """Success of the priors' policies on gaps and without one, as they are and after one rollout of identification.

    Of gaps in a scene of their own only as they are: identification compares with the simulator, in one program.
    """
    scene = drawn[0].scene
    everywhere = [gaps.find(env.name, SIM)._replace(scene=scene), *drawn]
    system, members = systems(env, everywhere, priors, episodes)
    policy = make_policy(priors[0].card, env)
    count = len(everywhere) * len(priors)
    nothing = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), none(env.act_dim, env.measured_dim))

    def rates(known: Distortion) -> list[dict[str, Any]]:
        played = play(system, policy, members._replace(distortion=known), episode_key(FINAL_SEED), episodes)
        return _rates(played, len(everywhere), len(priors))

    plain = rates(nothing)
    if scene:
        return {gap.name: {"zero_shot": success} for gap, success in zip(drawn, plain[1:], strict=True)}
    keys = jnp.broadcast_to(jax.random.split(episode_key(_ROLLOUT_SEED), _SIMULATED), (count, _SIMULATED))
    explored = system.play(policy, members._replace(distortion=nothing), keys, explore=True)
    part = command_interface(network_of(priors[0].card), env)
    fitted = rates(jax.jit(functools.partial(_identified, part, len(priors)))(members, explored))
    return {
        gap.name: {"zero_shot": before, "fit": after}
        for gap, before, after in zip(everywhere, plain, fitted, strict=True)
    }


def _identified(part: Interface, priors: int, members: PyTree, explored: Episode) -> Distortion:
    """What each policy [members] finds of each system, of which the first is the simulator.

    explored: [members, rollouts, T]; of real systems only the first rollout counts.
    """
    rows, held = explored.transitions, explored.valid

    def start(params: PyTree, rows: Transition) -> Identified:
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)

        def draw(key: Key, n: int) -> Transition:
            indices = jax.random.randint(key, (n,), 0, flat.reward.shape[0])
            return jax.tree.map(lambda x: x[indices], flat)

        return part.prepare(part.start(params, jax.random.key(0)), SimulatedData(draw, jnp.zeros(1)))

    sim = jax.vmap(start)(*jax.tree.map(lambda x: x[:priors], (members, rows)))
    everywhere = jax.tree.map(lambda x: jnp.tile(x, (len(held) // priors, *[1] * (x.ndim - 1))), sim)
    first = Seen(*jax.tree.map(lambda x: x[:, 0], (rows, held)))
    return jax.vmap(part.refit)(everywhere, first).distortion


def _plan(env: Env, drawn: Sequence[Gap], priors: list[Prior], episodes: int) -> Lines:
    """Success of what the planning method does before it has learned anything."""
    method = get_method(PLANNER)
    for prior in priors:
        api.check_prior(prior, method, env)
    policy = method.build(method.config(), priors[0], env).policy
    system, members = systems(env, drawn, priors, episodes)
    played = play(system, policy, members, episode_key(FINAL_SEED), episodes)
    rates = _rates(played, len(drawn), len(priors))
    return {gap.name: {"plan": success} for gap, success in zip(drawn, rates, strict=True)}


def _judge(env: Env, args: "DrawArgs", drawn: Sequence[Gap], seeds: list[int], folder: Path) -> Lines:
    """Success of policies that were trained on the gaps themselves and see their previous actions."""
    seen = env if env.previous_actions else with_previous_actions(env, PREVIOUS_ACTIONS)
    world, seen = real_env(env, drawn), real_env(seen, drawn)
    played = train(world, args.config, drawn, seeds, folder, episodes=args.episodes, seen=seen)
    return {gap.name: {"judge": rate(episodes, stats.mean)} for gap, episodes in zip(drawn, played, strict=True)}


def _rates(played: Episode, systems: int, policies: int) -> list[dict[str, Any]]:
    """Mean success over policies on each system, of episodes [systems * policies, n]."""
    return [rate(stacking.part(played, i, policies), stats.mean) for i in range(systems)]
