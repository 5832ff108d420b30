"""The table of a frozen set: strata, falls, who is ahead, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import runs_by_hand

from envs.types import UserError
from experiments.studies import scoreboard
from experiments.studies.scoreboard import ScoreboardArgs

SET = """
[easy]
stratum = "solved"
effects = { latency = 0.01 }
[hard]
stratum = "failed"
effects = { latency = 0.1 }
"""


@pytest.fixture
def home(tmp_path):
    """`guarded` never falls and learns the hard gap; `sac` falls on the easy one and learns half as much."""
    (tmp_path / "set.toml").write_text(SET)
    for method, gap, curve in (
        ("guarded", "easy", ([0.9] * 4, [0.9] * 4, [0.9] * 4)),
        ("guarded", "hard", ([0.1] * 4, [0.9, 0.9, 1.0, 1.0], [1.0] * 4)),
        ("sac", "easy", ([0.9] * 4, [0.5] * 4, [0.8] * 4)),
        ("sac", "hard", ([0.1] * 4, [0.3] * 4, [0.5, 0.5, 0.6, 0.6])),
        ("sac", "elsewhere", ([0.0] * 4, [0.0] * 4, [0.0] * 4)),
        ("mbpo", "sim", ([0.9] * 4, [0.9] * 4, [0.9] * 4)),  # on the control alone: no competitor
    ):
        digests = [f"p{i}" for i in range(4)]
        runs_by_hand.save(tmp_path, method, curve, rollouts=(0, 4, 8), real=gap, seeds="seeds-0-3", priors=digests)
    return tmp_path


def test_strata_falls_and_who_is_ahead(home, capsys):
    scoreboard.main(ScoreboardArgs((home / "set.toml",), out=home))
    said = capsys.readouterr().out
    assert "| solved | guarded | 1 | 90 | 90 | 90 | 1 of 1 | 1 of 1, 0 | 0 / 0 | 0 |" in said
    assert "| solved | sac | 1 | 90 | 68 | 80 | 0 of 1 | 0 of 1 | 40 / 40 (toy/easy) | 10 |" in said
    assert "| failed | guarded | 1 | 10 |" in said
    assert "| 1 of 1 | 1 of 1, 80 | 0 / 0 | 0 |" in said.split("failed | guarded")[1]  # four rollouts of 20 steps
    assert "| sac | 1 of 1 | 100 |" in said and "elsewhere" not in said and "mbpo" not in said
    assert (home / "scoreboard.md").read_text() in said and (home / "scoreboard.png").stat().st_size > 10_000


def test_a_method_that_begins_with_plans_also_falls_below_the_policy(home):
    digests = [f"p{i}" for i in range(4)]
    curve = ([0.7] * 4, [0.5] * 4, [0.95] * 4)
    runs_by_hand.save(home, "sgft-mpc", curve, rollouts=(0, 4, 8), real="easy", seeds="seeds-0-3", priors=digests)
    args = ScoreboardArgs((home / "set.toml",), out=home)
    assert "| solved | sgft-mpc | 1 | 70 | 66 | 95 | 0 of 1 | 0 of 1 | 40 / 20 (toy/easy) | 0 |" in scoreboard.board(
        args
    )
    runs_by_hand.save(home, "sgft-tdmpc2", curve, rollouts=(0, 4, 8), real="easy", seeds="seeds-0-3", priors=["others"])
    assert "| solved | sgft-tdmpc2 | 1 | 70 | 66 | 95 | 0 of 1 | 0 of 1 | - / 20 (toy/easy) | 0 |" in scoreboard.board(
        args
    )


def test_released_tables_say_the_same(home):
    from sgft_jax.analysis.release import export

    args = ScoreboardArgs((home / "set.toml",), out=home)
    export(home, home / "data")
    assert scoreboard.board(replace(args, data=home / "data", out=home / "nothing")) == scoreboard.board(args)
    with pytest.raises(UserError, match="--priors: there is no 'others'"):
        scoreboard.board(replace(args, data=home / "data", priors=("others",)))


def test_each_gap_has_a_line_and_fewer_seeds_can_be_asked_for(home):
    args = ScoreboardArgs((home / "set.toml",), out=home, each=True)
    said = scoreboard.board(args)
    assert "| gap | stratum | guarded | sac |" in said
    assert "| toy/easy | solved | 90: 90 / 90 / 0 | 90: 68 / 80 / 40 |" in said
    assert "| toy/hard | failed | 10: 75 / 100 / 0 | 10: 31 / 55 / 0 |" in said
    assert "sim" not in said  # the control, where only a method ran that met no gap
    first = scoreboard.board(replace(args, seeds=2))
    assert "| toy/hard | failed | 10: 72 / 100 / 0 | 10: 30 / 50 / 0 |" in first
    assert scoreboard.board(replace(args, seeds=9)) == said
    with pytest.raises(UserError, match="--seeds is 0: must be at least 1"):
        scoreboard.main(replace(args, seeds=0))


def test_bad_input(home):
    args = ScoreboardArgs((home / "set.toml",), out=home)
    with pytest.raises(UserError, match=r"--reference mbpo: did not run on these gaps; there are: .*sac"):
        scoreboard.board(ScoreboardArgs(args.gaps, reference="mbpo", out=home))
    with pytest.raises(UserError, match="holds no evaluated run on these gaps"):
        scoreboard.board(ScoreboardArgs(args.gaps, out=home / "nothing"))
    with pytest.raises(UserError, match=r"--tasks: there is no 'nope'\. Choose from: toy"):
        scoreboard.board(replace(args, tasks=("toy", "nope")))
    with pytest.raises(UserError, match=r"--priors: there is no 'nope'\. Choose from: fast-p0"):
        scoreboard.board(replace(args, priors=("nope",)))
    (home / "set.toml").write_text("[easy.params]\nmass = 1.0\n[hard.params]\nmass = 2.0\n")
    with pytest.raises(UserError, match=r"set.toml \[easy\]: has no 'stratum'"):
        scoreboard.board(args)


def test_pooled_curves_are_means_over_gaps_member_by_member(home):
    from sgft_jax.analysis.reading import read_runs

    sac = {curve.gap: curve for curve in read_runs(home).curves if curve.method == "sac" and curve.gap != "elsewhere"}
    one = scoreboard.pooled(sac)
    np.testing.assert_allclose(one.values, [[0.5, 0.4, 0.65], [0.5, 0.4, 0.65], [0.5, 0.4, 0.7], [0.5, 0.4, 0.7]])
    assert one.x.tolist() == [0, 4, 8] and np.isnan(one.minutes).all()
