"""The rollouts that a run has stored in real/, for commands that read them. Imports no JAX."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from envs.types import UserError
from experiments.runner.options import check_task
from sgft_jax.io import real
from sgft_jax.io.cards import known_task
from sgft_jax.io.real import Played
from sgft_jax.io.runs import CONFIG, read_config

if TYPE_CHECKING:
    from envs.base import Env


def home_of(option: str, folder: Path) -> Path:
    """The folder that holds real/ with rollouts, that itself or its parent; raises UserError where there is none."""
    home = real.home_of(folder)
    if home is None:
        raise UserError(f"{option} {folder}: holds no recorded rollouts (real/rollout-*.npz)")
    return home


def task_of(home: Path, task: str | None) -> str:
    """The task that was played: what the user says, or what the run says; raises UserError where nobody does.

    A run names no code: one of a task of the user's own is of that task again where the user says so.
    """
    if task is None:
        if (named := read_config(home).get("task")) is None:
            raise UserError(f"{home}: does not say of which task it is; name it with --task")
        return known_task(home / CONFIG, named)
    check_task(task)
    return task


def episodes_of(home: Path, seed: int | None) -> list[Played]:
    """The episodes of one seed of a run, or those of all; raises UserError for a seed that it does not have."""
    rollouts, first = real.played(home), read_config(home).get("seed", 0)
    seeds = sorted({first + rollout.seed for rollout in rollouts})
    if seed is not None and seed not in seeds:
        raise UserError(f"--seed {seed}: {home} has the seeds {', '.join(map(str, seeds))}")
    return [rollout._replace(seed=first + rollout.seed) for rollout in rollouts if seed in (None, first + rollout.seed)]


def check_sizes(home: Path, episodes: Sequence[Played], env: "Env") -> None:
    """Raises UserError for episodes of a task with other observations or actions."""
    seen, commanded = (episodes[0].rows[name].shape[1] for name in ("obs", "action"))
    if seen < env.measured_dim or commanded != env.act_dim:
        raise UserError(
            f"{home}: has {seen} observations and {commanded} actions, {env.name} has {env.measured_dim} and "
            f"{env.act_dim}; name its task with --task"
        )
