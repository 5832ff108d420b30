"""The fine-tuning command end to end, on a point mass whose force is turned by 30 degrees in reality."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import toy
from experiments.algorithms import make_player
from priors_by_hand import save_prior

import envs
from experiments import cli, evaluate, finetune, finetuning, video
from experiments.evaluation import play_episodes
from sgft_jax.io import checkpoint, runs
from sgft_jax.io.log import read_jsonl
from sgft_jax.io.real import RealStore
from sgft_jax.methods import FinetuneConfig, get_method
from sgft_jax.types import UserError

TESTS = Path(__file__).parent.parent
GAP = "[params]\nmass = 2.0\nfriction = 4.0\n[effects]\naction_rotation = 0.52\n"
OPTIONS = """--task toy --rollouts 5 --initial-rollouts 2 --eval-every 2 --eval-episodes 8 --checkpoint-every 2
    --utd 0.5 --options.batch-size 16 --options.branches 2 --options.critic-warmup 0 --options.actor-ramp 0
    --options.replay-capacity 256 --no-video"""
START = """
import os, signal, sys
import envs
envs.TASKS["toy"] = "toy"
from experiments import finetune
from experiments.finetune_record import Record
from sgft_jax.io.log import MetricsLog
"""
PROGRAM = f"""{START}
write = MetricsLog.metrics
def metrics(self, step, values):
    write(self, step, values)
    if values["rollouts"] == 5:
        os.kill(os.getpid(), signal.SIGKILL)
MetricsLog.metrics = metrics
finetune.main(sys.argv[1:])
"""
OFFLINE = f"""{START}
finetune._OFFLINE_PART = 10
write = Record.checkpoint_offline
def checkpoint_offline(self, state, updates):
    write(self, state, updates)
    if updates == 20:
        os.kill(os.getpid(), signal.SIGKILL)
Record.checkpoint_offline = checkpoint_offline
finetune.main(sys.argv[1:])
"""


@pytest.fixture(autouse=True)
def _toy(monkeypatch):
    monkeypatch.setitem(envs.TASKS, "toy", "toy")
    monkeypatch.setattr(os, "environ", os.environ.copy())
    monkeypatch.setattr(cli, "set_up", lambda: None)  # the tests have their own cache and environment


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Two untrained priors and a gap."""
    home = tmp_path_factory.mktemp("runs")
    for seed in (0, 1):
        save_prior(home / f"pretrain/toy/fast/seeds-0-1/prior/seed-{seed}", seed)
    (home / "turned.toml").write_text(GAP)
    (home / "heavy.toml").write_text("[params]\nmass = [1.5, 2.5]\n")  # its worlds vary, those of the other do not
    return home


def argv(home, method="sgft-sac", *more, seeds=2, out=None, reals=("turned",)):
    """Two seeds have a device each."""
    given = ["--method", method, "--seeds", seeds, "--devices", seeds]
    given += ["--out", out or home, "--real", *(home / f"{real}.toml" for real in reals)]
    given += ["--prior", home / "pretrain/toy/fast/seeds-0-1"]
    return [*OPTIONS.split(), *map(str, given), *more]


def call(arguments):
    finetune.main(arguments)


def run(home, method):
    """A finished run of two seeds, made once for all tests of the module."""
    folder = home / "finetune/toy/turned" / method / "seeds-0-1"
    if not folder.exists():
        call(argv(home, method))
    return folder


def killed(program, arguments):
    """Runs a program in a process of its own, which kills itself."""
    paths = {"PYTHONPATH": f"{TESTS}:{TESTS.parent}", "SGFT_CACHE_DIR": str(TESTS.parent / ".cache/jax")}
    done = subprocess.run([sys.executable, "-c", program, *arguments], env={**os.environ, **paths}, timeout=300)
    assert done.returncode == -signal.SIGKILL


def complaint(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        call(arguments)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and error.startswith("error: ") and error.count("\n") == 1
    return error


@pytest.mark.parametrize("method", ["sgft-sac", pytest.param("sac", marks=pytest.mark.slow)])
def test_a_run_leaves_curve_summary_policies_and_every_rollout(home, method):
    folder = run(home, method)
    curve = read_jsonl(folder / "eval.jsonl")
    assert [line["rollouts"] for line in curve] == [0, 2, 4, 5]
    assert [line["step"] for line in curve] == [0, 40, 80, 100]  # 20 steps a rollout
    assert curve[2]["robot_minutes"] == pytest.approx(4 * 20 * 0.1 / 60)
    assert [line["rollouts"] for line in read_jsonl(folder / "metrics.jsonl")] == [2, 3, 4, 5]
    assert all(len(line["success"]) == 2 for line in curve)
    summary = json.loads((folder / "summary.json").read_text())
    numbers = {"zero_shot", "final", "deepest_fall", "transitions_until_held", "seeds"}
    assert set(summary) == {"task", "method", "impl", "gap", *numbers}
    assert summary["gap"]["effects"] == {"action_rotation": 0.52} and summary["final"]["transitions"] == 100
    rollouts = RealStore(folder).load()
    assert len(rollouts) == 5 and rollouts[0]["obs"].shape == (2, 20, 4) and rollouts[0]["valid"].all()
    assert (folder / "figures/success.png").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize("method", ["rlpd", "iql"])
def test_methods_that_learn_from_the_simulator_too(home, method, capsys):
    """They start from nothing, so the simulator's policy makes the initial rollouts: those of any other method."""
    run(home, "sac")
    offline = ["--options.offline-updates", "20"] if method == "iql" else []
    call(argv(home, method, "--options.simulated-transitions", "390", *offline))
    assert "simulated: 40 episodes, returns from -" in capsys.readouterr().out  # 20 steps each, two priors
    mine, others = (RealStore(home / f"finetune/toy/turned/{name}/seeds-0-1").load() for name in (method, "sac"))
    for i in range(2):
        np.testing.assert_allclose(mine[i]["obs"], others[i]["obs"], atol=1e-5)
    assert not np.allclose(mine[2]["obs"], others[2]["obs"], atol=1e-2)


def test_the_actor_of_rlpd_follows_the_number_of_updates(home, tmp_path, monkeypatch):
    def stop(method, config, **_):
        raise RuntimeError(f"an actor update in {config.policy_delay}")

    monkeypatch.setattr(finetune, "make_finetuner", stop)
    for utd in (10, 40):
        with pytest.raises(RuntimeError, match=f"in {utd}$"):
            call(argv(home, "rlpd", "--utd", str(utd), "--options.simulated-share", "0", out=tmp_path / str(utd)))


@pytest.mark.parametrize("method", ["sgft-sac", "sac"])
def test_value_and_statistics_of_the_prior_stay_frozen_and_its_actor_moves(home, method):
    for seed in (0, 1):
        before, _ = checkpoint.load_prior(home / f"pretrain/toy/fast/seeds-0-1/prior/seed-{seed}")
        after, card = checkpoint.load_prior(run(home, method) / f"policy/seed-{seed}", task="toy")
        jax.tree.map(np.testing.assert_array_equal, (before.value, before.normalizer), (after.value, after.normalizer))
        assert not np.array_equal(before.actor["Dense_0"]["kernel"], after.actor["Dense_0"]["kernel"])
        assert card["finetuned"]["method"] == method and card["finetuned"]["seed"] == seed


def test_the_policies_are_what_the_run_evaluated(home, capsys):
    found = evaluate.evaluate(evaluate.EvaluateArgs(run=run(home, "sac"), real=str(home / "turned.toml"), episodes=30))
    assert [Path(p["policy"]).name for p in found["policies"]] == ["seed-0", "seed-1"]
    final = read_jsonl(run(home, "sac") / "eval.jsonl")[-1]["return"]
    assert [p["return"] for p in found["policies"]] == pytest.approx(final, abs=6.0)  # other episodes, 30 and 8


def test_a_planner_leaves_priors_that_plan(home):
    """The card says how, until a method that does not plan goes on from there."""
    run(home, "sgft-mpc")
    folder = run(home, "sgft-mpc") / "policy/seed-1"
    prior, card = checkpoint.load_prior(folder, task="toy")
    assert card["plan"] == {"horizon": 1, "samples": 128, "noise": 0.5}
    env, before = toy.make(), checkpoint.load_prior(home / "pretrain/toy/fast/seeds-0-1/prior/seed-1")[0]
    key, obs = jax.random.key(0), np.array([0.5, -0.5, 0.1, 0.0], np.float32)
    plans, plain = (make_player({**card, "plan": plan}, env) for plan in (card["plan"], None))
    planned, reflex = (p.act(prior, p.init_carry(), obs, key, explore=False)[0] for p in (plans, plain))
    assert not np.allclose(planned, reflex, atol=0.01)
    jax.tree.map(np.testing.assert_array_equal, (before.actor, before.value), (prior.actor, prior.value))
    assert not np.array_equal(*(p.dynamics["Dense_0"]["kernel"] for p in (before, prior)))
    reader = finetune._Run.__new__(finetune._Run)
    reader.method = get_method("sac")
    assert "plan" not in reader._card(card, FinetuneConfig())


def test_all_methods_meet_the_same_real_starts(home):
    ours, theirs = (RealStore(run(home, method)).load() for method in ("sgft-sac", "sac"))
    for i, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        np.testing.assert_array_equal(a["obs"][:, 0], b["obs"][:, 0])
        assert np.array_equal(a["action"], b["action"]) == (i < 2)  # the initial rollouts are those of the prior
    assert len({rollout["obs"][seed, 0].tobytes() for rollout in ours for seed in (0, 1)}) == 10


@pytest.mark.slow
def test_seeds_together_are_seeds_one_by_one(home, tmp_path):
    both = read_jsonl(run(home, "sgft-sac") / "eval.jsonl")
    call(argv(home, "sgft-sac", "--seed", "1", seeds=1, out=tmp_path))
    alone = read_jsonl(tmp_path / "finetune/toy/turned/sgft-sac/seed-1/eval.jsonl")
    for a, b in zip(both, alone, strict=True):
        assert a["return"][1] == pytest.approx(b["return"][0], abs=0.02)
    assert max(abs(line["return"][0] - line["return"][1]) for line in both) > 0.1


@pytest.mark.parametrize("method", ["sgft-sac", pytest.param("sac", marks=pytest.mark.slow)])
def test_killed_and_resumed_is_bit_for_bit_uninterrupted(home, tmp_path, method):
    """SIGKILL after the rollout that follows the checkpoint at 4, whose line and rollout are on disk already."""
    arguments = argv(home, method, out=tmp_path)
    killed(PROGRAM, arguments)
    cut = tmp_path / "finetune/toy/turned" / method / "seeds-0-1"
    assert checkpoint.latest(cut) == 4
    assert len(read_jsonl(cut / "metrics.jsonl")) == 4 and len(RealStore(cut)) == 5

    call([*arguments, "--resume"])
    for name in ("metrics.jsonl", "eval.jsonl", "summary.json"):
        assert (cut / name).read_bytes() == (run(home, method) / name).read_bytes()
    assert len(RealStore(cut)) == 5
    assert len(list(cut.glob("real/superseded-0/*.npz"))) == 1  # what the robot did is kept


@pytest.mark.slow
def test_killed_in_the_offline_phase_and_resumed_is_bit_for_bit_uninterrupted(home, tmp_path, monkeypatch, capsys):
    """SIGKILL when one of two real systems has a checkpoint after 20 of 40 updates, the other only after 10."""
    monkeypatch.setattr(finetune, "_OFFLINE_PART", 10)
    more = ["--rollouts", "2", "--options.offline-updates", "40", "--options.simulated-transitions", "390"]
    whole, parts = (argv(home, "iql", *more, out=tmp_path / o, reals=("turned", "heavy")) for o in ("whole", "parts"))
    call(whole)
    killed(OFFLINE, parts)
    folders = [tmp_path / f"parts/finetune/toy/{real}/iql/seeds-0-1" for real in ("turned", "heavy")]
    assert [checkpoint.latest(folder / "offline") for folder in folders] == [20, 10]

    capsys.readouterr()
    call([*parts, "--resume"])
    said = capsys.readouterr().out
    assert "30/40 updates" in said and "20/40 updates" not in said
    for folder in folders:
        for name in ("metrics.jsonl", "eval.jsonl", "summary.json"):
            other = tmp_path / "whole" / folder.relative_to(tmp_path / "parts") / name
            assert (folder / name).read_bytes() == other.read_bytes()
        assert not (folder / "offline").exists()  # the first checkpoint of the run takes its place


@pytest.mark.slow
def test_more_rollouts_continue_a_finished_run(home, tmp_path):
    call(argv(home, "sac", "--rollouts", "4", out=tmp_path))
    call(argv(home, "sac", "--rollouts", "5", "--resume", out=tmp_path))
    grown = tmp_path / "finetune/toy/turned/sac/seeds-0-1"
    assert (grown / "eval.jsonl").read_bytes() == (run(home, "sac") / "eval.jsonl").read_bytes()


def test_a_variant_has_a_folder_beside_its_method():
    args = finetune.FinetuneArgs(task="push", seeds=2, variant="horizon-4")
    assert finetune.run_folder(args, "default") == Path("runs/finetune/push/default/sgft-sac_horizon-4/seeds-0-1")


def test_a_rollout_is_on_disk_before_learning_from_it(home, tmp_path, monkeypatch):
    def crash(*_):
        raise RuntimeError("the learner died")

    make = finetuning.make_program
    monkeypatch.setattr(finetune, "make_program", lambda *a, **k: make(*a, **k)._replace(learn=crash))
    with pytest.raises(RuntimeError, match="the learner died"):
        call(argv(home, "sac", out=tmp_path))
    real = RealStore(tmp_path / "finetune/toy/turned/sac/seeds-0-1").load()
    assert len(real) == 2 and np.isfinite(real[1]["reward"]).all()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--method", "sgft-sca"], "did you mean 'sgft-sac'?"),
        (["--task", "toi"], "did you mean 'toy'?"),
        (["--preset", "fats"], "did you mean 'fast'?"),
        (["--real", "mild"], "toy has no gap 'mild'"),
        (["--real", "nowhere.toml"], "nowhere.toml: No such file"),
        (["--set", "latensy=1"], "toy has no domain parameter 'latensy'"),
        (["--set", "latency"], "'latency' does not set anything"),
        (["--prior", "nowhere"], "nowhere: holds no prior; make one with"),
        (["--rolouts", "5"], "did you mean --rollouts?"),
        (["--rollouts", "1"], "--initial-rollouts 2 is more than --rollouts 1"),
        (["--eval-every", "0"], "--eval-every is 0: must be at least 1"),
        (["--utd", "-1"], "--utd is -1.0: must be positive"),
        (["--variant", "a/b"], "--variant 'a/b': letters"),
        (["--seeds", "0"], "there must be at least one"),
        (["--real"], "--real: name at least one"),
        (["--real", "mild", "else/mild.toml"], "two of them would share the folder"),
        (["--real", "a.toml", "b.toml", "c.toml", "--seeds", "1"], "times --seeds is 3: not a multiple of the 2"),
        (["--resume"], "nothing to resume there"),
    ],
)
def test_a_bad_command_is_one_line_and_code_2(home, tmp_path, more, words, capsys):
    assert words in complaint([*argv(home, out=tmp_path), *more], capsys)
    assert not list(tmp_path.iterdir())


def test_another_configuration_does_not_continue_a_run(home, capsys):
    run(home, "sac")
    capsys.readouterr()
    assert "exists already" in complaint(argv(home, "sac"), capsys)
    assert "utd was 0.5, now 1.0" in complaint(argv(home, "sac", "--resume", "--utd", "1"), capsys)


def test_other_priors_do_not_continue_a_run(home, tmp_path, capsys):
    folder = tmp_path / run(home, "sac").relative_to(home)
    shutil.copytree(run(home, "sac"), folder)
    origin = json.loads((folder / "provenance.json").read_text())
    (start,) = origin["starts"]
    assert len(start["priors"]) == 2 and len(set(start["priors"])) == 2
    start["priors"][1] = "0" * 12
    (folder / "provenance.json").write_text(json.dumps(origin))
    error = complaint(argv(home, "sac", "--resume", "--rollouts", "6", out=tmp_path), capsys)
    assert f"{folder}: cannot resume with other priors: they were" in error and "000000000000" in error
    assert read_jsonl(folder / "eval.jsonl") == read_jsonl(run(home, "sac") / "eval.jsonl")


# ------------------------------------------------------------ several real systems


def files(folder):
    """What a run leaves, but for checkpoints and names that are drawn by chance or tell the time."""
    paths = (str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    return sorted(path for path in paths if "/d/" not in path and not path.startswith(("tensorboard/", "checkpoints/")))


def agree(one, two, upto):
    """The same starts and rollouts, and, up to the rounding of updates, metrics and evaluations."""
    for a, b in zip(RealStore(one).load()[:upto], RealStore(two).load()[:upto], strict=True):
        np.testing.assert_array_equal(a["obs"][:, 0], b["obs"][:, 0])
        np.testing.assert_allclose(a["trace"], b["trace"], atol=1e-3)
    for name in ("metrics.jsonl", "eval.jsonl"):
        lines = ([line for line in read_jsonl(run / name) if line["rollouts"] <= upto] for run in (one, two))
        for a, b in zip(*lines, strict=True):
            assert a.keys() == b.keys()
            for key in a:
                assert a[key] == pytest.approx(b[key], rel=1e-3, abs=1e-3), key


def test_real_systems_together_are_what_each_is_alone(home, tmp_path, capsys):
    both = [tmp_path / f"finetune/toy/{real}/sac/seeds-0-1" for real in ("heavy", "turned")]
    alone = run(home, "sac")
    arguments = argv(home, "sac", "--rollouts", "4", reals=("heavy", "turned"), out=tmp_path)
    call(arguments)
    assert files(both[0]) == files(both[1]) == [path for path in files(alone) if path != "real/rollout-000004.npz"]
    agree(both[1], alone, upto=4)
    heavy, turned = (read_jsonl(folder / "eval.jsonl")[-1]["return"] for folder in both)
    assert heavy != pytest.approx(turned, abs=0.05)
    told = [json.loads((folder / "config.json").read_text())["config"]["real"] for folder in (*both, alone)]
    assert told == [str(home / "heavy.toml"), *[str(home / "turned.toml")] * 2]
    card = checkpoint.load_prior(both[0] / "policy/seed-1")[1]["finetuned"]
    assert (card["gap"]["name"], card["seed"]) == ("heavy", 1)

    shutil.rmtree(both[1] / "checkpoints/4")
    error = complaint([*arguments, "--resume"], capsys)
    assert f"{both[0]} is at rollout 4, {both[1]} is at rollout 2: they cannot go on together" in error
    runs.Lock(both[0])  # they are free again


@pytest.mark.slow
def test_runs_go_on_together_or_alone_whichever_way_they_began(home, tmp_path):
    """Together for 3 rollouts, alone for the fourth, together for the last."""
    reals = ("heavy", "turned")
    call(argv(home, "sgft-sac", "--rollouts", "3", reals=reals, out=tmp_path))
    for real in reals:
        call(argv(home, "sgft-sac", "--rollouts", "4", "--resume", reals=(real,), out=tmp_path))
    call(argv(home, "sgft-sac", "--resume", reals=reals, out=tmp_path))
    heavy, turned = (tmp_path / f"finetune/toy/{real}/sgft-sac/seeds-0-1" for real in reals)
    assert [line["rollouts"] for line in read_jsonl(heavy / "eval.jsonl")] == [0, 2, 3, 4, 5]  # 3 was an end once
    curve = turned / "eval.jsonl"
    curve.write_text("".join(line for line in curve.read_text().splitlines(True) if '"rollouts": 3' not in line))
    agree(turned, run(home, "sgft-sac"), upto=5)


# ------------------------------------------------------------ video


def film(path, monkeypatch, scene=None, reason=None):
    monkeypatch.setattr(toy, "SCENE", scene, raising=False)
    monkeypatch.setattr(cli, "select_renderer", lambda: reason)
    env = toy.make()
    pool = envs.sample_worlds(env, jax.random.key(0), 3)

    def play():
        springs = [lambda carry, obs, key, k=k: (k * -obs[:2], carry) for k in (0.0, 1.0)]
        keys = jax.random.split(jax.random.key(4), 1)
        played = [play_episodes(env, pool, spring, (), keys, gamma=1.0) for spring in springs]
        return [jax.tree.map(lambda x: x[0], episodes) for episodes in played]

    return video.before_and_after(env, pool, play, path / "v/e.mp4", rollouts=7), pool


def test_no_scene_no_renderer_or_a_broken_one_is_a_notice(tmp_path, monkeypatch):
    assert film(tmp_path, monkeypatch)[0] == "no video: toy has no scene to draw"
    scene = object()
    assert film(tmp_path, monkeypatch, scene, "no library")[0] == "no video: no library"
    for error in (UserError("no graphics"), RuntimeError("no encoder\nat all")):
        monkeypatch.setattr(
            "envs.mujoco.render.render_side_by_side", lambda *_, error=error: (_ for _ in ()).throw(error)
        )
        assert film(tmp_path, monkeypatch, scene)[0] == f"no video: {str(error).splitlines()[0]}"


def test_both_policies_are_filmed_from_one_start_in_one_world(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr("envs.mujoco.render.render_side_by_side", lambda *given: seen.append(given))
    said, pool = film(tmp_path, monkeypatch, object())
    _, thetas, (before, after), captions, path = seen[0]
    assert said == f"video: {path}" and path.parent.exists()
    (chosen,) = [i for i, params in enumerate(np.asarray(pool.params).tolist()) if params == thetas[0]]
    assert thetas[0] == thetas[1] and chosen == 1  # where that key plays
    assert before.shape == after.shape == (21, 2)
    np.testing.assert_array_equal(before[0], after[0])
    np.testing.assert_array_equal(before, np.tile(before[0], (21, 1)))  # without force it stays where it is
    assert np.linalg.norm(after[-1]) < np.linalg.norm(after[0])
    assert captions[0].startswith("before fine-tuning: ") and captions[1] == "after 7 real rollouts: success"
