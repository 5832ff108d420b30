import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct

from sgft_jax.io import checkpoint
from sgft_jax.types import Normalizer, Prior, UserError

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
    step: int
    rate: float
    done: bool
    on_host: np.ndarray
    absent: None = None


def make_learner(key):
    params = {"Dense_0": {"kernel": jax.random.normal(key, (4, 3)), "bias": jnp.ones(3, jnp.bfloat16)}}
    return Learner(params, optax.adam(1e-3).init(params), jax.random.fold_in(key, 1))


def make_state(seed=0, *, step=7, width=2):
    key = jax.random.key(seed)
    return State(
        learner=make_learner(key),
        keys=jax.random.split(jax.random.key(seed, impl="rbg"), 3),
        count=jnp.int32(5),
        nothing=jnp.zeros((0, 4)),
        step=step,
        rate=0.1,
        done=True,
        on_host=np.arange(width, dtype=np.float64) / 3,
    )


def bits(tree):
    """Every leaf as (type, dtype, bytes): equal only if nothing at all changed."""

    def one(x):
        if hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return "key", str(jax.random.key_impl(x)), np.asarray(jax.random.key_data(x)).tobytes()
        return type(x).__name__, str(getattr(x, "dtype", "")), np.asarray(x).tobytes()

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


def test_python_numbers_fit_the_scalars_that_eval_shape_makes_of_them(tmp_path):
    checkpoint.save(tmp_path, 1, {"n": 3, "x": 0.5}, meta={})
    like = jax.eval_shape(lambda: {"n": 3, "x": 0.5})
    assert checkpoint.restore(tmp_path, like)[0] == {"n": 3, "x": 0.5}


def test_a_state_without_any_elements(tmp_path):
    checkpoint.save(tmp_path, 1, {"a": jnp.zeros((0, 2), jnp.int8)}, meta={})
    state, _ = checkpoint.restore(tmp_path, {"a": jnp.zeros((0, 2), jnp.int8)})
    assert state["a"].shape == (0, 2) and state["a"].dtype == jnp.int8


def test_named_step_and_newest(saved):
    assert checkpoint.latest(saved) == 20
    assert bits(checkpoint.restore(saved, make_state(), step=10)[0]) == bits(make_state(0))


def test_nothing_is_pickled(tmp_path):
    with pytest.raises(TypeError, match="name: a str is not an array"):
        checkpoint.save(tmp_path, 1, {"name": "hammer"}, meta={})


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
    checkpoint.save(sys.argv[1], step, {"x": np.full(50_000, step, np.float64)}, meta={"step": step})
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
        state, meta = checkpoint.restore(tmp_path, {"x": np.zeros(50_000)}, say=heard.append)
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


# ---------------------------------------------------------------- priors

CARD = {"task": "hammer", "obs_dim": 4, "act_dim": 2, "gamma": 0.99, "metrics": {"success": float("nan")}}


def make_prior(scale=1.0):
    dense = {"Dense_0": {"kernel": scale * jnp.arange(12.0).reshape(4, 3), "bias": jnp.zeros(3)}}
    return Prior(
        actor=dense,
        critic=jax.tree.map(lambda x: jnp.stack([x, x]), dense),
        value=dense,
        dynamics={},
        normalizer=Normalizer(jnp.zeros(4), jnp.ones(4)),
    )


def test_prior_round_trip(tmp_path):
    folder = checkpoint.save_prior(tmp_path / "run" / "prior", make_prior(2.0), CARD)
    prior, card = checkpoint.load_prior(folder, task="hammer", obs_dim=4, act_dim=2)
    assert bits(prior) == bits(make_prior(2.0))
    assert card == {**CARD, "metrics": {"success": "nan"}}
    assert json.loads((folder / "prior.json").read_text())["task"] == "hammer"
    assert bits(checkpoint.load_prior(tmp_path / "run")[0]) == bits(prior)


def test_saving_a_prior_again_replaces_it(tmp_path):
    checkpoint.save_prior(tmp_path / "prior", make_prior(1.0), CARD)
    checkpoint.save_prior(tmp_path / "prior", make_prior(3.0), CARD)
    assert bits(checkpoint.load_prior(tmp_path / "prior")[0]) == bits(make_prior(3.0))
    assert os.listdir(tmp_path) == ["prior"]


def test_a_digest_tells_priors_apart(tmp_path):
    prior = make_prior()
    loaded, _ = checkpoint.load_prior(checkpoint.save_prior(tmp_path / "prior", prior, CARD))
    assert checkpoint.digest(loaded) == checkpoint.digest(prior) and len(checkpoint.digest(prior)) == 12
    nudged = prior.normalizer._replace(mean=prior.normalizer.mean.at[0].add(1e-6))
    others = [prior.replace(normalizer=nudged), prior.replace(value={"renamed": prior.value}), make_prior(3.0)]
    assert len({checkpoint.digest(each) for each in [prior, *others]}) == 4


def test_a_foreign_prior_is_refused(tmp_path):
    folder = checkpoint.save_prior(tmp_path / "prior", make_prior(), CARD)
    with pytest.raises(UserError, match=r"prior: does not fit: .*task='hammer' where task='push' is needed"):
        checkpoint.load_prior(folder, task="push")
    with pytest.raises(UserError, match="obs_dim=4 where obs_dim=5 is needed"):
        checkpoint.load_prior(folder, obs_dim=5)


def test_a_prior_whose_card_lies_is_refused(tmp_path):
    folder = checkpoint.save_prior(tmp_path / "prior", make_prior(), CARD | {"obs_dim": 3})
    with pytest.raises(UserError, match="says obs_dim=3, the statistics have 4"):
        checkpoint.load_prior(folder)


def test_a_torn_prior_is_refused(tmp_path):
    folder = checkpoint.save_prior(tmp_path / "prior", make_prior(), CARD)
    damage_truncate(folder)
    with pytest.raises(UserError, match="torn"):
        checkpoint.load_prior(folder)
    with pytest.raises(UserError, match="no such folder"):
        checkpoint.load_prior(tmp_path / "elsewhere")


def test_a_checkpoint_is_not_a_prior(saved):
    with pytest.raises(UserError, match=r"prior.json: no such file"):
        checkpoint.load_prior(saved / "checkpoints" / "20")


def test_a_prior_needs_its_card_and_plain_dicts(tmp_path):
    with pytest.raises(ValueError, match="act_dim"):
        checkpoint.save_prior(tmp_path / "prior", make_prior(), {"task": "hammer", "obs_dim": 4})
    with pytest.raises(TypeError, match="nested dicts"):
        checkpoint.save_prior(tmp_path / "prior", make_prior().replace(dynamics=(jnp.ones(2),)), CARD)
    assert not Path(tmp_path / "prior").exists()
