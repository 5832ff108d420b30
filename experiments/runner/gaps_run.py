"""Impure: measures gaps. `experiments.gaps` is its command."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, World
from envs.gaps import Gap
from envs.rollout import Episode, real_env, real_worlds
from envs.types import Key, PyTree
from experiments.runner.cli import columns
from experiments.runner.machines import reserve
from experiments.runner.progress import RunProgress, doing
from experiments.runner.training import best_of, describe, play, scores
from sgft_jax import stacking
from sgft_jax.algorithms import make_policy
from sgft_jax.analysis import tables
from sgft_jax.io.log import MetricsLog, write_summary
from sgft_jax.io.priors import load_priors, variant_of
from sgft_jax.math import stats
from sgft_jax.presets import PretrainConfig
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train.pretraining import exported, memory, pretrain, prior_card
from sgft_jax.types import Prior

if TYPE_CHECKING:
    from experiments.gaps import GapsArgs

ZERO_SHOT_AT_MOST, TRAINED_AT_LEAST = 0.40, 0.95
_HELDOUT_SEED, FINAL_SEED = 2**31 + 4, 2**31 + 5  # held-out worlds and episodes


def run(args: "GapsArgs", seeds: list[int], folders: list[Path]) -> dict[str, Any]:
    """Measures, prints a table, writes and returns the summary. folders: of the priors."""
    task = envs.name_of(args.task)
    env = envs.make(args.task, args.impl, **variant_of(folders))
    reals = [gaps.load(env, name) for name in args.presets or gaps.presets(task, variants=False)]
    env = real_env(env, reals)
    folder = args.out / "gaps" / task
    priors = load_priors(folders, env)
    with doing(f"playing {args.episodes} episodes on each real system", 30, once=True):
        system, members = systems(env, reals, priors, args.episodes)
        played = play(system, make_policy(priors[0].card, env), members, episode_key(FINAL_SEED), args.episodes)
    zero_shot = [stacking.part(played, i, len(priors)) for i in range(len(reals))]

    def report(trained: Sequence[Episode | None]) -> dict[str, Any]:
        """Prints the table; writes and returns the summary."""
        lines = [_line(*row) for row in zip(reals, zero_shot, trained, strict=True)]
        about = {"task": task, "impl": env.impl, "preset": args.preset, "priors": [str(prior) for prior in folders]}
        limits = {"zero_shot_at_most": ZERO_SHOT_AT_MOST, "trained_at_least": TRAINED_AT_LEAST}
        summary = {**about, "limits": limits, "gaps": lines}
        folder.mkdir(parents=True, exist_ok=True)
        path = write_summary(folder, summary)
        print("\n".join(table(lines)))
        print(f"summary: {path}")
        return summary

    summary = report([None] * len(reals))
    if args.train:  # the long part: what is known already is on disk
        summary = report(train(env, args.config, reals, seeds, folder, episodes=args.episodes))
    return summary


def admissible(zero_shot: float, trained: float | None) -> bool | None:
    """Whether a gap is neither bridged by pretraining alone nor impossible; None = training has not been measured."""
    if zero_shot > ZERO_SHOT_AT_MOST:
        return False
    return None if trained is None else trained >= TRAINED_AT_LEAST


def table(lines: Sequence[dict[str, Any]]) -> list[str]:
    """The measurements for people, in per cent with 95 % intervals."""
    rows = [("gap", "zero-shot %", "trained on real %", "admissible")]
    for line in lines:
        answer = {True: "yes", False: "no", None: "not known"}[line["admissible"]]
        rows.append((line["gap"]["name"], percent(line["zero_shot"]), percent(line["trained"]), answer))
    return columns(rows)


def percent(rated: dict[str, Any] | None) -> str:
    """What `rate` says, for people; a dash for what has not been measured."""
    if rated is None:
        return "-"
    band = (np.asarray(x, float) for x in (rated["success"], *rated["interval"]))  # files spell NaN as a word
    return tables.number(stats.Interval(*band))


def _line(gap: Gap, zero_shot: Episode, trained: Episode | None) -> dict[str, Any]:
    zero, best = rate(zero_shot), None if trained is None else rate(trained)
    verdict = admissible(zero["success"], None if best is None else best["success"])
    return {"gap": gap.table, "zero_shot": zero, "trained": best, "admissible": verdict}


def rate(played: Episode, statistic: Callable[..., np.ndarray] = stats.iqm) -> dict[str, Any]:
    """Success of policies, [policies, episodes]: of one with its Wilson interval, of several a statistic over them."""
    policies = [describe(stacking.member(played, i)) for i in range(len(played.success))]
    if len(policies) == 1:
        success, interval = policies[0]["success"], policies[0]["success/interval"]
    else:
        band = stats.bootstrap_interval(np.array([policy["success"] for policy in policies]), statistic=statistic)
        success, interval = float(band.estimate), [float(band.low), float(band.high)]
    return {"success": success, "interval": interval, "policies": policies}


def systems(env: Env, reals: Sequence[Gap], priors: list[Prior], episodes: int) -> tuple[Simulated, PyTree]:
    """The real systems of gaps and the parameters of who plays there: members [gaps * priors], all priors on each."""
    env = real_env(env, reals)
    pools = real_worlds(env, reals, jax.random.key(FINAL_SEED), episodes)
    which = jnp.repeat(jnp.arange(len(reals)), len(priors))
    members = stacking.stack([prior.params for prior in priors] * len(reals))
    drift = gaps.drifts(env, reals)
    return Simulated(env, pools, which, gamma=priors[0].card["gamma"], drift=drift), members


def train(
    env: Env,
    config: PretrainConfig,
    reals: Sequence[Gap],
    seeds: list[int],
    folder: Path,
    *,
    episodes: int,
    seen: Env | None = None,
) -> list[Episode]:
    """For each gap, the episodes [seeds, episodes] of policies trained there and chosen by evaluations there.

    All gaps and seeds are members [gaps * seeds] of one program: the real systems of a task differ in numbers alone.
    eval.jsonl gets a line per evaluation. seen: the same task as policies see it, with more in its observation.
    """
    seen = seen or env
    policy, best = make_policy(prior_card(seen, config), seen), None
    which = jnp.repeat(jnp.arange(len(reals)), len(seeds))
    reserve(memory(seen, config), copies=len(which))

    def pools(number: int, domains: PyTree) -> World:
        """All seeds of a gap live in the same worlds."""
        worlds = real_worlds(env, reals, jax.random.fold_in(jax.random.key(seeds[0]), number), config.worlds)
        return jax.tree.map(lambda x: x[which], worlds)

    def system(seed: int, episodes: int) -> Simulated:
        return Simulated(seen, real_worlds(env, reals, jax.random.key(seed), episodes), which, gamma=config.gamma)

    log, heldout, size = MetricsLog(folder), system(_HELDOUT_SEED, config.eval_episodes), config.chunk_env_steps
    log.truncate({})
    steps = pretrain(seen, config, seeds * len(reals), pools=pools)
    with doing("building the worlds and compiling the training", 60, once=True):
        next(steps)
    with RunProgress("train on the real systems", total=config.chunks * size, unit="env steps") as progress:
        for done, (state, metrics) in enumerate(steps, start=1):
            log.metrics(done * size, metrics)
            ended = metrics["train/episodes"].all()
            shown = {"train/success": float(metrics["train/success"].mean())} if ended else {}
            if done % config.eval_every == 0 or done == config.chunks:
                params = exported(seen, config, state)
                played = play(heldout, policy, params, episode_key(_HELDOUT_SEED), config.eval_episodes)
                log.eval(done * size, scores(played))
                best = best_of(best, params, played, state.rounds)
                shown["success"] = float(played.success.mean())
            progress.advance(size, shown)
    log.close()
    assert best is not None
    played = play(system(FINAL_SEED, episodes), policy, best.params, episode_key(FINAL_SEED), episodes)
    return [stacking.part(played, i, len(seeds)) for i in range(len(reals))]


def episode_key(seed: int) -> Key:
    """Decides the starts and the noise of episodes."""
    return jax.random.fold_in(jax.random.key(seed), 1)
