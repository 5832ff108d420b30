"""Admissibility of gaps, measured on a point mass: a gap that can be learned, and one that nobody can master."""

import json

import compiled
import pytest
from priors_by_hand import save_prior

import envs
from experiments import gaps
from experiments.runner import gaps_run
from sgft_jax.types import Prior

FILES = {
    "turned": "[params]\nmass = 1.0\nfriction = 4.0\n[effects]\naction_rotation = 0.3\n",
    "stuck": "[params]\nmass = 400.0\n",
}
OPTIONS = """--task toy --preset cpu --config.n-envs 32 --config.worlds 16 --config.env-steps 10240
    --config.random-transitions 1024 --config.replay-capacity 8192 --config.batch-size 128 --config.chunk-steps 40
    --config.updates-per-step 8 --config.network.hidden 32 32 --config.gamma 0.9 --config.eval-every 2
    --config.eval-episodes 64 --config.lr 1e-3 --config.tau 0.02 --episodes 200"""
TINY = OPTIONS.split()


pytestmark = pytest.mark.usefixtures("toy_task")


@pytest.fixture
def home(tmp_path):
    """Two untrained priors, which fail, and the gaps."""
    for seed in (0, 1):
        save_prior(tmp_path / f"pretrain/toy/cpu/seeds-0-1/prior/seed-{seed}", seed)
    for name, text in FILES.items():
        (tmp_path / f"{name}.toml").write_text(text)
    return tmp_path


def call(home, *more):
    files = [str(home / f"{name}.toml") for name in FILES]
    gaps.main([*TINY, "--out", str(home), "--presets", *files, *more])
    return json.loads((home / "gaps/toy/summary.json").read_text())


@pytest.mark.slow
def test_a_gap_is_admissible_if_it_is_open_and_can_be_learned(home, capsys):
    turned, stuck = call(home)["gaps"]
    assert [turned["gap"]["name"], stuck["gap"]["name"]] == ["turned", "stuck"]
    for line in (turned, stuck):
        assert len(line["zero_shot"]["policies"]) == 2 and line["zero_shot"]["success"] < 0.4
        assert line["trained"]["policies"][0]["episodes"] == 200
    assert turned["trained"]["success"] >= 0.95 and turned["admissible"] is True
    assert stuck["trained"]["success"] < 0.4 and stuck["admissible"] is False
    rows = capsys.readouterr().out.splitlines()
    assert rows[-4].split() == ["gap", "zero-shot", "%", "trained", "on", "real", "%", "admissible"]
    assert rows[-3].startswith("turned ") and rows[-3].endswith("yes") and rows[-2].endswith("no")
    assert len((home / "gaps/toy/eval.jsonl").read_text().splitlines()) == 4  # 8 chunks, after every second one


@pytest.mark.slow
def test_without_training_the_answer_is_open(home, capsys):
    lines = call(home, "--no-train")["gaps"]
    assert [line["trained"] for line in lines] == [None, None] and [line["admissible"] for line in lines] == [
        None,
        None,
    ]
    assert capsys.readouterr().out.count("not known") == 2


@pytest.mark.parametrize(
    ("zero_shot", "trained", "answer"),
    [(0.4, 0.95, True), (0.41, 1.0, False), (0.41, None, False), (0.0, 0.94, False), (0.0, None, None)],
)
def test_the_limits(zero_shot, trained, answer):
    assert gaps_run.admissible(zero_shot, trained) is answer


def test_a_gap_is_measured_in_its_own_scene_and_with_its_errors_of_commands():
    """`diagnose` plays these systems too, and hands them the simulator."""
    env = compiled.make("push-towel")
    towel, late = envs.gaps.load(env, "default"), envs.gaps.from_dict(env, "late", {"commands": {"late": 1}})
    for gap, scene, errs in ((towel, "towel", False), (late, "", True)):
        system, _ = gaps_run.systems(env, [gap], [Prior({}, {"gamma": 0.9})], 1)
        assert system.env.scene == scene and system.env.commands == errs


def test_the_settings_of_the_training_are_those_of_the_preset(monkeypatch):
    seen = []
    monkeypatch.setattr(gaps, "measure", seen.append)
    gaps.main(["--preset", "cpu"])
    assert [args.config.n_envs for args in seen] == [32]


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--task", "toi"], "did you mean 'toy'?"),
        (["--task", "toy", "--preset", "fats"], "did you mean 'fast'?"),
        (["--task", "toy"], "toy comes with no gaps"),
        (["--task", "toy", "--presets", "mild"], "toy has no gap 'mild'"),
        (["--task", "toy", "--episodes", "20"], "at least 200"),
        (["--task", "push", "--presets", "mild", "--out", "nowhere"], "holds no prior; make one with"),
    ],
)
def test_a_bad_command_is_one_line_and_code_2(argv, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        gaps.main(argv)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1
