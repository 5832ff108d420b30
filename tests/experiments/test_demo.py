"""The demo from a prior to its tables, on a point mass."""

import re
from pathlib import Path

import pytest
from priors_by_hand import save_with_estimator

import envs
from envs.types import UserError
from experiments import demo
from experiments.runner import narrowed
from sgft_jax.posterior import decision, interface


@pytest.mark.slow
def test_the_demo_tells_what_rollouts_say_of_the_system(tmp_path, monkeypatch, capsys):
    for module in (decision, interface):
        for name, value in {"CANDIDATES": 2, "JUDGES": 2}.items():
            monkeypatch.setattr(module, name, value)
    monkeypatch.setitem(envs.TASKS, "toy", "toy")
    monkeypatch.setattr(narrowed, "_SHOWN", 20)  # all: the estimator tells nothing of any
    gap = tmp_path / "turned.toml"
    gap.write_text("[params]\nmass = 2.0\n[effects]\naction_rotation = 0.52\n")
    save_with_estimator(tmp_path / "prior")
    demo.main(demo.DemoArgs("toy", tmp_path / "prior", str(gap), video=False, out=tmp_path / "demo"))
    tables = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    (turned,) = [row for row in tables if "rotation of commands, rad" in row[0]]
    assert len(turned) == 5 and turned[-1].startswith("0.52")
    low, high = map(float, turned[1].split(" to "))
    assert -0.85 < low < -0.75 and 0.75 < high < 0.85  # 80 % of what it may be
    rollouts = [row for row in tables if re.match(r"\| \d", row[0])]
    assert [row[0] for row in rollouts] == ["| 0", "| 1", "| 2"] and rollouts[0][1] == "the prior as it is"
    assert all(row[3].endswith("%") and row[4].startswith("the prior ") for row in rollouts)
    assert list((tmp_path / "demo").rglob("posterior.png"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rollouts": 0}, "--rollouts is 0: must be at least 1"),
        ({"task": "psh"}, "there is no 'psh', did you mean 'push'"),
        ({"real": "hrd"}, "gap of push: there is no 'hrd', did you mean 'hard'"),
        ({"prior": Path("nowhere")}, "--prior nowhere: no such folder"),
    ],
)
def test_mistakes_are_found_before_anything_is_played(tmp_path, monkeypatch, options, words):
    monkeypatch.setattr(demo, "finetune", lambda args: pytest.fail("plays"))
    with pytest.raises(UserError, match=words):
        demo.main(demo.DemoArgs(out=tmp_path, **options))
    assert not list(tmp_path.iterdir())
