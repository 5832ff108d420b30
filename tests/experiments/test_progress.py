"""What commands tell while they work: phases, lines after some silence, progress of loops."""

import ast
import contextlib
import io
import re
import time
from pathlib import Path

import pytest
from jax import monitoring
from rich.console import Console

from experiments.runner import cli, progress
from experiments.runner.progress import RunProgress, doing, never_silent

COMPILE = "/jax/core/compile/backend_compile_duration"  # what JAX reports of its compiler


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
    monkeypatch.setattr(progress, "time", clock)
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


def test_what_does_not_fit_beside_the_bar_wraps():
    console = Console(file=io.StringIO(), width=100, height=20, force_terminal=True)
    with RunProgress("finetune hammer", total=100, unit="transitions", console=console) as shown:
        shown.advance(20)
        shown.advance(40, {"success, exploring": 0.5, "success, evaluation": 0.25, "the last": 0.125})
    assert "the last 0.125" in " ".join(console.file.getvalue().split())


@pytest.mark.parametrize(
    ("seconds", "shown"), [(0, "0:00:00"), (59.6, "0:01:00"), (3661, "1:01:01"), (90000, "25:00:00")]
)
def test_durations(seconds, shown):
    assert progress._duration(seconds) == shown


# ---------------------------------------------------------------- phases


def lines(capsys):
    said = capsys.readouterr()
    assert said.out == ""  # results alone
    return said.err.splitlines()


def test_a_phase_is_announced_once_with_the_time_that_it_takes(capsys):
    with never_silent():
        for _ in range(3):
            with doing("compiling the updates", 40, once=True), doing("loading"):
                pass
        with doing("collecting", 200), doing("linking", once=True):
            pass
    assert lines(capsys) == [
        "compiling the updates (about 40 s, once)",
        "loading",
        "collecting (about 3 min)",
        "linking (once)",
    ]


def test_what_goes_on_within_a_phase_is_said_where_it_lasts(capsys, monkeypatch):
    monkeypatch.setattr(progress, "_AGAIN", 0.2)
    with never_silent(), doing("playing"), progress.amid("waiting for a robot"):
        time.sleep(1.2)
    first, *others = lines(capsys)
    assert first == "playing" and others and all("waiting for a robot" in line for line in others)


def test_who_works_for_long_says_at_what_and_whether_it_compiles(monkeypatch, capsys):
    """15 s of compiling, of other work, and of work between two phases."""
    clock, voice = Clock(), progress._VOICE
    monkeypatch.setattr(progress, "time", clock)
    monkeypatch.setattr(voice, "said", set())
    for limit in ("_AGAIN", "_SELDOM"):
        monkeypatch.setattr(progress, limit, 10.0)

    def pause():
        clock.now += 15
        voice.still(cpu=0.0)

    with contextlib.suppress(KeyError), doing("measuring"):
        monitoring.record_scalar(COMPILE, 0.0)
        pause()
        monitoring.record_event_duration_secs(COMPILE, 15.0)
        pause()
        raise KeyError
    pause()
    assert lines(capsys) == [
        "measuring",
        "still measuring (0:00:15 so far, compiling)",
        "still measuring (0:00:30 so far)",
        "still working (0:00:15 so far)",
    ]


def test_lines_come_more_and_more_seldom(capsys, monkeypatch):
    """After 2 s of the processor, or 10 s; then 10 s after a line; later after half of the time, or half a minute."""
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    for name, seconds in {"_FIRST": 2.0, "_AGAIN": 10.0, "_SELDOM": 30.0}.items():
        monkeypatch.setattr(progress, name, seconds)
    voice, spoken = progress._Voice(), []
    monkeypatch.setattr(progress, "_VOICE", voice)
    for second in range(200):
        clock.now = 100.0 + second
        voice.still(cpu=second / 2)
        if lines(capsys):
            spoken.append(second)
    assert spoken == [5, 16, 33, 64, 95, 126, 157, 188]


def test_the_next_run_says_again_what_it_does(capsys):
    for _ in range(2):
        with RunProgress("train", total=1, console=Console(file=io.StringIO())), doing("training"), doing("training"):
            pass
    assert lines(capsys) == ["training", "training"]


def test_nothing_fails_for_want_of_a_reader(monkeypatch):
    closed = io.StringIO()
    closed.close()
    monkeypatch.setattr("sys.stderr", closed)
    with never_silent(), doing("working on"):
        pass


def announced(path):
    """What the calls of `doing` in a file say; "..." for what the run decides."""
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    texts = [ast.unparse(call.args[0]) for call in calls if ast.unparse(call.func) == "doing"]
    return {re.sub(r"\{[^{}]*(\[[^]]*\])?[^{}]*\}", "...", re.sub("^f?['\"]|['\"]$", "", text)) for text in texts}


def test_the_phases_of_every_command():
    """By the file that announces them. Commands without are done in seconds, or run those that are here."""
    files = Path(cli.__file__).parents[1].rglob("*.py")
    assert {path.stem: phases for path in files if (phases := announced(path))} == {
        "benchmark": {"measuring ...: ..."},
        "collect_run": {"compiling the training", "playing the episodes to record"},
        "demo": {"drawing from the posterior"},
        "diagnose_run": {
            "playing ... of each prior",
            "building systems that it may be",
            "trying corrections in these systems",
            "writing down what rollouts say",
        },
        "estimate": {"compiling the simulator and worlds of ..."},
        "estimating": {
            "simulating ... rollouts of ... to learn from",
            "checking how sure of systems of ... it may be",
            "learning which systems of ... make which rollouts",
        },
        "evaluate": {"building ... worlds for each system", "playing ... episodes for each policy"},
        "export": {"exporting to ... and comparing actions"},
        "finetune_run": {
            "making the real systems",
            "starting the process that learns",
            "preparing the agents",
            "learning from simulated transitions",
            "playing the first rollout",
            "compiling what learns",
            "playing the first rollout and compiling what learns from it",
            "playing and learning",
            "learning",
            "evaluating the best policies",
        },
        "gaps_run": {"playing ... episodes on each real system", "building the worlds and compiling the training"},
        "guidance": {
            "building ... worlds of ...",
            "trying ... actions in ... states of each system of ...",
        },
        "hybrid_run": {"building the worlds"},
        "landscape": {"playing an episode of ..."},
        "kept": {"collecting ... simulated transitions of the priors"},
        "pictures": {"rendering a video"},
        "posterior": {
            "compiling the simulator and worlds of ...",
            "playing ... rollouts",
            "playing in particles what may be deployed",
            "compiling ... real systems of ...",
            "playing the policy as it is",
            "playing, and choosing what to deploy",
        },
        "pretrain_run": {
            "building ... worlds",
            "collecting ... random transitions",
            "fitting V_sim",
            "measuring V_sim and the models",
            "playing fresh episodes for the cards",
        },
        "real_demo": {"making an environment for Bullet in ..."},
        "training": {"compiling the training", "training", "evaluating", "writing a checkpoint"},
        "theory": {
            "solving ... systems with a ... model for H = ...",
            "solving the pendulum of the bounds",
            "solving the pendulum on ... x ... points",
            "solving it on half of them, to see how much the grid matters",
        },
        "value": {"fitting V_sim of ...", "measuring it"},
    }
