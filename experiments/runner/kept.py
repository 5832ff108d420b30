"""Impure: simulated transitions, kept on disk between runs: a prior's are always the same, and take long to collect."""

import contextlib
import functools
import hashlib
import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
import sgft_jax
from envs import mesh
from envs.base import Env
from envs.types import Transition, UserError
from experiments.runner import progress
from experiments.runner.cli import cache_folder
from experiments.runner.progress import doing
from sgft_jax.data.replay import ReplayState
from sgft_jax.files.arrays import damage, read_npz
from sgft_jax.files.disk import NEW, jsonable, written
from sgft_jax.io.priors import digest
from sgft_jax.io.runs import versions
from sgft_jax.train.simulation import SimulatedRows
from sgft_jax.types import Prior, Simulation

_FORMAT, _MOST = 1, 2**30  # bytes of all files together: those go that have not been read for longest


def kept_in(task: str) -> Path | None:
    """Where transitions of a task are kept; None for one of the user's own, whose code may change anywhere."""
    folder = cache_folder()
    return folder / "simulated" if folder and envs.TASKS.get(task, "").startswith("envs.") else None


def simulated_rows(
    folder: Path | None, env: Env, priors: Sequence[Prior], needs: Simulation, make: Callable[..., SimulatedRows]
) -> SimulatedRows:
    """What `make(heard)` collects, or the same from disk, where an earlier run with these priors has kept it.

    folder: None keeps nothing. Prints a line where a file is damaged or cannot be written.
    """
    facts = "" if folder is None else json.dumps(_facts(env, priors, needs), sort_keys=True)
    path = folder and folder / f"{hashlib.sha256(facts.encode()).hexdigest()[:24]}.npz"
    if path and os.path.exists(path):  # False, too, in a folder that may not be searched
        try:
            return _read(path, facts)
        except UserError as error:
            print(f"{error}; collected anew")
    count = needs.transitions * len(priors)
    with doing(f"collecting {count:,} simulated transitions of the priors", 20 + count / 3_000, once=path is not None):
        rows = jax.block_until_ready(make(progress.far))
    if path:
        try:
            _write(path, facts, rows)
        except OSError as error:
            print(f"{path.parent}: {(error.strerror or 'cannot be written').lower()}; the next run collects anew")
    return rows


def _facts(env: Env, priors: Sequence[Prior], needs: Simulation) -> dict[str, Any]:
    """All that decides the transitions, to the bit."""
    return {
        "format": _FORMAT,
        "task": jsonable([env.name, env.impl, env.previous_actions, env.system]),
        "needs": [needs.transitions, needs.ladder],
        "priors": [[digest(prior), jsonable(prior.card)] for prior in priors],
        "code": _code(),
        "versions": versions(),
        "machine": [platform.node(), jax.default_backend(), jax.devices()[0].device_kind, mesh.pieces()],
        "flags": os.environ.get("XLA_FLAGS", ""),
    }


@functools.cache
def _code() -> str:
    """Hex digits of all files of the packages that play episodes."""
    sha = hashlib.sha256()
    for package in (envs, sgft_jax):
        home = Path(str(package.__file__)).parent
        for path in sorted(home.rglob("*.py")):
            sha.update(f"{path.relative_to(home)} ".encode() + path.read_bytes())
    return sha.hexdigest()


def _read(path: Path, facts: str) -> SimulatedRows:
    """The transitions of a file; raises UserError for a damaged one and for one of other facts."""
    arrays = read_npz(path)
    with damage(path, "it is of no use"):
        if str(arrays["facts"]) != facts:
            raise UserError(f"{path}: holds other transitions than its name says")
        data = Transition(*(jnp.asarray(arrays[name]) for name in Transition._fields))
        position, size, returns = (jnp.asarray(arrays[name]) for name in ("position", "size", "returns"))
    with contextlib.suppress(OSError):
        path.touch()
    return SimulatedRows(ReplayState(data, position, size), returns)


def _write(path: Path, facts: str, rows: SimulatedRows) -> None:
    """Keeps the transitions, whole or not at all, and makes room for them."""
    replay = rows.replay
    named: Mapping[str, Any] = replay.data._asdict() | {"position": replay.position, "size": replay.size}
    arrays = {name: np.asarray(x) for name, x in {**named, "returns": rows.returns}.items()}
    if sum(x.nbytes for x in arrays.values()) > _MOST:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with written(path, path.with_name(f"{NEW}{os.getpid()}-{path.name}")) as part, open(part, "wb") as file:
        np.savez(file, allow_pickle=False, facts=np.array(facts), **arrays)
    files = sorted(path.parent.glob("*.npz"), key=lambda file: file.stat().st_mtime, reverse=True)
    total = 0
    for file in files:
        total += file.stat().st_size
        if total > _MOST and file != path:
            file.unlink(missing_ok=True)
