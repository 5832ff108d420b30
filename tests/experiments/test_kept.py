"""Simulated transitions that runs keep on disk: collected once, under all that decides them, and never half."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
from priors_by_hand import save_prior

import envs
from envs.types import Transition
from experiments.runner import kept
from sgft_jax.data.replay import ReplayState
from sgft_jax.io.priors import load_prior
from sgft_jax.train.simulation import SimulatedRows
from sgft_jax.types import Prior, Simulation

ENV, NEEDS = toy.make(), Simulation(6, 0.5)


@pytest.fixture
def priors(tmp_path):
    for seed in (0, 1):
        save_prior(tmp_path / f"seed-{seed}", seed)
    return [load_prior(tmp_path / f"seed-{seed}") for seed in (0, 1)]


@pytest.fixture
def asked(tmp_path, priors):
    """asked(...) -> the rows, and whether they were collected for it; each collection has numbers of its own."""
    count = 0

    def collect(heard):
        nonlocal count
        count += 1
        rows = Transition(*(jnp.arange(12.0).reshape(1, 6, 2) + jnp.float32(count) for _ in Transition._fields))
        return SimulatedRows(
            ReplayState(rows, jnp.zeros(1, jnp.int32), jnp.full(1, 6, jnp.int32)), jnp.full((1, 2), jnp.float32(0.3))
        )

    def ask(folder=tmp_path / "cache", env=ENV, priors=priors[:1], needs=NEEDS):
        before = count
        rows = kept.simulated_rows(folder, env, priors, needs, collect)
        return rows, count > before

    return ask


def test_what_one_run_collects_others_read_to_the_bit(asked, capsys):
    (first, made), (second, again) = asked(), asked()
    assert (made, again) == (True, False)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert a.dtype == b.dtype and a.weak_type == b.weak_type
        np.testing.assert_array_equal(a, b)
    assert "collecting 6 simulated transitions" in capsys.readouterr().err


def test_all_that_decides_them_is_in_the_key(asked, priors, monkeypatch):
    assert asked()[1]
    gap = {"name": "wrong", "params": {"mass": 3.0}, "effects": {}, "scene": ""}
    others = [
        {"priors": priors[1:]},
        {"priors": priors},
        {"priors": [Prior(priors[0].params, {**priors[0].card, "gap": gap})]},
        {"env": ENV._replace(name="other")},
        {"env": ENV._replace(impl="c" if ENV.impl != "c" else "jax")},
        {"needs": Simulation(7, 0.5)},
        {"needs": Simulation(6, 0.4)},
    ]
    assert all(asked(**other)[1] for other in others)
    assert not any(asked(**other)[1] for other in [{}, *others, {"needs": NEEDS._replace(offline_updates=9)}])
    monkeypatch.setattr(kept, "_code", lambda: "changed")
    assert asked()[1]


def test_of_a_damaged_file_one_line_is_said_and_all_is_collected_anew(asked, tmp_path, capsys):
    asked(tmp_path / "other", needs=Simulation(7, 0.5))
    (other,) = (tmp_path / "other").iterdir()
    asked()
    (path,) = (tmp_path / "cache").iterdir()
    whole, middle = path.read_bytes(), path.stat().st_size // 2
    for content in (whole[:middle], b"", whole[:middle] + b"?" + whole[middle + 1 :], other.read_bytes()):
        path.write_bytes(content)
        capsys.readouterr()
        assert asked()[1]
        (line,) = capsys.readouterr().out.splitlines()
        assert line.startswith(str(path)) and line.endswith("collected anew")
        assert not asked()[1] and list(path.parent.iterdir()) == [path]


def test_a_place_that_cannot_be_written_only_costs_the_next_run_time(asked, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert asked(tmp_path / "file" / "cache")[1]
    assert "the next run collects anew" in capsys.readouterr().out
    assert asked(None)[1] and capsys.readouterr().out == ""


def test_what_was_read_longest_ago_makes_room(asked, tmp_path, monkeypatch):
    asked()
    (path,) = (tmp_path / "cache").iterdir()
    monkeypatch.setattr(kept, "_MOST", path.stat().st_size)
    asked(needs=Simulation(7, 0.5))
    (left,) = (tmp_path / "cache").iterdir()
    assert left != path
    monkeypatch.setattr(kept, "_MOST", 1)
    asked(needs=Simulation(8, 0.5))  # larger than all that may lie there
    assert list((tmp_path / "cache").iterdir()) == [left]


def test_rows_of_the_users_own_tasks_are_not_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("SGFT_CACHE_DIR", str(tmp_path))
    monkeypatch.setitem(envs.TASKS, "toy", "toy")
    assert kept.kept_in("hammer") == tmp_path / "simulated"
    assert kept.kept_in("toy") is kept.kept_in("mine.py") is None
    monkeypatch.setenv("SGFT_CACHE_DIR", "off")
    assert kept.kept_in("hammer") is None
