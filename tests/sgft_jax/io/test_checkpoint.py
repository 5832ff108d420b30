import json
import os
import shutil
import signal
import subprocess
import sys
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct

from envs.types import UserError
from sgft_jax.io import checkpoint

META = {"kind": "pretrain", "task": "hammer", "position": {"metrics.jsonl": 12}}


@struct.dataclass
class Learner:
    params: dict
    opt: tuple
    key: jax.Array


class State(NamedTuple):
    learner: Learner
    keys: jax.Array
    count: jax.Array
    nothing: jax.Array
    on_host: np.ndarray
    absent: None = None


def make_learner(key):
    params = {"Dense_0": {"kernel": jax.random.normal(key, (4, 3)), "bias": jnp.ones(3, jnp.bfloat16)}}
    return Learner(params, optax.adam(1e-3).init(params), jax.random.fold_in(key, 1))


def make_state(seed=0):
    key = jax.random.key(seed)
    return State(
        learner=make_learner(key),
        keys=jax.random.split(jax.random.key(seed, impl="rbg"), 3),
        count=jnp.int32(5),
        nothing=jnp.zeros((0, 4)),
        on_host=np.arange(2, dtype=np.float32) / 3,
    )


def bits(tree):
    """Every leaf as (type, dtype, bytes): equal only if nothing at all changed."""

    def one(x):
        if hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return "key", str(jax.random.key_impl(x)), np.asarray(jax.random.key_data(x)).tobytes()
        return str(x.dtype), np.asarray(x).tobytes()

    return jax.tree.map(one, tree), jax.tree.structure(tree)


@pytest.fixture
def saved(tmp_path):
    checkpoint.save(tmp_path, 10, make_state(0), meta=META)
    checkpoint.save(tmp_path, 20, make_state(1), meta=META)
    return tmp_path


def files_of(folder):
    return [f for f in (folder / "state").rglob("*") if f.is_file()]


def biggest(folder):
    return max(files_of(folder), key=lambda f: f.stat().st_size)


# ---------------------------------------------------------------- round trips


def test_round_trip_is_bit_identical(saved):
    state, meta = checkpoint.restore(saved, make_state(9), expect={"task": "hammer", "kind": "pretrain"})
    assert bits(state) == bits(make_state(1))
    assert meta == META


def test_restore_into_an_abstract_state(tmp_path, key):
    learner = make_learner(key)
    checkpoint.save(tmp_path, 1, learner, meta={})
    state, _ = checkpoint.restore(tmp_path, jax.eval_shape(make_learner, key))
    assert bits(state) == bits(learner)


def test_copies_outlive_a_donated_state(tmp_path):
    """A checkpoint is written while the next chunk of training uses the memory of its state."""
    state = make_state(1)
    kept = bits(state)
    copies = checkpoint.copied(state)
    used = jax.jit(lambda state: jax.tree.map(lambda x: x if checkpoint._is_key(x) else x + 1, state), donate_argnums=0)
    jax.block_until_ready(used(state))
    checkpoint.save(tmp_path, 1, copies, meta={})
    assert bits(checkpoint.restore(tmp_path, make_state())[0]) == kept


def test_a_state_without_any_elements(tmp_path):
    checkpoint.save(tmp_path, 1, {"a": jnp.zeros((0, 2), jnp.int8)}, meta={})
    state, _ = checkpoint.restore(tmp_path, {"a": jnp.zeros((0, 2), jnp.int8)})
    assert state["a"].shape == (0, 2) and state["a"].dtype == jnp.int8


def test_named_step_and_newest(saved):
    assert checkpoint.latest(saved) == 20
    assert bits(checkpoint.restore(saved, make_state(), step=10)[0]) == bits(make_state(0))


@pytest.mark.parametrize(
    ("leaf", "words"),
    [("hammer", "a str is not an array"), (3, "a int is not"), (np.zeros(2), "does not keep float64")],
)
def test_what_would_not_come_back_as_it_was_is_not_saved(tmp_path, leaf, words):
    with pytest.raises(TypeError, match=f"name: .*{words}"):
        checkpoint.save(tmp_path, 1, {"name": leaf}, meta={})
    assert checkpoint.latest(tmp_path) is None


def test_saving_is_quiet(tmp_path, capfd):
    checkpoint.save(tmp_path, 1, make_state(), meta={})
    checkpoint.restore(tmp_path, make_state())
    assert capfd.readouterr() == ("", "")


# ---------------------------------------------------------------- which checkpoints stay


def test_keeps_the_last_two(saved):
    checkpoint.save(saved, 30, make_state(2), meta=META)
    assert sorted(os.listdir(saved / "checkpoints")) == ["20", "30"]


def test_a_resume_from_an_older_step_abandons_the_newer_one(saved):
    checkpoint.save(saved, 15, make_state(2), meta=META)
    assert sorted(os.listdir(saved / "checkpoints")) == ["10", "15"]


def test_saving_the_same_step_again_replaces_it(saved):
    checkpoint.save(saved, 20, make_state(5), meta=META)
    assert bits(checkpoint.restore(saved, make_state())[0]) == bits(make_state(5))
    assert sorted(os.listdir(saved / "checkpoints")) == ["10", "20"]


# ---------------------------------------------------------------- torn


def test_a_torn_checkpoint_takes_nobodys_place(saved):
    damage_truncate(saved / "checkpoints" / "20")
    checkpoint.save(saved, 30, make_state(2), meta=META)
    assert sorted(os.listdir(saved / "checkpoints")) == ["10", "30"]


def test_a_leftover_of_a_killed_save_is_ignored_then_removed(saved):
    shutil.copytree(saved / "checkpoints" / "20", saved / "checkpoints" / ".sgft-new-30")
    assert checkpoint.latest(saved) == 20
    checkpoint.save(saved, 30, make_state(2), meta=META)
    assert sorted(os.listdir(saved / "checkpoints")) == ["20", "30"]


def damage_truncate(folder):
    os.truncate(biggest(folder), biggest(folder).stat().st_size // 2)


def damage_remove(folder):
    biggest(folder).unlink()


def damage_no_manifest(folder):
    (folder / "manifest.json").unlink()


def damage_half_manifest(folder):
    os.truncate(folder / "manifest.json", 100)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (damage_truncate, "torn: .* bytes, expected"),
        (damage_remove, "torn: .* is missing"),
        (damage_no_manifest, "manifest.json is missing"),
        (damage_half_manifest, "torn: manifest.json is not readable"),
    ],
)
def test_torn_checkpoints_are_refused_and_the_older_one_is_used(saved, damage, words):
    damage(saved / "checkpoints" / "20")
    with pytest.raises(UserError, match=words) as refused:
        checkpoint.restore(saved, make_state(), step=20)
    assert "checkpoints/20" in str(refused.value) and "\n" not in str(refused.value)
    heard = []
    state, _ = checkpoint.restore(saved, make_state(), say=heard.append)
    assert bits(state) == bits(make_state(0))
    assert len(heard) == 1 and heard[0].startswith("skipped: ") and "checkpoints/20" in heard[0]


def damage_flip(folder):
    file = biggest(folder)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(bytes(content))


def test_a_flipped_byte_is_noticed_and_the_older_one_is_used(saved):
    damage_flip(saved / "checkpoints" / "20")
    with pytest.raises(UserError, match=r"checkpoints/20: damaged: .* \(checksum differs\)$"):
        checkpoint.restore(saved, make_state(), step=20)
    heard = []
    assert checkpoint.latest(saved) == 20  # complete, as far as sizes tell
    assert checkpoint.latest(saved, whole=True, say=heard.append) == 10
    assert bits(checkpoint.restore(saved, make_state(), say=heard.append)[0]) == bits(make_state(0))
    assert len(heard) == 2 and all("skipped: " in line and "checksum differs" in line for line in heard)
    damage_flip(saved / "checkpoints" / "10")
    with pytest.raises(UserError, match=r"checkpoints: holds nothing whole; remove it, then --resume begins again"):
        checkpoint.latest(saved, whole=True, say=heard.append)


def test_checksums_are_compared_once(saved, monkeypatch):
    read = []
    fingerprint = checkpoint._fingerprint
    monkeypatch.setattr(checkpoint, "_fingerprint", lambda file: read.append(file) or fingerprint(file))
    checkpoint.restore(saved, make_state())
    assert read and len(set(read)) == len(read)
    count = len(read)
    step = checkpoint.latest(saved, whole=True)
    checkpoint.restore(saved, make_state(), step=step, checked=True)
    assert len(read) == 2 * count


@pytest.mark.parametrize("second", [False, True])
def test_a_kill_while_a_checkpoint_is_overwritten_leaves_it(saved, monkeypatch, second):
    """Dies at the second rename, where the old one is put aside; or when that, put back, is to be deleted."""
    shutil.rmtree(saved / "checkpoints" / "10")
    moved = []

    def dying(path, target):
        moved.append(target)
        if len(moved) == 2:
            raise KeyboardInterrupt
        os.rename(path, target)

    monkeypatch.setattr(type(saved), "rename", dying)
    monkeypatch.setattr(checkpoint.disk, "settle", lambda folder: None)
    with pytest.raises(KeyboardInterrupt):
        checkpoint.save(saved, 20, make_state(5), meta=META)
    monkeypatch.undo()
    assert os.listdir(saved / "checkpoints") == [".sgft-old-20"] and checkpoint.latest(saved, whole=True) == 20
    assert bits(checkpoint.restore(saved, make_state())[0]) == bits(make_state(1))
    checkpoint.save(saved, 20 if second else 30, make_state(6), meta=META)
    assert sorted(os.listdir(saved / "checkpoints")) == (["20"] if second else ["20", "30"])
    assert bits(checkpoint.restore(saved, make_state())[0]) == bits(make_state(6))


# ---------------------------------------------------------------- manifests that lie


def of_first_leaf(**changes):
    """The manifest with another path, kind, shape or dtype of its first array."""

    def change(manifest):
        leaf = dict(zip(("path", "kind", "shape", "dtype"), manifest["leaves"][0], strict=True)) | changes
        return manifest | {"leaves": [list(leaf.values()), *manifest["leaves"][1:]]}

    return change


def without(key):
    return lambda manifest: {name: value for name, value in manifest.items() if name != key}


def of_files(change):
    return lambda manifest: manifest | {"files": change(manifest["files"])}


LIES = {
    "no files": (of_files(lambda files: {}), "has no checksum of state/"),
    "another shape": (of_first_leaf(shape=[3, 2]), r"differ in leaf_00000: .*\(3, 2\).*\(2, 3\)"),
    "a huge shape": (of_first_leaf(shape=[2**20, 2**20]), "differ in leaf_00000"),
    "another type": (of_first_leaf(dtype="int32"), "differ in leaf_00000: .*int32.*float32"),
    "a type that nobody knows": (of_first_leaf(dtype="complex7"), "lists a complex7.*does not know"),
    "objects": (of_first_leaf(dtype="object"), "does not know"),
    "objects of which there are none": (of_first_leaf(dtype="object", shape=[0]), "does not know"),
    "what JAX does not keep": (of_first_leaf(dtype="float64"), "does not know"),
    "a key without its kind": (of_first_leaf(kind="key"), "does not know"),
    "no such kind": (of_first_leaf(kind="pickle"), "pickle"),
    "a negative size": (of_first_leaf(shape=[-1, 3]), r"leaves\[0\]\[2\]\[0\]: expected int >= 0"),
    "too few arrays": (lambda manifest: manifest | {"leaves": manifest["leaves"][:1]}, "differ in leaf_00001: None"),
    "no leaves": (without("leaves"), "lacks leaves"),
    "no list of files": (without("files"), "lacks files"),
    "no kinds of keys": (without("key_impls"), "lacks key_impls"),
    "kinds that nobody knows": (lambda manifest: manifest | {"key_impls": {"leaf_00001": "dice"}}, "does not know"),
    "a folder above": (of_files(lambda files: {"../secret": [1, 1]} | files), "names ../secret, which is not in"),
    "an absolute path": (of_files(lambda files: {"/etc/hostname": [1, 1]} | files), "names /etc/hostname, which is"),
    "a file without checksum": (of_files(lambda files: dict([*files.items()][1:])), "has no checksum of state/"),
    "a link": (of_files(lambda files: {"state/.link": [1, 1]} | files), "names state/.link, which is not in"),
    "a folder": (of_files(lambda files: {"state": [1, 1]} | files), "torn: state is missing"),
    "a size below 0": (of_files(lambda files: {"state/.x": [-1, 1]} | files), "expected int >= 0"),
    "a size as a text": (of_files(lambda files: {"state/.x": ["1", 1]} | files), "is a text, not a whole number"),
    "null": (lambda manifest: None, "is not readable"),
    "a list": (lambda manifest: [manifest], "is not readable"),
    "too deep": (lambda manifest: "[" * 100_000, "is not readable"),
}


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("lie", LIES)
def test_a_manifest_that_lies_is_refused_before_numbers_are_read(tmp_path, lie, monkeypatch):
    change, words = LIES[lie]
    where = checkpoint.save(tmp_path, 1, {"a": jnp.ones((2, 3)), "k": jax.random.key(0)}, meta={})
    (where / "state/.link").symlink_to("/etc/hostname")
    changed = change(json.loads((where / "manifest.json").read_text()))
    (where / "manifest.json").write_text(changed if isinstance(changed, str) else json.dumps(changed))
    monkeypatch.setattr(checkpoint.ocp, "load", lambda path: pytest.fail("numbers were read"))
    with pytest.raises(UserError, match=words) as refused:
        manifest = checkpoint.read_manifest(where)
        checkpoint.read_leaves(where, manifest)
    assert "\n" not in str(refused.value) and str(where) in str(refused.value)


def test_no_complete_checkpoint(tmp_path):
    assert checkpoint.latest(tmp_path) is None
    with pytest.raises(UserError, match="holds no complete checkpoint"):
        checkpoint.restore(tmp_path, make_state())
    with pytest.raises(UserError, match="no such folder"):
        checkpoint.restore(tmp_path, make_state(), step=3)


SAVER = """
import itertools, sys
import numpy as np
from sgft_jax.io import checkpoint
for step in itertools.count(1):
    checkpoint.save(sys.argv[1], step, {"x": np.full(50_000, step, np.float32)}, meta={"step": step})
"""


@pytest.mark.parametrize("delay", [0.02, *(pytest.param(x, marks=pytest.mark.slow) for x in (0.01, 0.03))])
def test_kill_at_any_moment_leaves_a_complete_checkpoint(tmp_path, delay):
    """Of a process that saves without pause."""
    process = subprocess.Popen([sys.executable, "-c", SAVER, str(tmp_path)], env=dict(os.environ))
    try:
        deadline = time.monotonic() + 60
        while not list(tmp_path.glob("checkpoints/[0-9]*")) and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(delay)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    heard = []
    state, meta = checkpoint.restore(tmp_path, {"x": np.zeros(50_000, np.float32)}, say=heard.append)
    assert (state["x"] == meta["step"]).all()
    assert heard == []


# ---------------------------------------------------------------- foreign


def test_another_task_or_kind_is_refused(saved):
    with pytest.raises(UserError, match=r"checkpoints/20: .*saved with task='hammer' where task='push' is needed"):
        checkpoint.restore(saved, make_state(), expect={"task": "push"})
    with pytest.raises(UserError, match="method=None where method='sac' is needed"):
        checkpoint.restore(saved, make_state(), expect={"method": "sac"})


def test_expectations_may_hold_tuples(tmp_path):
    checkpoint.save(tmp_path, 1, {"a": jnp.ones(2)}, meta={"layers": (2, 3)})
    checkpoint.restore(tmp_path, {"a": jnp.ones(2)}, expect={"layers": (2, 3)})


@pytest.mark.parametrize(
    ("like", "words"),
    [
        ({"a": jnp.ones(3), "b": jnp.ones(2)}, r"holds a float32\[2\] where a float32\[3\] is needed"),
        ({"a": jnp.ones(2, jnp.int32), "b": jnp.ones(2)}, r"where a int32\[2\] is needed"),
        ({"a": jnp.ones(2), "c": jnp.ones(2)}, r"holds b float32\[2\] where c float32\[2\]"),
        ({"a": jnp.ones(2)}, "2 arrays saved, 1 needed, the first odd one is b"),
        ({"a": jnp.ones(2), "b": jnp.ones(2), "c": jax.random.key(0)}, "2 arrays saved, 3 needed, .* is c key"),
    ],
)
def test_other_shapes_are_refused(tmp_path, like, words):
    checkpoint.save(tmp_path, 1, {"a": jnp.ones(2), "b": jnp.ones(2)}, meta={})
    with pytest.raises(UserError, match=words):
        checkpoint.restore(tmp_path, like)


@pytest.mark.parametrize("number", [checkpoint.FORMAT - 1, 99])
def test_another_format_is_refused_in_one_line(saved, number):
    folder = saved / "checkpoints" / "20"
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": number}))
    with pytest.raises(UserError) as refused:
        checkpoint.restore(saved, make_state(), step=20)
    assert str(refused.value) == (
        f"{folder}: written in format {number}, this version reads format {checkpoint.FORMAT} alone; begin again, or "
        "use the version that wrote it"
    )
