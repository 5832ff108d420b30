"""Impure: learning in a real system until a level is reached, and recording. `experiments.collect` is its command."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, EnvState
from envs.pools import real_env, real_worlds
from envs.rollout import Episode, counted
from envs.types import Array, Policy, PyTree, Transition, UserError
from experiments.runner.collect_args import PAIR, CollectArgs, is_d4rls, name_of, targets, transitions_of
from experiments.runner.options import seed_list
from sgft_jax.algorithms import make_policy
from sgft_jax.datasets import logs
from sgft_jax.datasets.recording import Joints, Noted, Recorded, cut, of_episodes, of_fleet, write_d4rl, write_minari
from sgft_jax.files.disk import write_json
from sgft_jax.io import runs
from sgft_jax.io.log import RunProgress
from sgft_jax.io.priors import load_prior, observed_by
from sgft_jax.keys import FromLog, seed_keys
from sgft_jax.methods import get_method
from sgft_jax.stacking import member
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train import hybrid
from sgft_jax.train.fleet import FleetState
from sgft_jax.train.schedule import Schedule
from sgft_jax.types import HybridAgent

_AT_ONCE = 50  # episodes of one recording call


def teach(args: CollectArgs, level: float) -> list[dict[str, Any]]:
    """SAC in the system itself, all seeds in one program; the pair of sets of each seed."""
    method = get_method("sac", "fixed")
    env, system = _system(args, envs.make(args.task, args.impl), args.seeds, method.config.gamma)
    agent, schedule = method.build(method.config, env), _schedule(args)
    seeds = seed_list(args.seed, args.seeds)
    pools = jax.tree.map(lambda x: jnp.repeat(x, len(seeds), axis=0), system.pools)
    keys, note = seed_keys(seeds, FromLog.COLLECTION), functools.partial(_note, agent)
    steps = hybrid.train(env, agent, schedule, pools, hybrid.no_data(env), keys, gamma=method.config.gamma, note=note)
    reached: dict[int, tuple[PyTree, Transition, Noted]] = {}
    with RunProgress(f"SAC on {env.name}", total=schedule.chunks * args.eval_every, unit="updates") as progress:
        for state, metrics in steps:
            if not metrics:
                continue
            returns = _level(args, agent, system, state)
            for i in np.flatnonzero(returns >= level):
                reached.setdefault(int(i), _snapshot(agent, state, int(i)))
            progress.advance(args.eval_every, {"return, exploring": float(returns.mean())})
            if len(reached) == len(seeds):
                break
    if late := [str(seeds[i]) for i in range(len(seeds)) if i not in reached]:
        print(f"no data of seed {', '.join(late)}: {level:g} was not reached in {args.updates:,} updates")
    if not reached:
        raise UserError(f"--level {level:g}: no seed reached it; raise --updates or lower it")
    cards = []
    for i, (params, rows, noted) in sorted(reached.items()):
        replay, medium = (args.out / f"{name_of(args, kind, seeds[i])}.hdf5" for kind in PAIR)
        judged = PAIR if is_d4rls(args) else ("", "")
        # What took long to learn is on disk before the policy plays on.
        cards.append(_write(args, replay, of_fleet(rows, args.environments, noted), kind=judged[0]))
        cards.append(_write(args, medium, _play(args, env, system, agent.policy, params, seeds[i]), kind=judged[1]))
    return cards


def record(args: CollectArgs) -> list[dict[str, Any]]:
    """Episodes of a policy that exists."""
    assert args.policy is not None
    env = envs.make(args.task, args.impl, **observed_by([args.policy]))
    prior = load_prior(args.policy, task=env.name, obs_dim=env.obs_dim, act_dim=env.act_dim)
    env, system = _system(args, env, 1, prior.card["gamma"])
    episodes = _play(args, env, system, make_policy(prior.card, env), prior.params, args.seed)
    return [_write(args, targets(args)[0], episodes)]


def _system(args: CollectArgs, env: Env, members: int, gamma: float) -> tuple[Env, Simulated]:
    """The real system, and how it is played: its traces are `Joints`."""
    gap = gaps.load(env, args.real)
    env = real_env(env, [gap])._replace(trace=_joints)
    pools = real_worlds(env, [gap], jax.random.key(0))
    return env, Simulated(env, pools, jnp.zeros(members, jnp.int32), gamma=gamma)


def _schedule(args: CollectArgs) -> Schedule:
    """An update for each step; nothing is overwritten."""
    room = args.updates + args.environments * 1_000  # the first batch comes before the first update
    return Schedule(args.updates, args.environments, buffer=room, chunk_updates=args.eval_every)


def _level(args: CollectArgs, agent: HybridAgent, system: Simulated, state: FleetState) -> np.ndarray:
    """Mean return [seeds] of the exploring policies."""
    params = jax.jit(jax.vmap(agent.export))(state.learner)
    played = _episodes(system, agent.policy, params, jax.random.key(FromLog.LEVEL), args.eval_episodes)
    return np.asarray(counted(played)[1]).mean(axis=1)


def _episodes(system: Simulated, policy: Policy, params: PyTree, key: Any, n: int) -> Episode:
    """Exploring episodes [members, n]."""
    keys = jnp.broadcast_to(jax.random.split(key, n), (*system.which.shape, n))
    return system.play(policy, params, keys, explore=True)


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
    before, after = (jax.tree.map(lambda x, own=own: x[:, own], played.trace) for own in (slice(-1), slice(1, None)))
    return Noted(before, after, log_prob)


def _snapshot(agent: HybridAgent, state: FleetState, i: int) -> tuple[PyTree, Transition, Noted]:
    """The policy of a seed and all that it has experienced, on the host."""
    held = int(state.replay.size[i])
    kept = state.replay.data, state.notes.data
    rows, noted = jax.tree.map(lambda x: np.asarray(x[i, :held]), kept)
    return jax.tree.map(np.asarray, agent.export(member(state.learner, i))), rows, noted


def _play(args: CollectArgs, env: Env, system: Simulated, policy: Policy, params: PyTree, seed: int) -> list[Recorded]:
    """Exploring episodes of one policy, until there are transitions enough."""
    alone = system.moved(system.pools, jnp.zeros(1, jnp.int32))
    params = jax.tree.map(lambda x: jnp.asarray(x)[None], params)
    key, episodes, held = jax.random.fold_in(jax.random.key(seed), FromLog.RECORDING), [], 0
    wanted = transitions_of(args)
    at_once = min(_AT_ONCE, math.ceil(wanted / env.episode_length))
    while held < wanted:
        key, key_now = jax.random.split(key)
        played = member(_episodes(alone, policy, params, key_now, at_once), 0)
        new = of_episodes(played, _noted(policy, member(params, 0), played))
        episodes, held = episodes + new, held + sum(len(own.reward) for own in new)
        if not new:
            raise UserError(f"{env.name}: physics exploded in the first step of {at_once} episodes; nothing to record")
    return cut(episodes, wanted)


def _write(args: CollectArgs, path: Path, episodes: Sequence[Recorded], *, kind: str = "") -> dict[str, Any]:
    """Both layouts of a data set and its card; says what it holds, as a reader finds it.

    kind: which of D4RL's sets it shall stand for, "" for none: then nothing is judged.
    """
    author = "sgft_jax experiments.collect"
    write_d4rl(path, episodes, {"algorithm": "SAC", "task": args.task, "real": args.real, "author": author})
    write_minari(path.with_name(f"{path.stem}-v0"), episodes, {"algorithm_name": "SAC", "author": [author]})
    facts = logs.load(path, gamma=1.0).facts
    steps = np.mean([len(own.reward) for own in episodes])
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
