import io
import time

import pytest
from rich.console import Console

from sgft_jax.io import log
from sgft_jax.io.log import RunProgress


class Clock:
    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now


def test_plain_lines_give_rate_and_time_left_after_the_chunk_that_compiles(monkeypatch):
    """A chunk of nothing and the first one do not count. 100 steps in 2 s: 50 steps/s, the 400 left take 8 s; 100 more
    in 8 s: 200 in 10 s are 20 steps/s, the 300 left take 15 s.
    """
    clock = Clock()
    monkeypatch.setattr(log, "time", clock)
    console = Console(file=io.StringIO(), width=40, soft_wrap=True)
    with RunProgress("pretrain", total=1000, done=400, console=console) as shown:
        clock.now += 5
        shown.advance(0)
        clock.now += 60
        shown.advance(100, {"success": 0.25})
        clock.now += 2
        shown.advance(100, {"success": 0.5})
        clock.now += 8
        shown.advance(100)
    assert console.file.getvalue().splitlines() == [
        "pretrain: 400/1,000 steps (40 %)",
        "pretrain: 500/1,000 steps (50 %)  success 0.25",
        "pretrain: 600/1,000 steps (60 %), 50 steps/s, 0:00:08 left  success 0.5",
        "pretrain: 700/1,000 steps (70 %), 20 steps/s, 0:00:15 left",
    ]


def test_live_bar_on_a_terminal():
    console = Console(file=io.StringIO(), width=120, force_terminal=True)
    with RunProgress("finetune", total=100, unit="transitions", console=console) as shown:
        shown.advance(40, {"success": 0.5})
    written = console.file.getvalue()
    assert "40/100 transitions" in written and "success 0.5" in written


@pytest.mark.parametrize(
    ("seconds", "shown"), [(0, "0:00:00"), (59.6, "0:01:00"), (3661, "1:01:01"), (90000, "25:00:00")]
)
def test_durations(seconds, shown):
    assert log._duration(seconds) == shown


def test_clock_adds_up():
    clock = log.Clock()
    clock.seconds = {"train": 10.0}
    for phase in ("train", "evaluate"):
        with clock(phase):
            time.sleep(0.02)
    times = clock.record()
    assert 10.02 <= times["time/train_s"] < 11 and 0.02 <= times["time/evaluate_s"] < 1
