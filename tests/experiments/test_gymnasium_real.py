"""`--real gymnasium:NAME`: fine-tuning, evaluation and diagnosis on an environment that is stepped from Python."""

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from priors_by_hand import save_prior

pytest.importorskip("gymnasium", reason="make setup EXTRAS=dev, or pip install 'sgft-jax[gymnasium]'")

import toy_gymnasium
from toy_gymnasium import NAME, Turned

import envs
from envs.types import UserError
from experiments import diagnose, evaluate, finetune
from experiments.runner import cli, real_systems
from sgft_jax.io.log import read_jsonl
from sgft_jax.io.priors import load_prior
from sgft_jax.io.real import RealStore

T, ROLLOUTS, EPISODES = 20, 4, 3  # steps of an episode, rollouts of a run, episodes of an evaluation
OPTIONS = f"""--task toy --method sac --seeds 2 --rollouts {ROLLOUTS} --eval-every 2 --eval-episodes {EPISODES}
    --checkpoint-every 3 --options.initial-rollouts 2 --options.utd 0.2 --options.batch-size 8
    --options.critic-warmup 0 --options.replay-capacity 128 --devices 1"""


@pytest.fixture(autouse=True)
def _toy(toy_task, monkeypatch):
    monkeypatch.setattr(Turned, "seeds", [])
    monkeypatch.setattr(Turned, "breaks", None)


@pytest.fixture(scope="module")
def priors(tmp_path_factory):
    home = tmp_path_factory.mktemp("priors")
    for seed in (0, 1):
        save_prior(home / f"seed-{seed}", seed)
    return home


def run(priors, out, *more):
    finetune.main([*OPTIONS.split(), "--real", NAME, "--prior", str(priors), "--out", str(out), *more])
    return out / "finetune/toy/gymnasium-Turned-v0/sac/seeds-0-1"


@pytest.fixture(scope="module")
def finished(priors, tmp_path_factory):
    """A whole run, and the seeds of its episodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(envs.TASKS, "toy", "toy")
        patch.setattr(cli, "set_up", lambda: None)
        patch.setattr(Turned, "seeds", [])
        return run(priors, tmp_path_factory.mktemp("runs")), list(Turned.seeds)


def stored(folder):
    store = RealStore(folder)
    return [store.load(i) for i in range(len(store))]


@pytest.mark.slow
def test_a_run_keeps_every_episode_and_counts_those_of_evaluations(finished):
    """Evaluations after 0, 2 and 4 rollouts, three episodes each; a step of the curve is all that went before."""
    folder, seeds = finished
    curve = read_jsonl(folder / "eval.jsonl")
    assert [line["rollouts"] for line in curve] == [0, 2, 4]
    assert [line["step"] for line in curve] == [0, (2 + 3) * T, (4 + 6) * T]
    assert curve[1]["robot_minutes"] == pytest.approx((2 + 3) * T * 0.1 / 60)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["real_steps"] == [(ROLLOUTS + 3 * EPISODES) * T] * 2
    assert summary["gap"]["name"] == NAME and "score" not in summary["best"]
    assert len(seeds) == 2 * (ROLLOUTS + 3 * EPISODES)
    assert len(stored(folder)) == ROLLOUTS and stored(folder)[0]["obs"].shape == (2, T, 4)
    names = sorted(path.name for path in (folder / "evaluation").iterdir())
    assert names == ["rollouts-000000", "rollouts-000002", "rollouts-000004"]
    evaluated = stored(folder / "evaluation/rollouts-000002")
    assert len(evaluated) == EPISODES
    total = np.mean([one["total_reward"] for one in evaluated], axis=0)
    np.testing.assert_allclose(curve[1]["return"], total, rtol=1e-5)


@pytest.mark.slow
def test_evaluations_play_the_same_starts_and_rollouts_play_others(finished):
    folder, _ = finished

    def starts(where):
        return np.stack([one["obs"][:, 0] for one in stored(where)])

    first, last = (starts(folder / f"evaluation/rollouts-00000{n}") for n in (0, 4))
    np.testing.assert_array_equal(first, last)
    assert len(np.unique(starts(folder).reshape(-1, 4), axis=0)) == 2 * ROLLOUTS


@pytest.mark.slow
@pytest.mark.parametrize("steps", [50, 250, 490], ids=["evaluation", "rollout", "last"])
def test_what_was_played_before_a_break_is_never_played_again(priors, finished, tmp_path, steps):
    """A break in mid-episode costs that episode alone, and the run ends as if nothing had happened."""
    whole, seeds = finished
    Turned.breaks = steps
    with pytest.raises(SystemExit):
        run(priors, tmp_path)
    Turned.breaks = None
    folder = run(priors, tmp_path, "--resume")
    assert len(Turned.seeds) == len(seeds) + 2  # both members take their steps together
    assert set(Turned.seeds) == set(seeds)
    for name in ("metrics.jsonl", "eval.jsonl", "summary.json"):
        assert (folder / name).read_bytes() == (whole / name).read_bytes(), name
    for name in ("policy/seed-0", "best/seed-1"):
        pair = (load_prior(home / name).params for home in (folder, whole))
        jax.tree.map(np.testing.assert_array_equal, *pair)


@pytest.mark.slow
def test_without_evaluations_only_rollouts_are_played(priors, tmp_path):
    folder = run(priors, tmp_path, "--eval-episodes", "0", "--set", "rotation=0.1")
    assert not folder.exists()  # what is set is a part of the name
    folder = tmp_path / "finetune/toy/gymnasium-Turned-v0_rotation=0.1/sac/seeds-0-1"
    assert len(Turned.seeds) == 2 * ROLLOUTS and not (folder / "evaluation").exists()
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["final"] == {"rollouts": 4, "transitions": 4 * T, "robot_minutes": pytest.approx(4 * T * 0.1 / 60)}
    assert summary["real_steps"] == [4 * T] * 2 and "zero_shot" not in summary
    assert (folder / "policy/seed-1/prior.json").exists()


@pytest.mark.heavy
def test_evaluation_says_what_it_has_cost(priors):
    args = evaluate.EvaluateArgs(prior=priors, real=(NAME,), episodes=5)
    (system,) = evaluate.evaluate(args)["systems"]
    assert system["real_steps"] == 2 * 5 * T and system["where"] == f"on the {NAME} real system"
    assert [one["episodes"] for one in system["policies"]] == [5, 5] and len(Turned.seeds) == 10
    assert Turned.seeds[0] == Turned.seeds[1]  # every policy plays the same episodes


@pytest.mark.slow
def test_diagnosis_keeps_the_rollouts_that_it_plays(priors, tmp_path, capsys):
    """So that another diagnosis needs none: read from disk, it says the same of them."""
    given = ["--task", "toy", "--prior", str(priors), "--out", str(tmp_path), "--json"]

    def call(*more):
        return cli.run_main(diagnose.main, diagnose.DiagnoseArgs, "", argv=[*given, *more])

    call("--real", NAME, "--rollouts", "2")
    first = json.loads(capsys.readouterr().out)
    assert len(Turned.seeds) == 4
    kept = tmp_path / "diagnose/toy/gymnasium-Turned-v0"
    shutil.copytree(kept / "real", tmp_path / "copy/real")
    call("--real", str(tmp_path / "copy"))
    again = json.loads(capsys.readouterr().out)
    assert len(Turned.seeds) == 4 and first["priors"] == again["priors"]


# --- what does not fit ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("real", "changes", "words"),
    [
        ([NAME, "sim"], (), "cannot be played together; run them one after another"),
        (["gymnasium:"], (), "name an environment, e.g. gymnasium:HalfCheetah-v5"),
        ([NAME], ("rotation",), "--set 'rotation': write name=value, each name once"),
        ([NAME], ("rotation=1", "rotation=2"), "--set 'rotation=2': write name=value, each name once"),
        (["gymnasium:Nope-v0"], (), "--real gymnasium:Nope-v0: Environment `Nope` doesn't exist"),
        (["gymnasium:HalfCheetah-v99"], (), "version `v99` for environment `HalfCheetah` doesn't exist"),
        (["gymnasium:nowhere:A-v0"], (), "ModuleNotFoundError: No module named 'nowhere'"),
        (["gymnasium:json:A-v0"], (), "Environment `A` doesn't exist"),
        (["gymnasium:a b"], (), "Malformed environment ID: a b"),
    ],
)
def test_mistakes_are_found_before_anything_is_made(real, changes, words):
    with pytest.raises(UserError) as stopped:
        real_systems.check("toy", real, changes)
    assert words in str(stopped.value) and "\n" not in str(stopped.value)


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("gymnasium:Turnt-v0", (), r"--real gymnasium:Turnt-v0: Environment `Turnt` doesn't exist"),
        ("gymnasium:nowhere:Turned-v0", (), r"--real gymnasium:nowhere:Turned-v0: .*nowhere"),
        (NAME, ("rotatoin=1",), r"TypeError: .*rotatoin"),
        ("gymnasium:CartPole-v1", (), r"CartPole-v1: observes 4 numbers|CartPole-v1: its actions are Discrete\(2\)"),
    ],
)
def test_an_environment_that_cannot_be_made_or_played_is_one_line(name, changes, words):
    with pytest.raises(UserError, match=words) as stopped:
        real_systems.connect(toy_gymnasium.toy.make(), [name], changes, members=1, gamma=0.9, home=Path())
    assert "\n" not in str(stopped.value)


def test_an_environment_that_cannot_be_made_leaves_no_folder(priors, tmp_path):
    with pytest.raises(SystemExit) as stopped:
        run(priors, tmp_path, "--set", "rotatoin=1")
    assert stopped.value.code == 2 and not any(tmp_path.iterdir())


def test_set_reads_json_and_text():
    assert real_systems.keywords(["a=1", "b=[1,2]", "c=mild", "d=true"]) == {
        "a": 1,
        "b": [1, 2],
        "c": "mild",
        "d": True,
    }


def test_folders_get_plain_names():
    assert real_systems.title("gymnasium:my_robot:lab/Arm-v1") == "gymnasium-lab-Arm-v1"
