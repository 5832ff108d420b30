"""TD-MPC2 from nothing through the command, on the point mass instead of the cartpole."""

import json

import numpy as np
import pytest
import toy

from experiments import cli, learning_curve
from experiments.learning_curve import LearningCurveArgs, main
from sgft_jax.io.log import MetricsLog, read_jsonl
from sgft_jax.learners import tdmpc2_model
from sgft_jax.types import UserError

SMALL = {
    "seeds": 2, "steps": 100, "random_steps": 40, "size": "tiny", "plan_samples": 24, "batch_size": 8,
    "eval_every": 2, "eval_episodes": 3,
}  # fmt: skip


@pytest.fixture(autouse=True)
def _toy(monkeypatch):
    monkeypatch.setattr(learning_curve.cartpole, "make", toy.make)
    monkeypatch.setitem(tdmpc2_model.SIZES, "tiny", tdmpc2_model.Size(8, 8, 8, 2, 2))
    monkeypatch.setattr(cli, "set_up", lambda: None)


@pytest.mark.slow
def test_a_run_and_one_that_was_stopped_and_resumed(tmp_path, capsys):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    main(LearningCurveArgs(out=whole, **SMALL))
    assert "published 3 (2 to 5) after 0 control steps" in capsys.readouterr().out
    main(LearningCurveArgs(out=parts, minutes=0.0, **SMALL))
    assert "stopped after 0 minutes" in capsys.readouterr().out
    main(LearningCurveArgs(out=parts, resume=True, **SMALL))
    folders = [out / "learning_curve/toy/tiny/seeds-0-1" for out in (whole, parts)]
    for name in ("eval.jsonl", "metrics.jsonl"):
        assert read_jsonl(folders[0] / name) == read_jsonl(folders[1] / name)
    records = read_jsonl(folders[0] / "metrics.jsonl")
    assert [r["step"] for r in records] == [40, 60, 80, 100]  # 2 random episodes of 20 steps, then one after another
    assert records[0]["return"][0] != records[0]["return"][1]  # the seeds differ
    assert [r["step"] for r in read_jsonl(folders[0] / "eval.jsonl")] == [0, 40, 80, 100]
    summary = json.loads((folders[0] / "summary.json").read_text())
    assert summary["ours"]["steps"] == 100 and len(summary["ours"]["seeds"]) == 2
    assert (folders[0] / "figures/return.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("length", "wanted"),
    # (T / 5 - 1) / (T / 5): 99 / 100, 7 / 8 and 399 / 400, within [0.95, 0.995]
    [(500, 0.99), (40, 0.95), (2000, 0.995)],
)
def test_the_authors_discount_factor(length, wanted):
    assert learning_curve.discount(length) == pytest.approx(wanted)


def test_the_published_curve_is_whole():
    assert np.shape(learning_curve.PUBLISHED) == (3, len(learning_curve.PUBLISHED_STEPS))


def test_a_run_is_compared_at_the_last_published_point_it_has_reached(tmp_path):
    log = MetricsLog(tmp_path, tensorboard=False)
    for step, returns in ((0, [1.0, 3.0]), (60_000, [840.0, 860.0])):
        log.eval(step, {"return": returns})
    # (860.5 + 789.8 + 867.9) / 3 = 839.4
    words = "ours 850 (840 to 860) after 60,000, published 839 (790 to 868) after 50,000 control steps"
    assert words in learning_curve.report(tmp_path)


def test_numbers_below_one_are_refused(tmp_path):
    with pytest.raises(UserError, match="--eval-every is 0: must be at least 1"):
        main(LearningCurveArgs(out=tmp_path, eval_every=0))
