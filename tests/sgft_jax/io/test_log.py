import json
import time

import jax.numpy as jnp
import numpy as np
import pytest

from envs.files import Count
from envs.types import UserError
from sgft_jax.io import log
from sgft_jax.io.log import DivergedError, MetricsLog, check_finite, read_jsonl, write_summary

# ---------------------------------------------------------------- metrics


def quiet(folder):
    return MetricsLog(folder, tensorboard=False)


def test_one_json_object_a_line(tmp_path):
    logged = quiet(tmp_path)
    logged.metrics(10, {"loss/critic": jnp.float32(0.1), "per_seed": jnp.array([1.0, jnp.nan])})
    logged.metrics(20, {"loss/critic": float("inf")})
    logged.eval(20, {"success": np.float64(0.5)})
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert lines == [
        '{"step": 10, "loss/critic": 0.1, "per_seed": [1.0, "nan"]}',
        '{"step": 20, "loss/critic": "inf"}',
    ]
    assert read_jsonl(tmp_path / "eval.jsonl") == [{"step": 20, "success": 0.5}]
    first, second = read_jsonl(tmp_path / "metrics.jsonl")
    assert np.isnan(first["per_seed"][1]) and second["loss/critic"] == np.inf


def test_an_interrupted_run_leaves_the_lines_of_an_uninterrupted_one(tmp_path):
    def run(folder, steps):
        logged = quiet(folder)
        for step in steps:
            logged.metrics(step, {"x": step / 3})
            logged.eval(step, {"y": -step})

    run(tmp_path / "whole", range(6))
    run(tmp_path / "cut", range(3))
    position = quiet(tmp_path / "cut").position()  # the checkpoint after step 2
    run(tmp_path / "cut", range(3, 5))  # ... killed after step 4, in the middle of a line
    with open(tmp_path / "cut" / "metrics.jsonl", "a") as file:
        file.write('{"step": 5, "x"')
    resumed = quiet(tmp_path / "cut")
    resumed.truncate(json.loads(json.dumps(position)))
    run(tmp_path / "cut", range(3, 6))
    for name in (log.METRICS, log.EVAL):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_truncate_to_nothing_and_to_too_much(tmp_path):
    logged = quiet(tmp_path)
    assert logged.position() == {"metrics.jsonl": 0, "eval.jsonl": 0}
    logged.truncate({})
    logged.metrics(1, {})
    logged.truncate({})
    assert (tmp_path / "metrics.jsonl").read_bytes() == b""
    with pytest.raises(UserError, match=r"metrics.jsonl: cut or replaced: it has 0 bytes, the checkpoint remembers 5"):
        logged.truncate({"metrics.jsonl": 5})


def test_reading_stops_before_a_torn_line_and_names_a_bad_one(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1}\n{"step": 2, "lo')
    assert read_jsonl(path) == [{"step": 1}]
    path.write_text('{"step": 1}\nnonsense\n')
    with pytest.raises(UserError, match=r"metrics.jsonl:2: not valid JSON"):
        read_jsonl(path)
    with pytest.raises(UserError, match="no such file"):
        read_jsonl(tmp_path / "other.jsonl")


def test_tensorboard_mirror(tmp_path):
    logged = MetricsLog(tmp_path)
    logged.metrics(1, {"a": 2.0, "seeds": [1.0, 2.0], "bad": float("nan"), "name": "hammer"})
    logged.eval(1, {"a": 3.0})
    logged.close()
    (events,) = (tmp_path / "tensorboard").iterdir()
    content = events.read_bytes()
    assert b"eval/a" in content and b"seeds" in content
    assert b"bad" not in content and b"hammer" not in content
    logged.metrics(2, {"a": 1.0})  # a closed log opens again
    logged.close()


def test_summary(tmp_path):
    path = write_summary(tmp_path, {"success": jnp.float32(0.75), "never": None})
    assert json.loads(path.read_text()) == {"success": 0.75, "never": None}


# ---------------------------------------------------------------- numbers that are not finite


@pytest.mark.parametrize(
    ("value", "members"),
    [
        (float("nan"), ""),
        (jnp.array([1.0, jnp.inf, 2.0]), " of 1 of 3 members"),
        (np.array([-np.inf, np.nan]), " of 2 of 2 members"),
    ],
)
def test_a_metric_that_is_not_finite_stops_the_run_in_one_line(tmp_path, value, members):
    with pytest.raises(DivergedError) as stopped:
        check_finite({"actor/loss": 1.0, "critic/loss": value}, 1200, unit="rollouts", last_good=tmp_path / "10")
    said = str(stopped.value)
    assert said.startswith(f"training has diverged: critic/loss{members} is not finite after 1,200 rollouts; ")
    assert f"the last good checkpoint is {tmp_path / '10'}" in said and "\n" not in said


def test_without_a_checkpoint_it_says_so_and_finite_metrics_pass():
    check_finite({"critic/loss": jnp.ones(3), "step": 3}, 1, unit="steps", last_good=None)
    with pytest.raises(DivergedError, match="there is no checkpoint from before"):
        check_finite({"critic/loss": jnp.float32(jnp.nan)}, 1, unit="steps", last_good=None)


# ---------------------------------------------------------------- logs that nobody wrote


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff\xfe\n", "is no UTF-8 text"),
        (b"[1]\n", "eval.jsonl:1: is no JSON object"),
        (b'{"step": 1, "score": [1]}\nnull\n', "eval.jsonl:2: is no JSON object"),
        (b'{"step": 1, "score": [1], "deep": ' + b"[" * 100_000 + b"]" * 100_000 + b"}\n", "nested too deeply"),
        (b'{"step": 1, "score": [1], "deep": ' + b"[" * 3000 + b"]" * 3000 + b"}\n", "nested too deeply"),
        (b'{"step": 1, "score": [NaN]}\n', "NaN is no finite number"),
        (b'{"step": 1}\n', "eval.jsonl:1: lacks score"),
        (b'{"step": "1", "score": [1]}\n', "eval.jsonl:1: step is a text, not a whole number"),
        (b'{"step": -1, "score": [1]}\n', "eval.jsonl:1: step: expected int >= 0"),
        (b'{"step": 1, "score": 1}\n', "eval.jsonl:1: score is a whole number, not a list"),
        (b'{"step": 1, "score": [null]}\n', "is null, not a number"),
        (b'{"step": 1, "score": []}\n', "its records are of 0 seeds"),
        (b'{"step": 1, "score": [1]}\n{"step": 2, "score": [1, 2]}\n', "its records are of 1 or 2 seeds"),
        (b"", "holds no record"),
    ],
)
def test_records_that_no_run_has_written_are_refused(content, words, tmp_path):
    (tmp_path / "eval.jsonl").write_bytes(content)
    with pytest.raises(UserError, match=words) as error:
        read_jsonl(tmp_path / "eval.jsonl", {"step": Count, "score": list[float]})
    assert "\n" not in str(error.value)


def test_records_may_hold_more_and_numbers_that_are_not_finite(tmp_path):
    (tmp_path / "eval.jsonl").write_text('{"step": 1, "real/score": ["nan", 2], "more": {}}\n')
    (record,) = read_jsonl(tmp_path / "eval.jsonl", {"step": Count, "real/score": list[float]})
    assert np.isnan(record["real/score"][0]) and record["more"] == {}


def test_clock_adds_up():
    clock = log.Clock()
    clock.seconds = {"train": 10.0}
    for phase in ("train", "evaluate"):
        with clock(phase):
            time.sleep(0.02)
    times = clock.record()
    assert 10.02 <= times["time/train_s"] < 11 and 0.02 <= times["time/evaluate_s"] < 1
