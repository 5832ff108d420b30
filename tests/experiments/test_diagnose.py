import json

import numpy as np
import pytest
import toy
from priors_by_hand import save_prior, save_with_estimator
from runs_by_hand import save

from envs import gaps
from experiments import diagnose
from experiments.runner import cli, diagnose_run, narrowed
from sgft_jax.io.real import RealStore
from sgft_jax.posterior import decision, interface

look = diagnose_run._look
pytestmark = pytest.mark.usefixtures("toy_task")


@pytest.fixture
def priors(tmp_path):
    for seed in (0, 1):
        save_prior(tmp_path / "prior" / f"seed-{seed}", seed)
    return tmp_path / "prior"


def call(*argv):
    cli.run_main(diagnose.main, diagnose.DiagnoseArgs, "Diagnose.", argv=[str(a) for a in argv])


def record(folder, *, policies=1, rollouts=4, success=(), obs_dim=4, steps=20, without=(), push=1.0):
    """Rollouts of a point that is pushed about, as a robot records them; `success` tells those that had it."""
    rng, store = np.random.default_rng(0), RealStore(folder)
    for i in range(rollouts):
        action = rng.uniform(-push, push, (policies, steps, 2)).astype(np.float32)
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
    assert all(f"\n{priors}/seed-{i} " in text for i in (0, 1))
    assert "\nWhich system it is stays open: no estimator; `python -m experiments.estimate" in text
    facts = json.loads((tmp_path / "runs/diagnose/toy/weak/diagnosis.json").read_text())
    assert [one["rollouts"] for one in facts["priors"]] == [3, 3] and "unknowns" not in facts
    assert facts["priors"][0]["V_sim"] != facts["priors"][1]["V_sim"]


@pytest.mark.slow
@pytest.mark.parametrize("usual", [-1.0, 1.0])
def test_an_estimator_says_which_system_it_may_be(usual, tmp_path, monkeypatch, capsys):
    """One that has learned nothing knows what it knew before, and contradicts itself by 0 nats."""
    for module in (decision, interface):
        for name, value in {"CANDIDATES": 2, "JUDGES": 2}.items():
            monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(narrowed, "_SHOWN", 20)
    save_with_estimator(tmp_path / "prior", usual)
    gap = tmp_path / "turned.toml"
    gap.write_text("[params]\nmass = 2.0\n[effects]\naction_rotation = 0.52\n")
    call("--prior", tmp_path / "prior", "--real", gap, "--rollouts", 3, "--out", tmp_path / "runs")
    text, home = capsys.readouterr().out, tmp_path / "runs/diagnose/toy/turned"
    assert ("None of the simulator's systems made these rollouts" in text) == (usual < 0)
    assert ("One of the simulator's systems may have made these rollouts" in text) == (usual > 0)
    assert (home / "posterior.png").stat().st_size > 10_000
    facts = json.loads((home / "diagnosis.json").read_text())
    unknowns, (one,) = facts["unknowns"], facts["priors"]
    assert unknowns["after"] == [0, 1, 2, 3] and one["contradiction"]["nats"] == pytest.approx(0, abs=1e-3)
    turned, mass = (next(i for i, x in enumerate(unknowns["names"]) if word in x) for word in ("rotation", "mass"))
    assert unknowns["truth"][turned] == pytest.approx(0.52) and unknowns["truth"][mass] == 2.0
    assert all(low == pytest.approx(-0.8, abs=0.06) for low, _ in np.array(unknowns["intervals"])[:, turned])
    assert (
        set(one["promised"]) == {"as it is", "corrected"}
        and one["promised"]["corrected"] >= one["promised"]["as it is"]
    )

    trained = gaps.load(toy.make(), str(home / "like-turned.toml")) if usual > 0 else None
    assert (home / "like-turned.toml").exists() == (usual > 0) and (
        trained is None or "action_rotation" in trained.effects
    )

    # What an earlier diagnosis has left is not beside the numbers of a later one.
    save_prior(tmp_path / "bare", 0)
    call("--prior", tmp_path / "bare", "--real", gap, "--rollouts", 1, "--out", tmp_path / "runs", "--json")
    capsys.readouterr()
    assert [path.name for path in home.iterdir()] == ["diagnosis.json"]

    # From disk nobody knows what is true, and the same rollouts by two policies say as much.
    recorded = record(tmp_path / "robot", success=(1,))
    call("--prior", tmp_path / "prior", "--real", recorded, "--rollouts", 1, "--out", tmp_path / "runs", "--json")
    facts = json.loads(capsys.readouterr().out)
    assert facts["unknowns"]["truth"] is None and facts["unknowns"]["after"] == [0, 1]
    assert facts["priors"][0]["contradiction"]["contradicted"] is False


@pytest.mark.slow
def test_sensors_drift_from_rollout_to_rollout(priors, tmp_path, monkeypatch):
    """The first measurement is off by ten more with each; starts differ by less than two."""
    gap = tmp_path / "drifting.toml"
    gap.write_text("[drift]\nxy = [10.0, 0.0]\n")
    seen = []
    monkeypatch.setattr(
        diagnose_run, "_look", lambda env, prior, rollouts: seen.append(rollouts) or look(env, prior, rollouts)
    )
    call("--prior", priors, "--real", gap, "--rollouts", 3, "--out", tmp_path / "runs")
    starts = np.asarray(seen[0].transitions.obs)[:, 0, 0]
    np.testing.assert_allclose(np.diff(starts), [10.0, 10.0], atol=2.0)


@pytest.mark.slow
def test_recordings_of_one_policy_are_looked_at_by_every_prior(priors, tmp_path, capsys):
    recorded = record(tmp_path / "robot", success=(1, 3))

    def successes(*argv):
        call("--prior", priors, "--out", tmp_path / "runs", "--json", *argv)
        facts = json.loads(capsys.readouterr().out)
        return facts["data"], [(one["succeeded"], one["rollouts"]) for one in facts["priors"]]

    assert successes("--real", recorded) == (f"4 rollouts recorded in {recorded}", [(2, 4)] * 2)
    data, counts = successes("--real", recorded / "real", "--rollouts", 2)
    assert data == f"2 rollouts recorded in {recorded}" and counts == [(1, 2)] * 2
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
        (["--prior", "PRIOR", "--real", "far"], "far/real: holds actions beyond [-1, 1]"),
        (["--prior", "PRIOR", "--real", "sim", "--out", "full"], "diagnosis.json: is a folder; move it away"),
        (["--prior", "PRIOR", "--seed", "-1"], "--seed is -1: seeds go from 0 to 2147483647"),
    ],
)
def test_a_bad_command_is_one_line_and_code_2(argv, words, priors, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "wide", obs_dim=5)
    record(tmp_path / "torn", without=("valid",))
    record(tmp_path / "three", policies=3)
    record(tmp_path / "far", push=5.0)
    (tmp_path / "empty").mkdir()
    (tmp_path / "full/diagnose/toy/sim/diagnosis.json").mkdir(parents=True)
    with pytest.raises(SystemExit) as stopped:
        call(*[{"PRIOR": priors, "EMPTY": tmp_path / "empty"}.get(word, word) for word in argv])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1
