"""The command that draws: figures and tables from run folders made by hand and from released tables."""

import subprocess
import sys

import pytest
from runs_by_hand import save

from experiments import figures
from experiments.runner import cli
from sgft_jax.analysis import figures as drawing


@pytest.fixture(autouse=True)
def _cheap(monkeypatch):
    monkeypatch.setattr(cli, "set_up", lambda: None)


def call(*argv):
    cli.run_main(figures.main, figures.FiguresArgs, "Draw.", argv=[str(a) for a in argv])


@pytest.fixture
def drawn(monkeypatch):
    """The panels of each figure, by its name, instead of the figure."""
    found = {}

    def draw(path, panels, *, title):
        path.parent.mkdir(parents=True, exist_ok=True)
        found[path.name] = {words: [curve.name for curve in curves] for words, curves in panels.items()}
        return path

    monkeypatch.setattr(drawing, "learning_curves", draw)
    return found


def runs(out):
    """Two tasks, two gaps, a variant, a second set of priors, an unfinished run."""
    rising, flat = [[0.2, 0.3], [0.9, 1.0]], [[0.2, 0.3], [0.2, 0.2]]
    for method, success in (("sac", flat), ("sgft-sac", rising)):
        save(out, method, success, rollouts=[0, 20])
    save(out, "sgft-sac_slow", flat, rollouts=[0, 20], variant="slow")
    save(out, "mbpo", rising, rollouts=[0, 20], priors=["bbbbbb"])
    save(out, "sgft-sac", rising, rollouts=[0, 20], real="hard", wanted=100)
    save(out, "sac", rising, rollouts=[0, 20], task="other")


def test_a_figure_and_tables_for_each_task_and_gap(tmp_path, capsys, drawn):
    runs(tmp_path)
    call("--out", tmp_path)
    text = (tmp_path / "figures/tables.md").read_text()
    assert text in capsys.readouterr().out
    assert drawn == {
        "overview-default.png": {"other": ["sac"], "toy": ["sgft-sac", "sac"]},
        "other-default.png": {"priors fast": ["sac"]},
        "toy-default.png": {
            "priors fast": ["sgft-sac", "sac"],
            "sgft-sac and its variants, priors fast": ["sgft-sac", "sgft-sac slow"],
            "priors fast-bbbbbb": ["mbpo"],
        },
        "toy-hard.png": {"priors fast": ["sgft-sac"]},
    }
    titles = ["## All tasks", "## other on the default", "### toy on the default real system, priors fast\n"]
    assert sorted(titles, key=text.index) == titles
    assert "| sgft-sac | 2 | 25 | 60 | 95 (20) | 0 / 0 | - | > 400 |" in text
    assert f"- {tmp_path / 'finetune/toy/hard/sgft-sac/seeds-0-1'}: unfinished, 20 of 100 rollouts" in text


def test_options_choose_what_is_drawn(tmp_path, drawn):
    runs(tmp_path)
    call("--out", tmp_path, "--task", "toy", "--gaps", "default", "--no-variants", "--methods", "sgft-sac", "mbpo")
    assert drawn == {"toy-default.png": {"priors fast": ["sgft-sac"], "priors fast-bbbbbb": ["mbpo"]}}
    drawn.clear()
    call("--out", tmp_path, "--priors", "fast-bbbbbb")
    assert drawn == {"toy-default.png": {"priors fast-bbbbbb": ["mbpo"]}}


def test_what_was_exported_draws_the_same(tmp_path, drawn):
    runs(tmp_path / "runs")
    call("--out", tmp_path / "runs")
    before, text = dict(drawn), (tmp_path / "runs/figures/tables.md").read_text()
    drawn.clear()
    call("--out", tmp_path / "runs", "--export", tmp_path / "docs/data")
    assert not drawn
    call("--data", tmp_path / "docs/data", "--out", tmp_path / "docs")
    assert drawn == before
    again = (tmp_path / "docs/figures/tables.md").read_text()
    assert again.splitlines() == text[: text.index("## Left out")].splitlines()[:-1]


def test_real_figures_are_drawn(tmp_path):
    save(tmp_path, "sgft-sac", [[0.2, 0.3], [0.9, 1.0]], rollouts=[0, 20])
    call("--out", tmp_path)
    assert (tmp_path / "figures/toy-default.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--task", "toi"], "did you mean 'toy'?"),
        (["--methods", "sca"], "did you mean 'sac'?"),
        (["--task", "toy", "--gaps", "hard", "--methods", "sac"], "there is no 'sac'"),
        (["--data", "nowhere"], "nowhere: holds no curves-*.csv"),
        (["--out", "nowhere"], "holds no evaluated run to draw; make one with"),
        (["--out", "broken"], "broken/finetune: holds no evaluated run to draw: broken/finetune/toy/default/mbpo/"),
        (["--out", "broken"], "summary.json: not valid JSON (Expecting value: line 1 column 1 (char 0)); and 1 more"),
        (["--data", "empty"], "empty: its curves-*.csv hold no run; write some with"),
        (["--out", "nowhere", "--export", "data"], "nowhere: holds no run"),
    ],
)
def test_a_bad_command_is_one_line_and_code_2(argv, words, tmp_path, capsys, monkeypatch):
    runs(tmp_path / "runs")
    for method, name in (("mbpo", "summary.json"), ("sac", "config.json")):
        (save(tmp_path / "broken", method, [[0.1, 0.2]], rollouts=[0]) / name).write_text("")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty/curves-toy.csv").touch()
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        call(*argv)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_that_there_is_nothing_to_draw_is_said_without_what_draws(tmp_path):
    """SciPy and Matplotlib take seconds."""
    code = (
        "import runpy, sys; sys.modules |= dict.fromkeys(('jax', 'matplotlib', 'scipy')); "
        "sys.argv = ['figures', '--out', sys.argv[1]]; runpy.run_module('experiments.figures', run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 2 and "holds no evaluated run to draw" in done.stderr
