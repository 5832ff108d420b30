import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from priors_by_hand import save_prior

from envs.rollout import Episode
from experiments import evaluate
from experiments.runner import cli, pictures, training

pytestmark = pytest.mark.usefixtures("toy_task")


@pytest.fixture
def run(tmp_path):
    """What fine-tuning leaves: two policies."""
    for seed in (0, 1):
        save_prior(tmp_path / "run/policy" / f"seed-{seed}", seed)
    return tmp_path / "run"


def played(scores, exploded, score="return"):
    """Episodes [1, n] with these returns, which are scores or, for a task of success, 0."""
    total, exploded = np.array([scores], np.float32), np.array([exploded], bool)
    judged = np.where(exploded, -np.inf, total) if score == "return" else np.zeros_like(total)
    return Episode(None, None, total, np.zeros_like(exploded), exploded, judged, None, None)


def test_episodes_that_explode_count_as_the_worst_that_is_known():
    """Rewards are costs, so what an episode had earned until then is more than a whole one earns."""
    episodes = played([-12, -14, -2], [False, False, True])
    found = training.scores(episodes)
    assert found["return"] == found["score"] == pytest.approx(-40 / 3) and found["exploded"] == pytest.approx(1 / 3)
    assert training.describe(jax.tree.map(lambda x: x[0], episodes))["return"] == pytest.approx(-40 / 3)
    assert training.scores(episodes, np.array([[-20.0, -20.0]]))["score"] == pytest.approx(-46 / 3)
    failed = training.scores(played([-12, -2], [False, True], "success"))
    assert failed["score"] == 0 and failed["return"] == -12


def test_a_prior_that_explodes_is_not_chosen():
    params, steps = jnp.zeros((1, 1)), jnp.zeros(1, jnp.int32)
    whole, bursts = played([-12, -14], [False, False]), played([-2, -3], [True, True])
    for first, second, kept in ((whole, bursts, 0), (bursts, whole, 1)):
        best = training.best_of(None, params, first, steps)
        best = training.best_of(best, params + 1, second, steps)
        assert best.params.tolist() == [[kept]] and best.score.tolist() == [-13]


def call(*argv):
    cli.run_main(evaluate.main, evaluate.EvaluateArgs, "Evaluate.", argv=[str(a) for a in argv])


@pytest.mark.heavy
def test_success_with_its_interval_as_json(run, capsys):
    call("--run", run, "--episodes", 20, "--json")
    found = json.loads(capsys.readouterr().out)
    (system,) = found["systems"]
    assert (found["task"], system["where"]) == ("toy", "in simulation")
    assert [p["policy"] for p in system["policies"]] == [str(run / "policy" / f"seed-{i}") for i in (0, 1)]
    for policy in system["policies"]:
        low, high = policy["success/interval"]
        assert policy["episodes"] == 20 and low <= policy["success"] <= high and policy["exploded"] == 0
        # Wilson at 0 of 20, z = 1.96: upper end z^2 / (n + z^2) = 3.84 / 23.84 = 0.161
        assert policy["success"] > 0 or high == pytest.approx(0.161, abs=5e-4)


@pytest.mark.heavy
def test_episodes_are_the_same_every_time_and_others_on_request(run, capsys):
    def returns(*more):
        call("--run", run, "--episodes", 20, "--json", *more)
        return json.loads(capsys.readouterr().out)["systems"][0]["policies"][0]["return"]

    first = returns()
    assert returns() == first != returns("--seed", 1)


@pytest.mark.slow
def test_several_systems_in_one_program_are_each_as_alone(run, capsys):
    def returns(*reals):
        call("--run", run, "--episodes", 10, "--json", "--real", *reals)
        systems = json.loads(capsys.readouterr().out)["systems"]
        return {s["where"]: [p["return"] for p in s["policies"]] for s in systems}

    heavy, ranged = run / "heavy.toml", run / "ranged.toml"
    heavy.write_text("[params]\nmass = 9.0\nfriction = 4.0\n")
    ranged.write_text("[params]\nmass = [2.0, 3.0]\n")
    together = returns("sim", heavy, ranged)
    both = run / "both.toml"
    both.write_text("[heavy.params]\nmass = 9.0\nfriction = 4.0\n[ranged.params]\nmass = [2.0, 3.0]\n")
    assert returns("sim", both) == together  # a file without a name: all of its gaps
    assert list(together) == ["in simulation", "on the heavy real system", "on the ranged real system"]
    alone = returns("sim") | returns(heavy) | returns(ranged)
    for where, values in together.items():
        assert values == pytest.approx(alone[where], rel=1e-5)
    assert len({tuple(values) for values in together.values()}) == 3


@pytest.mark.heavy
def test_lines_for_people(run, capsys):
    (run / "slow.toml").write_text("[params]\nmass = 9.0\nfriction = 4.0\n")
    call("--run", run, "--episodes", 20, "--real", run / "slow.toml")
    head, *lines = capsys.readouterr().out.splitlines()
    assert head == "toy, on the slow real system, 20 episodes for each policy:"
    assert len(lines) == 2 and all(re.search(r"seed-\d: success \d+\.\d % \[.*\], return -?\d", line) for line in lines)
    call("--prior", run / "policy", "--episodes", 10, "--real", run / "slow.toml")
    advice = capsys.readouterr().out.splitlines()[-1]
    assert re.match(rf"\d+ of 20 failed: next: python -m experiments.finetune --task toy --prior {run}/policy ", advice)


@pytest.mark.heavy
def test_a_task_without_a_scene_has_no_film(run, capsys):
    call("--run", run, "--episodes", 20, "--video", run / "films")
    assert capsys.readouterr().out.count("\n    no video: toy has no scene to draw\n") == 2
    call("--run", run, "--episodes", 20, "--video", run / "films", "--json")
    (system,) = json.loads(capsys.readouterr().out)["systems"]
    assert [one["video"] for one in system["policies"]] == ["no video: toy has no scene to draw"] * 2


@pytest.mark.slow
def test_a_film_of_each_system(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if reason := pictures.select_renderer():
        pytest.skip(reason)
    prior = Path(__file__).parents[2] / "sgft_jax/priors/push/seed-0"
    call("--prior", prior, "--real", "sim", "mild", "--episodes", 2, "--impl", "c", "--video", tmp_path)
    said = capsys.readouterr().out
    for system in ("sim", "mild"):
        path = tmp_path / f"{system}-seed-0.mp4"
        assert f"    video: {path}\n" in said and path.stat().st_size > 10_000


@pytest.mark.slow
def test_the_best_policies_of_a_run(run, capsys):
    save_prior(run / "best" / "seed-0", 7)
    call("--run", run, "--best", "--episodes", 2)
    assert "best/seed-0: success" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([], "name a folder with --prior or --run"),
        (["--prior", "a", "--run", "b"], "exclude each other"),
        (["--task", "toi"], "did you mean 'toy'?"),
        (["--task", "toy", "--out", "nowhere"], "nowhere/pretrain/toy/robust: holds no prior"),
        (["--prior", "nowhere"], "--prior nowhere: no such folder"),
        (["--task", "toy", "--real", "sim", "sim"], "--real names sim twice"),
        (["--task", "toy", "--real", "strange"], "toy has no gap 'strange'"),
        (["--task", "toy", "--set", "mass=3"], "name one with --real"),
        (["--task", "toy", "--real", "gymnasium:A", "--video", "v"], "--video: films simulated systems, and"),
        (["--task", "toy", "--video", __file__], "is a file; choose another --video"),
        (["--task", "toy", "--real", "a.toml:x", "b.toml:x", "--video", "v"], "--real names x twice"),
        (["--task", "toy", "--best"], "--best: name the fine-tuning run"),
        (["--task", "toy", "--episodes", "0"], "must be at least 1"),
        (["--task", "toy", "--seed", "-5"], "--seed is -5: seeds go from 0 to 2147483647"),
        (["--task", "toy", "--seed", "5000000000"], "--seed is 5000000000: seeds go from 0 to 2147483647"),
    ],
)
def test_a_bad_command_is_one_line_and_code_2(argv, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        call(*argv)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1


def test_systems_of_several_scenes_are_played_one_scene_after_another(monkeypatch):
    file, groups = "envs/gaps/development/push-unexplained.toml", []

    def play(args, folders, task):
        groups.append([real.rpartition(":")[2] for real in args.real])
        return {"task": task, "systems": [{"where": real} for real in args.real]}

    monkeypatch.setattr(evaluate, "_evaluate", play)
    args = evaluate.EvaluateArgs(prior=Path("shipped:push"), real=(f"{file}:push-4-02", f"{file}:push-4-03", "default"))
    systems = evaluate.evaluate(args)["systems"]
    assert groups == [["push-4-02", "default"], ["push-4-03"]]
    assert [system["where"] for system in systems] == list(args.real)
