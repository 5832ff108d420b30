"""What many commands say of a folder that cannot be made: one line, before any work, and nothing is written."""

import os
from pathlib import Path

import pytest

from envs.types import UserError
from experiments import collect, diagnose, evaluate, export, export_data, figures, gaps, replay
from experiments.studies import bullet, gaps_draw, scoreboard

PRIOR = Path(__file__).parents[2] / "sgft_jax/priors/push/seed-0"

COMMANDS = {
    "collect": lambda run, out: collect.check(collect.CollectArgs(out=out)),
    "diagnose": lambda run, out: diagnose.check(diagnose.DiagnoseArgs(prior=PRIOR, out=out)),
    "evaluate": lambda run, out: evaluate.check(evaluate.EvaluateArgs(prior=PRIOR, real=("remote",), out=out)),
    "replay": lambda run, out: replay.main(replay.ReplayArgs(run, task="push", out=out)),
    "export": lambda run, out: export.main(export.ExportArgs(PRIOR, "numpy", out)),
    "export_data": lambda run, out: export_data.main(export_data.ExportDataArgs(run, "minari", task="push", out=out)),
    "figures": lambda run, out: figures.main(figures.FiguresArgs(out=out)),
    "scoreboard": lambda run, out: scoreboard.main(scoreboard.ScoreboardArgs((), out=out)),
    "gaps": lambda run, out: gaps.measure(gaps.GapsArgs(prior=PRIOR, out=out)),
    "gaps_draw": lambda run, out: gaps_draw.draw(gaps_draw.DrawArgs(count=1, prior=PRIOR, out=out)),
    "bullet": lambda run, out: bullet.check(bullet.BulletArgs(out=out)),
}
OTHER = {
    "--export": lambda run, out: figures.main(figures.FiguresArgs(export=out)),
    "--to": lambda run, out: gaps_draw.draw(gaps_draw.DrawArgs(count=1, choose=1, to=out / "set.toml", out=run)),
}


@pytest.fixture
def run(tmp_path):
    """A folder that looks like that of a run."""
    (tmp_path / "run/real").mkdir(parents=True)
    (tmp_path / "run/real/rollout-000000.npz").touch()
    return tmp_path / "run"


@pytest.mark.parametrize("command", [*COMMANDS, *OTHER])
def test_a_folder_below_a_file_is_refused_before_any_work(command, run, tmp_path):
    (tmp_path / "file").write_text("mine")
    before, option = sorted(tmp_path.rglob("*")), command if command in OTHER else "--out"
    with pytest.raises(UserError, match=rf"cannot be made, .*/file is a file; choose another {option}$"):
        (COMMANDS | OTHER)[command](run, tmp_path / "file" / "out")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("command", COMMANDS)
def test_so_is_one_that_may_not_be_written(command, run, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    with pytest.raises(UserError, match=r"you may not write to .*; choose another --out$"):
        COMMANDS[command](run, tmp_path / "out")
