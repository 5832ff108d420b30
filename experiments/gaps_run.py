"""Impure: measures gaps. `experiments.gaps` is its command."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, World
from envs.gaps import Gap
from envs.pools import real_env, real_worlds
from envs.rollout import Episode
from experiments import stacking
from experiments.cli import columns
from experiments.evaluation import best_of, describe, play, scores
from experiments.gaps import GapsArgs
from experiments.memory import reserve
from sgft_jax.analysis import stats, tables
from sgft_jax.io.log import MetricsLog, write_summary
from sgft_jax.io.priors import load_priors
from sgft_jax.io.progress import RunProgress
from sgft_jax.policies import make_policy
from sgft_jax.pretraining import exported, memory, pretrain, prior_card
from sgft_jax.systems.simulated import Simulated
from sgft_jax.types import Key, Prior

ZERO_SHOT_AT_MOST, TRAINED_AT_LEAST = 0.40, 0.95
_HELDOUT_SEED, _FINAL_SEED = 2**31 + 4, 2**31 + 5  # held-out worlds and episodes


def run(args: GapsArgs, seeds: list[int], folders: list[Path]) -> dict[str, Any]:
    """Measures, prints a table, writes and returns the summary. folders: of the priors."""
    task = envs.name_of(args.task)
    env = envs.make(args.task, args.impl)
    found = [gaps.load(env, name) for name in args.presets or gaps.presets(task)]
    env = real_env(env, found)
    folder = args.out / "gaps" / task
    here = _zero_shot(env, found, load_priors(folders, env), args.episodes)
    about = {"task": task, "impl": env.impl, "preset": args.preset, "priors": [str(prior) for prior in folders]}
    summary = _report(folder, about, [_line(gap, here[i], None) for i, gap in enumerate(found)])
    if args.train:  # the long part: what is known already is on disk
        there = _train(env, args, found, seeds, folder)
        summary = _report(folder, about, [_line(gap, here[i], there[i]) for i, gap in enumerate(found)])
    return summary


def _report(folder: Path, about: dict[str, Any], lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Writes the summary, which is returned, and prints the table."""
    limits = {"zero_shot_at_most": ZERO_SHOT_AT_MOST, "trained_at_least": TRAINED_AT_LEAST}
    summary = {**about, "limits": limits, "gaps": lines}
    folder.mkdir(parents=True, exist_ok=True)
    path = write_summary(folder, summary)
    print("\n".join(table(lines)))
    print(f"summary: {path}")
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
        rows.append((line["gap"]["name"], _percent(line["zero_shot"]), _percent(line["trained"]), answer))
    return columns(rows)


def _percent(found: dict[str, Any] | None) -> str:
    return "-" if found is None else tables.number(stats.Interval(found["success"], *found["interval"]))


def _line(gap: Gap, zero_shot: Episode, trained: Episode | None) -> dict[str, Any]:
    zero, best = _rate(zero_shot), None if trained is None else _rate(trained)
    verdict = admissible(zero["success"], None if best is None else best["success"])
    return {"gap": gap._asdict(), "zero_shot": zero, "trained": best, "admissible": verdict}


def _rate(played: Episode) -> dict[str, Any]:
    """Success of policies, [policies, episodes]: of one with its Wilson interval, of several as IQM over them."""
    each = [describe(stacking.member(played, i)) for i in range(len(played.success))]
    if len(each) == 1:
        return {"success": each[0]["success"], "interval": each[0]["success/interval"], "policies": each}
    band = stats.bootstrap_interval(np.array([one["success"] for one in each]))
    return {"success": float(band.estimate), "interval": [float(band.low), float(band.high)], "policies": each}


def _zero_shot(env: Env, found: Sequence[Gap], priors: list[Prior], episodes: int) -> list[Episode]:
    """For each gap, the episodes of the priors [priors, episodes]; every policy plays the same ones."""
    n, card = len(priors), priors[0].card
    pools = real_worlds(env, found, jax.random.key(_FINAL_SEED), episodes)
    system = Simulated(env, pools, jnp.repeat(jnp.arange(len(found)), n), gamma=card["gamma"])
    members = stacking.stack([prior.params for prior in priors] * len(found))
    played = play(system, make_policy(card, env), members, _episode_key(_FINAL_SEED), episodes)
    return [stacking.part(played, i, n) for i in range(len(found))]


def _train(env: Env, args: GapsArgs, found: Sequence[Gap], seeds: list[int], folder: Path) -> list[Episode]:
    """For each gap, the episodes [seeds, episodes] of policies trained there and chosen by evaluations there.

    All gaps and seeds are members [gaps * seeds] of one program: the real systems of a task differ in numbers alone.
    eval.jsonl gets a line per evaluation.
    """
    config, policy, best = args.config, make_policy(prior_card(env, args.config), env), None
    which = jnp.repeat(jnp.arange(len(found)), len(seeds))
    reserve(memory(env, config), copies=len(which))

    def pools(number: int) -> World:
        """All seeds of a gap live in the same worlds."""
        there = real_worlds(env, found, jax.random.fold_in(jax.random.key(seeds[0]), number), config.worlds)
        return jax.tree.map(lambda x: x[which], there)

    def system(seed: int, episodes: int) -> Simulated:
        return Simulated(env, real_worlds(env, found, jax.random.key(seed), episodes), which, gamma=config.gamma)

    log, heldout, size = MetricsLog(folder), system(_HELDOUT_SEED, config.eval_episodes), config.chunk_env_steps
    log.truncate({})
    steps = pretrain(env, config, seeds * len(found), pools=pools)
    next(steps)
    with RunProgress("train on the real systems", total=config.chunks * size, unit="env steps") as progress:
        for done, (state, metrics) in enumerate(steps, start=1):
            log.metrics(done * size, metrics)
            shown = {"train/success": float(metrics["train/success"].mean())}
            if done % config.eval_every == 0 or done == config.chunks:
                params = exported(env, config, state)
                played = play(heldout, policy, params, _episode_key(_HELDOUT_SEED), config.eval_episodes)
                log.eval(done * size, scores(played))
                best = best_of(best, params, played, state.steps)
                shown["success"] = float(played.success.mean())
            progress.advance(size, shown)
    log.close()
    assert best is not None
    played = play(system(_FINAL_SEED, args.episodes), policy, best.params, _episode_key(_FINAL_SEED), args.episodes)
    return [stacking.part(played, i, len(seeds)) for i in range(len(found))]


def _episode_key(seed: int) -> Key:
    return jax.random.fold_in(jax.random.key(seed), 1)
