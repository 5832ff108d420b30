"""What many commands say of the same mistake: one line, before any work, and nothing is written."""

import os
from pathlib import Path

import pytest

from experiments import (
    bullet,
    collect,
    diagnose,
    evaluate,
    export,
    export_data,
    figures,
    finetune,
    gaps,
    grid,
    replay,
    scoreboard,
)  # fmt: skip
from experiments.options import check_variant
from sgft_jax.types import UserError

PRIOR = Path(__file__).parents[2] / "docs/priors/push/seed-0"

GAPS = PRIOR.parents[3] / "envs/gaps/test/push.toml"
HEADER = "task,gap,method,variant,priors,prior,seed,rollouts,transitions,minutes,success,return,training"

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
    "gaps --draw": lambda run, out: gaps.measure(gaps.GapsArgs(prior=PRIOR, draw=1, out=out)),
    "bullet": lambda run, out: bullet.check(bullet.BulletArgs(out=out)),
}
OTHER = {
    "--export": lambda run, out: figures.main(figures.FiguresArgs(export=out)),
    "--to": lambda run, out: gaps.measure(gaps.GapsArgs(draw=1, choose=1, to=out / "set.toml", out=run)),
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


def test_names_that_no_file_system_has(tmp_path):
    with pytest.raises(UserError, match="--variant has 300 letters: choose a shorter word"):
        check_variant(300 * "v")
    with pytest.raises(UserError, match=r"cannot be made \(file name too long\); choose another --out"):
        figures.main(figures.FiguresArgs(out=tmp_path / (300 * "o")))


PRIOR_READERS = {
    "evaluate": lambda folder: evaluate.check(evaluate.EvaluateArgs(prior=folder)),
    "export": lambda folder: export.main(export.ExportArgs(folder, "numpy")),
    "diagnose": lambda folder: diagnose.check(diagnose.DiagnoseArgs(prior=folder)),
}


@pytest.mark.parametrize("command", PRIOR_READERS)
@pytest.mark.parametrize(("content", "words"), [("{}", "lacks task"), ("[1]", "is no JSON object")])
def test_a_prior_that_names_no_task(command, content, words, tmp_path):
    (tmp_path / "prior.json").write_text(content)
    with pytest.raises(UserError, match=f"prior.json: {words}; take another prior"):
        PRIOR_READERS[command](tmp_path)


@pytest.mark.parametrize(("content", "words"), [("{}", "lacks config"), ("[1]", "is no JSON object")])
def test_a_run_that_does_not_say_its_options(content, words, run):
    (run / "config.json").write_text(content)
    for call in (
        lambda: export_data.main(export_data.ExportDataArgs(run, "minari")),
        lambda: replay.main(replay.ReplayArgs(run)),
        lambda: diagnose.check(diagnose.DiagnoseArgs(real=str(run))),
    ):
        with pytest.raises(UserError, match=f"config.json: {words}; put back the file"):
            call()


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["task,gap", "push,hard"], "curves-push.csv: row 1 has no method; put the table back"),
        ([HEADER, "push,hard,sac,,robust,0,0,0,0,0,1,2,", "push,hard,sac,,robust,0"], "row 2 has no seed"),
        ([HEADER, "push,hard,sac,,robust,0,0,none,0,0,1,2,"], r"curves-\*.csv: .*'none'; put the tables back"),
    ],
    ids=["a column less", "a row cut off", "no number"],
)
def test_a_released_table_that_is_damaged(lines, words, tmp_path):
    (tmp_path / "curves-push.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(UserError, match=words):
        scoreboard.main(scoreboard.ScoreboardArgs((GAPS,), data=tmp_path))


@pytest.mark.parametrize(("content", "words"), [("[1]", "is no JSON object"), ("{", "not valid JSON")])
def test_a_summary_that_is_damaged_is_named_by_commands_that_go_through_runs(content, words, tmp_path):
    args = finetune.FinetuneArgs(method="sac", prior=PRIOR, out=tmp_path)
    folder = grid.look_up(args).folder
    folder.mkdir(parents=True)
    for name in ("config.json", "summary.json"):
        (folder / name).write_text(content)
    with pytest.raises(UserError, match=rf"summary.json: {words}"):
        grid.look_up(args)
