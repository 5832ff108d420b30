"""Cards and run folders are data: a task or a method that they name is never executed, and what is odd is one line."""

import json

import numpy as np
import pytest
from priors_by_hand import save_prior

import envs
from envs.types import UserError
from experiments import diagnose, evaluate, export, export_data, replay
from experiments.runner import cli, finetune_args, grid, tuned
from experiments.runner.options import prior_folders, task_of_priors
from sgft_jax import api
from sgft_jax.analysis import release
from sgft_jax.files.disk import ASIDE
from sgft_jax.io.priors import load_prior

pytestmark = pytest.mark.usefixtures("toy_task")


@pytest.fixture
def code(tmp_path, monkeypatch):
    """How a file may name code that leaves a mark when it is executed; and the mark."""
    mark = tmp_path / "executed"
    (tmp_path / "evil.py").write_text(f"open({str(mark)!r}, 'w').close()\nMETHOD = None\n\ndef make(impl): ...\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "package").mkdir()
    (tmp_path / "package/evil.py").write_text((tmp_path / "evil.py").read_text())
    return {"path": str(tmp_path / "evil.py"), "relative": "evil.py", "module": "package.evil", "unknown": "evil"}, mark


def run_with(folder, **config):
    """A run folder with two recorded rollouts of the toy task and a curve."""
    (folder / "real").mkdir(parents=True, exist_ok=True)
    steps = {"obs": (1, 3, 4), "action": (1, 3, 2), "reward": (1, 3), "discount": (1, 3), "next_obs": (1, 3, 4)}
    rows = {name: np.zeros(shape, np.float32) for name, shape in steps.items()}
    facts = {"valid": np.ones((1, 3), bool), "success": np.ones(1, bool), "world": np.zeros(1, int)}
    facts |= {name: np.zeros(1, np.float32) for name in ("total_reward", "score")} | {"exploded": np.zeros(1, bool)}
    for number in range(2):
        np.savez(folder / f"real/rollout-{number:06d}.npz", **rows, **facts, trace=np.zeros((1, 4, 0)))
    line = {"step": 3, "rollouts": 1, "robot_minutes": 0.1, "score": [1.0], "success": [1.0], "return": [1.0]}
    (folder / "eval.jsonl").write_text(f"{json.dumps(line)}\n")
    stored = {"sgft_jax": "1", "format": 2, "kind": "finetune", "config": {"task": "toy", "seed": 0} | config}
    (folder / "config.json").write_text(json.dumps(stored))
    return folder


OF_PRIORS = [
    (evaluate.main, evaluate.EvaluateArgs, "--prior", "prior"),
    (export.main, export.ExportArgs, "--policy", "prior", "--to", "numpy"),
    (diagnose.main, diagnose.DiagnoseArgs, "--prior", "prior"),
]
OF_RUNS = [
    (replay.main, replay.ReplayArgs, "--run", "run"),
    (export_data.main, export_data.ExportDataArgs, "--run", "run", "--to", "minari"),
    (diagnose.main, diagnose.DiagnoseArgs, "--real", "run", "--prior", "prior"),
]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def call(command, tmp_path, capsys):
    """The one line of a command, which leaves nothing behind."""
    main, args, *words = command
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as stopped:
        cli.run_main(main, args, "", argv=words)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and error.startswith("error: ") and error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before
    return error


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("how", ["path", "relative", "module", "unknown"])
def test_a_card_never_names_code(how, code, tmp_path, capsys):
    names, mark = code
    save_prior(tmp_path / "prior", 0, task=names[how])
    for command in OF_PRIORS:
        error = call(command, tmp_path, capsys)
        assert "evil" in error and "if it is yours, name its file with --task" in error
    prior = load_prior(tmp_path / "prior")
    for attempt in (lambda: api.make_env(prior), lambda: api.load_policy(tmp_path / "prior")):
        with pytest.raises(UserError, match="does not come with this code; if it is yours, name its file with task="):
            attempt()
    assert not mark.exists()


@pytest.mark.parametrize("how", ["path", "relative", "module", "unknown"])
def test_neither_does_the_config_of_a_run(how, code, tmp_path, capsys):
    names, mark = code
    save_prior(tmp_path / "prior", 0)
    for name in ("run", "other"):
        run_with(tmp_path / name, task=names[how], method=names["path"])
    for command in OF_RUNS:
        assert "name its file with --task" in call(command, tmp_path, capsys)
    run_with(tmp_path / "finetune/toy/default/evil/seed-0", task=names[how], method=names["path"])
    release.export(tmp_path, tmp_path / "tables")
    assert not mark.exists()


def test_a_task_of_the_users_own_is_named_again(code, tmp_path, monkeypatch):
    """Its card has the plain name; whoever uses the prior says where the file is."""
    source = tmp_path / "mine.py"
    source.write_text("import toy\n\ndef make(impl):\n    return toy.make(impl)._replace(name='mine')\n")
    save_prior(tmp_path / "prior", 0, task="mine")
    prior = load_prior(tmp_path / "prior")
    with pytest.raises(UserError, match="name its file with task="):
        api.make_env(prior)
    monkeypatch.setattr(envs, "TASKS", dict(envs.TASKS))
    assert api.make_env(prior, task=str(source)).name == "mine"
    assert api.make_env(prior).name == "mine"  # named in this process already


CONFIGS = {
    "task a number": {"task": 3},
    "task null": {"task": None},
    "seed a text": {"seed": "0"},
    "seed negative": {"seed": -1},
    "seed a float": {"seed": 0.5},
    "prior a number": {"prior": 3},
    "method null": {"method": None},
    "real a list": {"real": ["default"]},
    "set a text": {"set": "mass=2"},
    "impl": {"impl": "bullet"},
    "variant a list": {"variant": []},
}


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("odd", CONFIGS)
def test_a_config_of_other_types_is_one_line(odd, tmp_path, capsys):
    save_prior(tmp_path / "prior", 0)
    run_with(tmp_path / "run", **CONFIGS[odd])
    run_with(tmp_path / "other")
    for command in OF_RUNS:
        error = call(command, tmp_path, capsys)
        assert "config.json: config." in error and "put back the file that the run has written" in error


TUNED = {
    "a text for a number": ({"utd": "8"}, r"utd is a text, not a number"),
    "null for a number": ({"lr_critic": None}, r"lr_critic is null, not a number"),
    "a list": ([8.0], r"options is a list, not an object"),
    "an option of nobody": ({"nope": 1}, "there is no option 'nope'"),
}


@pytest.mark.parametrize("odd", TUNED)
def test_tuned_options_of_other_types_are_one_line(odd, tmp_path):
    options, words = TUNED[odd]
    path = tuned.path_of(tmp_path, "toy", "sac")
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"budget": {"reals": []}, "options": options}))
    with pytest.raises(UserError, match=f"sac.json: {words}; tune again with: "):
        tuned.read(tmp_path, "toy", "sac")


@pytest.mark.parametrize("final", [None, 3, {}, {"rollouts": "20"}, {"rollouts": -1}])
def test_a_summary_of_other_types_is_one_line(final, tmp_path):
    args = finetune_args.FinetuneArgs(task="toy", method="sac", out=tmp_path)
    folder = run_with(finetune_args.run_folder(args, "default"))
    (folder / "summary.json").write_text(json.dumps({"final": final}))
    with pytest.raises(UserError, match=r"summary.json: (lacks )?final.*; put back the file that the run has written"):
        grid.look_up(grid.FINETUNING, args)


def test_priors_that_a_killed_writer_has_put_aside_are_found(tmp_path):
    for seed in (0, 1):
        save_prior(tmp_path / f"run/prior/seed-{seed}", seed)
    folders = prior_folders(tmp_path / "run", out=tmp_path, task="", preset="")
    folders[0].rename(folders[0].with_name(f"{ASIDE}seed-0"))
    assert prior_folders(tmp_path / "run", out=tmp_path, task="", preset="") == folders
    assert task_of_priors(folders, None) == "toy"
