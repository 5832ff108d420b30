"""The command that exports policies, and the files that a robot's computer gets."""

import ast
import json
import subprocess
import sys

import numpy as np
import pytest
from priors_by_hand import save_prior

from experiments import export
from experiments.export import ExportArgs
from experiments.runner import cli
from sgft_jax import api

PLAY = """
import json, sys
sys.path[:0] = [sys.argv[1]]
from policy import Policy
policy = Policy()
actions = [policy.act(measured).tolist() for measured in json.loads(sys.argv[2])]
others = sorted({name.partition(".")[0] for name in sys.modules} & {"jax", "jaxlib", "flax", "sgft_jax", "envs"})
print(json.dumps([actions, others]))
"""


pytestmark = pytest.mark.usefixtures("toy_task")


@pytest.fixture
def run(tmp_path):
    """A run that has left two policies, each of which reads the last two actions."""
    import toy

    from envs.observations import with_previous_actions

    sizes = {"obs_dim": with_previous_actions(toy.make(), 2).obs_dim, "previous_actions": 2}
    for seed in (0, 1):
        save_prior(tmp_path / f"run/policy/seed-{seed}", seed, **sizes)
    return tmp_path / "run"


@pytest.mark.heavy
def test_the_folder_is_played_without_this_code_or_jax(run, capsys):
    """In a process of its own that finds neither through its paths: `-I` keeps PYTHONPATH out."""
    export.main(ExportArgs(run, "numpy"))
    said = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in said] == [str(run / f"export/numpy/seed-{i}") for i in (0, 1)]
    folder, episode = run / "export/numpy/seed-1", np.random.default_rng(0).normal(size=(10, 4))
    assert sorted(file.name for file in folder.iterdir()) == ["contract.json", "policy.npz", "policy.py"]
    words = [sys.executable, "-I", "-c", PLAY, str(folder), json.dumps(episode.tolist())]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=run)
    actions, others = json.loads(done.stdout)
    policy = api.load_policy(run / "policy/seed-1")
    np.testing.assert_allclose(actions, [policy.act(measured) for measured in episode], atol=1e-5)
    assert others == []


@pytest.mark.heavy
def test_the_player_is_python_3_9(run):
    export.main(ExportArgs(run / "policy/seed-0", "numpy", run.parent / "one"))
    tree = ast.parse((run.parent / "one/policy.py").read_text(), feature_version=(3, 9))
    imported = [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom))]
    assert not [node for node in imported if "sgft" in ast.unparse(node)]
    assert "strict" not in {word.arg for node in ast.walk(tree) if isinstance(node, ast.Call) for word in node.keywords}


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--policy", "nowhere", "--to", "numpy"], "--policy nowhere: no such folder"),
        (["--policy", ".", "--to", "numpy"], "--policy .: holds no prior"),
        (["--policy", "run", "--to", "numppy"], "numppy"),
        (["--policy", "run", "--to", "numpy", "--task", "toi"], "did you mean 'toy'?"),
        (["--policy", "run", "--to", "numpy", "--task", "push"], "task"),
        (["--policy", "run", "--to", "numpy", "--out", "there"], "there/seed-1: exists already; choose another --out"),
    ],
)
def test_mistakes_are_told_in_one_line_and_nothing_is_written(run, words, complaint, capsys, monkeypatch):
    monkeypatch.chdir(run.parent)
    (run.parent / "there/seed-1").mkdir(parents=True)
    before = sorted(run.parent.rglob("*"))
    with pytest.raises(SystemExit) as stopped:
        cli.run_main(export.main, ExportArgs, "", argv=words)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and error.count("\n") == 1 and complaint in error
    assert sorted(run.parent.rglob("*")) == before
