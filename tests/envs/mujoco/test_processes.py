"""Processes that work for this one: whatever happens there, the caller gets answers or None, and nothing stays."""

import os
import pickle
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from envs.mujoco import processes

WORK = """
import os, subprocess, sys, time

def number(x):
    return x

def prints(x):
    print("This is no answer", flush=True)
    os.write(1, b"WARNING: from C")
    return x

def reads(x):
    return input()

def leaves_a_child(x):
    subprocess.Popen(["sleep", "60"])
    return x

def fails(x):
    raise ValueError

def dies(x):
    os.kill(os.getpid(), 9)

def sleeps(x):
    time.sleep(60)
"""


@pytest.fixture
def work(tmp_path, monkeypatch):
    """A module that the processes find; the working directory has modules that they shall not find."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "work_of_processes.py").write_text(WORK)
    for name in ("envs", "pickle"):
        (tmp_path / f"{name}.py").write_text("open('imported', 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    monkeypatch.setattr(processes, "_KEPT", [])
    yield pytest.importorskip("work_of_processes")
    processes._end_kept()
    assert not (tmp_path / "imported").exists()


def twice(function, *, keep=True):
    return processes.in_parallel(function, [(1,), (2,)], keep=keep)


def test_streams_belong_to_what_runs_there(work):
    for function, wanted in ((work.prints, [1, 2]), (work.leaves_a_child, [1, 2]), (work.reads, None)):
        assert twice(function, keep=False) == wanted


def test_what_fails_is_done_by_the_caller_and_the_next_task_finds_new_processes(work):
    for function in (work.fails, work.dies, lambda x: x):
        assert twice(function) is None
        assert twice(work.number) == [1, 2]


def test_threads_get_their_own_answers(work):
    with ThreadPoolExecutor(4) as threads:
        tasks = [[(i,), (-i,)] for i in range(8)]
        answers = threads.map(lambda task: processes.in_parallel(work.number, task, keep=True), tasks)
        assert list(answers) == [[i, -i] for i in range(8)]
    assert len(processes._KEPT) == 2


def test_ctrl_c_ends_them_at_once(work):
    assert twice(work.number) == [1, 2]
    begun = time.monotonic()
    threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        twice(work.sleeps)
    assert time.monotonic() - begun < 10
    assert not any(process.alive() for process in processes._KEPT)


def test_they_end_with_whom_they_serve(work):
    process = processes._Process()
    process._file.write(pickle.dumps((work.sleeps, 1)))
    process._file.close()
    assert process._process.wait(10) == 1
