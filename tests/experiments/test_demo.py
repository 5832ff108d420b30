"""The demo from pretraining to the table, on a point mass."""

import pytest

import envs
from experiments import demo


@pytest.mark.slow
def test_demo_compares_both_methods_from_one_prior(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(envs.TASKS, "toy", "toy")
    gap = tmp_path / "turned.toml"
    gap.write_text("[params]\nmass = 2.0\n[effects]\naction_rotation = 0.52\n")
    out = tmp_path / "demo"
    demo.main(demo.DemoArgs(task="toy", real=str(gap), env_steps=5_120, seeds=2, rollouts=3, video=False, out=out))
    printed = capsys.readouterr().out
    table = [line for line in printed.splitlines() if line.startswith("|")]
    assert {"sgft-sac", "sac"} <= {line.split("|")[1].strip() for line in table}
    for method in demo.METHODS:
        run = out / "finetune" / "toy" / "turned" / method / "seeds-0-1"
        assert (run / "summary.json").exists() and len(list((run / "real").glob("*.npz"))) == 3
