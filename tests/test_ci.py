"""In CI a test may not be skipped because something that our extras bring is not installed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(("ci", "outcome"), [("true", "No module named 'nowhere'"), ("", "1 skipped")])
def test_a_missing_extra_fails_in_ci_alone(ci, outcome, tmp_path):
    (tmp_path / "test_it.py").write_text("import pytest\ndef test_it(): pytest.importorskip('nowhere')\n")
    environment = {**os.environ, "CI": ci, "PYTHONPATH": str(Path(__file__).parent)}
    words = [sys.executable, "-m", "pytest", "-q", "-p", "conftest", "-p", "no:cacheprovider", "test_it.py"]
    done = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert outcome in done.stdout and (done.returncode == 0) == ("skipped" in outcome)
