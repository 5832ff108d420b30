"""A comparison in Bullet: which runs there are, in which order, and how it goes on. The engine is not asked."""

from pathlib import Path

import pytest

from envs.types import UserError
from experiments import real_demo
from experiments.studies import bullet
from experiments.studies.bullet import BulletArgs

ROOT = Path(__file__).parents[2]
PRIOR = ROOT / "sgft_jax/priors/panda-push"


@pytest.fixture
def played(monkeypatch):
    """The runs that would be played: method, seed, whether it goes on. That of seed 1 ends at its second attempt."""
    calls = []

    def fine_tune(python, out, options, *, log):
        words = [str(word) for word in options]
        method, seed = (words[words.index(name) + 1] for name in ("--method", "--seed"))
        folder = out / f"finetune/panda-push/remote/{method}/seed-{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        if "--resume" in words or seed != "1":
            (folder / "summary.json").touch()
        calls.append((method, int(seed), "--resume" in words))

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(real_demo, "bullet", lambda home, python: Path("python3.11"))
    monkeypatch.setattr(real_demo, "fine_tune", fine_tune)
    return calls


def test_all_methods_of_a_seed_before_the_next_and_no_run_twice(played, tmp_path, capsys):
    args = BulletArgs(("guarded", "sac"), PRIOR, seeds=2, out=tmp_path)
    bullet.main(args)
    assert played == [("guarded", 0, False), ("sac", 0, False), ("guarded", 1, False), ("sac", 1, False)]
    assert "2 of 4 runs are finished" in capsys.readouterr().out
    played.clear()
    bullet.main(args)
    assert played == [("guarded", 1, True), ("sac", 1, True)]
    played.clear()
    bullet.main(args)
    assert not played and "4 of 4 runs are finished" in capsys.readouterr().out


def test_evaluations_and_an_end_of_the_time(played, tmp_path):
    args = BulletArgs(("sac",), PRIOR, seeds=1, out=tmp_path, eval_at=(0, 3), episodes=7, minutes=0.0)
    bullet.main(args)
    assert not played
    words = " ".join(map(str, bullet.words_of(next(bullet.runs(args)))))
    assert "--eval-episodes 7 --eval-at 0 3" in words and "--resume" not in words


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"methods": ("sac", "sac")}, "--methods"),
        ({"methods": ("sacc",)}, "sacc"),
        ({"seeds": 0}, "--seeds is 0: must be at least 1"),
        ({"seed": -1}, "--seed is -1: seeds go from 0 to"),
        ({"minutes": -1.0}, "--minutes is -1.0: must be at least 0"),
        ({"eval_at": (-1,)}, "--eval-at -1: numbers of rollouts, from 0 on"),
        ({"eval_at": (500,)}, "--eval-at 500: no evaluation within --rollouts 20"),
        ({"methods": ("sac", "tdmpc2")}, "seed-0: tdmpc2 needs a prior of tdmpc2, not of sac; make one with: python"),
        ({"methods": ("sac", "sysid")}, "seed-0: sysid needs a prior that was told the system; make one with: python"),
        ({"prior": Path("shipped:push")}, "seed-0: the prior is of the task 'push', not of 'panda-push'"),
        ({"prior": Path("nowhere")}, "--prior nowhere: no such folder"),
    ],
)
def test_mistakes_are_found_before_anything_is_made(played, tmp_path, options, words):
    with pytest.raises(UserError, match=words):
        bullet.main(BulletArgs(**{"prior": PRIOR, "out": tmp_path / "out", **options}))
    assert not played and not list(tmp_path.iterdir())
