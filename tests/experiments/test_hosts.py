"""Two processes on this machine as two hosts."""

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import envs
from envs import mesh
from envs.types import UserError
from experiments import pretrain
from experiments.runner import machines
from sgft_jax.io import checkpoint
from sgft_jax.io.log import read_jsonl
from sgft_jax.io.priors import load_prior

TESTS = Path(__file__).parent.parent
OPTIONS = """--task toy --preset cpu --no-video --no-report --config.n-envs 32 --config.worlds 16
    --config.env-steps 1280 --config.random-transitions 64 --config.replay-capacity 512 --config.batch-size 64
    --config.chunk-steps 20 --config.updates-per-step 1 --config.network.hidden 16 --config.ensemble-size 1
    --config.gamma 0.9 --config.eval-every 1 --config.checkpoint-every 1 --config.eval-episodes 16
    --config.report-episodes 16"""
PROGRAM = """
import sys
import envs
envs.TASKS["toy"] = "toy"
from experiments import pretrain
pretrain.main(sys.argv[1:])
"""
RUN = "pretrain/toy/cpu/seed-0"


def on_two_hosts(*argv):
    """The same command on both; (exit codes, what each said)."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    paths = {"PYTHONPATH": f"{TESTS}:{TESTS.parent}", "SGFT_CACHE_DIR": str(TESTS.parent / ".cache/jax")}
    flags = os.environ["XLA_FLAGS"].replace("device_count=2", "device_count=1")
    command, env = [sys.executable, "-c", PROGRAM, *argv], {**os.environ, **paths, "XLA_FLAGS": flags}
    each = [[*command, "--hosts", f"127.0.0.1:{port},2,{i}"] for i in (0, 1)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    started = [subprocess.Popen(one, env=env, **pipes) for one in each]
    said = [process.communicate(timeout=300)[0] for process in started]
    return [process.returncode for process in started], said


@pytest.mark.slow
def test_two_hosts_continue_what_one_began(tmp_path, monkeypatch):
    """The second of two chunks, from the checkpoint after the first, is that of an uninterrupted run on one device."""
    monkeypatch.setitem(envs.TASKS, "toy", "toy")
    monkeypatch.setattr(os, "environ", os.environ.copy())
    pretrain.main([*OPTIONS.split(), "--out", str(tmp_path / "one")])
    one, two = (tmp_path / name / RUN for name in ("one", "two"))
    shutil.copytree(one, two)
    for later in ("checkpoints/2", "prior", "summary.json"):
        path = two / later
        path.unlink() if path.is_file() else shutil.rmtree(path)

    codes, said = on_two_hosts(*OPTIONS.split(), "--out", str(tmp_path / "two"), "--resume")
    assert codes == [0, 0], said
    assert "results: " in said[0] and "results: " not in said[1]
    assert [line["step"] for line in read_jsonl(two / "metrics.jsonl")] == [640, 1280]
    for name in ("metrics.jsonl", "eval.jsonl"):
        a, b = (read_jsonl(run / name)[-1] for run in (one, two))
        assert a.keys() == b.keys()
        for key, value in a.items():
            np.testing.assert_allclose(b[key], value, rtol=0.02, atol=1e-3, err_msg=key)
    assert checkpoint.latest(two) == 2 and (two / "summary.json").exists()
    priors = [load_prior(run / "prior/seed-0").params for run in (one, two)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0.02, atol=2e-3), *priors)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("auto", "--hosts auto: "),
        ("node7", "must be 'auto' or ADDRESS:PORT,COUNT,INDEX"),
        ("node7:12,2", "must be 'auto' or ADDRESS:PORT,COUNT,INDEX"),
        ("node7:99999,2,0", "the port of node7:99999 must be from 1 to 65535"),
        ("node7:12,2,2", "index 2 of 2 hosts; they are counted from 0"),
    ],
)
def test_hosts_that_nobody_can_meet(given, words):
    with pytest.raises(UserError, match=words):
        machines.join_hosts(given)


def test_what_is_no_host_is_found_before_jax_starts():
    with pytest.raises(UserError, match="the port of node7:0 must be from 1 to 65535"):
        pretrain.check(pretrain.PretrainArgs(hosts="node7:0,2,0"))


def test_several_hosts_work_with_all_their_devices(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    assert mesh.devices(None, {}) == mesh.devices(0, {}) == 2
    with pytest.raises(UserError, match="--devices 1: 2 hosts work with all their 2 devices; leave it out"):
        mesh.devices(1, {})
