import io
import json
import os

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from sgft_jax.io import log
from sgft_jax.io.log import MetricsLog, RealLog, RunProgress, read_jsonl, write_summary
from sgft_jax.types import UserError

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
    with pytest.raises(UserError, match=r"metrics.jsonl:2: not a JSON object"):
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


# ---------------------------------------------------------------- real rollouts


def rollout(number, length=3):
    return {
        "obs": np.full((length, 2), number, np.float32),
        "truncated": np.arange(length) == length - 1,
        "reward": jnp.ones(length) * number,
    }


def numbers(rollouts):
    return [int(r["obs"][0, 0]) for r in rollouts]


def test_rollouts_come_back_in_order_with_their_dtypes(tmp_path):
    stored = RealLog(tmp_path)
    assert [stored.append(rollout(n, length=n + 1)) for n in range(12)] == list(range(12))
    again = RealLog(tmp_path)
    assert len(again) == 12
    loaded = again.load()
    assert numbers(loaded) == list(range(12))
    assert loaded[3]["obs"].shape == (4, 2) and loaded[3]["obs"].dtype == np.float32
    assert loaded[3]["truncated"].dtype == bool


def test_rollouts_are_on_disk_before_append_returns(tmp_path, monkeypatch):
    synced = []
    real_fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: synced.append(os.fstat(handle).st_size) or real_fsync(handle))
    RealLog(tmp_path).append(rollout(0))
    data, _ = synced  # the file, then its folder
    assert data == (tmp_path / "real" / "rollout-000000.npz").stat().st_size


def test_resume_moves_later_rollouts_aside(tmp_path):
    stored = RealLog(tmp_path)
    for n in range(5):
        stored.append(rollout(n))
    assert stored.truncate(5) is None
    assert stored.truncate(3) == tmp_path / "real" / "superseded-0"
    assert stored.append(rollout(30)) == 3
    assert stored.truncate(3) == tmp_path / "real" / "superseded-1"
    assert numbers(stored.load()) == [0, 1, 2]
    aside = sorted(str(p.relative_to(tmp_path / "real")) for p in tmp_path.glob("real/superseded-*/*"))
    assert aside == [
        "superseded-0/rollout-000003.npz",
        "superseded-0/rollout-000004.npz",
        "superseded-1/rollout-000003.npz",
    ]
    with pytest.raises(UserError, match="holds 3 rollouts, the checkpoint remembers 4"):
        stored.truncate(4)


def test_damaged_missing_and_half_written_rollouts(tmp_path):
    stored = RealLog(tmp_path)
    for n in range(3):
        stored.append(rollout(n))
    (tmp_path / "real" / "rollout-000003.tmp").write_bytes(b"half")  # killed while writing
    assert numbers(stored.load()) == [0, 1, 2]
    os.truncate(tmp_path / "real" / "rollout-000001.npz", 100)
    with pytest.raises(UserError, match=r"rollout-000001.npz: damaged"):
        stored.load()
    (tmp_path / "real" / "rollout-000001.npz").unlink()
    with pytest.raises(UserError, match="rollout 1 is missing"):
        stored.load()


def test_nothing_is_pickled(tmp_path):
    stored = RealLog(tmp_path)
    with pytest.raises(TypeError, match="info"):
        stored.append({"obs": np.ones(2), "info": [{}, None]})
    np.savez(tmp_path / "real" / "rollout-000000.npz", obs=np.array([{}, None], dtype=object))
    with pytest.raises(UserError, match="allow_pickle=False"):
        stored.load()


# ---------------------------------------------------------------- progress


class Clock:
    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now


def test_plain_lines_give_rate_and_time_left(monkeypatch):
    """100 steps in 2 s: 50 steps/s, the 500 left take 10 s; 100 more in 8 s: 20 steps/s, the 400 left take 20 s."""
    clock = Clock()
    monkeypatch.setattr(log, "time", clock)
    console = Console(file=io.StringIO(), width=40, soft_wrap=True)
    with RunProgress("pretrain", total=1000, done=400, console=console) as progress:
        clock.now += 2
        progress.advance(100, {"success": 0.25})
        clock.now += 8
        progress.advance(100)
        progress.say("checkpoint [1]")
    assert console.file.getvalue().splitlines() == [
        "pretrain: 500/1,000 steps (50 %), 50 steps/s, 0:00:10 left  success 0.25",
        "pretrain: 600/1,000 steps (60 %), 20 steps/s, 0:00:20 left",
        "checkpoint [1]",
    ]


def test_live_bar_on_a_terminal():
    console = Console(file=io.StringIO(), width=120, force_terminal=True)
    with RunProgress("finetune", total=100, unit="transitions", console=console) as progress:
        progress.advance(40, {"success": 0.5})
        progress.say("hello")
    written = console.file.getvalue()
    assert "40/100 transitions" in written and "success 0.5" in written and "hello" in written


@pytest.mark.parametrize(
    ("seconds", "shown"), [(0, "0:00:00"), (59.6, "0:01:00"), (3661, "1:01:01"), (90000, "25:00:00")]
)
def test_durations(seconds, shown):
    assert log._duration(seconds) == shown
