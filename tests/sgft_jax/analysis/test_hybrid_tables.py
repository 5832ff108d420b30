"""Tables of methods on data sets and simulators, against numbers by hand."""

import numpy as np
import pytest

from envs import D4RL
from envs.types import UserError
from sgft_jax.analysis import hybrid, release
from sgft_jax.analysis.curves import Curve
from sgft_jax.analysis.hybrid import Results, late

LOW, HIGH = D4RL["halfcheetah"]


def of_scale(*scores):
    """Returns with these scores on D4RL's scale."""
    return np.array([LOW + x / 100 * (HIGH - LOW) for x in scores])


def run(method, data, gap, scores, *, task="halfcheetah", score="return", **measures):
    """A curve whose last evaluation has these scores [seeds]. measures: [seeds, evaluations]."""
    curves = {name: np.asarray(values, float) for name, values in {score: np.transpose([scores]), **measures}.items()}
    updates, seeds = np.arange(curves[score].shape[1]), np.arange(len(scores))
    return Curve(task, gap, method, seeds=seeds, x=updates, scores=curves, score=score, data=data, unit="updates")


def results(*curves, methods=("h2oplus", "iql", "sac")):
    return Results(("replay", "medium"), ("gravity", "friction"), methods, curves, "last")


def rows(text):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:]]


FOUND = results(
    run("h2oplus", "replay", "gravity", of_scale(50, 60, 70)),
    run("h2oplus", "replay", "friction", of_scale(10, 20, 30)),
    run("h2oplus", "medium", "gravity", of_scale(80, 80, 80)),
    run("iql", "replay", "", of_scale(40, 40, 40)),
    run("iql", "medium", "", of_scale(55, 45, 50)),
    run("sac", "", "gravity", of_scale(0, 0, 0)),
    run("sac", "", "friction", of_scale(30, 30, 30)),
)


def test_a_run_stands_in_every_row_that_it_belongs_to():
    """In returns: 60 points of 12,415 above -280 are 7,169; the std of 50, 60, 70 is 8.165 points, 1,014."""
    found = rows(hybrid.cells(FOUND))
    assert found[0] == ["replay", "gravity", "7,169 ± 1,014", "4,686 ± 0", "-280 ± 0"]
    assert [row[3] for row in found] == ["4,686 ± 0", "4,686 ± 0", "5,927 ± 507", "5,927 ± 507"]
    assert [row[2] for row in found][2:] == ["9,652 ± 0", "-"]
    assert [row[4] for row in found] == ["-280 ± 0", "3,444 ± 0"] * 2


def test_the_mean_over_simulators_needs_all_of_them():
    found = rows(hybrid.headline(FOUND))
    assert found[0][1].startswith("40.0 [") and found[0][2:] == ["40.0", "15.0"]
    assert found[1][1] == "-" and found[1][2].startswith("50.0 [") and found[1][3] == "15.0"


def test_intervals_draw_seeds_within_a_simulator():
    """The spread between simulators, 60 and 20, does not widen the mean of 50, 60, 70 and of 10, 20, 30."""
    band = hybrid.overall(FOUND, "h2oplus", "replay")
    assert band is not None and band.estimate == pytest.approx(40) and 30 < band.low < 36 and 44 < band.high < 50
    alone = hybrid.overall(results(run("iql", "replay", "", of_scale(40, 50, 60))), "iql", "replay")
    # one run, not two strata: a resample of three has the std 8.165 / sqrt(3) = 4.7
    assert alone is not None and alone.low == pytest.approx(40, abs=3.4) and alone.high == pytest.approx(60, abs=3.4)
    few = hybrid.overall(results(run("iql", "replay", "", of_scale(40, 50))), "iql", "replay")
    assert few is not None and np.isnan(few.low)


def test_two_seeds_on_many_simulators_give_no_interval():
    found = results(*(run("h2oplus", "replay", gap, of_scale(1, 2)) for gap in ("gravity", "friction")))
    band = hybrid.overall(found, "h2oplus", "replay")
    assert band is not None and np.isnan(band.low)


def test_probability_of_improvement():
    """On gravity all seeds are better than IQL's 40, on friction none; of IQL's medium on gravity alone, all."""
    found = rows(hybrid.duels(FOUND, "h2oplus"))
    assert found[0][1].startswith("50") and found[1][1].startswith("100")
    # SAC: all are better on gravity; on friction 10, 20, 30 against 30: half of a third, 1/6; mean 58 %
    assert found[0][2].startswith("58 ")


def test_tasks_without_a_scale_are_in_their_own():
    found = results(run("iql", "replay", "", [0.25, 0.75, 0.5], task="toy", score="success"))
    assert rows(hybrid.headline(found))[0][2].startswith("50 [")
    assert rows(hybrid.cells(found))[0][3] == "50 ± 20"
    assert rows(hybrid.cells(found))[2][3] == "-"


def test_the_order_of_methods_in_two_sets_of_runs():
    """Ranks 1, 2, 3 against 1, 3, 2: covariance 1 of variances 2, so a half. Seeds decide between h2oplus and iql."""
    here = {"h2oplus": (50, 50, 50), "iql": (40, 40, 40), "sac": (0, 0, 0)}
    there = {"h2oplus": (39, 39, 45), "iql": (42, 42, 42, 42), "sac": (0, 0, 0)}
    ours, theirs = (
        results(*(run(m, "replay", "gravity", scores) for m, scores in each.items())) for each in (here, there)
    )
    assert rows(hybrid.ranks(ours, theirs)) == [
        ["replay", "gravity", "0.50 [0.50, 1.00]", "h2oplus, iql, sac", "iql, h2oplus, sac"]
    ]
    pairs = [(curve.values[:, -1],) * 2 for curve in ours.curves]
    assert hybrid.agreement(pairs).estimate == pytest.approx(1)
    assert rows(hybrid.ranks(ours, ours._replace(curves=ours.curves[:2]))) == []  # two methods have no order


def test_what_else_a_task_is_judged_by():
    """Seconds of two seeds at two evaluations, the last ones 8 and 9. Without a measure a cell is empty."""
    standing = np.array([[1.0, 8.0], [2.0, 9.0]])
    found = results(
        run("h2oplus", "replay", "gravity", [0, 0], upright_s=standing),
        run("iql", "replay", "", [0, 0], upright_s=standing, speed_error=standing / 100),
    )
    shown = hybrid.measured(found)
    assert shown is not None and shown.startswith("| measure | data | simulator | h2oplus | iql | sac |\n")
    assert rows(shown)[:2] == [
        ["upright_s", "replay", "gravity", "8.50", "8.50", "-"],
        ["upright_s", "replay", "friction", "-", "8.50", "-"],
    ]
    assert ["speed_error", "replay", "gravity", "-", "0.08", "-"] in rows(shown)  # 0.085, to the even digit
    assert hybrid.measured(FOUND) is None


def test_the_last_ten_evaluations_of_each_seed():
    curve = np.arange(24.0).reshape(12, 2)
    np.testing.assert_allclose(late(curve), [13, 14])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed-0": "nan"}, "seed-0 is nan, not a finite number"),
        ({"step": "0.5"}, "step is 0.5, not a whole number from 0 on"),
        ({"updates": "-1"}, "updates is -1, not a whole number from 0 on"),
        ({"seed-0": ""}, "a run of iql on toy has no seed"),
    ],
)
def test_tables_with_odd_numbers_are_refused(change, words, tmp_path):
    cells = dict.fromkeys(release.RUN, "x") | {"task": "toy", "method": "iql", "commit": "c", "updates": "5"}
    cells |= {"score": "success", "step": "5", "seed-0": "0.5", **change}
    (tmp_path / "hybrid.csv").write_text(",".join(cells) + "\n" + ",".join(cells.values()) + "\n")
    with pytest.raises(UserError, match=f"hybrid.csv: {words}; put the table back as it was"):
        release.read_hybrid(tmp_path)
