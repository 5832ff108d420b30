"""docs/quickstart.ipynb runs from top to bottom, as a notebook would run it: in its folder, in one namespace."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parent.parent / "docs/quickstart.ipynb"
LIMIT = 900  # seconds
CHECKS = """
zero_shot, *later = curve.values.mean(0)
assert len(later) == 3 and later[-1] > zero_shot + 0.2, (zero_shot, later)
assert {row["seed"] for row in rows} == set(setup.seeds.tolist()) and rows[-1]["success"] == curve.values[-1, -1]
assert axes.lines and policy.act(np.zeros(policy.env.measured_dim)).shape == (policy.env.act_dim,)
assert metrics["train/success"][0] > 0.3 and folder.exists()
"""


@pytest.mark.slow  # .ci/run runs it
@pytest.mark.timeout(LIMIT + 60)  # the notebook's own limit comes first, and names it
def test_the_notebook_runs_and_fine_tuning_helps():
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] for cell in cells), "commit it without outputs"
    program = "\n".join(["".join(cell["source"]) for cell in cells] + [CHECKS])
    users = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "SGFT_IMPL")}
    environment = {**users, "JAX_PLATFORMS": "cpu", "MPLBACKEND": "agg", "PYTHONPATH": str(NOTEBOOK.parent.parent)}
    subprocess.run([sys.executable, "-c", program], cwd=NOTEBOOK.parent, env=environment, check=True, timeout=LIMIT)
