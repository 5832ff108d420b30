"""Fine-tuning through a `System`, against the same rollout, updates and physics fused into one compiled program."""

import time
from pathlib import Path
from typing import Any

import jax

import envs
from envs import gaps
from envs.gaps import SIM
from envs.mujoco.worlds import Impl
from envs.rollout import Episode
from envs.types import Key, PyTree
from experiments.runner.options import prior_folders
from sgft_jax import api
from sgft_jax.io.priors import load_priors, observed_by
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train import finetuning
from sgft_jax.types import Metrics


def speed(task: str, impl: Impl, seeds: int, *, prior: Path, repeats: int) -> dict[str, Any]:
    """Seconds of a rollout and its updates of the recommended method, by both; the fastest of `repeats`, in turns."""
    folders = prior_folders(prior, out=prior, task=task, preset="")
    env = envs.make(task, impl, **observed_by(folders))
    setup = api.setup(env, gaps.find(env.name, SIM), load_priors(folders, env), seeds=seeds)
    assert isinstance(setup.system, Simulated)
    through = finetuning.finetune(*setup, rollouts=10**9)
    progress, _ = next(through)
    agent = jax.tree.map(lambda x: x.copy(), progress.agent)
    fused = jax.jit(_fused(setup), donate_argnums=0)
    through_s, fused_s = [], []
    for i in range(repeats + 1):  # the first one compiles
        start = time.perf_counter()
        jax.block_until_ready(next(through))
        middle = time.perf_counter()
        agent, _, _ = jax.block_until_ready(fused(agent, jax.random.key(i)))
        through_s.append(middle - start)
        fused_s.append(time.perf_counter() - middle)
    line = {"task": task, "impl": env.impl, "seeds": seeds}
    fastest = {"system_s": min(through_s[1:]), "fused_s": min(fused_s[1:])}
    return line | fastest | {"fused/system": fastest["fused_s"] / fastest["system_s"]}


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
