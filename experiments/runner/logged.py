"""Impure: recorded data of a real system for runs that learn from them."""

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp

from envs.base import Env
from envs.types import UserError
from sgft_jax.datasets import logs as datasets
from sgft_jax.datasets.logs import Log
from sgft_jax.train.finetuning import Logged
from sgft_jax.types import Finetuner, Successors


def read(path: Path, env: Env, *, gamma: float, successors: Successors = "stored") -> Log:
    """The real rows of a file or folder; says what they are. Raises UserError if they are not of this task."""
    log = datasets.load(path, gamma=gamma, successors=successors, env=env)
    facts = log.facts
    clipped = f"; {facts.clipped:,} actions beyond [-1, 1] were clipped" if facts.clipped else ""
    print(
        f"data: {facts.path}, {facts.size:,} bytes, sha256 {facts.sha256[:12]}; {facts.transitions:,} transitions of "
        f"{facts.episodes:,} episodes, return {facts.return_mean:.4g} (std {facts.return_std:.3g}, "
        f"{facts.return_min:.4g} to {facts.return_max:.4g}){clipped}"
    )
    if facts.assumed:
        print(f"{facts.path}: {facts.assumed}")
    return log


def begin_with(logs: Sequence[Log], finetuner: Finetuner, env: Env, *, capacity: int, updates: int | None) -> Logged:
    """What fine-tuning begins with. capacity: transitions that an agent keeps.

    updates: on the logs; None makes as many as rollouts of so many transitions would allow. Raises UserError where the
    logs are more than an agent keeps.
    """
    count = transitions(logs)
    if count > capacity:
        raise UserError(
            f"--real-data: {count:,} transitions, but an agent keeps {capacity:,}; raise --options.replay-capacity"
        )
    rows, valid = jax.tree.map(jnp.asarray, datasets.episodes(logs))
    made = round(finetuner.updates_per_rollout * count / env.episode_length) if updates is None else updates
    return Logged(rows, valid, made)


def transitions(logs: Sequence[Log]) -> int:
    """How many they hold together."""
    return sum(log.facts.transitions for log in logs)
