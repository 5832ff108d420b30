"""Wall clock of whole commands: pretraining over devices, fine-tuning by number of seeds, and what fine-tuning through
a `System` costs against one compiled program.

The commands run in folders that are thrown away. What is timed as a whole runs twice: the second time its programs come
from JAX's compilation cache, so the difference is what compiling costs, if the cache did not hold them before.
"""

import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

import envs
from envs import gaps
from envs.gaps import SIM
from envs.mujoco.worlds import Impl
from envs.rollout import Episode
from envs.types import Key, PyTree
from experiments.bench.timing import fastest_in_turns
from experiments.finetune import finetune
from experiments.pretrain import PretrainArgs, pretrain
from experiments.runner.finetune_args import arguments, run_folder
from experiments.runner.options import prior_folders
from sgft_jax import api
from sgft_jax.io.log import read_jsonl
from sgft_jax.io.priors import load_priors, variant_of
from sgft_jax.presets import PRESETS
from sgft_jax.train import finetuning
from sgft_jax.types import Metrics

_NEVER = 10**9  # chunks between what training is not slowed by


def weak_scaling(
    task: str, impl: Impl, devices: Sequence[int], *, worlds: int, batch: int, preset: str, env_steps: int | None
) -> list[dict[str, Any]]:
    """Environment steps per second while training, compilation and evaluations left out, for each number of devices.

    worlds, batch, env_steps: for each device, as are the replay and the random-action data of the preset. ideal_per_s:
    as many times the speed of the smallest number; the ratio of both is `env/ideal`.
    """
    base = PRESETS[preset]
    summaries = {}
    for n in devices:
        sizes = {"n_envs": n * worlds, "batch_size": n * batch, "env_steps": n * (env_steps or base.env_steps)}
        sizes["random_transitions"] = n * max(base.random_transitions, worlds)
        sizes |= {"replay_capacity": n * base.replay_capacity, "eval_every": _NEVER, "checkpoint_every": _NEVER}
        config = replace(base, **sizes)
        args = PretrainArgs(task=task, preset=preset, config=config, impl=impl, devices=n, report=False, video=False)
        with tempfile.TemporaryDirectory() as out:
            summaries[n] = pretrain(replace(args, out=Path(out)))
    speed = {n: summary["env_steps"] / summary["time/train_s"] for n, summary in summaries.items()}
    alone = speed[min(speed)] / min(speed)
    lines = []
    for n in sorted(speed):
        line = {"task": task, "impl": summaries[n]["impl"], "devices": n, "worlds": worlds, "batch": batch}
        line |= {"env_per_s": speed[n], "ideal_per_s": n * alone, "env/ideal": speed[n] / (n * alone)}
        lines.append(line | {"compile_s": summaries[n]["time/compile_s"]})
    return lines


def fine_tuning(task: str, impl: Impl, seeds: int, *, prior: Path, rollouts: int, method: str) -> dict[str, Any]:
    """Seconds of a method from that prior, its curve included, and those of the median rollout with its updates."""

    def run(out: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        chosen = {"task": task, "seeds": seeds, "rollouts": rollouts, "prior": prior, "impl": impl}
        args = arguments(method, **chosen, video=False, out=out)
        (summary,) = finetune(args)
        return summary, read_jsonl(run_folder(args, *args.real) / "timing.jsonl")

    first_s, ((summary, timing), seconds) = _twice(run)
    rollout_s = statistics.median(line["time/rollout_s"] for line in timing[1:])
    line = {"task": task, "method": method, "impl": summary["impl"], "seeds": seeds, "rollouts": rollouts}
    return line | {"seconds": seconds, "first_run_s": first_s, "rollout_s": rollout_s}


def through_system(task: str, impl: Impl, seeds: int, *, prior: Path, repeats: int) -> dict[str, Any]:
    """Seconds of a rollout and its updates of the recommended method, by both; the fastest of `repeats`, in turns."""
    folders = prior_folders(prior, out=prior, task=task, preset="")
    env = envs.make(task, impl, **variant_of(folders))
    setup = api.setup(env, gaps.find(env.name, SIM), load_priors(folders, env), seeds=seeds)
    through = finetuning.finetune(*setup, rollouts=10**9)
    next(through)  # the fresh state
    progress, _ = next(through)
    agent = jax.tree.map(lambda x: x.copy(), progress.agent)
    fused = jax.jit(_fused(setup), donate_argnums=0)

    def in_one_program() -> None:
        nonlocal agent
        agent, _, _ = jax.block_until_ready(fused(agent, jax.random.key(0)))

    calls = (lambda: jax.block_until_ready(next(through)), in_one_program)
    system_s, fused_s = fastest_in_turns(calls, repeats=repeats)
    line = {"task": task, "impl": env.impl, "seeds": seeds}
    return line | {"system_s": system_s, "fused_s": fused_s, "fused/system": fused_s / system_s}


def _fused(setup: api.Setup) -> Any:
    """(agent, key) -> agent, episodes, metrics: what `finetuning.finetune` does between two yields."""
    finetuner, updates = setup.finetuner, setup.finetuner.updates_per_rollout
    learn = finetuning.Updates(finetuner, setup.seeds, finetuning.prior_of(setup.priors, setup.seeds), setup.simulated)

    def rollout(agent: PyTree, key: Key) -> tuple[PyTree, Episode, Metrics]:
        keys = jax.random.split(key, (len(setup.seeds), 1))
        played = setup.system.play(finetuner, agent, keys, explore=True)
        first = jax.tree.map(lambda x: x[:, 0], (played.transitions, played.valid, played.score))
        agent, metrics = learn(jax.vmap(finetuner.observe)(agent, *first), [0], updates)
        return agent, played, metrics

    return rollout


def _twice(run: Callable[[Path], Any]) -> tuple[float, tuple[Any, float]]:
    """(Seconds of the first run, (what the second returned, its seconds))."""
    runs = []
    for _ in range(2):
        with tempfile.TemporaryDirectory() as out:
            start = time.perf_counter()
            result = run(Path(out))
            runs.append((result, time.perf_counter() - start))
    return runs[0][1], runs[1]
