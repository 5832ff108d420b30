"""The fine-tuning command end to end, on a point mass whose force is turned by 30 degrees in reality."""

import contextlib
import dataclasses
import functools
import io
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
from priors_by_hand import save_prior

import envs
from envs import gaps
from envs.rollout import Episode, play_episode
from envs.types import Transition, UserError
from experiments import evaluate, finetune
from experiments.runner import finetune_args, finetune_run, pictures
from experiments.runner.finetune_args import FinetuneArgs, arguments, run_folder
from experiments.runner.finetune_run import FinetuneRecord
from experiments.runner.recorded import RecordedSystem
from sgft_jax import api
from sgft_jax.algorithms import make_policy
from sgft_jax.analysis.curves import training_score
from sgft_jax.analysis.reading import read_curve
from sgft_jax.io import checkpoint, runs
from sgft_jax.io.log import read_jsonl
from sgft_jax.io.priors import load_prior
from sgft_jax.io.real import RealStore
from sgft_jax.methods import NAMES, get_method
from sgft_jax.stacking import member
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train import finetuning

TESTS = Path(__file__).parent.parent
GAP = "[params]\nmass = 2.0\nfriction = 4.0\n[effects]\naction_rotation = 0.52\n"
COMMON = "--task toy --rollouts 5 --eval-every 2 --eval-episodes 8 --checkpoint-every 3 --no-video"
# A method gets those that it has.
SMALL = (
    {"batch_size": 16, "utd": 0.5, "replay_capacity": 256, "critic_warmup": 0, "actor_ramp": 0}
    | {"initial_rollouts": 2, "simulated_transitions": 390, "offline_updates": 20}
    | {"branches": 2, "plan_samples": 24}
)
START = """
import os, signal, sys
import envs
envs.TASKS["toy"] = "toy"
from experiments import finetune
from experiments.runner.finetune_run import FinetuneRecord
from sgft_jax.train import finetuning
from sgft_jax.io.real import RealStore
def die():
    os.kill(os.getpid(), signal.SIGKILL)
"""
STORED = """
append = RealStore.append
def stored(self, rollout):
    if append(self, rollout) == 3:
        die()
RealStore.append = stored
"""
LOGGED = """
metrics = FinetuneRecord.metrics
def logged(self, done, values):
    metrics(self, done, values)
    if done == 5:
        die()
FinetuneRecord.metrics = logged
"""
OFFLINE = """
finetuning.OFFLINE_PART = 10
checkpoint = FinetuneRecord.checkpoint
def offline(self, progress, step, **facts):
    checkpoint(self, progress, step, **facts)
    if int(progress.offline) == 20:
        die()
FinetuneRecord.checkpoint = offline
"""


pytestmark = pytest.mark.usefixtures("toy_task")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Two untrained priors and two gaps."""
    home = tmp_path_factory.mktemp("runs")
    for seed in (0, 1):
        save_prior(home / f"pretrain/toy/fast/seeds-0-1/prior/seed-{seed}", seed)
    (home / "turned.toml").write_text(GAP)
    (home / "heavy.toml").write_text("[params]\nmass = [1.5, 2.5]\n")  # its worlds vary, those of the other do not
    return home


def small(method):
    """The options that make a method small, as words."""
    own = {field.name for field in dataclasses.fields(get_method(method).config)}
    found = {name: value for name, value in SMALL.items() if name in own}
    return [word for name, value in found.items() for word in (f"--options.{name.replace('_', '-')}", str(value))]


def argv(home, method="sgft-sac", *more, seeds=2, out=None, reals=("turned",)):
    """Two seeds have a device each."""
    given = ["--method", method, "--seeds", seeds, "--devices", seeds]
    given += ["--out", out or home, "--real", *(home / f"{real}.toml" for real in reals)]
    given += ["--prior", home / "pretrain/toy/fast/seeds-0-1"]
    return [*COMMON.split(), *small(method), *map(str, given), *more]


def run(home, method):
    """A finished run of two seeds, made once for all tests of the module."""
    folder = home / "finetune/toy/turned" / method / "seeds-0-1"
    if not folder.exists():
        with contextlib.redirect_stderr(io.StringIO()) as words:
            finetune.main(argv(home, method))
        (home / f"{method}.words").write_text(words.getvalue())
    return folder


def rollouts(folder):
    """The arrays of every real rollout of a run."""
    store = RealStore(folder)
    return [store.load(i) for i in range(len(store))]


@pytest.mark.slow
def test_sensors_drift_from_rollout_to_rollout_also_of_a_run_that_goes_on(home, tmp_path, monkeypatch):
    """By 100 m along x; evaluations after k rollouts see the system as it is then, and a system without drift none."""
    (home / "drifting.toml").write_text("drift = { xy = [100.0, 0.0] }\n")
    seen, evaluate = [], finetuning.evaluate

    def evaluated(*args):
        played = evaluate(*args)
        seen.append(float(played.transitions.obs[..., 0].mean()))
        return played

    monkeypatch.setattr(finetuning, "evaluate", evaluated)
    arguments = argv(home, "sac", "--rollouts", "2", out=tmp_path, reals=("drifting",))
    for more in ([], ["--rollouts", "4", "--resume"]):
        finetune.main([*arguments, *more])
    made = rollouts(tmp_path / "finetune/toy/drifting/sac/seeds-0-1")
    np.testing.assert_allclose([x["obs"][..., 0].mean() for x in made], [0, 100, 200, 300], atol=3)
    np.testing.assert_allclose([x["obs"][..., 1].mean() for x in made], 0, atol=3)
    np.testing.assert_allclose(seen, [0, 200, 200, 400, 400], atol=3)  # the last ones of a run: the best policies


def killed(program, arguments):
    """Runs a program in a process of its own, which kills itself."""
    paths = {"PYTHONPATH": f"{TESTS}:{TESTS.parent}", "SGFT_CACHE_DIR": str(TESTS.parent / ".cache/jax")}
    program = f"{START}{program}\nfinetune.main(sys.argv[1:])"
    done = subprocess.run([sys.executable, "-c", program, *arguments], env={**os.environ, **paths}, timeout=300)
    assert done.returncode == -signal.SIGKILL


@pytest.fixture
def explored(monkeypatch):
    """How many episodes each member has explored on real systems since the test began, [] of numbers."""
    seen, play = [], Simulated.play

    def counted(self, policy, states, keys, *, explore):
        seen.extend([keys.shape[1]] * explore)
        return play(self, policy, states, keys, explore=explore)

    monkeypatch.setattr(Simulated, "play", counted)
    return seen


def complaint(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        finetune.main(arguments)
    *phases, error = capsys.readouterr().err.splitlines()
    assert stopped.value.code == 2 and error.startswith("error: ") and "error" not in "".join(phases).lower()
    return error


def same_results(one, two):
    """To the bit: logs, summaries, real rollouts and policies."""
    for name in ("metrics.jsonl", "eval.jsonl", "summary.json"):
        assert (one / name).read_bytes() == (two / name).read_bytes(), name
    jax.tree.map(np.testing.assert_array_equal, rollouts(one), rollouts(two))
    for name in ("policy/seed-0", "policy/seed-1", "best/seed-0", "best/seed-1"):
        jax.tree.map(np.testing.assert_array_equal, *(load_prior(folder / name).params for folder in (one, two)))


# --- what a run leaves ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ({"eval_every": 3}, [0, 2, 3, 6, 7]),  # also at the start, after the first rollouts, and at the end
        ({"eval_at": (0, 1, 4, 7)}, [0, 2, 4, 7]),  # the first two rollouts come together
        ({"eval_at": (5,)}, [5]),
    ],
)
def test_when_runs_are_evaluated(options, wanted):
    args = arguments("sac", rollouts=7, **options)
    steps = [0, 0, *range(2, 8)]
    assert [b for a, b in itertools.pairwise(steps) if finetune_run.evaluates(args, a, b)] == wanted


@pytest.mark.heavy
def test_a_run_leaves_curve_summary_policies_and_every_rollout(home):
    folder = run(home, "sgft-sac")
    curve = read_jsonl(folder / "eval.jsonl")
    assert [line["rollouts"] for line in curve] == [0, 2, 4, 5]
    assert [line["step"] for line in curve] == [0, 40, 80, 100]  # 20 steps a rollout
    assert curve[2]["robot_minutes"] == pytest.approx(4 * 20 * 0.1 / 60)
    assert [line["rollouts"] for line in read_jsonl(folder / "metrics.jsonl")] == [2, 3, 4, 5]
    assert all(len(line["success"]) == len(line["score"]) == 2 for line in curve)
    summary = json.loads((folder / "summary.json").read_text())
    numbers = {"zero_shot", "final", "deepest_fall", "transitions_until_held", "seeds", "best"}
    assert set(summary) == {"task", "method", "impl", "gap", "score", *numbers}
    assert summary["gap"]["effects"] == {"action_rotation": 0.52} and summary["final"]["transitions"] == 100
    assert summary["score"] == "success" and len(summary["best"]["score"]) == 2
    real = rollouts(folder)
    assert len(real) == 5 and real[0]["obs"].shape == (2, 20, 4) and real[0]["valid"].all()
    assert len({rollout["obs"][seed, 0].tobytes() for rollout in real for seed in (0, 1)}) == 10  # starts
    assert (folder / "figures/score.png").stat().st_size > 10_000


@pytest.mark.heavy
def test_a_run_says_what_it_is_doing(home):
    run(home, "sgft-sac")
    assert (home / "sgft-sac.words").read_text().splitlines() == [
        "making the real systems (about 5 s)",
        "preparing the agents (about 10 s, once)",
        "evaluating (about 15 s, once)",
        "playing the first rollout and compiling what learns from it (about 60 s, once)",
        "writing a checkpoint",
        "playing and learning",
        "evaluating the best policies (about 15 s, once)",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["sgft-sac", "sac"])
def test_value_and_statistics_of_the_prior_stay_frozen_and_its_actor_moves(home, method):
    for seed in (0, 1):
        before = load_prior(home / f"pretrain/toy/fast/seeds-0-1/prior/seed-{seed}").params
        tuned = load_prior(run(home, method) / f"policy/seed-{seed}", task="toy")
        after = tuned.params
        jax.tree.map(np.testing.assert_array_equal, (before.value, before.normalizer), (after.value, after.normalizer))
        assert not np.array_equal(before.actor["Dense_0"]["kernel"], after.actor["Dense_0"]["kernel"])
        assert (tuned.card["finetuned"]["method"], tuned.card["finetuned"]["seed"]) == (method, seed)


@pytest.mark.heavy
def test_the_best_policy_is_of_an_earlier_moment(home):
    """Five rollouts are evidence for the policy that played the last of them: it had learned from four."""
    folder = run(home, "sgft-sac")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["best"]["rollouts"] == [4, 4] and all(np.isfinite(summary["best"]["evidence"]))
    last, best = (load_prior(folder / kind / "seed-1") for kind in ("policy", "best"))
    assert (last.card["finetuned"]["which"], best.card["finetuned"]["which"]) == ("policy", "best")
    assert not np.array_equal(last.params.actor["Dense_0"]["kernel"], best.params.actor["Dense_0"]["kernel"])


@pytest.mark.heavy
def test_the_policies_are_what_the_run_evaluated(home):
    args = evaluate.EvaluateArgs(run=run(home, "sgft-sac"), real=(str(home / "turned.toml"),), episodes=30)
    (system,) = evaluate.evaluate(args)["systems"]
    assert [Path(p["policy"]).name for p in system["policies"]] == ["seed-0", "seed-1"]
    final = read_jsonl(run(home, "sgft-sac") / "eval.jsonl")[-1]["return"]
    assert [p["return"] for p in system["policies"]] == pytest.approx(final, abs=6.0)  # other episodes, 30 and 8


@pytest.mark.slow
def test_a_planner_leaves_priors_that_plan(home, tmp_path):
    """The card says how, until a method that does not plan goes on from there."""
    tuned = load_prior(run(home, "sgft-mpc") / "policy/seed-1", task="toy")
    prior, card = tuned.params, tuned.card
    assert card["plan"] == {"horizon": 1, "samples": 24, "noise": 0.5}
    env, before = toy.make(), load_prior(home / "pretrain/toy/fast/seeds-0-1/prior/seed-1").params
    key, obs = jax.random.key(0), np.array([0.5, -0.5, 0.1, 0.0], np.float32)
    plans, plain = (make_policy({**card, "plan": plan}, env) for plan in (card["plan"], None))
    planned, reflex = (p.act(prior, p.init_carry(), obs, key, explore=False)[0] for p in (plans, plain))
    assert not np.allclose(planned, reflex, atol=0.01)
    jax.tree.map(np.testing.assert_array_equal, (before.actor, before.value), (prior.actor, prior.value))
    assert not np.array_equal(*(p.dynamics["Dense_0"]["kernel"] for p in (before, prior)))
    arguments = argv(home, "sac", "--prior", str(run(home, "sgft-mpc")), "--rollouts", "2", out=tmp_path)
    finetune.main(arguments)
    assert not load_prior(tmp_path / "finetune/toy/turned/sac/seeds-0-1/policy/seed-0").card["plan"]


@pytest.mark.slow
def test_without_a_prior(home, tmp_path):
    """The networks are RLPD's; what is left acts, and says what it is of."""
    finetune.main([*argv(home, "sac", "--rollouts", "2", seeds=1, out=tmp_path), "--prior", "none"])
    folder = tmp_path / "finetune/toy/turned/sac/seed-0/policy/seed-0"
    found = load_prior(folder, task="toy", obs_dim=4, act_dim=2)
    assert found.card["network"]["hidden"] == [256, 256] and found.params.value is None
    policy = make_policy(found.card, toy.make())
    action, _ = policy.act(found.params, policy.init_carry(), jnp.zeros(4), jax.random.key(0), explore=False)
    assert action.shape == (2,) and np.isfinite(action).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["rlpd", "iql"])
def test_methods_that_learn_from_the_simulator_too(home, method):
    """They start from nothing, so the simulator's policy makes the initial rollouts: those of any other method."""
    mine, others = (rollouts(run(home, name)) for name in (method, "sac"))
    for i in range(2):
        np.testing.assert_allclose(mine[i]["obs"], others[i]["obs"], atol=1e-5)
    assert not np.allclose(mine[2]["obs"], others[2]["obs"], atol=1e-2)


@pytest.mark.slow
def test_all_methods_meet_the_same_real_starts(home):
    ours, theirs = (rollouts(run(home, method)) for method in ("sgft-sac", "sac"))
    for i, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        np.testing.assert_array_equal(a["obs"][:, 0], b["obs"][:, 0])
        assert np.array_equal(a["action"], b["action"]) == (i < 2)  # the initial rollouts are those of the prior
    assert len({rollout["obs"][seed, 0].tobytes() for rollout in ours for seed in (0, 1)}) == 10


@pytest.mark.slow
def test_seeds_together_are_seeds_one_by_one(home, tmp_path):
    both = read_jsonl(run(home, "sgft-sac") / "eval.jsonl")
    finetune.main(argv(home, "sgft-sac", "--seed", "1", seeds=1, out=tmp_path))
    alone = read_jsonl(tmp_path / "finetune/toy/turned/sgft-sac/seed-1/eval.jsonl")
    for a, b in zip(both, alone, strict=True):
        assert a["return"][1] == pytest.approx(b["return"][0], abs=0.02)
    assert max(abs(line["return"][0] - line["return"][1]) for line in both) > 0.1


def test_a_file_without_a_name_means_all_of_its_gaps(tmp_path, monkeypatch):
    file = tmp_path / "two.toml"
    file.write_text("[a.params]\nobject_mass = 9.0\n[b.params]\nobject_mass = 2.0\n")
    save_prior(tmp_path / "prior/seed-0", 0, task="push")
    monkeypatch.setattr(finetune_run, "run", lambda args, *given: args.real)
    args = arguments("sac", prior=tmp_path / "prior", real=("sim", str(file)), out=tmp_path)
    assert finetune.finetune(args) == ["sim", f"{file}:a", f"{file}:b"]


def test_a_variant_has_a_folder_beside_its_method():
    args = FinetuneArgs(task="push", seeds=2, variant="horizon-4")
    assert run_folder(args, "default") == Path("runs/finetune/push/default/guarded_horizon-4/seeds-0-1")


# --- killed and resumed -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", NAMES)
def test_every_method_is_told_what_it_takes(method):
    """`recurrent` and `sysid` learn nothing and name no batch; the room for their transitions is counted too."""
    args = arguments(method, real=("sim",))
    finetune_run._reserve(args, toy.make(), priors=1, devices=1)
    with pytest.raises(UserError, match="replay-capacity"):
        finetune_run._reserve(dataclasses.replace(args, seeds=2**40), toy.make(), priors=1, devices=1)


@pytest.mark.slow
def test_what_was_stored_after_the_last_checkpoint_is_replayed_not_collected_again(home, tmp_path, explored):
    """SIGKILL when rollout 4 of 5 is on disk and the checkpoint is of rollout 3: one rollout is left to play."""
    arguments = argv(home, "sgft-sac", out=tmp_path)
    killed(STORED, arguments)
    cut = tmp_path / "finetune/toy/turned/sgft-sac/seeds-0-1"
    stored = [path.read_bytes() for path in sorted(cut.glob("real/*"))]
    assert checkpoint.latest(cut) == 3 and len(read_jsonl(cut / "metrics.jsonl")) == 2 and len(stored) == 4

    whole = run(home, "sgft-sac")
    explored.clear()
    finetune.main([*arguments, "--resume"])
    assert explored == [1]
    assert [path.read_bytes() for path in sorted(cut.glob("real/*"))][:4] == stored
    same_results(cut, whole)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["sac", "rlpd", "iql", "sgft-mpc", "sgft-relabel", "sac-online", "frozen-critic"])
def test_every_learner_killed_and_resumed_is_bit_for_bit_uninterrupted(home, tmp_path, method, explored):
    """SIGKILL when all rollouts are on disk, and the lines of the last one, but not its checkpoint."""
    arguments = argv(home, method, out=tmp_path)
    killed(LOGGED, arguments)
    cut = tmp_path / "finetune/toy/turned" / method / "seeds-0-1"
    assert checkpoint.latest(cut) in (3, 4)  # with an offline phase that is a step of its own
    assert len(RealStore(cut)) == 5 and read_jsonl(cut / "metrics.jsonl")[-1]["rollouts"] == 5
    whole = run(home, method)
    explored.clear()
    finetune.main([*arguments, "--resume"])
    assert explored == []
    same_results(cut, whole)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["sgft-mpc", "rlpd"])
def test_a_guarded_run_killed_and_resumed_is_bit_for_bit_uninterrupted(home, tmp_path, method):
    """The log says who is deployed: after failures alone what learns; the curve knows what training scored."""
    arguments = {part: argv(home, method, "--options.guard", out=tmp_path / part) for part in ("whole", "cut")}
    finetune.main(arguments["whole"])
    killed(LOGGED, arguments["cut"])
    finetune.main([*arguments["cut"], "--resume"])
    cut, whole = (tmp_path / part / "finetune/toy/turned" / method / "seeds-0-1" for part in ("cut", "whole"))
    same_results(cut, whole)
    lines = read_jsonl(whole / "metrics.jsonl")
    assert [line["rollouts"] for line in lines] == [2, 3, 4, 5] and 1.0 in lines[0]["guard/challenger"]
    scores = np.average([line["real/score"] for line in lines], axis=0, weights=[2, 1, 1, 1])
    np.testing.assert_allclose(training_score(read_curve(whole)), scores)


@pytest.mark.slow
def test_killed_in_the_offline_phase_and_resumed_ends_as_if_uninterrupted(home, tmp_path, monkeypatch, capsys):
    """SIGKILL when one of two real systems has a checkpoint after 20 of 40 updates, the other only after 10."""
    monkeypatch.setattr(finetuning, "OFFLINE_PART", 10)
    more = ["--rollouts", "2", "--options.offline-updates", "40"]
    whole, parts = (argv(home, "iql", *more, out=tmp_path / o, reals=("turned", "heavy")) for o in ("whole", "parts"))
    finetune.main(whole)
    killed(OFFLINE, parts)
    folders = [tmp_path / f"parts/finetune/toy/{real}/iql/seeds-0-1" for real in ("turned", "heavy")]
    assert [checkpoint.latest(folder) for folder in folders] == [2, 1]
    assert "they cannot go on together, resume them one at a time" in complaint([*parts, "--resume"], capsys)
    for real, folder in zip(("turned", "heavy"), folders, strict=True):
        finetune.main([*argv(home, "iql", *more, out=tmp_path / "parts", reals=(real,)), "--resume"])
        assert [line["rollouts"] for line in read_jsonl(folder / "metrics.jsonl")] == [0, 0, 0, 0, 2]
        agree(folder, tmp_path / "whole" / folder.relative_to(tmp_path / "parts"), upto=2)


@pytest.mark.slow
def test_more_rollouts_continue_a_finished_run(home, tmp_path):
    finetune.main(argv(home, "sac", "--rollouts", "4", out=tmp_path))
    finetune.main(argv(home, "sac", "--rollouts", "5", "--resume", out=tmp_path))
    same_results(tmp_path / "finetune/toy/turned/sac/seeds-0-1", run(home, "sac"))


@pytest.mark.heavy
def test_a_rollout_is_on_disk_before_learning_from_it(home, tmp_path, monkeypatch):
    """Those of the prior are the same whatever the method."""
    usual = rollouts(run(home, "sgft-sac"))

    def crash(*_):
        raise RuntimeError("the learner died")

    monkeypatch.setattr(finetuning._Steps, "_take", crash)
    with pytest.raises(RuntimeError, match="the learner died"):
        finetune.main(argv(home, "sac", out=tmp_path))
    real = rollouts(tmp_path / "finetune/toy/turned/sac/seeds-0-1")
    assert len(real) == 2 and np.isfinite(real[1]["reward"]).all()
    for mine, theirs in zip(real, usual, strict=False):
        np.testing.assert_array_equal(mine["obs"], theirs["obs"])


class Counter:
    """A system of two members whose rollouts are numbered: observations of the n-th are n and n + 0.5."""

    def __init__(self):
        self.played = []

    def play(self, policy, states, keys, *, explore):
        self.played.append(explore)
        shape, number = (2, keys.shape[1], 3), 10.0 + len(self.played)
        obs = number + jnp.broadcast_to(jnp.array([0.0, 0.5])[:, None, None, None], (*shape, 2))
        rows = Transition(obs, jnp.zeros((*shape, 1)), jnp.ones(shape), jnp.ones(shape), obs)
        each, no = jnp.zeros(shape[:2]), jnp.zeros(shape[:2], bool)
        trace = jnp.zeros((*shape[:2], shape[2] + 1, 2))
        return Episode(rows, jnp.ones(shape, bool), each, no, no, each, each.astype(int), trace)


def play(system, *, explore=True):
    """The first observation of each member's episode."""
    played = system.play(None, None, jax.random.split(jax.random.key(0), (2, 1)), explore=explore)
    return played.transitions.obs[:, 0, 0, 0].tolist()


@pytest.mark.heavy
def test_a_recorded_system_plays_what_is_missing_and_no_more(tmp_path):
    store = RealStore(tmp_path)
    first = RecordedSystem(Counter(), [store], done=0)
    assert [play(first), play(first, explore=False), play(first)] == [[11, 11.5], [12, 12.5], [13, 13.5]]
    assert len(store) == 2  # evaluations are not stored
    inner = Counter()
    again = RecordedSystem(inner, [store], done=1)
    assert play(again) == [13, 13.5] and inner.played == []
    assert play(again) == [11, 11.5] and len(store) == 3
    with pytest.raises(UserError, match=r"real: holds 3 rollouts, the checkpoint remembers 4"):
        RecordedSystem(inner, [store], done=4)


@pytest.mark.heavy
def test_no_rollout_of_a_real_system_is_replaced_because_another_lacks_it(tmp_path):
    one, two = RealStore(tmp_path / "one"), RealStore(tmp_path / "two")
    system = RecordedSystem(Counter(), [one, two], done=0)
    play(system)
    shutil.rmtree(two.folder)
    two = RealStore(tmp_path / "two")
    before = one.load(0)["obs"]
    later = Counter()
    later.played = [True] * 3
    assert play(RecordedSystem(later, [one, two], done=0)) == [11, 14.5]  # what is learned from is what is stored
    assert len(one) == len(two) == 1
    np.testing.assert_array_equal(one.load(0)["obs"], before)
    assert two.load(0)["obs"][0, 0, 0] == 14.5


# --- what can be wrong ------------------------------------------------------------------------------------------------


@pytest.mark.heavy_after_first
@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--method", "sgft-sca"], "did you mean 'sgft-sac'?"),
        (["--task", "toi"], "did you mean 'toy'?"),
        (["--real", "mild"], "toy has no gap 'mild'"),
        (["--real", "nowhere.toml"], "nowhere.toml: no such file"),
        (["--set", "latensy=0.1"], "did you mean 'latency'?"),
        (["--set", "latency"], "'latency' does not set anything"),
        (["--set", "latency=0.2"], "latency"),
        (["--set", "latency=nan"], "latency"),
        (["--set", "obs_noise_prob=1.5"], "obs_noise_prob"),
        (["--set", "friction=-1"], "friction"),
        (["--set", "mass=1", "mass=2"], "'mass' is set twice"),
        (["--prior", "nowhere"], "--prior nowhere: no such folder"),
        (["--prior", "none"], "--prior none: sgft-sac needs a prior of sac"),
        (["--rolouts", "5"], "did you mean --rollouts?"),
        (["--rollouts", "1"], "--options.initial-rollouts 2 is more than --rollouts 1"),
        (["--eval-every", "0"], "--eval-every is 0: must be at least 1"),
        (["--eval-at", "0", "-1"], "--eval-at 0 -1: numbers of rollouts, from 0 on"),
        (["--eval-at", "500"], "--eval-at 500: no evaluation within --rollouts 5; name smaller numbers"),
        (["--eval-at", "0", "--eval-episodes", "0"], "--eval-at 0: evaluations have no episodes; say how many with"),
        (["--variant", 300 * "v"], "--variant has 300 bytes: choose a shorter word"),
        (["--devices", "x"], "--devices x: must be a whole number or None"),
        (["--options.utd", "-1"], "utd is -1.0: must be a positive number"),
        (["--options.utd", "nan"], "utd is nan: must be a positive number"),
        (["--options.lr-actor", "inf"], "lr-actor is inf: must be a positive number"),
        (["--options.gamma", "0.9"], "--options.gamma"),
        (["--variant", "a/b"], "--variant 'a/b' cannot name a folder"),
        (["--seeds", "0"], "--seeds is 0: must be at least 1"),
        (["--seed", "4294967296"], "--seed is 4294967296: seeds go from 0 to"),
        (["--real"], "--real: name at least one"),
        (["--real", "mild", "mild"], "--real names mild twice"),
        (["--real", "{home}/turned.toml", "{home}/else/turned.toml"], "two of them would share the folder"),
        (
            ["--real", "{home}/turned.toml", "{home}/heavy.toml", "{home}/else/light.toml", "--seeds", "1"],
            "times --seeds is 3: not a multiple of the 2",
        ),
        (["--resume"], "nothing to resume there"),
        (["--out", "{home}/turned.toml"], "turned.toml is a file; choose another --out"),
    ],
)
def test_a_bad_command_is_one_line_and_code_2(home, tmp_path, more, words, capsys):
    (home / "else").mkdir(exist_ok=True)
    for name in ("turned", "light"):
        (home / f"else/{name}.toml").write_text("[params]\nmass = 0.5\n")
    assert words in complaint([*argv(home, out=tmp_path), *(word.format(home=home) for word in more)], capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_training_that_diverges_stops_in_one_line(home, tmp_path, capsys):
    error = complaint([*argv(home, "sac", out=tmp_path), "--options.lr-critic", "1e30"], capsys)
    assert "training has diverged: " in error and "is not finite after 2 rollouts; there is no checkpoint" in error
    folder = tmp_path / "finetune/toy/turned/sac/seeds-0-1"
    assert len(RealStore(folder)) == 2 and not (folder / "metrics.jsonl").exists()


@pytest.mark.heavy
def test_another_configuration_does_not_continue_a_run(home, capsys):
    run(home, "sgft-sac")
    capsys.readouterr()
    assert "exists already" in complaint(argv(home, "sgft-sac"), capsys)
    error = complaint(argv(home, "sgft-sac", "--resume", "--options.utd", "1"), capsys)
    assert "options.utd was 0.5, now 1.0" in error


@pytest.mark.heavy
def test_other_priors_do_not_continue_a_run(home, tmp_path, capsys):
    folder = tmp_path / run(home, "sgft-sac").relative_to(home)
    shutil.copytree(run(home, "sgft-sac"), folder)
    origin = json.loads((folder / "provenance.json").read_text())
    (start,) = origin["starts"]
    assert len(start["priors"]) == 2 and len(set(start["priors"])) == 2
    start["priors"][1] = "0" * 12
    (folder / "provenance.json").write_text(json.dumps(origin))
    error = complaint(argv(home, "sgft-sac", "--resume", "--rollouts", "6", out=tmp_path), capsys)
    assert f"{folder}: cannot resume with other priors: they were" in error and "000000000000" in error
    assert read_jsonl(folder / "eval.jsonl") == read_jsonl(run(home, "sgft-sac") / "eval.jsonl")


# --- several real systems ---------------------------------------------------------------------------------------------


def files(folder):
    """What a run leaves, but for checkpoints and names that are drawn by chance or tell the time."""
    paths = (str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    return sorted(path for path in paths if "/d/" not in path and not path.startswith(("tensorboard/", "checkpoints/")))


def agree(one, two, upto):
    """The same starts and rollouts, and, up to the rounding of updates, metrics and evaluations."""
    for a, b in zip(rollouts(one)[:upto], rollouts(two)[:upto], strict=True):
        np.testing.assert_array_equal(a["obs"][:, 0], b["obs"][:, 0])
        np.testing.assert_allclose(a["trace"], b["trace"], atol=1e-3)
    for name in ("metrics.jsonl", "eval.jsonl"):
        lines = ([line for line in read_jsonl(run / name) if line["rollouts"] <= upto] for run in (one, two))
        for a, b in zip(*lines, strict=True):
            assert a.keys() == b.keys()
            for key in a:
                assert a[key] == pytest.approx(b[key], rel=1e-3, abs=1e-3), key


@pytest.mark.slow
def test_simulated_data_are_those_of_the_simulator_that_the_prior_comes_from(tmp_path):
    """A mass of 3 kg without friction, where the task's own domain has 0.8 to 1.2 kg and 3.5 to 4.5 per second."""
    gap = {"name": "wrong", "params": {"mass": 3.0, "friction": 0.0}, "effects": {"obs_noise": 0.0}, "scene": ""}
    save_prior(tmp_path / "seed-0", 0, gap=gap | {"families": [], "stratum": ""})
    prior, env = load_prior(tmp_path / "seed-0"), toy.make()
    options = {"simulated_share": 0.5, "simulated_transitions": 200}
    setup = api.setup(env, gaps.load(env, "sim"), prior, method="sac", **options)
    rows = setup.simulated().of(0).draw(jax.random.key(0), 50)
    gained = 0.1 * 4.0 * rows.action / 3.0  # dt times force over mass
    np.testing.assert_allclose(rows.next_obs[:, 2:] - rows.obs[:, 2:], gained, atol=1e-5)


@pytest.mark.slow
def test_real_systems_together_are_what_each_is_alone(home, tmp_path, capsys):
    both = [tmp_path / f"finetune/toy/{real}/sac/seeds-0-1" for real in ("heavy", "turned")]
    alone = run(home, "sac")
    arguments = argv(home, "sac", "--rollouts", "4", reals=("heavy", "turned"), out=tmp_path)
    finetune.main(arguments)
    assert files(both[0]) == files(both[1]) == [path for path in files(alone) if path != "real/rollout-000004.npz"]
    agree(both[1], alone, upto=4)
    heavy, turned = (read_jsonl(folder / "eval.jsonl")[-1]["return"] for folder in both)
    assert heavy != pytest.approx(turned, abs=0.05)
    named = [json.loads((folder / "config.json").read_text())["config"]["real"] for folder in (*both, alone)]
    assert named == [str(home / "heavy.toml"), *[str(home / "turned.toml")] * 2]
    card = load_prior(both[0] / "policy/seed-1").card["finetuned"]
    assert (card["gap"]["name"], card["seed"]) == ("heavy", 1)

    shutil.rmtree(both[1] / "checkpoints/4")
    error = complaint([*arguments, "--resume"], capsys)
    assert f"{both[0]} is at step 4, {both[1]} is at step 3: they cannot go on together" in error
    runs.Lock(both[0])  # they are free again


@pytest.mark.slow
def test_runs_go_on_together_or_alone_whichever_way_they_began(home, tmp_path):
    """Together for 3 rollouts, alone for the fourth, together for the last."""
    reals = ("heavy", "turned")
    finetune.main(argv(home, "sgft-sac", "--rollouts", "3", reals=reals, out=tmp_path))
    for real in reals:
        finetune.main(argv(home, "sgft-sac", "--rollouts", "4", "--resume", reals=(real,), out=tmp_path))
    finetune.main(argv(home, "sgft-sac", "--resume", reals=reals, out=tmp_path))
    heavy, turned = (tmp_path / f"finetune/toy/{real}/sgft-sac/seeds-0-1" for real in reals)
    assert [line["rollouts"] for line in read_jsonl(heavy / "eval.jsonl")] == [0, 2, 3, 4, 5]  # 3 was an end once
    curve = turned / "eval.jsonl"
    curve.write_text("".join(line for line in curve.read_text().splitlines(True) if '"rollouts": 3' not in line))
    agree(turned, run(home, "sgft-sac"), upto=5)


# --- video ------------------------------------------------------------------------------------------------------------


@functools.cache
def springs(pushes):
    """The toy task, worlds, and six episodes [1, 6] of each of two springs, with their strengths."""
    env = toy.make()
    pool = envs.sample_worlds(env, jax.random.key(0), 3)
    keys = jax.random.split(jax.random.key(4), (1, 6))

    def played(push):
        def spring(carry, obs, key):
            return push * -obs[:2], carry

        return jax.vmap(jax.vmap(lambda key: play_episode(env, pool, spring, (), key, gamma=1.0)))(keys)

    return env, pool, jax.vmap(jax.jit(played))(jnp.array(pushes))


def film(folder, monkeypatch, *, pushes=(0.0, 1.0), scene=None, reason=None):
    """Records two springs, before and after; returns what was said, and the episodes."""
    monkeypatch.setattr(toy, "SCENE", scene, raising=False)
    monkeypatch.setattr(pictures, "select_renderer", lambda: reason)
    env, pool, both = springs(pushes)
    played = [jax.tree.map(lambda x, i=i: x[i], both) for i in (0, 1)]
    path = folder / "videos" / "seed-0.mp4"
    words = pictures.before_and_after(env, pool, lambda: [member(x, 0) for x in played], path, rollouts=7)
    return words, played, pool


def test_a_record_counts_the_steps_that_were_made(tmp_path):
    """Of two seeds whose episodes end early; evaluations on the real system are steps too."""
    record = FinetuneRecord(tmp_path, toy.make(), gaps.Gap("toy", {}, {}), "sac", [0, 1], costly=True)
    record.played = np.array([7, 12])
    record.evaluation(1, {"score": np.zeros(2)}, np.array([3, 2]))
    record.metrics(1, {"real/return": np.zeros(2), "critic/loss": np.array([np.nan, 1.0]), "updates": np.array([0, 3])})
    record.played = np.array([7, 20])
    record.evaluation(2, {"score": np.zeros(2)}, np.array([1, 1]))
    lines, (trained,) = (read_jsonl(tmp_path / name) for name in ("eval.jsonl", "metrics.jsonl"))
    assert [line["step"] for line in lines] == [10, 16] and trained["step"] == 12
    assert lines[1]["robot_minutes"] == pytest.approx(16 * toy.DT / 60)
    assert np.isnan(trained["critic/loss"][0])  # a seed that has made no update has no loss
    with pytest.raises(UserError, match="critic/loss of 1 of 2 members is not finite"):
        record.metrics(2, {"critic/loss": np.array([np.nan, 1.0]), "updates": np.array([3, 3])})


@pytest.mark.slow
def test_no_scene_no_renderer_or_a_broken_one_is_a_notice(tmp_path, monkeypatch):
    assert film(tmp_path, monkeypatch)[0] == "no video: toy has no scene to draw"
    scene = object()
    assert film(tmp_path, monkeypatch, scene=scene, reason="no library")[0] == "no video: no library"
    for error in (UserError("no graphics"), RuntimeError("no encoder\nat all")):
        monkeypatch.setattr(
            "envs.mujoco.render.render_side_by_side", lambda *_, error=error: (_ for _ in ()).throw(error)
        )
        assert film(tmp_path, monkeypatch, scene=scene)[0] == f"no video: {str(error).splitlines()[0]}"


@pytest.mark.heavy
@pytest.mark.parametrize(("pushes", "words"), [((0.0, 1.0), ("failure", "success")), ((1.0, 0.0), None)])
def test_the_film_shows_an_episode_that_only_the_tuned_agent_solves(tmp_path, monkeypatch, pushes, words):
    """Both from the same start in the same world; without such an episode the first one."""
    seen = []
    monkeypatch.setattr("envs.mujoco.render.render_side_by_side", lambda *given: seen.append(given))
    said, (old, new), pool = film(tmp_path, monkeypatch, pushes=pushes, scene=object())
    only_new = np.flatnonzero(np.asarray(new.success & ~old.success)[0])
    expected = int(only_new[0]) if only_new.size else 0
    _, thetas, (before, after), captions, path = seen[0]
    assert said == f"video: {path}" and path.parent.exists()
    np.testing.assert_allclose(thetas, [np.asarray(pool.theta.params)[new.world[0, expected]]] * 2)
    np.testing.assert_array_equal(before, old.trace[0, expected])
    np.testing.assert_array_equal(after, new.trace[0, expected])
    np.testing.assert_array_equal(before[0], after[0])
    assert captions[0].startswith("before fine-tuning: ") and captions[1].startswith("after 7 real rollouts: ")
    assert (only_new.size > 0) == (words is not None)
    if words:
        assert [caption.split(": ")[1] for caption in captions] == list(words)


def test_systems_of_several_scenes_are_fine_tuned_one_scene_after_another(tmp_path, monkeypatch):
    file, groups = "envs/gaps/development/push-unexplained.toml", []

    def run(args, method, seeds, priors, homes):
        groups.append([home.parents[1].name for home in homes])
        assert [config["real"] for config in homes.values()] == list(args.real)
        return [{"gap": real} for real in args.real]

    monkeypatch.setattr(finetune_run, "run", run)
    reals = (f"{file}:push-4-02", f"{file}:push-4-03", f"{file}:push-4-06")
    args = arguments("sac", task="push", prior=Path("shipped:push"), real=reals, out=tmp_path)
    assert [summary["gap"] for summary in finetune_args.finetune(args)] == list(reals)
    assert groups == [["push-4-02", "push-4-06"], ["push-4-03"]]
