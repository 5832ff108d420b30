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

from sgft_jax.io import checkpoint
from sgft_jax.types import UserError

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
    shutil.copytree(saved / "checkpoints" / "20", saved / "checkpoints" / ".tmp-30")
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


def test_a_flipped_byte_is_noticed(saved):
    file = biggest(saved / "checkpoints" / "20")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(bytes(content))
    with pytest.raises(UserError, match="checksum differs"):
        checkpoint.restore(saved, make_state())


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


def test_kill_at_any_moment_leaves_a_complete_checkpoint(tmp_path):
    """Several kills of one process that saves without pause, each at another moment."""
    for delay in (0.01, 0.03):
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
        shutil.rmtree(tmp_path / "checkpoints")


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


def test_another_format_is_refused(saved):
    path = saved / "checkpoints" / "20" / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 99}))
    with pytest.raises(UserError, match="written in format 99, this version reads format 1"):
        checkpoint.restore(saved, make_state(), step=20)
