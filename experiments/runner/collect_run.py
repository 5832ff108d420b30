"""Impure: recording data of a real system: SAC as it learns, a policy, or an operator of a wheel-legged robot.

`experiments.collect` is the command.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, EnvState
from envs.locomotion import wheel_forward, wheel_legged
from envs.locomotion.wheel_legged import nominal_gain, operator
from envs.rollout import Episode, counted, play_episode, real_env, real_worlds
from envs.types import Array, Policy, PyTree, Transition, UserError
from experiments.runner.options import seed_list
from experiments.runner.progress import RunProgress, doing
from experiments.runner.training import play
from sgft_jax.algorithms import make_policy
from sgft_jax.datasets import logs, recording
from sgft_jax.datasets.recording import Joints, Noted, Recorded
from sgft_jax.files.disk import write_json
from sgft_jax.io import runs
from sgft_jax.io.priors import load_prior, variant_of
from sgft_jax.keys import FromLog, seed_keys
from sgft_jax.methods import get_method
from sgft_jax.stacking import member
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train import hybrid
from sgft_jax.train.fleet import FleetState
from sgft_jax.train.schedule import Schedule
from sgft_jax.types import HybridAgent

if TYPE_CHECKING:
    from experiments.collect import CollectArgs

_AT_ONCE = 50  # episodes of one recording call
_NAMES = ("v", "pitch", "pitch velocity", "torque")  # of the robot's log, columns 1 to 4


def teach(args: "CollectArgs", level: float, files: Sequence[Path], kinds: Sequence[str]) -> list[dict[str, Any]]:
    """SAC in the system itself, all seeds in one program; the pair of sets of each seed.

    files: of the first pair, then of the next. kinds: see `_write`, of a pair.
    """
    method, seeds = get_method("sac", "fixed"), seed_list(args.seed, args.seeds)
    config = method.config
    system = _system(args, envs.make(args.task, args.impl), args.seeds, config.gamma)
    env, agent = system.env, method.build(config, system.env)
    # An update for each step. Nothing is overwritten; the first batch comes before the first update.
    room = args.updates + args.environments * 1_000
    schedule = Schedule(args.updates, args.environments, buffer=room, chunk_updates=args.eval_every)
    pools = jax.tree.map(lambda x: jnp.repeat(x, len(seeds), axis=0), system.pools)
    keys, note = seed_keys(seeds, FromLog.COLLECTION), functools.partial(_note, agent)
    with doing("compiling the training", 30, once=True):
        steps = hybrid.train(env, agent, schedule, pools, hybrid.no_data(env), keys, gamma=config.gamma, note=note)
        next(steps)  # the start, which no updates are behind
    reached: dict[int, tuple[PyTree, Transition, Noted]] = {}
    with RunProgress(f"SAC on {env.name}", total=schedule.chunks * args.eval_every, unit="updates") as progress:
        for state, _ in steps:
            returns = _returns(args, agent, system, state)
            for i in np.flatnonzero(returns >= level).tolist():
                reached.setdefault(i, _snapshot(agent, state, i))
            progress.advance(args.eval_every, {"return, exploring": float(returns.mean())})
            if len(reached) == len(seeds):
                break
    if late := [str(seed) for i, seed in enumerate(seeds) if i not in reached]:
        print(f"no data of seed {', '.join(late)}: {level:g} was not reached in {args.updates:,} updates")
    if not reached:
        raise UserError(f"--level {level:g}: no seed reached it; raise --updates or lower it")
    cards = []
    for i, (params, rows, noted) in sorted(reached.items()):
        replay, medium = files[2 * i : 2 * i + 2]
        # What took long to learn is on disk before the policy plays on.
        cards.append(_write(args, replay, recording.of_fleet(rows, args.environments, noted), kind=kinds[0]))
        cards.append(_write(args, medium, _play(args, system, agent.policy, params, seeds[i]), kind=kinds[1]))
    return cards


def record(args: "CollectArgs", file: Path) -> dict[str, Any]:
    """Episodes of a policy that exists."""
    assert args.policy is not None
    env = envs.make(args.task, args.impl, **variant_of([args.policy]))
    prior = load_prior(args.policy, task=env.name, obs_dim=env.obs_dim, act_dim=env.act_dim)
    system = _system(args, env, 1, prior.card["gamma"])
    return _write(args, file, _play(args, system, make_policy(prior.card, env), prior.params, args.seed))


def _system(args: "CollectArgs", env: Env, members: int, gamma: float) -> Simulated:
    """The real system; its traces are `Joints`."""
    gap = gaps.load(env, args.real)
    env = real_env(env, [gap])._replace(trace=_joints)
    return Simulated(env, real_worlds(env, [gap], jax.random.key(0)), jnp.zeros(members, jnp.int32), gamma=gamma)


def _returns(args: "CollectArgs", agent: HybridAgent, system: Simulated, state: FleetState) -> np.ndarray:
    """Mean return [seeds] of the exploring policies."""
    params = jax.jit(jax.vmap(agent.export))(state.learner)
    key, n = jax.random.key(FromLog.LEVEL), args.eval_episodes
    played = play(system, agent.policy, params, key, n, explore=True)
    return np.asarray(counted(played)[1]).mean(axis=1)


def _joints(physics: Any) -> Joints | None:
    """Those of a state, None where the task's physics has none."""
    while type(physics) is tuple:  # an observation with more entries keeps its memory beside it
        physics = physics[0]
    return Joints(physics.qpos, physics.qvel) if hasattr(physics, "qpos") and hasattr(physics, "qvel") else None


def _note(agent: HybridAgent, state: PyTree, before: EnvState, action: Array, after: EnvState) -> Noted:
    """What is kept of a step of learning."""
    density = agent.policy.log_prob
    log_prob = None if density is None else density(agent.export(state), before.obs, action)
    return Noted(_joints(before.physics), _joints(after.physics), log_prob)


def _noted(policy: Policy, params: PyTree, played: Episode) -> Noted:
    """The same of the steps of episodes [n] of one policy."""
    rows, log_prob = played.transitions, None
    if policy.log_prob is not None:
        log_probs = jax.vmap(jax.vmap(policy.log_prob, (None, 0, 0)), (None, 0, 0))
        log_prob = jax.jit(log_probs)(params, rows.obs, rows.action)
    before, after = (jax.tree.map(lambda x, i=i: x[:, i], played.trace) for i in (slice(-1), slice(1, None)))
    return Noted(before, after, log_prob)


def _snapshot(agent: HybridAgent, state: FleetState, i: int) -> tuple[PyTree, Transition, Noted]:
    """The policy of a seed and all that it has experienced, on the host."""
    size = int(state.replay.size[i])
    rows, noted = jax.tree.map(lambda x: np.asarray(x[i, :size]), (state.replay.data, state.notes.data))
    return jax.tree.map(np.asarray, agent.export(member(state.learner, i))), rows, noted


def _play(args: "CollectArgs", system: Simulated, policy: Policy, params: PyTree, seed: int) -> list[Recorded]:
    """Exploring episodes of one policy, until there are transitions enough."""
    assert args.transitions is not None
    alone = system.moved(system.pools, jnp.zeros(1, jnp.int32))
    params = jax.tree.map(lambda x: jnp.asarray(x)[None], params)
    key, episodes = jax.random.fold_in(jax.random.key(seed), FromLog.RECORDING), []
    at_once = min(_AT_ONCE, math.ceil(args.transitions / system.env.episode_length))
    while sum(len(episode.reward) for episode in episodes) < args.transitions:
        key, key_now = jax.random.split(key)
        with doing("playing the episodes to record", 20, once=True):
            played = member(play(alone, policy, params, key_now, at_once, explore=True), 0)
        if not (new := recording.of_episodes(played, _noted(policy, member(params, 0), played))):
            what = f"physics exploded in the first step of {at_once} episodes; nothing to record"
            raise UserError(f"{system.env.name}: {what}")
        episodes += new
    return recording.cut(episodes, args.transitions)


def _write(args: "CollectArgs", path: Path, episodes: Sequence[Recorded], *, kind: str = "") -> dict[str, Any]:
    """Both layouts of a data set and its card; says what it holds, as a reader finds it.

    kind: which of D4RL's sets it shall stand for, "" for none: then nothing is judged.
    """
    author = "sgft_jax experiments.collect"
    recording.write_d4rl(path, episodes, {"algorithm": "SAC", "task": args.task, "real": args.real, "author": author})
    recording.write_minari(path.with_name(f"{path.stem}-v0"), episodes, {"algorithm_name": "SAC", "author": [author]})
    facts = logs.load(path, gamma=1.0).facts
    steps = np.mean([len(episode.reward) for episode in episodes])
    print(
        f"{path}: {facts.transitions:,} transitions, {facts.episodes:,} episodes of {steps:.0f} steps on average, "
        f"return {facts.return_mean:.1f} (std {facts.return_std:.1f}, {facts.return_min:.1f} to {facts.return_max:.1f})"
    )
    verdicts = logs.judge(f"{args.task}-{kind}", facts, mean_length=float(steps))
    for verdict in verdicts:
        print(f"  {verdict}")
    judged = [{**verdict._asdict(), "passed": verdict.passed} for verdict in verdicts]
    card = {**dataclasses.asdict(facts), "path": path.name, "mean_length": float(steps), "acceptance": judged}
    write_json(path.with_suffix(".json"), {**card, "provenance": runs.provenance()})
    return card


# --- operators --------------------------------------------------------------------------------------------------------


def operate(args: "CollectArgs", files: Sequence[Path], *, speed: float) -> list[dict[str, Any]]:
    """The log of each seed; returns what the files hold. speed: that the operator wants, m/s."""
    env = envs.make("wheel-legged", args.impl)  # an operator sees where the robot is, whatever the task tells
    gap = gaps.load(env, args.real)
    env = real_env(env, [gap])
    pool = member(real_worlds(env, [gap], jax.random.key(0)), 0)
    policy, gain = operator(speed), jnp.asarray(nominal_gain(), jnp.float32)
    act, length = functools.partial(policy.act, gain, explore=True), args.transitions
    assert length is not None
    plays = jax.jit(
        jax.vmap(lambda key: play_episode(env, pool, act, policy.init_carry(), key, gamma=1.0, length=length))
    )
    cards = []
    for file, seed in zip(files, seed_list(args.seed, args.seeds), strict=True):
        key, episodes = jax.random.key(seed), []
        while sum(len(episode.reward) for episode in episodes) < length:  # one that has fallen is put up again
            key, key_now = jax.random.split(key)
            episodes += recording.of_episodes(plays(key_now[None]))
        cards.append(_write_log(args, env, file, recording.cut(episodes, length), stands=not speed))
    return cards


def _write_log(args: "CollectArgs", env: Env, path: Path, episodes: list[Recorded], *, stands: bool) -> dict[str, Any]:
    """The log and its card; says how it compares with what is published of the real one."""
    recording.write_table(path, episodes, scale=wheel_legged.TORQUE)
    log = logs.load(path, gamma=1.0, env=env)
    rows, obs = log.rows, np.asarray(log.rows.obs)
    spread = [*obs[:, 1:].std(0), wheel_legged.TORQUE * np.asarray(rows.action).std()]
    moving = jax.vmap(wheel_forward.reward)(rows.obs[:, 1:], rows.action, rows.next_obs[:, 1:])
    rewards = ({"standing": rows.reward} if stands else {}) | {"moving": moving}  # who moves on has left his place
    facts = {
        **dataclasses.asdict(log.facts),
        "path": path.name,
        "std": dict(zip(_NAMES, map(float, spread), strict=True)),
        "reward": {name: float(np.mean(values)) for name, values in rewards.items()},
    }
    spreads = ", ".join(f"{name} {value:.3g}" for name, value in facts["std"].items())
    earned = ", ".join(f"{value:.2f} {name}" for name, value in facts["reward"].items())
    falls = f"{log.facts.transitions:,} transitions, {log.facts.terminal} falls"
    print(f"{path}: {falls}; std of {spreads}; reward of a step {earned}")
    write_json(path.with_suffix(".json"), {**facts, "real": args.real, "provenance": runs.provenance()})
    return facts
