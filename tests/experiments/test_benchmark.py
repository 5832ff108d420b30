"""The benchmark measures what it says it does; how fast things are is not tested."""

import json
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.franka import hammer
from experiments import benchmark
from experiments.benchmark import BenchmarkConfig, bare_steps, fastest, main
from sgft_jax.types import UserError


def test_the_fastest_call_counts_without_the_first(monkeypatch):
    times = iter([10.0, 10.5, 20.0, 20.25, 30.0, 31.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(times))
    calls = []
    assert fastest(lambda state: calls.append(state) or state + 1, 0, repeats=3) == 0.25
    assert calls == [0, 1, 2, 3]  # the first call compiles; each call goes on from the one before


def test_numbers_reach_the_disk(tmp_path, capsys):
    config = BenchmarkConfig(
        tasks=("hammer",), worlds=(2,), impls=("c",), control_steps=2, repeats=1, width=8, batches=(4,), updates=2,
        out=tmp_path,
    )  # fmt: skip
    with jax.numpy_rank_promotion("allow"):  # the hand-written update broadcasts ensembles against batches
        measured = main(config)
    (physics,), (updates,) = measured["physics"], measured["updates"]
    assert physics["worlds"] == 2 and physics["env_per_s"] > 0
    assert updates["updates/bare"] == pytest.approx(updates["updates_per_s"] / updates["bare_per_s"])
    stored = json.loads((tmp_path / "benchmark" / "summary.json").read_text())
    assert stored["physics"] == [physics] and stored["updates"] == [updates]
    assert stored["provenance"]["versions"]["mujoco"]
    assert "hammer" in capsys.readouterr().out


@pytest.mark.slow
def test_bare_steps_are_those_of_mjx(key):
    """Worlds differ by their commands, and time passes as asked for."""
    host = hammer.build({p.name: p.nominal for p in hammer.PARAMETERS}).compile()
    run, start = bare_steps(host, "jax", worlds=2, control_steps=1, substeps=3)
    before = np.array(start[0])
    with jax.numpy_rank_promotion("allow"):
        qpos, qvel, _ = run(start)
    assert jnp.isfinite(qpos).all() and np.abs(qpos - before).max() > 1e-4
    assert np.abs(qvel[0] - qvel[1]).max() > 1e-3


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"tasks": ("hamer",)}, "--tasks: there is no 'hamer', did you mean 'hammer'?"),
        ({"worlds": (4, 0)}, "--worlds is 0"),
        ({"repeats": 0}, "--repeats is 0"),
        ({"batches": ()}, "--batches is 0"),
    ],
)
def test_bad_input(change, complaint, tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "physics_speed", lambda *_: pytest.fail("measured"))
    with pytest.raises(UserError, match=complaint.replace("?", r"\?")):
        main(BenchmarkConfig(out=tmp_path, **change))
