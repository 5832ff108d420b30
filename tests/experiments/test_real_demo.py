"""The demo in another engine: mistakes, the robot's process, the choice of a film; all of it where there is Bullet."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import toy
from priors_by_hand import save_prior

from envs.types import UserError
from experiments import real_demo
from experiments.real_demo import RealDemoArgs
from experiments.runner import pictures

ROOT = Path(__file__).parents[2]
PRIOR = ROOT / "sgft_jax/priors/panda-push/seed-0"  # it is only looked for
BULLET = os.environ.get("SGFT_BULLET_PYTHON", str(ROOT / "build/panda-gym/bin/python"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"prior": ROOT}, "holds no prior; make one with: python -m experiments.pretrain --task panda-push"),
        ({"rollouts": 0}, "--rollouts is 0: must be at least 1"),
        ({"episodes": 0}, "--episodes is 0: must be at least 1"),
        ({"python": "python3.99"}, r"python3.99 is no Python 3.11, .* name one with PYTHON311="),
        ({"python": sys.executable}, "is no Python 3.11"),
    ],
)
def test_mistakes_are_found_before_anything_is_made(tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(ROOT)
    with pytest.raises(UserError, match=words):
        real_demo.main(RealDemoArgs(**{"prior": PRIOR, "out": tmp_path / "out", "home": tmp_path / "home", **options}))
    assert not list(tmp_path.iterdir())


def test_it_runs_in_the_folder_of_the_code_and_overwrites_demos_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"panda_gym_robot.py: no such file; run this command in the folder"):
        real_demo.check(RealDemoArgs(PRIOR))
    monkeypatch.chdir(ROOT)
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(UserError, match="holds something that is no demo"):
        real_demo.check(RealDemoArgs(PRIOR, out=tmp_path))
    (tmp_path / "robot.log").touch()
    real_demo.check(RealDemoArgs(PRIOR, out=tmp_path))


def fake_python(folder, code):
    """An executable in the place of Python 3.11: says yes to every `-c`, else runs `code` in the shell."""
    path = folder / "python3.11"
    path.write_text(f'#!/bin/sh\ncase "$1" in -c) exit 0;; esac\n{code}\n')
    path.chmod(0o755)
    return str(path)


def test_the_environment_is_made_once_and_its_failure_is_one_line(tmp_path):
    home = tmp_path / "home"
    makes = f"echo $2 >> {tmp_path}/calls; mkdir -p {home}/bin; ln -sf {tmp_path}/python3.11 {home}/bin/python"
    python = fake_python(tmp_path, makes)
    assert real_demo.bullet(home, python) == real_demo.bullet(home, python) == home / "bin" / "python"
    assert (tmp_path / "calls").read_text() == "venv\npip\n"
    broken = fake_python(tmp_path, "echo long story >&2; echo no room on this disk >&2; exit 1")
    with pytest.raises(UserError, match=r"python3.11 -m venv --clear failed: no room on this disk$"):
        real_demo.bullet(tmp_path / "other", broken)


def test_the_robots_process_ends_with_the_learner(tmp_path, monkeypatch):
    monkeypatch.setattr(real_demo, "_END", 0.1)
    real_demo.together(["true"], ["sh", "-c", f"echo $$ > {tmp_path}/pid; exec sleep 60"], tmp_path / "log")
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_a_side_that_fails_is_an_error_and_no_endless_wait(tmp_path, monkeypatch):
    monkeypatch.setattr(real_demo, "_END", 5.0)
    with pytest.raises(UserError, match=r"the robot's side has ended with exit code 3; see .*log"):
        real_demo.together(["sleep", "60"], ["sh", "-c", "echo no pybullet; exit 3"], tmp_path / "log")
    assert "no pybullet" in (tmp_path / "log").read_text()
    with pytest.raises(UserError, match="fine-tuning has ended with exit code 2"):
        real_demo.together(["sh", "-c", "exit 2"], ["sleep", "0.2"], tmp_path / "log")


def test_a_learner_has_all_the_time_it_needs_once_it_has_dismissed_the_robot(tmp_path, monkeypatch):
    """A robot ends with exit code 0 only after the learner has told it that the run is over."""
    monkeypatch.setattr(real_demo, "_END", 0.1)
    real_demo.together(["sh", "-c", f"sleep 1; touch {tmp_path}/saved"], ["true"], tmp_path / "log")
    assert (tmp_path / "saved").exists()
    with pytest.raises(UserError, match="fine-tuning has ended with exit code 2"):
        real_demo.together(["sh", "-c", "sleep 0.5; exit 2"], ["true"], tmp_path / "log")


def test_the_film_shows_an_episode_that_was_mended():
    no, yes = False, True
    assert pictures.telling(np.array([yes, no, no]), np.array([yes, no, yes])) == 2
    assert pictures.telling(np.array([yes, no]), np.array([yes, no])) == 0


def test_an_episode_is_described_by_what_its_task_is_judged_by():
    by_success, by_return = (toy.make()._replace(score=score) for score in ("success", "return"))
    assert pictures.outcome(by_success, np.bool_(True), 3.0) == "success"
    assert pictures.outcome(by_success, np.bool_(False), 3.0) == "failure"
    assert pictures.outcome(by_return, np.bool_(False), np.float32(123.4)) == "return 123"


def test_the_first_and_the_last_evaluation_are_filmed():
    """0 to 19 before the first rollout, 20 more after it, 8 rollouts: the last evaluation is 48 to 67."""
    assert real_demo.filmed(RealDemoArgs(rollouts=8, episodes=20)) == (range(3), range(48, 51))
    assert real_demo.filmed(RealDemoArgs(rollouts=1, episodes=2)) == (range(2), range(3, 5))  # two evaluations


@pytest.mark.slow
def test_the_demo_in_bullet(tmp_path, monkeypatch, capsys):
    if real_demo.output(BULLET, "import panda_gym, msgpack, websockets") is None:
        pytest.skip("no panda-gym: run `make real-demo` once, or name a Python that has it in SGFT_BULLET_PYTHON")
    monkeypatch.chdir(ROOT)
    save_prior(tmp_path / "prior", 0, task="panda-push", obs_dim=21, act_dim=3)
    monkeypatch.setattr(real_demo, "bullet", lambda home, python: Path(BULLET))
    real_demo.main(RealDemoArgs(tmp_path / "prior", "sac", rollouts=2, episodes=3, out=tmp_path / "demo"))
    said = capsys.readouterr().out
    assert "success in Bullet: " in said and "video: " in said
    run = "finetune/panda-push/remote/sac/seed-0"
    for made in (f"{run}/figures/score.png", "videos/before-after.mp4", f"{run}/policy/seed-0/prior.json"):
        assert (tmp_path / "demo" / made).stat().st_size > 100
    assert "connected to" in (tmp_path / "demo" / "robot.log").read_text()
    assert not subprocess.run(["pgrep", "-f", str(tmp_path)], capture_output=True).stdout  # the robot's side has ended
