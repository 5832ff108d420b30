"""Every command refuses what it cannot use in one line, with exit code 2, and changes nothing on disk.

A row is a command line, words of what it says, and perhaps files that it reads. Rows of `ROWS` need neither JAX nor
MuJoCo to be judged, those of `HEAVY` do.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import made
import pytest
import rows_code
import rows_gap_files
import rows_grids
import rows_reading
import rows_robots
import rows_stored
import rows_training

TABLES = (
    rows_training,
    rows_grids,
    rows_reading,
    rows_robots,
    rows_code,
    rows_gap_files,
    rows_stored,
)
WORKER = Path(__file__).with_name("worker.py")


def faults(rows, folder, *argv):
    """What is wrong with what the commands did, a line for each row."""
    made.make(folder)
    given = [{"command": command, "files": dict(*files)} for command, _, *files in rows]
    cache = {"JAX_COMPILATION_CACHE_DIR": str(made.ROOT / ".cache/jax")}
    environment = {**os.environ, **cache, "PYTHONPATH": str(made.ROOT), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, WORKER, *argv],
        input=json.dumps(given),
        env=environment,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=540,  # before pytest's own limit, which ends every test of this process
    )
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(answers) == len(rows), f"{rows[len(answers)][0]}: killed the process: {done.stderr}"
    return [
        f"{command[:100]}: {wrong}"
        for (command, words, *_), answer in zip(rows, answers, strict=True)
        if (wrong := fault(words, **answer, begun=not argv))
    ]


def fault(words, *, code, out, err, changed, begun):
    """What is wrong with one of them, None if nothing is. begun: whether it may have said what it was doing."""
    *phases, error = err.splitlines() or [""]
    if code != 2 or not error.startswith("error: ") or (phases and not begun) or "Traceback" in err:
        return f"exit code {code}: {err[-1000:]}"
    if words not in err:
        return f"says {err[:300].rstrip()}, not {words}"
    return f"changes {', '.join(changed)}" if changed else None


@pytest.mark.heavy
@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.__name__.rpartition(".")[2])
def test_mistakes_that_need_no_model(table, tmp_path):
    assert faults(table.ROWS, tmp_path, "apart") == []


@pytest.mark.heavy
def test_mistakes_that_need_one(tmp_path):
    assert faults([row for table in TABLES for row in getattr(table, "HEAVY", ())], tmp_path) == []


def test_there_are_rows_for_every_command():
    rows = [row[0].split()[0] for table in TABLES for row in (*table.ROWS, *getattr(table, "HEAVY", ()))]
    files = (made.ROOT / "experiments").glob("*.py")
    commands = {path.stem for path in files if "cli.run_main(" in path.read_text()} - {"cli"}
    assert len(rows) >= 300 and {name for name in commands if rows.count(name) < 3} == set()
