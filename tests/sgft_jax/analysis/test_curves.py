"""Learning curves by hand: metrics, what is comparable, run folders."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from runs_by_hand import save

from envs.rollout import Episode
from envs.types import UserError
from sgft_jax.analysis.curves import (
    Curve,
    area,
    at,
    by_prior,
    by_priors,
    common_grid,
    deepest_fall,
    describe,
    from_main_priors,
    improvement,
    make_curve,
    spread,
    training_score,
    transitions_until_held,
    zero_shot,
)
from sgft_jax.analysis.reading import read_curve, read_runs, set_name
from sgft_jax.analysis.release import COLUMNS, from_rows, read_data, rows


def curve(values, rollouts=(0, 1, 2, 4), *, method="sac", variant="", priors="fast", prior=None, score="success"):
    values, rollouts = np.atleast_2d(np.asarray(values, float)), np.asarray(rollouts)
    return Curve(
        "toy",
        "default",
        method,
        variant,
        priors,
        seeds=np.arange(len(values)),
        x=rollouts,
        scores={score: values},
        score=score,
        prior=np.asarray(-1 if prior is None else prior),
        transitions=20 * rollouts,
        minutes=rollouts / 30,
    )


def test_area_is_on_the_common_grid():
    """One method was evaluated more often than the other. Of both count 0, 2 and 4 rollouts: (0.2 + 0.6) / 2 * 2 +
    (0.6 + 1) / 2 * 2 = 2.4 over 4 rollouts, 0.6, whatever the first one scored after one rollout.
    """
    often, seldom = curve([0.2, 0.9, 0.6, 1.0]), curve([0.2, 0.6, 1.0, 1.0], (0, 2, 4, 8))
    grid = common_grid([often, seldom])
    assert grid.tolist() == [0, 2, 4]
    assert area(often, grid) == area(seldom, grid) == pytest.approx(0.6)
    assert area(often, [0, 2, 8]) is None and area(often, [0]) is None  # not evaluated there; no area
    assert at(often, 1) == [0.9] and at(often, 3) is None


def test_a_level_is_held_at_two_evaluations_in_a_row():
    """Success after one rollout is gone after two; it stays from the third evaluation, after 40 transitions, on."""
    assert transitions_until_held(curve([0.1, 0.95, 0.5, 0.9], (0, 1, 2, 3))) is None
    assert transitions_until_held(curve([0.1, 0.95, 0.5, 0.9, 1.0], (0, 1, 2, 3, 4))) == 60
    assert transitions_until_held(curve([[0.94, 0.94], [0.84, 0.84], [0.92, 0.92]], (0, 1))) == 0  # 2.7 of three
    assert transitions_until_held(curve([1.0], (0,))) is None


def test_deepest_fall_is_of_the_mean():
    assert deepest_fall(curve([[0.6, 0.2, 0.9], [0.4, 0.6, 0.9]], (0, 1, 2))) == pytest.approx(0.1)  # 0.5 to 0.4
    assert deepest_fall(curve([0.5, 0.6, 0.9], (0, 1, 2))) == 0.0
    assert deepest_fall(curve([0.5, 0.6, 0.9], (0, 1, 2)), np.array([0.7, 0.9])) == pytest.approx(0.3)
    assert deepest_fall(curve([0.5, 0.6, 0.9], (0, 1, 2)), np.array([0.4])) == 0.0


def test_zero_shot_is_where_the_simulators_policy_was_evaluated():
    """A method that begins with plans, or from nothing, is held against the same seeds of one that does not."""
    plans, nothing = curve([[0.9, 1], [0.8, 1]], (0, 1), method="sgft-mpc"), curve([[0, 1]], (0, 1), method="rlpd")
    policy, late = curve([[0.2, 0], [0.4, 0]], (0, 1), method="sac"), curve([[0.7, 0]] * 2, (1, 2), method="mbpo")
    others = [plans, nothing, late, policy]
    assert zero_shot(policy, others).tolist() == zero_shot(plans, others).tolist() == [0.2, 0.4]
    assert zero_shot(nothing, others).tolist() == [0.2]  # it has the first seed alone
    assert zero_shot(plans, [plans, nothing, late]) is None
    more = curve([[0, 0]] * 3, (0, 1), method="iql")
    assert zero_shot(more, [more, policy]) is None


def test_training_rollouts_count_once_each():
    """Evaluated after 1, 2 and 4 rollouts, of which the third and the fourth scored 0.5 on average."""
    own = dataclasses.replace(curve([0, 0, 0, 0]), training=np.array([[np.nan, 1.0, 0.0, 0.5]]))
    assert training_score(own) == pytest.approx([0.5]) and training_score(curve([0])) is None
    assert own.of("success").training is own.training and own.of("return").training is None


@pytest.mark.parametrize("priors", [[0, 0, 1, 1], None])
def test_improvement_of_areas_is_by_prior_or_else_by_seed(priors):
    """By seed 1, 0, 1, 1; from the first prior 0.5 against 0 and 0.3: 1; 0.1 against 0.2: 0; that is 2 of 4."""
    high, low = (
        curve(np.repeat(x, 2, 1), (0, 4), prior=priors)
        for x in (np.array([[0.5], [0.1], [1], [1]]), np.array([[0.0], [0.2], [0], [0]]))
    )
    found = improvement(high, low, [0, 4])
    assert found.estimate == (pytest.approx((0.75 + 1) / 2) if priors else 0.75)
    assert improvement(high, low, [0, 8]) is None
    assert improvement(high, dataclasses.replace(low, prior=low.prior - 5, seeds=low.seeds + 9), [0, 4]) is None


def test_spread_is_over_priors_where_there_are_three():
    values = [[0.0], [0.5], [1.0]] * 4
    assert by_prior(curve(values, (0,), prior=[0, 1, 2] * 4))
    assert spread(curve(values, (0,), prior=[0, 1, 2] * 4), np.ravel(values)).low == 0.0
    two = curve(values, (0,), prior=[0, 1, 0] * 4)
    assert not by_prior(two) and spread(two, np.ravel(values)).low > 0.0
    assert not by_prior(curve(values, (0,)))  # unknown


def test_any_score():
    returns = curve([[-3.0, 5.0], [-1.0, 7.0]], (0, 1), score="return")
    assert describe(returns)["final"]["return"]["mean"] == 6.0 and "success" not in describe(returns)["final"]
    np.testing.assert_array_equal(area(returns, [0, 1]), [1.0, 3.0])
    both = dataclasses.replace(returns, scores={**returns.scores, "success": np.zeros((2, 2))})
    assert both.of("success").values.sum() == 0.0 and both.values.sum() == 8.0


def test_the_numbers_of_a_run():
    """Means 0.3, 0.1, 0.9, 1.0; 90 % held from 2 rollouts of 20 transitions on; two seeds tell no interval."""
    found = describe(curve([[0.2, 0.1, 0.8, 1.0], [0.4, 0.1, 1.0, 1.0]]))
    assert found["zero_shot"]["success"]["mean"] == pytest.approx(0.3)
    assert found["final"] == {
        "rollouts": 4,
        "transitions": 80,
        "robot_minutes": pytest.approx(4 / 30),
        "success": {
            "iqm": 1.0,
            "low": pytest.approx(np.nan, nan_ok=True),
            "high": pytest.approx(np.nan, nan_ok=True),
            "mean": 1.0,
        },
    }
    assert found["deepest_fall"] == pytest.approx(0.2) and found["seeds"] == 2
    assert found["transitions_until_held"] == {"level": 0.9, "transitions": 40}


def test_only_methods_from_the_same_priors_are_comparable():
    """Two methods began from `fast-2`, so that set counts; TD-MPC2 cannot begin from it and has a set of its own."""
    curves = [
        curve([0, 0, 0, 0], method=method, priors=priors, variant=variant)
        for method, priors, variant in (
            ("mbpo", "fast", ""),
            ("mbpo", "fast-2", ""),
            ("sac", "fast-2", ""),
            ("tdmpc2", "tdmpc2", ""),
            ("sac", "fast", "tuned"),
            ("mine", "fast-2", ""),
        )
    ]
    chosen = [(c.method, c.priors) for c in from_main_priors(curves)]
    assert chosen == [("tdmpc2", "tdmpc2"), ("mbpo", "fast-2"), ("sac", "fast-2"), ("mine", "fast-2")]
    sets = by_priors(curves)
    assert next(iter(sets)) == "fast-2" and [c.name for c in sets["fast"]] == ["mbpo", "sac tuned"]
    assert {c.method: c.family for c in curves}["tdmpc2"] == "planning" and curves[-1].family == "own"


@pytest.mark.parametrize(
    "folder", ["fast", "runs/pretrain/push/fast/seeds-0-11", "x/fast/seed-3/prior", "fast/prior/seed-2"]
)
def test_a_set_of_priors_is_named_like_its_preset(folder):
    assert set_name(Path(folder), ["aaaaaaaaaaaa", "bbbbbbbbbbbb"]) == "fast-aaaaaa"


def test_a_set_of_priors_without_a_folder_or_a_digest():
    assert set_name(Path("shipped:push"), []) == "push" and set_name(Path(), ["aaaaaaaaaaaa"]) == "aaaaaa"


def test_a_run_folder(tmp_path):
    digests = ("aaaaaaaaaaaa", "bbbbbbbbbbbb")
    success = [[0.2, 0.4, 0.3], [0.8, 1.0, 0.5]]
    folder = save(
        tmp_path, "my_own_v2", success, rollouts=[0, 20], seeds="seeds-3-5", priors=digests, variant="v2", wanted=100
    )
    scores = {0: None, 2: [0.1, 0.2, 0.3], **dict.fromkeys(range(3, 21), [0.9] * 3), 21: [0.0] * 3}
    lines = [{"rollouts": n} | ({"real/score": each} if each else {}) for n, each in scores.items()]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (found,), notes = read_runs(tmp_path)
    assert (found.task, found.gap, found.method, found.variant) == ("toy", "default", "my_own", "v2")
    assert found.priors == "fast-aaaaaa" and found.seeds.tolist() == [3, 4, 5] and found.prior.tolist() == [1, 0, 1]
    np.testing.assert_array_equal(found.values, np.transpose(success))
    np.testing.assert_array_equal(found.of("return").values, 10 * np.transpose(success))
    assert found.transitions.tolist() == [0, 400] and found.minutes[1] == pytest.approx(40 / 60)
    # initial rollouts 1 and 2 scored 0.1, 0.2, 0.3, those from 3 to 20 on average 0.9 for all
    np.testing.assert_allclose(found.training, [[np.nan, 0.82], [np.nan, 0.83], [np.nan, 0.84]])
    assert found.facts["commit"] == "0123456789ab" and found.facts["options.network.hidden"] == "8 8"
    assert notes == [f"{tmp_path / 'finetune/toy/default/my_own_v2/seeds-3-5'}: unfinished, 20 of 100 rollouts"]


@pytest.mark.parametrize("score", ["success", "return"])
def test_an_unfinished_run_is_judged_as_its_task_is(tmp_path, score):
    """Its summary does not exist yet. A task such as halfcheetah never succeeds, and success says nothing of it."""
    folder = save(tmp_path, "sac", [[0.2, 0.4], [0.8, 1.0]], rollouts=[0, 20], wanted=100)
    lines = [json.loads(line) for line in (folder / "eval.jsonl").read_text().splitlines()]
    (folder / "eval.jsonl").write_text("".join(json.dumps(line | {"score": line[score]}) + "\n" for line in lines))
    assert read_curve(folder).score == score


def test_of_several_runs_that_with_the_most_seeds(tmp_path):
    save(tmp_path, "sac", [[0.2], [0.3]], rollouts=[0, 90], seeds="seed-0")
    save(tmp_path, "sac", [[0.2, 0.4], [0.8, 1.0]], rollouts=[0, 20])
    (tmp_path / "finetune/toy/default/mbpo/seed-0").mkdir(parents=True)
    found, notes = read_runs(tmp_path)
    assert [len(c.seeds) for c in found] == [2]
    assert "holds no evaluation yet" in notes[0] and "seed-0: left out, seeds-0-1 has more seeds" in notes[1]


def test_runs_of_other_seeds_are_one_curve(tmp_path):
    """As those of a robot, which plays one seed at a time. Another grid of evaluations does not fit."""
    save(tmp_path, "sac", [[0.2], [0.3]], rollouts=[0, 20], seeds="seed-7")
    save(tmp_path, "sac", [[0.3, 0.4], [0.8, 1.0]], rollouts=[0, 20], seeds="seeds-3-4")
    save(tmp_path, "sac", [[0.5], [0.6]], rollouts=[0, 10], seeds="seed-5")
    (found,), (note,) = read_runs(tmp_path)
    assert found.seeds.tolist() == [3, 4, 7] and len(found.prior) == 3
    np.testing.assert_array_equal(found.values, [[0.3, 0.8], [0.4, 1.0], [0.2, 0.3]])
    assert "seed-5: left out" in note and "cannot be put together" in note
    with pytest.raises(UserError, match=r"mbpo/seed-0: no such folder$"):
        read_curve(tmp_path / "finetune/toy/default/mbpo/seed-0")
    with pytest.raises(UserError, match="holds no evaluation yet"):
        read_curve(tmp_path)


def test_a_flat_table_and_back():
    original = [curve([[0.1, 0.2, 0.3, 0.4], [0, 0, 1, 1]], prior=[0, 1]), curve([1, 2, 3, 4], score="return")]
    original[1] = dataclasses.replace(original[1], variant="x", training=np.array([[np.nan, 0.5, 0.2, 1.0]]))
    table = list(rows(original))
    assert len(table) == 8 + 4 and table[1]["rollouts"] == 1 and table[1]["success"] == 0.2
    for one, other in zip(original, from_rows(table), strict=True):
        assert (one.name, one.priors, one.score) == (other.name, other.priors, other.score)
        for name in ("seeds", "prior", "x", "transitions", "minutes", "values"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert (one.training is None) == (other.training is None)
    np.testing.assert_array_equal(from_rows(table)[1].training, original[1].training)
    with pytest.raises(UserError, match="not evaluated after the same rollouts"):
        from_rows(table[:7])


@pytest.mark.parametrize(
    ("name", "cell", "words"),
    [
        ("success", "nan", "success is nan, not a finite number"),
        ("success", "1.5", "success is 0 to 1.5, not a share"),
        ("success", "-0.5", "success is -0.5 to 0, not a share"),
        ("minutes", "inf", "minutes is inf, not a finite number"),
        ("minutes", "-1", "minutes is -1, less than 0"),
        ("rollouts", "0.5", "rollouts is 0.5, not a whole number from 0 on"),
        ("transitions", "1e30", "transitions is 1e30, not a whole number from 0 on"),
        ("seed", "-1", "seed is -1, not a whole number from 0 on"),
        ("prior", "-2", "prior is -1.0, not a whole number from 0 on"),
        ("training", "inf", "training is inf, not a finite number"),
        ("success", "", "toy/default/sac//fast has no success or return"),
    ],
)
def test_tables_with_odd_numbers_are_refused(name, cell, words, tmp_path):
    table = list(rows([dataclasses.replace(curve([0.0, 0.0], (0, 1)))]))
    odd = [{**dict.fromkeys(COLUMNS, ""), **row, name: cell} for row in table[:1]] + table[1:]
    lines = [",".join(str(row.get(column, "")) for column in COLUMNS) for row in odd]
    (tmp_path / "curves-toy.csv").write_text("\n".join([",".join(COLUMNS), *lines]) + "\n")
    with pytest.raises(UserError, match=f"curves-.*csv: {words}; put the tables back as they were"):
        read_data(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"success": [0.1]}, "its records are of 1 or 2 seeds"),
        ({"success": None}, "success is null, not a list"),
        ({"rollouts": "20"}, "rollouts is a text"),
        ({"robot_minutes": -1}, "robot_minutes: expected float >= 0"),
    ],
)
def test_evaluations_that_no_run_has_written_are_refused(change, words, tmp_path):
    folder = save(tmp_path, "sac", [[0.2, 0.4], [0.8, 1.0]], rollouts=[0, 20])
    lines = [json.loads(line) for line in (folder / "eval.jsonl").read_text().splitlines()]
    lines[1] |= change
    (folder / "eval.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(UserError, match=words):
        read_curve(folder)


def test_a_summary_of_another_score_is_refused(tmp_path):
    folder = save(tmp_path, "sac", [[0.2, 0.4], [0.8, 1.0]], rollouts=[0, 20])
    (folder / "summary.json").write_text('{"score": "fame"}')
    with pytest.raises(UserError, match=r"summary.json: score is 'fame', eval.jsonl has success, return"):
        read_curve(folder)


def test_a_curve_from_python_counts_what_it_is_told():
    """Two rollouts of seven steps together; of two episodes one exploded, and its part of the cost is no return."""
    total, exploded = np.array([[-12.0, -2.0]]), np.array([[False, True]])
    score, no = np.where(exploded, -np.inf, total), np.zeros((1, 2), bool)
    task = SimpleNamespace(name="toy", episode_length=20, control_dt=0.1, score="return")
    played = {
        0: Episode(None, None, total, no, no, total, None, None),
        2: Episode(None, None, total, no, exploded, score, None, None),
    }
    given = {"gap": "default", "method": "sac", "seeds": [0]}
    found = make_curve(played, task, transitions=[0, 7], **given)
    assert found.transitions.tolist() == [0, 7] and found.minutes[1] == pytest.approx(0.7 / 60)
    assert found.values.tolist() == [[-7, -12]]
    assert make_curve(played, task, **given).transitions.tolist() == [0, 40]
