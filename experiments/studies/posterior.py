"""Which system is this? What rollouts tell, on systems that are known (docs/rules.md).

calibrate: systems are drawn from the prior over what is unknown of a real one, and a shipped prior's policy plays in
each; how often the posterior covers the truth, how far it narrows it, and what the policy that is chosen under it
promises and does. deploy: the same choice after every rollout on drawn development gaps. In both, rollouts 0 is the
choice without data. Controls of deploy choose by what they believe instead: the posterior of another gap, one particle
of their own, or the truth.
"""

import functools
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, World
from envs.mujoco.worlds import choose_impl
from envs.rollout import Episode, play_episode, real_env, real_worlds
from envs.types import Array, Key, Policy, PyTree, UserError
from experiments.runner import cli
from experiments.runner.cli import Json
from experiments.runner.narrowed import truth
from experiments.runner.options import Impl, Out, at_least_one, each_once, seed_list
from experiments.runner.progress import doing
from sgft_jax.algorithms import make_policy
from sgft_jax.analysis import tables
from sgft_jax.io.log import write_summary
from sgft_jax.io.priors import load_prior, variant
from sgft_jax.models.distortion import Distortion, none
from sgft_jax.posterior.candidates import Candidates, candidates, point_of
from sgft_jax.posterior.decision import CANDIDATES, JUDGES, choose, play
from sgft_jax.posterior.estimator import MOST, Estimator, Rollout, blank, draw, rollout_of
from sgft_jax.stacking import member, stack

_POINTS = 256  # of a posterior
_DECIDED = 32  # systems in which that is deployed which is chosen
_PLAYED = 50  # episodes of what is chosen, in the true system
_GAPS, _LOOKED, _EVALUATED = 4, 100, 200  # of a task; episodes by which they are chosen, and in which they are judged
_RUNS = 4  # of a gap
_AT_ONCE = 8  # systems for which a decision is made in one program

Belief = Literal["posterior", "another", "single", "truth"]


@dataclass(frozen=True)
class PosteriorArgs:
    """One study of posteriors."""

    parts: tuple[Literal["calibrate", "deploy"], ...] = ("calibrate", "deploy")
    """What to measure; the head of this help explains it."""
    tasks: tuple[str, ...] = ("push", "insert", "hammer")
    """Tasks; their shipped priors play."""
    systems: int = 10
    """Systems a task that are taken for real ones, for calibrate."""
    rollouts: tuple[int, ...] = (1, 4)
    """Rollouts in each of them, one line for each number."""
    priors: Path | None = None
    """Folder with a prior of each task, TASK/seed-0, that has an estimator; default: those that come with the code."""
    gaps: tuple[str, ...] = ()
    """Real systems for deploy, as files of gaps; default: the drawn ones of development. It takes the four on which
    the policy starts lowest."""
    beliefs: tuple[Belief, ...] = ("posterior",)
    """Whose systems deploy chooses in: its own posterior's, another gap's, a single particle of its own, or the truth,
    as far as it has unknowns."""
    seed: int = 0
    """Expert: another seed draws other systems."""
    impl: Impl = "auto"
    json: Json = False
    out: Out = Path("runs")


class Setup(NamedTuple):
    """A task and the policy that plays it.

    env: with the observations of the prior's policy. params: of the policy.
    """

    env: Env
    systems: Candidates
    policy: Policy
    params: PyTree

    def behind(self, distortion: Distortion | None) -> PyTree:
        """Params of the policy behind a correction."""
        return self.params._replace(distortion=distortion, estimator=None)

    def nothing(self) -> Distortion:
        """The correction that changes nothing."""
        return none(self.env.act_dim, self.env.measured_dim)

    def success(self, distortion: Distortion, point: Array, key: Key) -> Array:
        """[] bool, of an episode of the policy behind a correction in the system at a point [d]."""
        key_world, key_play = jax.random.split(key)
        world = self.systems.episode(point, key_world)
        return play(self.env, self.policy, self.behind(distortion), world, key_play).success


def main(args: PosteriorArgs) -> None:
    """Measures, prints and writes the numbers to <out>/posterior/summary.json."""
    at_least_one(args, "systems", "rollouts")
    each_once(args, "parts", "tasks", "rollouts", "beliefs")
    seed_list(args.seed, 1)
    if max(args.rollouts) > MOST:
        raise UserError(f"--rollouts {max(args.rollouts)}: at most {MOST} are read together")
    folder = args.out / "posterior"
    summary: dict[str, Any] = {part: [] for part in args.parts}
    for task in args.tasks:
        setup = _set_up(args, task)
        for part in args.parts:
            lines = {"calibrate": _calibrate, "deploy": _deploy}[part](args, setup)
            summary[part] += [{"task": task} | line for line in lines]
            folder.mkdir(parents=True, exist_ok=True)
            write_summary(folder, summary)
            print(_table(summary[part]), file=sys.stderr, flush=True)
    if args.json:
        print(json.dumps(summary))
        return
    for lines in summary.values():
        print(_table(lines))
    print(f"numbers: {folder / 'summary.json'}")


def _set_up(args: PosteriorArgs, task: str) -> Setup:
    """The task, its systems and what is played in them."""
    prior = load_prior(f"shipped:{task}/seed-0" if args.priors is None else args.priors / task / "seed-0")
    impl = choose_impl(args.impl)
    env = envs.make(task, impl, **variant(prior.card))
    policy = make_policy(prior.card, env)
    with doing(f"compiling the simulator and worlds of {task}", 40, once=True):
        env.prepare()
        systems = candidates(env)
    return Setup(env, systems, policy, prior.params)


def _played(args: PosteriorArgs, setup: Setup, count: int) -> tuple[Array, Rollout]:
    """Systems [G, d] and `count` rollouts [G, count] in each."""
    key_systems, key_play = jax.random.split(jax.random.key(args.seed))
    true = setup.systems.draw(key_systems, args.systems)

    def record(point: Array, key: Key) -> Rollout:
        key_world, key_episode = jax.random.split(key)
        params, world = setup.behind(setup.nothing()), setup.systems.episode(point, key_world)
        episode = play(setup.env, setup.policy, params, world, key_episode)
        return rollout_of(setup.env, episode.transitions, episode.valid, episode.success)

    with doing(f"playing {args.systems * count} rollouts", 20):
        keys = jax.random.split(key_play, (args.systems, count))
        return true, jax.jit(jax.vmap(jax.vmap(record, (None, 0))))(true, keys)


def _calibrate(args: PosteriorArgs, setup: Setup) -> list[dict[str, Any]]:
    """A line for each number of rollouts."""
    estimator = _estimator(setup)
    true, rollouts = _played(args, setup, max(args.rollouts))
    judged = jax.jit(functools.partial(_judged, setup, estimator, true, _padded(rollouts)))
    lines = []
    for number in (0, *args.rollouts):
        with doing("playing in particles what may be deployed", 60):
            points, *books = jax.device_get(judged(jnp.arange(MOST) < number, jax.random.key(args.seed + 2)))
        lines.append({"rollouts": number} | _covered(setup, points, np.asarray(true)) | _kept(*books))
    return lines


def _judged(
    setup: Setup, estimator: Estimator, true: Array, rollouts: Rollout, counts: Array, key: Key
) -> tuple[Array, Array, Array, Array]:
    """Points [G, n, d] of the posteriors of systems [G, d]; in the first of these what is promised for the chosen
    candidate, the success of the policy as it is and of that candidate.
    """
    keys = jax.random.split(key, (2, len(true)))
    points = jax.vmap(lambda *row: _points(setup, estimator, row[0], counts, row[1]))(rollouts, keys[0])

    def one(row: tuple[Array, Array, Key]) -> tuple[Array, Array, Array]:
        true, points, key = row
        key_choose, key_played = jax.random.split(key)
        deployed, promised = choose(setup.env, setup.systems, setup.policy, setup.behind(None), points, key_choose)
        both, keys = stack([setup.nothing(), deployed]), jax.random.split(key_played, _PLAYED)
        played = jax.vmap(jax.vmap(setup.success, (None, None, 0)), (0, None, None))(both, true, keys).mean(axis=1)
        return promised[1], played[0], played[1]

    few = points[:, -CANDIDATES - JUDGES :]
    first = jax.tree.map(lambda x: x[:_DECIDED], (true, few, keys[1]))
    return points, *jax.lax.map(one, first, batch_size=_AT_ONCE)


def _deploy(args: PosteriorArgs, setup: Setup) -> list[dict[str, Any]]:
    """Gate 2: a line for each number of rollouts and belief, over the gaps on which the policy starts lowest."""
    estimator, key = _estimator(setup), jax.random.key(args.seed)
    key_worlds, key_look, key_before, key_run = jax.random.split(key, 4)
    real = _real(args, setup, key_worlds)
    evaluate = jax.jit(functools.partial(_success, setup, real), static_argnames="episodes")
    with doing("playing the policy as it is", 60):
        look = evaluate(setup.nothing(), jnp.arange(len(real.names)), key_look, episodes=_LOOKED)
        lowest = np.argsort(np.asarray(look))[:_GAPS]
        which = jnp.asarray(np.repeat(lowest, _RUNS))
        before = evaluate(setup.nothing(), which, key_before, episodes=_EVALUATED)
    room = blank(MOST, setup.env.episode_length, setup.env.measured_dim, setup.env.act_dim)
    begun = jax.tree.map(lambda x: jnp.repeat(x[None], len(which), axis=0), (setup.nothing(), room))
    runs = {belief: _Runs(which, *begun) for belief in args.beliefs}
    steps = {b: jax.jit(functools.partial(_adapted, setup, real, estimator, b)) for b in args.beliefs}
    lines = []
    for number in range(max(args.rollouts) + 1):
        for belief, step in steps.items():
            with doing("playing, and choosing what to deploy", 60):
                key = jax.random.fold_in(key_run, number)
                runs[belief], promised, played = step(runs[belief], jnp.int32(number), key)
            numbers = [np.asarray(x) for x in (promised, before, played)]
            means = np.stack(numbers[1:], axis=1).reshape(len(lowest), _RUNS, 2).mean(axis=1)
            by_gap = {real.names[i]: mean.tolist() for i, mean in zip(lowest, means, strict=True)}
            lines.append({"rollouts": number, "belief": belief} | _kept(*numbers) | {"gaps": by_gap})
    return lines


class _Real(NamedTuple):
    """Real systems: their env, pools of their worlds [gaps, n], what they are called, and the points [gaps, d] nearest
    to them.
    """

    env: Env
    pool: World
    names: list[str]
    points: Array


class _Runs(NamedTuple):
    """Runs [R]: which real system each is in, what it deploys, and the rollouts [R, MOST] that it has played."""

    which: Array
    deployed: Distortion
    rollouts: Rollout


def _real(args: PosteriorArgs, setup: Setup, key: Key) -> _Real:
    """The gaps of a task that are asked for, by default the drawn ones of development."""
    sources = args.gaps or (f"envs/gaps/development/{setup.env.name}-drawn.toml",)
    drawn = [gaps.load(setup.env, source) for source in gaps.expand(sources)]
    env = real_env(setup.env, drawn)
    with doing(f"compiling {len(drawn)} real systems of {setup.env.name}", 40):
        pool, unknowns = real_worlds(env, drawn, key), setup.systems.unknowns
        firsts = [member(member(pool, i), 0) for i in range(len(drawn))]
        points = jnp.stack([point_of(unknowns, jnp.asarray(truth(setup.env, world, unknowns))) for world in firsts])
        return _Real(env, pool, [gap.name for gap in drawn], points)


def _success(setup: Setup, real: _Real, deployed: Distortion, which: Array, key: Key, *, episodes: int) -> Array:
    """[R] success in real systems [R] of what is deployed, in one of them or [R]."""

    def one(deployed: Distortion, which: Array, key: Key) -> Array:
        def success(key: Key) -> Array:
            return _play(setup, real, which, deployed, key).success

        return jax.vmap(success)(jax.random.split(key, episodes)).mean()

    alike = deployed.bias.ndim == 1
    return jax.vmap(one, (None if alike else 0, 0, 0))(deployed, which, jax.random.split(key, len(which)))


def _play(setup: Setup, real: _Real, which: Array, deployed: Distortion, key: Key, explore: bool = False) -> Episode:
    """An episode in a real system."""
    act = functools.partial(setup.policy.act, setup.behind(deployed), explore=explore)
    return play_episode(real.env, real.pool, act, setup.policy.init_carry(), key, gamma=1.0, which=which)


def _rollout(setup: Setup, real: _Real, which: Array, deployed: Distortion, key: Key) -> Rollout:
    """One that trains, so it explores."""
    episode = _play(setup, real, which, deployed, key, explore=True)
    return rollout_of(real.env, episode.transitions, episode.valid, episode.success)


def _adapted(
    setup: Setup, real: _Real, estimator: Estimator, belief: Belief, runs: _Runs, number: Array, key: Key
) -> tuple[_Runs, Array, Array]:
    """Runs after a decision upon `number` rollouts, of which they play the last one; what was promised [R] for what is
    chosen, and its success [R]. Without data nothing of the choice is deployed.
    """
    key_play, key_choose, key_evaluate = jax.random.split(key, 3)
    keys_play, keys_choose = (jax.random.split(key, len(runs.which)) for key in (key_play, key_choose))
    new = jax.vmap(functools.partial(_rollout, setup, real))(runs.which, runs.deployed, keys_play)
    last = jnp.arange(MOST) == number - 1

    def put(rows: Array, row: Array) -> Array:
        return jnp.where(last.reshape(-1, *[1] * (row.ndim - 1)), row[:, None], rows)

    rollouts = jax.tree.map(put, runs.rollouts, new)

    def decide(row: tuple[Rollout, Array, Key]) -> tuple[Distortion, Array]:
        key_points, key_decide = jax.random.split(row[2])
        points = _points(setup, estimator, row[0], jnp.arange(MOST) < number, key_points)
        few = points[-CANDIDATES - JUDGES :]
        if belief in ("single", "truth"):
            few = jnp.broadcast_to(few[0] if belief == "single" else row[1], few.shape)
        deployed, promised = choose(setup.env, setup.systems, setup.policy, setup.behind(None), few, key_decide)
        return deployed, promised[1]

    read = jax.tree.map(lambda x: jnp.roll(x, _RUNS, axis=0), rollouts) if belief == "another" else rollouts
    rows = read, real.points[runs.which], keys_choose
    chosen, promised = jax.lax.map(decide, rows, batch_size=_AT_ONCE)
    played = _success(setup, real, chosen, runs.which, key_evaluate, episodes=_EVALUATED)
    deployed = jax.tree.map(lambda a, b: jnp.where(number > 0, a, b), chosen, runs.deployed)
    return _Runs(runs.which, deployed, rollouts), promised, played


def _estimator(setup: Setup) -> Estimator:
    if setup.params.estimator is None:
        fix = "`python -m experiments.estimate` makes it, --priors names its folder"
        raise UserError(f"the prior of {setup.env.name} has no estimator; {fix}")
    return setup.params.estimator


def _points(setup: Setup, estimator: Estimator, rollouts: Rollout, counts: Array, key: Key) -> Array:
    """[n, d] points of the posterior, or of the prior where no rollout counts."""
    key_prior, key_draw = jax.random.split(key)
    prior = setup.systems.draw(key_prior, _POINTS)
    told = draw(estimator, rollouts, counts, prior.shape[1], key_draw, _POINTS)
    return jnp.where(counts.any(), told, prior)


def _padded(rollouts: Rollout) -> Rollout:
    """Rollouts [G, k] as [G, MOST]."""
    return jax.tree.map(
        lambda x: jnp.concatenate([x, jnp.zeros((len(x), MOST - x.shape[1], *x.shape[2:]), x.dtype)], axis=1), rollouts
    )


def _covered(setup: Setup, points: np.ndarray, true: np.ndarray) -> dict[str, Any]:
    """What posteriors [G, n, d] say of the true systems [G, d]."""
    below = (points < true[:, None]).mean(axis=1)
    inside = (below > 0.1) & (below < 0.9)
    std = np.maximum(points.std(axis=1), 1e-3)
    score = -0.5 * ((true - points.mean(axis=1)) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)
    width = 12**0.5 * std.mean(axis=0)
    return {
        "inside 80": float(inside.mean()),
        "least inside": float(inside.mean(axis=0).min()),
        "most inside": float(inside.mean(axis=0).max()),
        "log score": float(np.clip(score, -20.0, None).mean()),
        "std": float(width.mean()),
        "by unknown": {
            f"{u.name}[{u.index}]": [float(inside[:, i].mean()), float(width[i])]
            for i, u in enumerate(setup.systems.unknowns)
        },
    }


def _kept(promised: np.ndarray, before: np.ndarray, played: np.ndarray) -> dict[str, float]:
    """What was promised [G] for what is deployed, what that did, and the policy as it is."""
    return {
        "zero-shot": float(before.mean()),
        "played": float(played.mean()),
        "promised": float(promised.mean()),
        "overestimate": float((promised - played).mean()),
        "error": float(np.sqrt(np.mean((promised - played) ** 2))),
        "worst fall": float((before - played).max()),
    }


def _table(lines: list[dict[str, Any]]) -> str:
    """The numbers of lines, which all have the same."""
    rows = [{name: x for name, x in line.items() if not isinstance(x, dict)} for line in lines]
    cells = [[f"{x:.3g}" if isinstance(x, float) else str(x) for x in row.values()] for row in rows]
    return tables.markdown(list(rows[0]), cells)


if __name__ == "__main__":
    cli.run_main(main, PosteriorArgs, __doc__ or "")
