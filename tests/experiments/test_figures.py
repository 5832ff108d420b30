"""Figures and tables from run folders made by hand."""

import numpy as np
import pytest
from runs_by_hand import save

import envs
from experiments import cli, figures, tables
from experiments.results import read_curve
from sgft_jax.analysis.stats import Censored, Interval


@pytest.fixture(autouse=True)
def _cheap(monkeypatch):
    monkeypatch.setitem(envs.TASKS, "toy", "toy")
    monkeypatch.setattr(cli, "set_up", lambda: None)


def call(*argv):
    cli.run_main(figures.main, figures.FiguresArgs, "Draw.", argv=[str(a) for a in argv])


def test_a_row_says_what_the_curve_says(tmp_path):
    success = [[0.2, 0.4], [0.1, 0.1], [0.8, 1.0], [1.0, 1.0]]
    curve = read_curve(save(tmp_path, "sac", success, rollouts=[0, 20, 50, 100]))
    # Means 0.3, 0.1, 0.9, 1.0: dip 0.3 - 0.1 = 20 points; 90 % first at 50 rollouts = 1,000 transitions, 98 % at 2,000;
    # 100 rollouts of 2 s are 3.3 min. Two seeds: the bootstrap interval reaches from one to the other, of which one is
    # at both levels after 1,000 and one after 2,000.
    cells = [
        "sac",
        "2",
        "30 [20, 40]",
        "-",
        "10 [10, 10]",
        "90 [80, 100]",
        "100 [100, 100]",
        "100 [100, 100] (100)",
        "1,000 [1,000, 2,000]",
        "2,000 [1,000, 2,000]",
        "38 [33, 43]",
        "20",
        "3.3",
    ]
    # Areas to 50 rollouts: 20 * (0.2 + 0.1) / 2 + 30 * (0.1 + 0.8) / 2 = 16.5 of 50 or 33 %; 5 + 16.5 = 21.5, 43 %.
    assert tables.row("sac", curve, tables.BUDGETS, 50) == cells
    assert len(cells) == len(tables.columns(tables.BUDGETS, 50))


@pytest.mark.parametrize("common", [0, 18])
def test_budgets_not_reached_or_not_evaluated_stay_empty(tmp_path, common):
    """So does the area up to where all got, if there is no evaluation on the way to it."""
    folder = save(tmp_path, "sac", [[0.5], [0.6], [0.7]], rollouts=[0, 19, 50], seeds="seed-0")
    ended = "> 1,000"
    assert tables.row("sac", read_curve(folder), (10, 50, 100), common) == [
        *("sac", "1", "50", "-", "70", "-", "70 (50)"),
        *(ended, ended, "-", "0", "1.7"),
    ]


@pytest.mark.parametrize(
    ("least", "most", "digits", "text"),
    [
        ((800, 720, 1200), (800, 720, 1200), 0, "800 [720, 1,200]"),
        ((800, 720, 4000), (800, 720, np.inf), 0, "800 [720, > 4,000]"),
        ((4000, 3200, 4000), (np.inf, 3200, np.inf), 0, "> 4,000 [3,200, > 4,000]"),
        ((4000, 4000, 4000), (np.inf, np.inf, np.inf), 0, "> 4,000"),
        ((400, 400, 400), (400, 400, 400), 0, "400 [400, 400]"),
        ((800, np.nan, np.nan), (800, np.nan, np.nan), 0, "800"),
        ((5.2, 3.91, 7.06), (5.2, 3.91, 7.06), 1, "5.2 [3.9, 7.1]"),
        ((4.19, 2.29, 6.09), (np.inf, np.inf, np.inf), 1, "> 4.1 [> 2.2, > 6.0]"),  # rounded down
        ((0, 0, 0), (0.31, 0.11, 0.5), 1, "< 0.4 [< 0.2, < 0.5]"),  # rounded up
        ((5.2, 0, 6.0), (5.2, 0.7, np.inf), 1, "5.2 [< 0.7, > 6.0]"),
        ((5.2, 3.0, 6.0), (5.2, 3.5, 7.0), 1, "5.2 [3.0, 7.0]"),  # the ends that enclose all there can be
        ((5.2, 0, 0), (5.2, np.inf, np.inf), 1, "5.2 [-, -]"),
        ((0, 0, 1), (np.inf, 1, np.inf), 1, "-"),
    ],
)
def test_how_an_interval_is_written(least, most, digits, text):
    assert tables.censored(Censored(Interval(*least), Interval(*most)), digits=digits) == text


def test_one_figure_and_one_table_per_real_system(tmp_path, capsys, monkeypatch):
    drawn = {}
    monkeypatch.setattr(
        figures.plot, "learning_curves", lambda path, curves, **more: drawn.update({path: (curves, more)}) or path
    )
    rising, flat = [[0.2, 0.3], [0.9, 1.0]], [[0.2, 0.3], [0.2, 0.2]]
    for method, success in (("sac", flat), ("sgft-sac", rising), ("sgft-sac_horizon-4", rising)):
        save(tmp_path, method, success, rollouts=[0, 20])
    save(tmp_path, "sgft-sac", rising, rollouts=[0, 20], real="hard+latency=0.1", wanted=100)
    save(tmp_path, "sgft-sac", [[0.2], [0.9]], rollouts=[0, 20], real="hard+latency=0.1", seeds="seed-0")
    (tmp_path / "finetune/toy/default/mbpo/seed-0").mkdir(parents=True)
    (tmp_path / "finetune/toy/default/mbpo/seed-0/eval.jsonl").touch()
    call("--out", tmp_path, "--task", "toy")

    text = (tmp_path / "figures/results.md").read_text()
    assert text in capsys.readouterr().out
    names = ("default", "default_sgft-sac", "hard+latency=0.1")
    assert list(drawn) == [tmp_path / f"figures/toy-{name}.png" for name in names]
    curves, more = drawn[tmp_path / "figures/toy-default.png"]
    assert list(curves) == ["sgft-sac", "sac"]
    assert more["zero_shot"] == 0.25 and more["rollout_length"] == 20 and more["control_dt"] == pytest.approx(0.1)
    np.testing.assert_array_equal(curves["sac"][1], np.transpose(flat))
    # Colours in all figures: the variant, which others lack, must not move those of the methods.
    assert [more["order"][:2] for _, more in drawn.values()] == [["sgft-sac", "sac"]] * 3
    assert drawn[tmp_path / "figures/toy-default_sgft-sac.png"][1]["order"][2:] == ["sgft-sac_horizon-4"]
    titles = ["## All tasks", "## toy on the default", "## toy on the hard", "## The three transforms", "## Missing"]
    assert sorted(titles, key=text.index) == titles and "## The horizon" not in text
    assert "| 20 rollouts |" in text and "50 rollouts" not in text  # no run got there
    assert text.index("| sgft-sac | 2 |") < text.index("| sac | 2 |") and "![toy on the default real system]" in text
    for missing in (
        "- toy/default: no run of sgft-relabel, sgft, sgft-mpc, sgft-tdmpc2, sgft-tdmpc2-code, tdmpc2, iql, rlpd, "
        "sac-online, frozen-critic, pbrs-branch, pbrs, sac-reset",
        "holds no evaluation yet",
        "- toy/default: no two horizons of sgft-sac",
        "- toy/hard+latency=0.1: sgft-sac: seed-0 left out, seeds-0-1 has more seeds or rollouts",
        "- toy/hard+latency=0.1: sgft-sac: unfinished, 20 of 100 rollouts",
    ):
        assert missing in text


def test_variants_of_several_methods_and_of_a_single_one_have_figures_of_their_own(tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(
        figures.plot, "learning_curves", lambda path, curves, **more: drawn.update({path.name: list(curves)}) or path
    )
    for method in ("sac", "sgft-sac", "sgft-sac_horizon-4", "sac_tuned", "sgft-sac_tuned", "rlpd_utd-1"):
        save(tmp_path, method, [[0.2, 0.3], [0.9, 1.0]], rollouts=[0, 20])
    call("--out", tmp_path)
    assert drawn == {
        "toy-default.png": ["sgft-sac", "rlpd_utd-1", "sac"],  # there is no rlpd that it could be compared with
        "toy-default_sgft-sac.png": ["sgft-sac", "sgft-sac_horizon-4"],
        "toy-default_tuned.png": ["sgft-sac_tuned", "sac_tuned"],
    }
    text = (tmp_path / "figures/results.md").read_text()
    assert "![toy on the default real system, tuned](toy-default_tuned.png)" in text


def test_real_figures_are_drawn_and_untouched_gaps_are_named(tmp_path, capsys):
    save(tmp_path, "sgft-sac", [[0.2, 0.3], [0.9, 1.0]], rollouts=[0, 20])
    call("--out", tmp_path)
    assert (tmp_path / "figures/toy-default.png").stat().st_size > 10_000
    assert "- no run on push/mild, push/default, push/hard, push-towel/default" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "words"),
    [(["--task", "toi"], "did you mean 'toy'?"), ([], "holds no evaluated run to draw; make one with")],
)
def test_a_bad_command_is_one_line_and_code_2(argv, words, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        call(*argv, "--out", tmp_path)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_zero_shot_is_a_line_where_all_start_alike(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        figures.plot, "learning_curves", lambda path, *_, zero_shot, **__: drawn.append(zero_shot) or path
    )
    save(tmp_path, "sac", [[0.3, 0.3], [0.9, 1.0]], rollouts=[0, 20])
    call("--out", tmp_path)
    save(tmp_path, "tdmpc2", [[0.0, 0.0], [0.9, 1.0]], rollouts=[0, 20])
    call("--out", tmp_path)
    assert drawn == [0.3, None]
