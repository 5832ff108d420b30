"""The small files that the rows name, in the folder where the commands run."""

import json
import os
import shutil
from pathlib import Path

import numpy as np

from sgft_jax.io.cards import SHIPPED

ROOT = Path(__file__).parents[3]
OBS, ACT, STEPS = 4, 2, 3  # of push, as it is measured


def make(home: Path) -> None:
    """Priors, a run with rollouts, files of gaps, tasks and methods, and things that are none of these."""
    shutil.copytree(SHIPPED / "push/seed-0", home / "prior")
    for task in ("hammer", "panda-push"):
        shutil.copytree(SHIPPED / f"{task}/seed-0", home / f"prior-{task}")
    for name in ("own_task.py", "own_method.py"):
        shutil.copy(ROOT / "docs/examples" / name, home)
    (home / "empty").mkdir()
    (home / "file").write_text("mine")
    (home / "binary").write_bytes(bytes(range(256)))
    (home / "piped").mkdir()
    (home / "folder.py").mkdir()
    (home / "folder.toml").mkdir()
    for name in ("fifo", "fifo.py", "fifo.toml", "piped/prior.json"):
        os.mkfifo(home / name)
    for name in ("loop", "loop.py", "loop.toml"):
        (home / name).symlink_to(name)
    _run(home / "run")
    _set(home / "set.hdf5")


def _run(home: Path) -> None:
    """What fine-tuning on push has left after one rollout of one seed."""
    (home / "real").mkdir(parents=True)
    about = {"task": "push", "method": "sac", "seed": 0, "seeds": 1, "prior": "prior", "preset": "robust"}
    stored = {"sgft_jax": "0", "format": 2, "kind": "finetune", "config": about}
    (home / "config.json").write_text(json.dumps(stored))
    (home / "eval.jsonl").write_text(json.dumps({"step": 0, "success": [0.0]}) + "\n")
    rows = {"obs": np.zeros((1, STEPS, OBS)), "action": np.zeros((1, STEPS, ACT)), "reward": np.zeros((1, STEPS))}
    facts = {"discount": np.ones((1, STEPS)), "valid": np.ones((1, STEPS), bool), "success": np.zeros(1, bool)}
    np.savez(home / "real/rollout-000000.npz", next_obs=rows["obs"], **rows, **facts)


def _set(path: Path) -> None:
    """A D4RL file of push, of one episode."""
    import h5py

    with h5py.File(path, "w") as file:
        for name, size in (("observations", (STEPS, OBS)), ("actions", (STEPS, ACT)), ("rewards", (STEPS,))):
            file[name] = np.zeros(size, np.float32)
        file["terminals"], file["timeouts"] = np.zeros(STEPS, bool), np.arange(STEPS) == STEPS - 1
