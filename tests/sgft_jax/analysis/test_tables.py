"""Tables of learning curves: cells by hand."""

import dataclasses
import math

import numpy as np
import pytest
from test_curves import curve

from sgft_jax.analysis import tables
from sgft_jax.math.stats import Interval


def cells(table):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


@pytest.mark.parametrize(
    ("band", "score", "text"),
    [
        ((0.923, 0.88, 0.951), "success", "92 [88, 95]"),
        ((0.923, math.nan, math.nan), "success", "92"),  # too few seeds for an interval
        ((1.0, 1.0, 1.0), "success", "100"),  # all agree: the bootstrap has nothing to say
        ((-0.001, -0.2, 0.0), "success", "0 [-20, 0]"),
        ((12.34, 10.0, 15.0), "return", "12.3 [10.0, 15.0]"),
    ],
)
def test_how_a_number_is_written(band, score, text):
    assert tables.number(Interval(*map(np.asarray, band)), score) == text


def test_a_row_says_what_the_curve_says():
    """Two seeds, no intervals. Grid 0, 2, 4, as `often` was evaluated there too; area of the means 0.3, 0.95, 1:
    (0.3 + 0.95) + (0.95 + 1) = 3.2 of 4 rollouts, 80 %; the fall from 0.3 to 0.1 is 20 points.
    """
    often = curve([[0.2, 0.1, 0.9, 1.0], [0.4, 0.1, 1.0, 1.0]], method="mbpo")
    seldom = curve([[0.0, 0.0, 0.5, 0.5]] * 2, (0, 2, 4, 10))
    head, _, first, second = cells(tables.summary([often, seldom]))
    assert head == [
        "method",
        "seeds",
        "start",
        "area, 0 to 4 rollouts",
        "end (rollouts)",
        "deepest fall: zero-shot / own start",
        "training",
        "90 % held after",
        "area minus mbpo",
        "P(better than mbpo)",
    ]
    assert first == ["mbpo", "2", "30", "80", "100 (4)", "20 / 20", "-", "40", "-", "-"]
    assert second == ["sac", "2", "0", "12", "50 (10)", "0 / 0", "-", "> 200", "-68", "0.00"]
    assert len(cells(tables.summary([often]))[0]) == 8  # nothing to compare with


def test_a_return_is_never_held():
    """It has no best value that a policy could come near."""
    (row,) = cells(tables.summary([curve([[-300.0, 40.0, 40.0]], (0, 2, 4), score="return")]))[2:]
    assert row[-1] == "-"


def test_a_method_that_plans_is_held_against_the_policy_too():
    """Plans begin at 0.5 and fall to 0.4; the policy had 0.7. The robot lived through 0.25 while exploring."""
    plans = dataclasses.replace(curve([0.5, 0.4], (0, 4), method="sgft-mpc"), training=np.array([[np.nan, 0.25]]))
    row = cells(tables.summary([plans, curve([0.7, 0.7], (0, 4))]))[2]
    assert row[5:7] == ["30 / 10", "25"]


def test_a_pair_of_runs_with_the_same_options_is_compared_like_any_other():
    """An A/A pair, three priors: variant b is better from one of them, equal from another, worse from the third."""
    a, b = np.array([[0.2], [0.5], [0.8]]), np.array([[0.3], [0.5], [0.7]])
    pair = [curve(np.repeat(x, 2, 1), (0, 4), variant=v, prior=[0, 1, 2]) for v, x in (("a", a), ("b", b))]
    head, _, first, second = cells(tables.summary(pair, "sac:a"))
    assert head[-2:] == ["area minus sac:a", "P(better than sac:a)"]
    assert first[-2:] == ["-", "-"] and second[-2:] == ["0 [-10, 10]", "0.50 [0.00, 1.00]"]
    assert len(cells(tables.summary(pair, "mbpo"))[0]) == 8  # a table without it


def test_a_short_run_and_variants_do_not_shorten_the_grid():
    curves = [curve([0, 0, 0, 1], (0, 5, 10, n), method=m) for m, n in (("mbpo", 90), ("sac", 90))]
    short, variant = curve([0, 1], (0, 5), method="iql"), curve([0, 1], (0, 7), variant="x")
    assert tables.shared_grid([*curves, short, variant]).tolist() == [0, 5, 10, 90]
    assert cells(tables.summary([*curves, short]))[-1][3] == "-"
    assert tables.shared_grid([variant]).tolist() == [0, 7]


def test_differences_are_paired_and_from_the_best():
    """Each of three seeds of `mbpo` is 0.2 above the same seed of `sac`, so there is no spread."""
    low, high = np.array([[0.0], [0.3], [0.6]]), np.array([[0.2], [0.5], [0.8]])
    curves = [curve(np.repeat(x, 2, 1), (0, 4), method=m) for m, x in (("sac", low), ("mbpo", high))]
    row = cells(tables.summary(curves))[2]
    assert row[-2:] == ["-20", "0.00"]


def test_all_tasks():
    """`sac` ran on both tasks, three seeds each: all areas are 1 and 0, whose middle half is 1, 1, 0, 0."""
    one, zero = (curve([[x, x]] * 3, (0, 4)) for x in (1.0, 0.0))
    other = curve([[0.5, 0.5]] * 3, (0, 4), method="mbpo")
    head, _, *rows = cells(tables.areas_by_task({"hammer": [one, other], "push": [zero]}))
    assert head == ["area", "hammer, to 4 rollouts", "push, to 4 rollouts", "all tasks"]
    assert rows == [["sac", "100", "0", "50"], ["mbpo", "50", "-", "-"]]
    assert tables.leading({"hammer": [one, other], "push": [zero]}, 1) == ["sac"]


def test_the_outcome_has_a_column_for_each_evaluation():
    table = tables.outcome([curve([0.0, 0.9], (0, 5)), curve([0.0, 0.5, 1.0], (0, 1, 5), method="mbpo")])
    assert cells(table) == [
        ["method", "zero-shot", "1 rollout", "5 rollouts"],
        ["---"] * 4,
        ["sac", "0", "-", "90"],
        ["mbpo", "0", "50", "100"],
    ]
