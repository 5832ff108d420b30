"""The pretraining command end to end, on a point mass: train, kill, resume, and what it leaves behind."""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import toy
from jax import monitoring

import envs
from envs import gaps
from experiments import pretrain
from experiments.runner import pretrain_run, progress
from experiments.runner.ahead import Ahead
from sgft_jax import api
from sgft_jax.io import checkpoint
from sgft_jax.io.log import MetricsLog, read_jsonl
from sgft_jax.io.priors import load_prior
from sgft_jax.presets import PRESETS
from sgft_jax.train import finetuning

TESTS = Path(__file__).parent.parent
OPTIONS = """--task toy --preset cpu --no-video --config.n-envs 32 --config.worlds 16 --config.env-steps 10240
    --config.random-transitions 1024 --config.replay-capacity 8192 --config.batch-size 128 --config.chunk-steps 40
    --config.updates-per-step 8 --config.network.hidden 32 32 --config.gamma 0.9 --config.eval-every 2
    --config.checkpoint-every 3 --config.eval-episodes 64 --config.lr 1e-3 --config.tau 0.02
    --config.value-episodes 512 --config.value-updates 2000"""
TINY = OPTIONS.split()  # 8 chunks of 1,280 env steps; evaluations after 0, 2, 4, 6, 8 and checkpoints after 3, 6, 8
SHORT = """--no-report --config.env-steps 640 --config.chunk-steps 10 --config.updates-per-step 2 --config.eval-every 1
    --config.eval-episodes 8 --config.choose-from 0 --config.network.hidden 8 --config.ensemble-size 1
    --config.value-episodes 8 --config.value-updates 40"""
PROGRAM = """
import os, signal, sys
import envs
envs.TASKS["toy"] = "toy"
from experiments import pretrain
from sgft_jax.io.log import MetricsLog
write = MetricsLog.metrics
def metrics(self, *args):
    write(self, *args)
    os.kill(os.getpid(), signal.SIGKILL)
MetricsLog.metrics = metrics
pretrain.main(sys.argv[1:])
"""


def interrupted(write, *, after):
    """`write`, but the user presses Ctrl-C at the call after `after` ones."""
    left = iter(range(after))

    def metrics(*args):
        if next(left, None) is None:
            raise KeyboardInterrupt
        write(*args)

    return metrics


pytestmark = pytest.mark.usefixtures("toy_task")


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def finished(out):
    """Two seeds, start to end, in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(envs.TASKS, "toy", "toy")
        patch.setattr(os, "environ", os.environ.copy())
        pretrain.main([*TINY, "--seeds", "2", "--out", str(out)])
    return out / "pretrain/toy/cpu/seeds-0-1"


def complaint(argv, capsys):
    with pytest.raises(SystemExit) as stopped:
        pretrain.main(argv)
    *phases, error = capsys.readouterr().err.splitlines()
    assert stopped.value.code == 2 and error.startswith("error: ") and "error" not in "".join(phases).lower()
    return error


def compiled_slowly(function):
    """The same, for which JAX compiles for 1.5 seconds."""

    def slowly(*args):
        name = "/jax/core/compile/backend_compile_duration"
        monitoring.record_scalar(name, 0.0)
        time.sleep(1.5)
        monitoring.record_event_duration_secs(name, 1.5)
        return function(*args)

    return slowly


@pytest.fixture(scope="module")
def short(out):
    """Two seeds that have hardly begun to learn: two chunks, an evaluation after each, what is made of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(envs.TASKS, "toy", "toy")
        patch.setattr(os, "environ", os.environ.copy())
        for limit in ("_AGAIN", "_SELDOM"):
            patch.setattr(progress, limit, 0.5)
        patch.setattr(Ahead, "wait", compiled_slowly(Ahead.wait))
        with contextlib.redirect_stderr(io.StringIO()) as words:
            pretrain.main([*TINY, *SHORT.split(), "--seeds", "2", "--out", str(out / "short")])
    (out / "short/words").write_text(words.getvalue())
    return out / "short/pretrain/toy/cpu/seeds-0-1"


@pytest.mark.heavy
def test_a_run_leaves_a_prior_per_seed_that_is_its_best_evaluation(short):
    summary, curve = json.loads((short / "summary.json").read_text()), read_jsonl(short / "eval.jsonl")
    assert summary["env_steps"] == 2 * 10 * 32 and summary["updates"] == 2 * 10 * 2
    assert [line["step"] for line in curve] == [0, 320, 640]
    for seed, found in zip((0, 1), summary["seeds"], strict=True):
        assert found["seed"] == seed
        assert found["success/interval"][0] <= found["success"] <= found["success/interval"][1]
        best = max(curve, key=lambda line: (line["success"][seed], line["return"][seed]))
        assert found["best/env_steps"] == best["step"]
        assert found["best/success"] == pytest.approx(best["success"][seed])
        assert found["best/return"] == pytest.approx(best["return"][seed])
        prior = load_prior(short / "prior" / f"seed-{seed}", task="toy", obs_dim=4, act_dim=2)
        assert prior.card["metrics"] == found and prior.card["config"]["n_envs"] == 32
        assert prior.card["network"]["hidden"] == [8]
        assert prior.params.actor["Dense_0"]["kernel"].shape == (4, 8)


@pytest.mark.heavy
def test_a_run_says_what_it_is_doing(short, out):
    words, first = (out / "short/words").read_text().splitlines(), {}
    for line in words:
        first.setdefault(line.partition(" (")[0], line)
    begun = [line for line in first.values() if not line.startswith(("still ", "starting", "working"))]
    assert begun == [
        "building 32 worlds (about 3 s)",
        "compiling the training (about 30 s, once)",
        "collecting 2,048 random transitions (about 15 s, once)",
        "evaluating (about 15 s, once)",
        "training",
        "writing a checkpoint",
        "fitting V_sim (about 60 s, once)",
        "playing fresh episodes for the cards (about 5 s)",
    ]
    assert "still collecting 2,048 random transitions (0:00:01 so far, compiling)" in words


@pytest.mark.slow
def test_sac_learns_the_toy_task_and_leaves_a_prior_per_seed(finished):
    summary = json.loads((finished / "summary.json").read_text())
    assert summary["env_steps"] == 10_240  # 8 chunks * 40 steps * 32 environments
    assert summary["updates"] == 2_560  # 8 * 40 * 8
    for seed, found in zip((0, 1), summary["seeds"], strict=True):
        assert found["seed"] == seed and found["success"] > 0.9
        assert found["success/interval"][0] <= found["success"] <= found["success/interval"][1]
        prior = load_prior(finished / "prior" / f"seed-{seed}", task="toy", obs_dim=4, act_dim=2)
        assert prior.card["metrics"] == found and prior.card["config"]["n_envs"] == 32
        assert prior.card["network"]["hidden"] == [32, 32]
        assert prior.params.actor["Dense_0"]["kernel"].shape == (4, 32)
        assert (finished / "figures" / f"seed-{seed}.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_prior_is_the_best_evaluation(finished):
    curve = read_jsonl(finished / "eval.jsonl")
    assert [line["step"] for line in curve] == [0, 2_560, 5_120, 7_680, 10_240]
    for i, found in enumerate(json.loads((finished / "summary.json").read_text())["seeds"]):
        best = max(curve, key=lambda line: (line["success"][i], line["return"][i]))
        assert found["best/env_steps"] == best["step"]
        assert found["best/success"] == pytest.approx(best["success"][i])
        assert found["best/return"] == pytest.approx(best["return"][i])


@pytest.mark.slow
def test_value_and_model_are_worth_something(finished):
    """On an almost noise-free point mass both must be good."""
    for found in json.loads((finished / "summary.json").read_text())["seeds"]:
        assert found["value/system_explained_variance"] > 0.95 and found["value/system_rank_correlation"] > 0.9
        assert found["value/off_path_explained_variance"] > 0.95 * found["value/explainable_variance"]
        assert abs(found["value/off_path_bias_of_range"]) < 0.03
        assert len(found["dynamics/error"]) == 10
        assert max(found["dynamics/error"]) < 0.5 * min(found["dynamics/error_if_nothing_moved"])
    arrays = np.load(finished / "report/seed-0.npz", allow_pickle=False)
    assert arrays["value"].shape == arrays["returns"].shape == (64,)  # a state of each


@pytest.mark.slow
def test_sgft_recovers_from_a_turned_command_frame(finished):
    """Commands turned by 80 degrees: the simulators' policies circle, 8 real rollouts bring them back to the goal."""
    env = toy.make()
    gap = gaps.from_dict(env, "turned", {"effects": {"action_rotation": 1.4}})
    priors = [load_prior(finished / f"prior/seed-{i}") for i in (0, 1)]
    options = {"lr_actor": 1e-3, "lr_critic": 1e-3, "batch_size": 64, "replay_capacity": 800, "utd": 4.0}
    tuning = api.setup(env, gap, priors, method="sgft-sac", seeds=4, critic_warmup=100, actor_ramp=0, **options)

    def success(policy, states):
        return np.asarray(finetuning.evaluate(policy, tuning.system, states, tuning.seeds, 16).success.mean(1))

    steps = finetuning.finetune(*tuning, rollouts=8)
    begun, _ = next(steps)
    before = success(tuning.finetuner, begun.agent)
    *_, (ended, _) = steps
    after, best = success(tuning.finetuner, ended.agent), success(tuning.finetuner.policy, ended.best.params)
    assert before.mean() < 0.2 and after.min() > 0.8 and best.mean() > 0.8


@pytest.mark.slow
def test_killed_and_resumed_is_bit_for_bit_uninterrupted(finished, tmp_path, monkeypatch):
    argv = [*TINY, "--seeds", "2", "--out", str(tmp_path)]
    cut = tmp_path / "pretrain/toy/cpu/seeds-0-1"

    paths = {"PYTHONPATH": f"{TESTS}:{TESTS.parent}", "SGFT_CACHE_DIR": str(TESTS.parent / ".cache/jax")}
    killed = subprocess.run([sys.executable, "-c", PROGRAM, *argv], env={**os.environ, **paths}, timeout=300)
    assert killed.returncode == -signal.SIGKILL  # after one chunk, before the first checkpoint
    assert not (cut / "checkpoints").exists() and len(read_jsonl(cut / "metrics.jsonl")) == 1

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as stopped:
        patch.setattr(MetricsLog, "metrics", interrupted(MetricsLog.metrics, after=5))
        pretrain.main([*argv, "--resume"])
    assert stopped.value.code == 130
    assert len(read_jsonl(cut / "metrics.jsonl")) == 5 and checkpoint.latest(cut) == 3

    pretrain.main([*argv, "--resume"])
    for name in ("metrics.jsonl", "eval.jsonl"):
        assert (cut / name).read_bytes() == (finished / name).read_bytes()
    found, wanted = (json.loads((run / "summary.json").read_text())["seeds"] for run in (cut, finished))
    assert found == wanted
    priors = [load_prior(run / "prior/seed-1").params for run in (cut, finished)]
    jax.tree.map(np.testing.assert_array_equal, *priors)


@pytest.mark.slow
def test_killed_while_the_value_is_fitted_it_ends_with_the_same_bits(finished, tmp_path, monkeypatch):
    argv = [*TINY, "--seeds", "2", "--out", str(tmp_path)]

    def killed(*args):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(pretrain_run._Run, "_value", killed)
        pretrain.main(argv)
    cut = tmp_path / "pretrain/toy/cpu/seeds-0-1"
    assert not (cut / "prior").exists()
    pretrain.main([*argv, "--resume"])
    priors = [load_prior(run / "prior/seed-1").params for run in (cut, finished)]
    jax.tree.map(np.testing.assert_array_equal, *priors)


@pytest.mark.slow
def test_a_finished_run_is_neither_repeated_nor_changed(finished, out, capsys):
    argv = [*TINY, "--seeds", "2", "--out", str(out)]
    assert "exists already" in complaint(argv, capsys)
    assert "config.tau was 0.02, now 0.1" in complaint([*argv, "--resume", "--config.tau", "0.1"], capsys)
    before = (finished / "metrics.jsonl").read_bytes()
    pretrain.main([*argv, "--resume"])
    assert (finished / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (
            ["--task", "toi"],
            "task: there is no 'toi', did you mean 'toy'? Choose from: cheetah-run, cheetah-run-du, halfcheetah,",
        ),
        (
            ["--preset", "fats"],
            "--preset: there is no 'fats', did you mean 'fast'? Choose from: asymmetric, cpu, doraemon",
        ),
        (["--config.gama", "0.9"], "did you mean --config.gamma?"),
        (["--task", "toy", "--seeds", "0"], "--seeds is 0: must be at least 1"),
        (["--task", "toy", "--real", "mild"], "toy has no gap 'mild'"),
        (["--task", "toy", "--config.n-envs", "0"], "option n-envs is 0: must be at least 1"),
        (["--task", "toy", "--config.gamma", "2"], "option gamma is 2.0: must be at least 0 and less than 1"),
        (["--task", "toy", "--config.lr", "nan"], "option lr is nan: must be a positive number"),
        (["--task", "toy", "--config.env-steps", "-5"], "option env-steps is -5: must be at least 1"),
        (["--task", "toy", "--config.network.hidden"], "hidden is empty: must be one or more layers"),
        (["--task", "toy", "--config.network.hidden", "0"], "hidden is 0: must be at least 1"),
        (["--task", "toy", "--seed", "4294967296"], "--seed is 4294967296: seeds go from 0 to 2147483647"),
        (["--task", "toy", "--config.batch-size", "999999999"], "GiB free: lower --config.batch-size"),
        (["--task", "toy", "--set", "latency=0.1"], "name one with --real"),
        (["--task", "toy", "--config.replay-capacity", "9"], "option replay-capacity is 9: must be at least n-envs = "),
        (
            ["--task", "toy", "--config.replay-capacity", "2000000000"],
            "GiB free: lower --config.replay-capacity",
        ),
        (["--task", "toy", "--resume"], "nothing to resume there"),
    ],
)
def test_a_bad_command_is_one_line_and_code_2(argv, words, capsys, tmp_path):
    assert words in complaint([*argv, "--out", str(tmp_path)], capsys)
    assert not list(tmp_path.iterdir())


def test_presets_give_the_defaults_that_single_options_change(monkeypatch):
    seen = []
    monkeypatch.setattr(pretrain, "pretrain", seen.append)
    pretrain.main(["--preset=paper", "--config.gamma", "0.5"])
    assert seen[0].preset == "paper" and seen[0].config.gamma == 0.5
    assert seen[0].config.n_envs == PRESETS["paper"].n_envs != PRESETS["fast"].n_envs


@pytest.mark.slow
def test_training_on_the_real_system_has_its_own_folder(tmp_path):
    gap = tmp_path / "strange.toml"
    gap.write_text("[params]\nmass = 2.0\nfriction = 4.0\n[effects]\naction_scale = 0.5\n")
    argv = [*TINY, "--config.env-steps", "1280", "--real", str(gap), "--set", "mass=3", "--out", str(tmp_path)]
    pretrain.main(argv)
    (card,) = tmp_path.glob("pretrain/toy/cpu-on-strange+mass=3/seed-0/prior/seed-0/prior.json")
    assert json.loads(card.read_text())["gap"]["params"] == {"mass": 3, "friction": 4.0}


def test_out_that_is_a_file_is_one_line(capsys, tmp_path):
    (tmp_path / "file").touch()
    assert "file is a file; choose another --out" in complaint(["--out", str(tmp_path / "file")], capsys)


@pytest.mark.slow
def test_training_that_diverges_stops_in_one_line_and_a_failed_start_blocks_nobody(capsys, tmp_path, monkeypatch):
    argv = [*TINY, "--config.env-steps", "2560", "--out", str(tmp_path)]
    said = complaint([*argv, "--config.lr", "1e30"], capsys)
    assert "training has diverged: " in said and "is not finite after 1,280 env steps; there is no checkpoint" in said
    (lines,) = (read_jsonl(path) for path in tmp_path.rglob("metrics.jsonl"))
    assert len(lines) == 1
    pretrain.main(argv)  # neither --resume nor --overwrite: nothing was achieved that could be lost
