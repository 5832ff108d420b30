"""Recurrent SAC through the commands, on push: pretraining, its prior, zero-shot, and what refuses it."""

import json

import jax
import numpy as np
import pytest

from experiments import finetune, pretrain
from sgft_jax import api
from sgft_jax.io.priors import load_prior
from sgft_jax.learners.recurrent import RecurrentParams

PRETRAIN = """--task push --preset recurrent --no-video
    --config.n-envs 4 --config.worlds 2 --config.env-steps 80 --config.random-transitions 160 --config.gru 8
    --config.replay-capacity 160 --config.batch-size 4 --config.updates-per-step 1 --config.chunk-steps 10
    --config.eval-every 1 --config.checkpoint-every 1 --config.eval-episodes 2 --config.report-episodes 2"""
FINETUNE = "--task push --real default --no-video --seeds 2 --rollouts 2 --eval-every 1 --eval-episodes 2"


@pytest.fixture(autouse=True)
def _engine():
    with jax.numpy_rank_promotion("allow"):  # MJX broadcasts matrices against vectors
        yield


@pytest.mark.slow
def test_from_pretraining_to_a_policy_that_acts(tmp_path, capsys):
    pretrain.main([*PRETRAIN.split(), "--out", str(tmp_path)])
    run = tmp_path / "pretrain/push/recurrent/seed-0"
    assert "--method recurrent" in capsys.readouterr().out
    prior = load_prior(run / "prior/seed-0")
    assert isinstance(prior.params, RecurrentParams) and prior.card["algorithm"] == "recurrent"
    assert not any(name.startswith(("value/", "dynamics/")) for name in prior.card["metrics"])

    given = [*FINETUNE.split(), "--prior", str(run), "--out", str(tmp_path)]
    finetune.main(["--method", "recurrent", *given])
    tuned = tmp_path / "finetune/push/default/recurrent/seeds-0-1"
    assert json.loads((tuned / "summary.json").read_text())["final"]["rollouts"] == 2

    with pytest.raises(SystemExit) as stopped:
        finetune.main(["--method", "sac", *given])
    error = capsys.readouterr().err.splitlines()[-1]
    assert stopped.value.code == 2 and "sac needs a prior of sac, not of recurrent" in error

    first, after = (api.load_policy(folder) for folder in (run / "prior/seed-0", tuned / "policy/seed-1"))
    still = np.zeros(first.env.measured_dim, np.float32)
    acts = [[policy.act(still) for _ in range(3)] for policy in (first, after)]
    np.testing.assert_array_equal(*acts)
    assert (acts[0][0] != acts[0][1]).any(), "it remembers"
    first.reset()
    np.testing.assert_array_equal(first.act(still), acts[0][0])
