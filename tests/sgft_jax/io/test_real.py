"""Real rollouts on disk: complete or ignored, never lost."""

import os
import signal
import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest

from sgft_jax.io.real import RealStore, played
from sgft_jax.types import UserError


def rollout(number, length=3):
    return {
        "obs": np.full((length, 2), number, np.float32),
        "valid": np.arange(length) < length - 1,
        "reward": jnp.ones(length) * number,
    }


def first(stored):
    return int(stored["obs"][0, 0])


def test_rollouts_come_back_with_their_dtypes(tmp_path):
    store = RealStore(tmp_path)
    assert [store.append(rollout(n, length=n + 1)) for n in range(12)] == list(range(12))
    again = RealStore(tmp_path)
    assert len(again) == 12 and [first(again.load(n)) for n in range(12)] == list(range(12))
    assert again.load(3)["obs"].shape == (4, 2) and again.load(3)["obs"].dtype == np.float32
    assert again.load(3)["valid"].dtype == bool
    assert again.append(rollout(12)) == 12


def test_rollouts_are_on_disk_before_append_returns(tmp_path, monkeypatch):
    synced = []
    real_fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: synced.append(os.fstat(handle).st_size) or real_fsync(handle))
    RealStore(tmp_path).append(rollout(0))
    data, _ = synced  # the file, then its folder
    assert data == (tmp_path / "real" / "rollout-000000.npz").stat().st_size


def test_a_rollout_that_a_kill_has_cut_short_is_ignored_and_named(tmp_path):
    RealStore(tmp_path).append(rollout(0))
    half = tmp_path / "real" / "rollout-000001.half"
    half.write_bytes(b"half")
    heard = []
    store = RealStore(tmp_path, say=heard.append)
    assert heard == [f"ignored: {half}: writing it was cut short"] and len(store) == 1
    assert store.append(rollout(1)) == 1 and first(store.load(1)) == 1
    RealStore(tmp_path, say=pytest.fail)


def test_a_damaged_or_missing_rollout_is_named_and_its_number_is_not_taken(tmp_path):
    store = RealStore(tmp_path)
    for n in range(3):
        store.append(rollout(n))
    os.truncate(tmp_path / "real" / "rollout-000001.npz", 100)
    with pytest.raises(UserError, match=r"rollout-000001.npz: damaged"):
        store.load(1)
    (tmp_path / "real" / "rollout-000001.npz").unlink()
    with pytest.raises(UserError, match="rollout 1 is missing"):
        store.load(1)
    assert len(store) == 3 and store.append(rollout(3)) == 3


def whole(seeds=2, steps=3, width=4):
    rows = {name: np.zeros((seeds, steps)) for name in ("reward", "discount")}
    vectors = {name: np.zeros((seeds, steps, width)) for name in ("obs", "next_obs")}
    facts = {"valid": np.ones((seeds, steps), bool), "success": np.zeros(seeds, bool)}
    return {**rows, **vectors, **facts, "action": np.zeros((seeds, steps, 2))}


def test_rollouts_that_do_not_go_together_are_refused(tmp_path):
    for i, (odd, said) in enumerate(
        [
            (whole(seeds=1), r"obs has shape \[1, 3, 4\], here \[2, 3, 4\]; keep it apart"),
            (whole(width=5), r"obs has shape \[2, 3, 5\], here \[2, 3, 4\]"),
            (whole() | {"reward": np.zeros((2, 2))}, r"reward has shape \[2, 2\], here \[2, 3\]"),
            (whole() | {"valid": np.ones(2, bool)}, "obs has shape"),
        ]
    ):
        store = RealStore(tmp_path / str(i))
        store.append(whole())
        store.append(odd)
        with pytest.raises(UserError, match=f"rollout-000001.npz: {said}"):
            played(tmp_path / str(i))


def test_rollouts_may_differ_in_length(tmp_path):
    store = RealStore(tmp_path)
    store.append(whole())
    store.append(whole(steps=5))
    assert [(one.seed, one.number, len(one.rows["obs"])) for one in played(tmp_path)] == [
        (0, 0, 3), (0, 1, 5), (1, 0, 3), (1, 1, 5),
    ]  # fmt: skip


def test_nothing_is_pickled(tmp_path):
    store = RealStore(tmp_path)
    with pytest.raises(TypeError, match="info"):
        store.append({"obs": np.ones(2), "info": [{}, None]})
    np.savez(tmp_path / "real" / "rollout-000000.npz", obs=np.array([{}, None], dtype=object))
    with pytest.raises(UserError, match="allow_pickle=False"):
        store.load(0)


WRITER = """
import itertools, sys
import numpy as np
from sgft_jax.io.real import RealStore
store = RealStore(sys.argv[1])
for n in itertools.count():
    store.append({"obs": np.full((5000, 4), n, np.float32)})
"""


def test_every_rollout_survives_a_kill_at_any_moment(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)])
    deadline = time.monotonic() + 60
    while len(list(tmp_path.glob("real/*.npz"))) < 3 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    store = RealStore(tmp_path, say=lambda _: None)
    assert len(store) >= 3 and [first(store.load(n)) for n in range(len(store))] == list(range(len(store)))
