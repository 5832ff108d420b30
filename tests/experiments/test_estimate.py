"""Priors are given an estimator, and fine-tuning reads it."""

import json
import shutil

import jax
import numpy as np
import pytest

from experiments import estimate, finetune
from experiments.runner import estimating
from sgft_jax.io.cards import SHIPPED
from sgft_jax.io.priors import load_prior
from sgft_jax.posterior import decision, interface
from sgft_jax.posterior.estimator import without_estimator


@pytest.fixture
def prior(tmp_path):
    return shutil.copytree(SHIPPED / "push/seed-0", tmp_path / "prior/seed-0")


@pytest.mark.slow
def test_a_prior_is_given_an_estimator_and_adapts(prior, tmp_path, monkeypatch, capsys):
    for module in (decision, interface):
        for name, value in {"CANDIDATES": 2, "JUDGES": 2}.items():
            monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(estimating, "_AT_ONCE", 2)  # so that both engines make lessons
    before = load_prior(prior)
    with jax.numpy_rank_promotion("allow"):  # MJX broadcasts matrices against vectors
        estimate.main(estimate.EstimateArgs(prior=prior, lessons=4, updates=1, impl="jax"))
    assert "after 10 rollouts it is" in capsys.readouterr().out
    after = load_prior(prior)
    same = jax.tree.map(np.array_equal, *(without_estimator(prior.params) for prior in (before, after)))
    assert jax.tree.all(same)
    learned, shipped = (jax.tree.leaves(prior.params.estimator) for prior in (after, before))
    assert any(not np.array_equal(*pair) for pair in zip(learned, shipped, strict=True))
    ranks = np.asarray(after.params.estimator.ranks)
    with jax.numpy_rank_promotion("allow"):
        estimate.main(estimate.EstimateArgs(prior=prior, start=prior, lessons=2, updates=1, impl="c"))
    again = load_prior(prior).params.estimator
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), after.params.estimator.params, again.params)
    assert 0 < max(jax.tree.leaves(moved)) < 0.01 and not np.array_equal(ranks, again.ranks)
    options = ["--task", "push", "--method", "posterior", "--prior", str(prior), "--rollouts", "2", "--no-video"]
    finetune.main([*options, "--seeds", "1", "--eval-episodes", "2", "--impl", "c", "--out", str(tmp_path / "runs")])
    (summary,) = (tmp_path / "runs").rglob("summary.json")
    assert json.loads(summary.read_text())
    (policy,) = (tmp_path / "runs").glob("finetune/push/*/posterior/*/policy/seed-*")
    tuned = load_prior(policy)
    assert tuned.params.estimator is None and tuned.card["estimator"] is None and tuned.params.distortion is not None


def test_finetuning_says_how_an_estimator_is_made(tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        options = ["--task", "panda-push", "--method", "posterior", "--prior", "shipped:panda-push"]
        finetune.main([*options, "--real", "stand-in", "--out", str(tmp_path)])
    assert stopped.value.code == 2 and "experiments.estimate" in capsys.readouterr().err
