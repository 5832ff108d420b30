"""TD-MPC2 through the commands: pretraining, priors, fine-tuning and evaluation on a point mass."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
from priors_by_hand import save_prior

from experiments import evaluate, finetune, pretrain
from sgft_jax import api
from sgft_jax.algorithms import make_policy
from sgft_jax.io.log import read_jsonl
from sgft_jax.io.priors import load_prior
from sgft_jax.learners import tdmpc2_model

PRETRAIN = """--task toy --preset tdmpc2 --no-video --config.size tiny --config.plan-samples 24 --config.n-envs 16
    --config.worlds 8 --config.env-steps 640 --config.random-transitions 160 --config.replay-capacity 320
    --config.batch-size 16 --config.updates-per-step 1 --config.chunk-steps 20 --config.eval-every 1
    --config.checkpoint-every 1 --config.eval-episodes 8 --config.report-episodes 8 --config.gamma 0.9"""
FINETUNE = """--task toy --no-video --seeds 2 --rollouts 4 --eval-every 1 --eval-episodes 4 --checkpoint-every 1
    --options.initial-rollouts 2 --options.utd 1 --options.plan-samples 24 --options.batch-size 16
    --options.replay-capacity 256"""


@pytest.fixture(autouse=True)
def _toy(toy_task, monkeypatch):
    monkeypatch.setitem(tdmpc2_model.SIZES, "tiny", tdmpc2_model.Size(8, 8, 8, 2, 2))


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


def started(home):
    """A pretraining run, made once for all tests of the module."""
    run = home / "pretrain/toy/tdmpc2/seed-0"
    if not run.exists():
        pretrain.main([*PRETRAIN.split(), "--out", str(home)])
    return run


@pytest.mark.slow
def test_a_prior_of_td_mpc2_plays_as_its_card_says(home):
    run = started(home)
    prior = load_prior(run / "prior/seed-0", task="toy")
    assert isinstance(prior.params, tdmpc2_model.TDMPC2Params) and prior.card["algorithm"] == "tdmpc2"
    measured = prior.card["metrics"]
    assert "value/off_path_explained_variance" in measured and "dynamics/error" not in measured
    assert (run / "figures/seed-0.png").stat().st_size > 10_000
    outcome = api.evaluate_prior(prior, toy.make(), episodes=4)
    (system,) = evaluate.evaluate(evaluate.EvaluateArgs(prior=run, episodes=4))["systems"]
    assert np.isfinite(outcome.total_reward).all() and system["policies"][0]["exploded"] == 0
    assert system["policies"][0]["return"] == pytest.approx(float(outcome.total_reward.mean()), rel=1e-5)
    policy = make_policy(prior.card, toy.make())
    assert jnp.isfinite(policy.value(prior.params, jnp.zeros(4)))
    acting = api.load_policy(run / "prior/seed-0")
    assert (np.abs(acting.act(np.zeros(4, np.float32))) <= 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["tdmpc2", "sgft-tdmpc2", "sgft-tdmpc2-code"])
def test_fine_tuning_and_its_continuation(home, method):
    """Two runs of 4 rollouts, one of which stops after 3 and is resumed: the same bits."""
    run = started(home)
    gap = home / "heavy.toml"
    gap.write_text("[params]\nmass = 2.0\n")
    arguments = [*FINETUNE.split(), "--method", method, "--prior", str(run), "--real", str(gap)]
    whole, parts = home / f"{method}-whole", home / f"{method}-parts"
    finetune.main([*arguments, "--out", str(whole)])
    finetune.main([*arguments, "--out", str(parts), "--rollouts", "3"])
    finetune.main([*arguments, "--out", str(parts), "--resume"])
    folders = [out / f"finetune/toy/heavy/{method}/seeds-0-1" for out in (whole, parts)]
    curves = [[read_jsonl(folder / name)[-1] for name in ("eval.jsonl", "metrics.jsonl")] for folder in folders]
    assert curves[0] == curves[1]
    assert json.loads((folders[0] / "summary.json").read_text())["final"]["rollouts"] == 4
    tuned = [load_prior(folder / "policy/seed-1", task="toy") for folder in folders]
    jax.tree.map(np.testing.assert_array_equal, tuned[0].params, tuned[1].params)
    assert tuned[0].card["finetuned"]["method"] == method


def test_methods_refuse_the_other_algorithms_priors(tmp_path, capsys):
    save_prior(tmp_path / "seed-0", 0)
    gap = tmp_path / "heavy.toml"
    gap.write_text("[params]\nmass = 2.0\n")
    common = ["--task", "toy", "--real", str(gap), "--prior", str(tmp_path), "--out", str(tmp_path)]
    with pytest.raises(SystemExit) as stopped:
        finetune.main(["--method", "sgft-tdmpc2", *common])
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert "seed-0: sgft-tdmpc2 needs a prior of tdmpc2, not of sac" in error and error.count("\n") == 1
    assert "--preset robust-tdmpc2" in error
