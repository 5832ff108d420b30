"""Real rollouts on disk: complete or ignored, never lost."""

import os
import signal
import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest

from envs.types import UserError
from sgft_jax.io.real import RealStore, played


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
            (whole() | {"reward": np.zeros((2, 2))}, r"reward has shape \[2, 2\], not \[2, 3\]"),
            (whole() | {"valid": np.ones(2, bool)}, r"valid has shape \[2\], not \[n, n\]"),
        ]
    ):
        store = RealStore(tmp_path / str(i))
        store.append(whole())
        store.append(odd)
        with pytest.raises(UserError, match=f"rollout-000001.npz: {said}"):
            played(tmp_path / str(i))


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("valid", np.full((2, 3), 0.5), "valid of row 0 is 0.5, not 0 or 1"),
        ("valid", np.full((2, 3), np.nan), "valid of row 0 is nan, not 0 or 1"),
        ("valid", np.ones((2, 0)), "has no step"),
        ("valid", np.array([[1, 1, 0], [1, 0, 1]]), "valid goes on after a step that is not valid"),
        ("success", np.array([0, -1]), "success of row 1 is -1, not 0 or 1"),
        ("exploded", np.zeros(3), r"exploded has shape \[3\], not \[2\]"),
        ("obs", np.full((2, 3, 4), "a"), "obs holds str32, not numbers"),
        ("obs", np.full((2, 3, 4), 1e39), "obs of row 0 is too large for float32"),
        ("reward", np.full((2, 3), np.nan), "reward of row 0 is not finite"),
        ("discount", np.full((2, 3), 2.0), "discount is not between 0 and 1"),
        ("command", np.zeros((2, 2, 2)), r"command has shape \[2, 2, 2\], not \[2, 3, n\]"),
        ("command", np.zeros((2, 3, 3)), "command has 3 entries, action 2"),
        ("next_obs", np.zeros((2, 3, 3)), "next_obs has 3 entries, obs 4"),
        ("command", np.full((2, 3, 2), np.nan), "command of row 0 is not finite"),
        ("trace", np.zeros((2, 3, 1)), r"trace has shape \[2, 3, 1\], not \[2, 4, n\]"),
        ("trace", np.full((2, 4, 1), np.nan), "trace of row 0 is not finite"),
        ("world", np.array([np.nan, 0]), "world is .*, no numbers of worlds"),
        ("world", np.array([0, -1]), "world is .*, no numbers of worlds"),
        ("world", np.zeros((2, 1), int), r"world has shape \[2, 1\], not \[2\]"),
        ("score", np.array(["a", "b"]), "score holds str32, not numbers"),
    ],
)
def test_odd_arrays_are_refused(name, values, words, tmp_path):
    store = RealStore(tmp_path)
    store.append(whole() | {name: values})
    with pytest.raises(UserError, match=f"rollout-000000.npz: {words}"):
        store.rollout(0)


def test_flags_may_be_numbers_and_what_is_not_valid_may_be_anything(tmp_path):
    valid = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    obs = np.where(valid[..., None] > 0, np.ones(4), np.nan)
    RealStore(tmp_path).append(whole() | {"valid": valid, "success": np.array([1, 0], np.int8), "obs": obs})
    first, second = played(tmp_path)
    assert len(first.rows.obs) == 2 and len(second.rows.obs) == 1
    assert first.success is True and second.success is False and first.rows.obs.dtype == np.float32


@pytest.mark.parametrize("name", ["rollout-xyz.npz", "rollout-3.npz", "rollout-000001 (1).npz"])
def test_other_names_are_refused(name, tmp_path):
    """A copy or a renamed rollout would not be read, in silence."""
    store = RealStore(tmp_path)
    store.append(whole())
    (tmp_path / "real" / name).write_bytes((tmp_path / "real/rollout-000000.npz").read_bytes())
    with pytest.raises(UserError, match=r"is no name of a rollout, such as rollout-000000.npz"):
        played(tmp_path)


# --- the journal of a rollout that is going on ------------------------------------------------------------------------

ASKED = {"obs": np.zeros((1, 2), np.float32), "over": np.zeros(1, bool), "success": np.zeros(1, np.int8)}
BEGIN = '{"types": {"obs": "float32", "over": "bool", "success": "int8"}, '
ASKED_LINE = BEGIN + '"asked": {"obs": [[0, 0]], "over": [false], "success": [0]}}\n'


def test_a_journal_comes_back_as_it_was(tmp_path):
    with RealStore(tmp_path).journal(0) as journal:
        journal.begin(ASKED)
        (asked,) = journal.read()
        journal.append(ASKED | {"obs": np.array([[np.nan, np.inf]], np.float32)})
    (step,) = journal.read()
    assert {name: x.dtype for name, x in asked.items()} == {name: x.dtype for name, x in ASKED.items()}
    np.testing.assert_array_equal(step["obs"], [[np.nan, np.inf]])


@pytest.mark.parametrize(
    "content",
    [
        b"[]\n",
        b"3\n",
        b"[" * 100_000 + b"\n",
        b"\xff\xfe\n",
        b'{"types": {"obs": "O"}, "asked": {"obs": [{}]}}\n',
        b'{"types": {"obs": "V100000000"}, "asked": {"obs": [0]}}\n',
        b'{"types": {"obs": "U100000000"}, "asked": {"obs": [0]}}\n',
        b'{"types": {"obs": null}, "asked": {"obs": [0]}}\n',
        b'{"types": ["obs"], "asked": {"obs": [0]}}\n',
        b'{"types": {"obs": "int8"}, "asked": {"obs": [300]}}\n',
        b'{"types": {"obs": "float32"}, "asked": {"obs": ["1"]}}\n',
        b'{"types": {"obs": "float32"}, "asked": {"obs": [[0], [0, 1]]}}\n',
        b'{"types": {"obs": "float32"}, "asked": {}}\n',
        ASKED_LINE.replace("false", "0.5").encode(),
        ASKED_LINE.encode() + b'{"obs": [[0, 0]], "over": [false]}\n',
        ASKED_LINE.encode() + b'{"obs": [[0, 0, 0]], "over": [false], "success": [0]}\n',
    ],
)
def test_a_journal_that_nobody_wrote_is_refused(content, tmp_path):
    journal = RealStore(tmp_path).journal(0)
    journal.path.write_bytes(content)
    with pytest.raises(UserError, match=r"steps\.jsonl: ") as error:
        journal.read()
    assert "\n" not in str(error.value)


def test_rollouts_may_differ_in_length(tmp_path):
    store = RealStore(tmp_path)
    store.append(whole())
    store.append(whole(steps=5))
    assert [(one.seed, one.number, len(one.rows.obs)) for one in played(tmp_path)] == [
        (0, 0, 3),
        (0, 1, 5),
        (1, 0, 3),
        (1, 1, 5),
    ]


def test_nothing_is_pickled(tmp_path):
    store = RealStore(tmp_path)
    with pytest.raises(TypeError, match="info"):
        store.append({"obs": np.ones(2), "info": [{}, None]})
    np.savez(tmp_path / "real" / "rollout-000000.npz", obs=np.array([{}, None], dtype=object))
    with pytest.raises(UserError, match="no plain numbers"):
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
