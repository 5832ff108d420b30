import json

import numpy as np
import pytest
from priors_by_hand import save_prior
from runs_by_hand import save

from experiments import diagnose
from experiments.runner import cli
from experiments.studies import diagnose_calibrate
from sgft_jax.io.real import RealStore

pytestmark = pytest.mark.usefixtures("toy_task")


@pytest.fixture
def priors(tmp_path):
    for seed in (0, 1):
        save_prior(tmp_path / "prior" / f"seed-{seed}", seed)
    return tmp_path / "prior"


def call(*argv):
    cli.run_main(diagnose.main, diagnose.DiagnoseArgs, "Diagnose.", argv=[str(a) for a in argv])


def calibrate(*argv):
    main, kind = diagnose_calibrate.main, diagnose_calibrate.CalibrateArgs
    cli.run_main(main, kind, "Calibrate.", argv=[str(a) for a in argv])


def record(folder, *, policies=1, rollouts=4, success=(), obs_dim=4, steps=20, without=()):
    """Rollouts of a point that is pushed about, as a robot records them; `success` tells those that had it."""
    rng, store = np.random.default_rng(0), RealStore(folder)
    for i in range(rollouts):
        action = rng.uniform(-1, 1, (policies, steps, 2)).astype(np.float32)
        obs = np.cumsum(rng.normal(0, 0.1, (policies, steps + 1, obs_dim)), axis=1).astype(np.float32)
        arrays = {
            "obs": obs[:, :-1],
            "action": action,
            "next_obs": obs[:, 1:],
            "reward": -np.abs(obs[:, 1:, 0]),
            "discount": np.full((policies, steps), 0.9, np.float32),
            "valid": np.ones((policies, steps), bool),
            "success": np.full(policies, i in success),
        }
        store.append({name: x for name, x in arrays.items() if name not in without})
    return folder


@pytest.mark.slow
def test_a_gap_is_played_and_diagnosed_by_every_prior(priors, tmp_path, capsys):
    gap = tmp_path / "weak.toml"
    gap.write_text("[effects]\naction_scale = 0.3\n")
    call("--prior", priors, "--real", gap, "--rollouts", 3, "--out", tmp_path / "runs")
    text = capsys.readouterr().out
    assert "3 rollouts of each of 2 priors, just played zero-shot on the gap weak" in text
    assert all(f"\n{priors}/seed-{i} " in text for i in (0, 1)) and "\nmean " in text
    assert all(f"\n{word}: " in text for word in ("gap", "V_sim", "fine-tuning", "horizon of SGFT", "time"))
    home = tmp_path / "runs/diagnose/toy/weak"
    found = json.loads((home / "diagnosis.json").read_text())
    assert (home / "diagnosis.png").stat().st_size > 10_000
    assert [[one["rollouts"] for one in prior["found"]] for prior in found["priors"]] == [[1, 2, 3]] * 2
    assert found["mean"][-1]["rollouts"] == 6


@pytest.mark.slow
def test_recordings_of_one_policy_are_looked_at_by_every_prior(priors, tmp_path, capsys):
    recorded = record(tmp_path / "robot", success=(1, 3))

    def successes(*argv):
        call("--prior", priors, "--out", tmp_path / "runs", "--json", *argv)
        found = json.loads(capsys.readouterr().out)
        assert [one["rollouts"] for one in found["mean"]] == [one["rollouts"] for one in found["priors"][0]["found"]]
        return found["data"], [[one["success"] for one in prior["found"]] for prior in found["priors"]]

    every = [0.0, 0.5, 0.5]  # of the first 1, 2 and 4
    assert successes("--real", recorded) == (f"4 rollouts recorded in {recorded}", [every] * 2)
    data, found = successes("--real", recorded / "real", "--rollouts", 2)
    assert data == f"2 rollouts recorded in {recorded}" and found == [every[:2]] * 2
    call("--prior", priors, "--out", tmp_path / "runs", "--real", recorded)
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("2 of 4 failed, 10 say more: next: python -m experiments.finetune --task toy --prior ")
    assert last.endswith("--real remote --seeds 1 --method guarded")


def run(out, real, success, priors, **settings):
    """A finished run of two seeds with its recorded rollouts."""
    folder = save(out, "sac", success, rollouts=[0, 4, 20], real=real, **settings)
    config = json.loads((folder / "config.json").read_text())
    config["config"] |= {"task": "toy", "prior": str(priors)}
    (folder / "config.json").write_text(json.dumps(config))
    return record(folder, policies=2, success=(0,) if "half" in real else ())


@pytest.mark.slow
def test_a_run_says_which_prior_each_seed_has(priors, tmp_path, capsys):
    folder = run(tmp_path, "half", [[0.1, 0.1]] * 3, priors, seeds="seeds-1-2")
    call("--real", folder, "--out", tmp_path / "runs", "--json")
    found = json.loads(capsys.readouterr().out)
    assert [one["prior"][-6:] for one in found["priors"]] == ["seed-1", "seed-0"] and found["task"] == "toy"


@pytest.mark.slow
def test_calibration_and_its_check_on_other_runs(priors, tmp_path, capsys):
    runs = [
        run(tmp_path / "a", real, [[0.2, 0.1], [0.5, 0.4], after], priors)
        for real, after in (
            ("half-1", [0.4, 0.3]),
            ("half-2", [0.4, 0.3]),
            ("none-1", [0.9, 0.8]),
            ("none-2", [0.9, 0.8]),
        )
    ]
    calibrate("--runs", tmp_path / "a", "--json")
    found = json.loads(capsys.readouterr().out)
    assert sorted(found["runs"]) == sorted(map(str, runs)) and found["members"] == 4
    assert all(value >= 0 for value in found["coefficients"].values())
    # Held out, of each kind one: gains 0.2, 0.2 of half a success and 0.7, 0.7 of none: less success, more gain.
    assert found["rank_correlation"]["100 - success of the same 4 rollouts"]["estimate"] == pytest.approx(1.0)
    other = run(tmp_path / "b", "other", [[0.0, 0.0], [0.0, 0.0], [1.0, 0.5]], priors)
    calibrate("--runs", tmp_path / "a", "--check", other)
    text = capsys.readouterr().out
    assert "1 other runs, predicted from 4: 2 members, 1 gaps" in text and "are +75 points" in text
    assert "coefficients from 4 rollouts of all of --runs: base" in text


@pytest.mark.heavy_after_first
@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--real", "sim"], "name a prior with --prior, or a task with --task"),
        (["--task", "toy", "--prior", "PRIOR", "--real", "strange"], "toy has no gap 'strange'"),
        (["--prior", "PRIOR", "--real", "sim", "--rollouts", "0"], "must be at least 1"),
        (["--prior", "PRIOR", "--real", "EMPTY"], "holds no recorded rollouts"),
        (["--prior", "PRIOR", "--real", "runs/nothing"], "runs/nothing: no such folder"),
        (
            ["--prior", "PRIOR", "--real", "wide"],
            "obs has shape [1, 20, 5], these priors of toy need [seeds, steps, 4]",
        ),
        (["--prior", "PRIOR", "--real", "torn"], "rollout-000000.npz: lacks valid"),
        (["--prior", "PRIOR", "--real", "three"], "holds rollouts of 3 policies"),
        (["--prior", "PRIOR", "--seed", "-1"], "--seed is -1: seeds go from 0 to 2147483647"),
    ],
)
def test_a_bad_command_is_one_line_and_code_2(argv, words, priors, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "wide", obs_dim=5)
    record(tmp_path / "torn", without=("valid",))
    record(tmp_path / "three", policies=3)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit) as stopped:
        call(*[{"PRIOR": priors, "EMPTY": tmp_path / "empty"}.get(word, word) for word in argv])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([], "--runs is missing"),
        (["--runs"], "--runs: name at least one"),
        (["--check", "one"], "--runs is missing"),
        (["--runs", "empty"], "holds no fine-tuning run with recorded rollouts"),
        (["--runs", "one", "--check", "one"], "is also in --runs"),
        (["--runs", "one"], "these runs are on one gap"),
    ],
)
def test_a_bad_calibration_is_one_line_and_code_2(argv, words, priors, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    run(tmp_path / "one", "half", [[0.1, 0.1]] * 3, priors)
    with pytest.raises(SystemExit) as stopped:
        calibrate(*argv)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1
