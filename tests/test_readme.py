"""README.md: every line of shell and Python runs as pasted, in order; its table says what the released data say."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.studies.scoreboard import ScoreboardArgs, played_on
from sgft_jax.analysis.curves import area, common_grid, deepest_fall

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
ROW = re.compile(r"^\| `([\w-]+)` \| ([\d/]+) \| ([\d/]+) \| ([\d/]+) \| (\d+) \|$", re.M)
PRIORS = ("robust", "informed", "recurrent", "robust-tdmpc2")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_all_of_it_runs_as_pasted_in_a_fresh_clone(tmp_path):
    """But for `make setup`, which .ci/run tries in a fresh clone: here a link to this environment stands for it."""
    blocks = re.findall(r"^```(bash|python)\n(.*?)^```$", README, re.M | re.S)
    pasted = [text if language == "bash" else f"python - <<'END'\n{text}END\n" for language, text in blocks]
    script, setups = re.subn(r"^make setup\b", f"ln -s '{sys.prefix}' .venv", "".join(pasted), flags=re.M)
    assert setups == 1
    users = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "SGFT_IMPL")}
    environment = {**users, "JAX_PLATFORMS": "cpu", "URL": str(ROOT)}
    subprocess.run(["bash", "-ex", "-c", script], cwd=tmp_path, env=environment, check=True, timeout=3500)
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.glob("sgft-jax/runs/*")}
    assert left >= {f"sgft-jax/runs/{name}" for name in ("demo", "finetune", "mine", "pretrain")}


def test_the_table_is_what_the_released_data_say():
    """On gaps where the policies that play work before fine-tuning, and on those where they do not."""
    files = tuple((ROOT / "envs/gaps/test").glob("*.toml"))
    board = played_on(ScoreboardArgs(files, data=ROOT / "docs/data", priors=PRIORS))
    played = {
        method: {gap: curve for runs in strata.values() for gap, curve in runs.items()}
        for method, strata in board.items()
    }
    start = {gap: 100 * curve.values[:, 0].mean() for gap, curve in played["guarded"].items()}
    control = {gap for gap in start if gap.endswith("/sim")}
    works = {gap for gap in start.keys() - control if start[gap] > 75}
    fails = start.keys() - control - works
    for gaps, words in ((works, "works"), (fails, "fails")):
        low, high = (f"{bound(start[gap] for gap in gaps):.0f}" for bound in (min, max))
        assert f"| {len(gaps)} gaps, policy {words} ({low} to {high}) |" in README
    rows = ROW.findall(README)
    assert len(rows) == 7
    for method, *cells, fall in rows:
        assert [_scores([played[method][gap] for gap in gaps]) for gaps in (control, works, fails)] == cells
        assert fall == f"{100 * max(deepest_fall(played[method][gap]) for gap in works):.0f}"


def _scores(curves):
    """Success before, on average over the rollouts, and after the last, mean over gaps and priors, in per cent."""
    grid = common_grid(curves)
    columns = np.array([[curve.values[:, 0], area(curve, grid), curve.values[:, -1]] for curve in curves])
    return "/".join(f"{100 * round(score, 6):.0f}" for score in columns.mean(axis=(0, 2)))
