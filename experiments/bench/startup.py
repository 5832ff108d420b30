"""Seconds from the start of a pretraining process to priors that can be loaded, without compiled programs and with."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from envs.mujoco.worlds import Impl
from envs.types import UserError

_PHASES = ("worlds", "random", "compile", "train", "evaluate", "report")


def to_priors(task: str, impl: Impl, seeds: int, *, preset: str, env_steps: int | None) -> list[dict[str, Any]]:
    """A line for a process with empty caches (XLA's and Warp's), and one for a second process that finds them filled.

    prior_s: until the priors are on disk. process_s: until it has ended. The rest is the run's own account; success is
    that of the worst seed. Raises UserError if a process fails.
    """
    asked = {"task": task, "impl": impl, "seeds": seeds, "preset": preset, "config.env-steps": env_steps}
    options = [f"--{name}={value}" for name, value in asked.items() if value is not None]
    lines = []
    with tempfile.TemporaryDirectory() as place:
        home = Path(place)
        caches = {"SGFT_CACHE_DIR": str(home / "xla"), "WARP_CACHE_PATH": str(home / "warp")}
        for state in ("empty", "filled"):
            command = [sys.executable, "-m", "experiments.pretrain", *options, "--no-video", f"--out={home / state}"]
            begun = time.time()
            if subprocess.run(command, env=os.environ | caches, stdout=sys.stderr).returncode:
                raise UserError(f"--parts startup: {' '.join(command[2:])} has failed, see above")
            line = {"task": task, "seeds": seeds, "caches": state, "process_s": time.time() - begun}
            (path,) = home.glob(f"{state}/**/summary.json")
            lines.append(line | _account(path, begun))
    return lines


def _account(path: Path, begun: float) -> dict[str, Any]:
    """What a run says of itself. path: of its summary. begun: when its process began, s since the epoch."""
    summary = json.loads(path.read_text())
    parts = {f"{phase}_s": summary.get(f"time/{phase}_s", 0.0) for phase in _PHASES}
    success = min(seed["success"] for seed in summary["seeds"])
    return {
        "impl": summary["impl"],
        "prior_s": (path.parent / "prior").stat().st_mtime - begun,
        "success": success,
    } | parts
