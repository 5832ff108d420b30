"""docs/quickstart.ipynb runs from top to bottom, as a notebook would run it: in its folder, in one namespace."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parent.parent / "docs/quickstart.ipynb"
CHECKS = """
zero_shot, *later = curve.values.mean(0)
assert max(later) > zero_shot, (zero_shot, later)
assert {row["seed"] for row in rows} == set(setup.seeds.tolist()) and rows[-1]["success"] == curve.values[-1, -1]
assert axes.lines and policy.act(np.array([-0.15, 0.0, 0.0])).shape == (1,)
"""


@pytest.mark.slow  # .ci/run runs it
def test_the_notebook_runs_and_fine_tuning_helps():
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] for cell in cells), "commit it without outputs"
    program = "\n".join(["".join(cell["source"]) for cell in cells] + [CHECKS])
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "MPLBACKEND": "agg", "PYTHONPATH": str(NOTEBOOK.parent.parent)}
    subprocess.run([sys.executable, "-c", program], cwd=NOTEBOOK.parent, env=environment, check=True, timeout=580)
