"""Impure: measures gaps. `experiments.gaps` is its command."""

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, World
from envs.gaps import Gap
from experiments import stacking
from experiments.algorithms import describe_use, make_player
from experiments.evaluation import Best, Outcome, describe, grade, score
from experiments.gaps import GapsArgs
from experiments.memory import reserve
from experiments.presets import PretrainConfig
from experiments.pretrain_run import Program, Saved, make_program
from experiments.pretraining import PretrainState, memory
from experiments.worlds import real_env, real_worlds
from sgft_jax.analysis.stats import iqm_interval
from sgft_jax.io.log import MetricsLog, write_summary
from sgft_jax.io.progress import RunProgress
from sgft_jax.io.priors import load_priors
from sgft_jax.types import Key, Metrics, PyTree, UserError

ZERO_SHOT_AT_MOST, TRAINED_AT_LEAST = 0.40, 0.95
_RANDOM, _START = range(4, 6)  # purposes, folded into a seed's key
_EXAM_SEED, _REPORT_SEED = 2**31 + 4, 2**31 + 5  # held-out worlds and episodes


def run(args: GapsArgs, seeds: list[int], folders: list[Path]) -> dict[str, Any]:
    """Measures, prints a table, writes and returns the summary. folders: of the priors."""
    task = envs.name_of(args.task)
    env = envs.make(args.task, args.impl)
    found = [gaps.load(env, name) for name in args.presets or gaps.presets(task)]
    if not found:
        raise UserError(f"{task} comes with no gaps; name .toml or .json files with --presets")
    env = real_env(env, found)
    folder = args.out / "gaps" / task
    priors, card = load_priors(folders, env)
    here = _zero_shot(env, found, stacking.stack(priors), card, args.episodes)
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
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _percent(found: dict[str, Any] | None) -> str:
    if found is None:
        return "-"
    low, high = found["interval"]
    return f"{100 * found['success']:.0f} [{100 * low:.0f}, {100 * high:.0f}]"


def _line(gap: Gap, zero_shot: Outcome, trained: Outcome | None) -> dict[str, Any]:
    zero, best = _rate(zero_shot), None if trained is None else _rate(trained)
    verdict = admissible(zero["success"], None if best is None else best["success"])
    return {"gap": gap._asdict(), "zero_shot": zero, "trained": best, "admissible": verdict}


def _rate(outcome: Outcome) -> dict[str, Any]:
    """Success of policies, [policies, episodes]: of one with its Wilson interval, of several as IQM over them."""
    each = [describe(stacking.member(outcome, i)) for i in range(len(outcome.success))]
    if len(each) == 1:
        return {"success": each[0]["success"], "interval": each[0]["success/interval"], "policies": each}
    band = iqm_interval(np.array([one["success"] for one in each]))
    return {"success": float(band.estimate), "interval": [float(band.low), float(band.high)], "policies": each}


def _zero_shot(env: Env, found: Sequence[Gap], priors: PyTree, card: dict[str, Any], episodes: int) -> list[Outcome]:
    """For each gap, the episodes of the priors [priors, episodes]; every policy plays the same ones."""
    pools = real_worlds(env, found, jax.random.key(_REPORT_SEED), episodes)
    key = jax.random.fold_in(jax.random.key(_REPORT_SEED), 1)
    graded = _grader(env, card, episodes=episodes)
    over_priors = jax.vmap(graded, (None, None, 0))
    outcome = jax.tree.map(np.asarray, jax.jit(jax.vmap(over_priors, (None, 0, None)))(key, pools, priors))
    return [stacking.member(outcome, i) for i in range(len(found))]


def _grader(env: Env, card: dict[str, Any], *, episodes: int) -> Callable[[Key, World, PyTree], Outcome]:
    """(key, pool, prior) -> Outcome [episodes]."""
    player, gamma = make_player(card, env), card["gamma"]
    return lambda key, pool, prior: grade(env, player, pool, key, prior, gamma=gamma, episodes=episodes)


# ------------------------------------------------------------ training on the real systems


def _train(env: Env, args: GapsArgs, found: Sequence[Gap], seeds: list[int], folder: Path) -> list[Outcome]:
    """For each gap, the episodes [seeds, episodes] of policies trained there and chosen by evaluations there.

    All gaps and seeds are members [gaps * seeds] of one program: the real systems of a task differ in numbers alone.
    """
    config, count = args.config, len(found) * len(seeds)
    reserve(memory(env, config), copies=count)

    def members(seed: int, n: int) -> World:
        """Worlds [gaps * seeds, n]; all seeds of a gap live in the same ones."""
        pools = real_worlds(env, found, jax.random.key(seed), n)
        return jax.tree.map(lambda x: jnp.repeat(x, len(seeds), axis=0), pools)

    def examiner(seed: int, episodes: int) -> Callable[[PyTree], Outcome]:
        """Priors [gaps * seeds] -> Outcome [gaps * seeds, episodes], the same episodes every time."""
        graded = _grader(env, describe_use(env, config), episodes=episodes)
        program = jax.jit(stacking.over_seeds(graded, count, shared=1))
        return functools.partial(program, jax.random.fold_in(jax.random.key(seed), 1), members(seed, episodes))

    program = make_program(env, config, seeds=count)
    pools = members(seeds[0], config.worlds)
    random_keys, start_keys = (
        jnp.tile(stacking.seed_keys(seeds, purpose), len(found)) for purpose in (_RANDOM, _START)
    )
    random = program.collect(pools, random_keys)
    saved = program.begin(pools, random, start_keys)
    chunk = functools.partial(program.chunk, pools, random)
    best = _best(saved, chunk, examiner(_EXAM_SEED, config.eval_episodes), program, config, folder)
    outcome = jax.tree.map(np.asarray, examiner(_REPORT_SEED, args.episodes)(best))
    return [stacking.part(outcome, i, len(seeds)) for i in range(len(found))]


def _best(
    saved: Saved,
    chunk: Callable[[PretrainState], tuple[PretrainState, Metrics]],
    examine: Callable[[PyTree], Outcome],
    program: Program,
    config: PretrainConfig,
    folder: Path,
) -> PyTree:
    """Trains to the end, with a line in eval.jsonl per evaluation; the policies at their best evaluation."""
    size = config.n_envs * config.chunk_steps
    chunks = math.ceil(config.env_steps / size)
    log, (run, best) = MetricsLog(folder), saved
    log.truncate({})
    with RunProgress("train on the real systems", total=chunks * size, unit="env steps") as progress:
        for done in range(1, chunks + 1):
            run, metrics = chunk(run)
            log.metrics(done * size, metrics)
            shown = {"train/success": float(metrics["train/success"].mean())}
            if done % config.eval_every == 0 or done == chunks:
                prior = program.extract(run.learner)
                scores = jax.vmap(score)(examine(prior))
                log.eval(done * size, scores)
                best = program.better(best, Best(prior, scores["success"], scores["return"], run.steps), 0.0)
                shown["success"] = float(scores["success"].mean())
            progress.advance(size, shown)
    log.close()
    return best.prior
