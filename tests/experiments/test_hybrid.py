"""Learning from real data and a simulator, end to end on a point mass: run, interrupt, resume, errors."""

import json

import h5py
import jax
import numpy as np
import pytest
import toy

import sgft_jax
from envs import normalised
from envs.types import UserError
from experiments import hybrid
from experiments.hybrid import data_name, run_folder
from experiments.runner.hybrid_run import in_words, intervals
from sgft_jax.analysis import figures
from sgft_jax.io.log import MetricsLog, read_jsonl

OPTIONS = """--task toy --seeds 2 --no-video --schedule.updates 24 --schedule.simulators 2 --schedule.buffer 64
    --schedule.chunk-updates 6 --eval-every 12 --eval-episodes 2 --checkpoint-every 6 --options.hidden 16
    --options.rows 8"""
TINY = OPTIONS.split()


pytestmark = pytest.mark.usefixtures("toy_task")


@pytest.fixture
def data(tmp_path):
    return d4rl(tmp_path / "recorded-v2.hdf5", toy.make().obs_dim, 2)


@pytest.fixture
def gap(tmp_path):
    """A file of two simulators."""
    path = tmp_path / "two.toml"
    path.write_text("[heavy.params]\nmass = 2.0\n[slippery.params]\nfriction = 1.0\n")
    return str(path)


def d4rl(path, obs_dim, act_dim, n=60):
    draw = np.random.default_rng(0)
    obs = draw.uniform(-1, 1, (n, obs_dim)).astype(np.float32)
    with h5py.File(path, "w") as file:
        file["observations"], file["next_observations"] = obs, obs + 0.01
        file["actions"] = draw.uniform(-1, 1, (n, act_dim)).astype(np.float32)
        file["rewards"] = draw.normal(size=n).astype(np.float32)
        file["terminals"], file["timeouts"] = np.zeros(n, bool), (np.arange(n) % 20) == 19
    return path


def words(tmp_path, data, *more):
    given = [] if data is None else ["--data", str(data), "--options.ratio-rows", "8"]
    return [*TINY, *given, "--out", str(tmp_path / "out"), *more]


def complaint(argv, capsys):
    with pytest.raises(SystemExit) as stopped:
        hybrid.main(argv)
    *phases, error = capsys.readouterr().err.splitlines()
    assert stopped.value.code == 2 and "error" not in "".join(phases).lower()
    return error


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("method", "simulators"),
    [("iql", [""]), pytest.param("h2oplus", ["heavy", "slippery"], marks=pytest.mark.slow)],
)
def test_a_run_leaves_curves_policies_and_a_summary_for_each_simulator(
    method, simulators, tmp_path, data, gap, capsys, monkeypatch
):
    drawn, draw = {}, figures.learning_curves
    monkeypatch.setattr(
        figures, "learning_curves", lambda path, *a, **b: drawn.update({path: a}) or draw(path, *a, **b)
    )
    given = ["--gap", gap, "--options.ratio-rows", "8"] if method == "h2oplus" else ["--gap", "sim"]
    given += ["--method", method, "--variant", "w", "--seeds", "3", "--data", str(data)]
    hybrid.main(words(tmp_path, None, *given))
    said = capsys.readouterr().out
    assert "60 transitions of 3 episodes" in said
    for simulator in simulators:
        name = simulator or "no-simulator"
        assert f"{name}: success in the real system" in said
        folder = tmp_path / f"out/hybrid/toy/{name}/recorded-v2/{method}_w/seeds-0-2"
        evaluations = read_jsonl(folder / "eval.jsonl")
        assert [line["step"] for line in evaluations] == [0, 12, 24] and len(evaluations[0]["score"]) == 3
        assert [line["step"] for line in read_jsonl(folder / "metrics.jsonl")] == [6, 12, 18, 24]
        summary = json.loads((folder / "summary.json").read_text())
        assert summary["last"] == evaluations[-1]["score"] and summary["updates"] == 24
        assert summary["data"]["transitions"] == 60 and summary["gap"]["name"] == name and not summary["measures"]
        np.testing.assert_allclose(summary["late"], np.mean([line["score"] for line in evaluations], axis=0))
        assert {one: summary[one] for one in summary if "interval" in one} == intervals(
            {one: np.array(summary[one]) for one in ("last", "late")}
        )
        for before, one in (("real system", "last"), ("the last 10 evaluations", "late")):
            assert f"{before} {in_words(np.array(summary[one]), summary[f'{one}/interval'])}" in said
        assert f"results: {folder}  (policy/, summary.json, eval.jsonl, figures/)" in said
        assert (folder / "figures/score.png").stat().st_size > 5_000
        (((words_of_panel, (curve,)),),) = (panels.items() for panels in drawn[folder / "figures/score.png"])
        assert words_of_panel == f"simulator: {simulator or 'none'}" and curve.gap == simulator
        assert (curve.spec, curve.data) == (f"{method}:w", "recorded-v2") and curve.x.tolist() == [0, 12, 24]
        np.testing.assert_array_equal(curve.values, np.transpose([line["score"] for line in evaluations]))
        policy = sgft_jax.load_policy(folder / "policy/seed-1")
        action = np.asarray(policy.act([0.5, 0.0, 0.0, 0.0]))
        assert action.shape == (2,) and (np.abs(action) < 1).all()


def test_intervals_are_of_the_mean_over_seeds_and_need_three():
    found = intervals({"last": np.array([0.0, 0.0, 3.0, 100.0]), "late": np.array([2.0, 2.0, 2.0])})
    low, high = found["last/interval"]
    assert low == 0 and 50 < high <= 100  # the interquartile mean of these is 1.5
    assert found["late/interval"] == [2.0, 2.0]
    assert intervals({"last": np.array([0.0, 1.0])}) == {}


def test_scores_in_words():
    scores = np.array([20.0, 21.0])
    assert in_words(scores, [18.0, 22.25]) == "20.5 [18, 22.25]"
    assert in_words(scores, None) == in_words(scores, [20.5, 20.5]) == "20.5"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "simulator"),
    [("h2oplus", "sim"), ("iql", "no-simulator")],  # the rate of the second follows the updates
)
def test_an_interrupted_run_goes_on_and_ends_the_same(method, simulator, tmp_path, data, monkeypatch):
    ratio_rows = [] if method == "iql" else ["--options.ratio-rows", "8"]
    given = [*TINY, "--data", str(data), *ratio_rows, "--method", method, "--gap", "sim", "--out"]
    hybrid.main([*given, str(tmp_path / "whole")])
    write, left = MetricsLog.metrics, iter(range(3))

    def metrics(*args):
        if next(left, None) is None:
            raise KeyboardInterrupt
        write(*args)

    with monkeypatch.context() as patched, pytest.raises(SystemExit) as stopped:
        patched.setattr(MetricsLog, "metrics", metrics)
        hybrid.main([*given, str(tmp_path / "cut")])
    assert stopped.value.code == 130
    hybrid.main([*given, str(tmp_path / "cut"), "--resume"])
    home = f"hybrid/toy/{simulator}/recorded-v2/{method}/seeds-0-1"
    whole, cut = (tmp_path / out / home for out in ("whole", "cut"))
    for name in ("metrics.jsonl", "eval.jsonl"):
        assert (whole / name).read_text() == (cut / name).read_text()
    assert (cut / "figures/score.png").exists()


@pytest.mark.slow
def test_sac_needs_no_data(tmp_path):
    hybrid.main(words(tmp_path, None, "--method", "sac", "--gap", "sim"))
    folder = tmp_path / "out/hybrid/toy/sim/no-data/sac/seeds-0-1"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["data"] is None and not [name for name in summary if "interval" in name]  # of two seeds
    assert (folder / "policy/seed-1").exists() and (folder / "figures/score.png").exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--method", "h2opuls"], "did you mean 'h2oplus'"),
        (["--preset", "papre"], "did you mean 'paper'"),
        (["--options.value-share", "2"], "option value-share is 2.0: must be from 0 to 1"),
        (["--schedule.simulators", "0"], "option simulators is 0: must be at least 1"),
        (["--schedule-preset", "flet"], "--schedule-preset: there is no 'flet', did you mean 'fleet'"),
        (["--gap", "gravitiy"], "gravitiy"),
        (["--variant", "a/b"], "--variant 'a/b'"),
        (["--previous-actions", "-1"], "--previous-actions is -1: must be at least 0"),
        (["--gap", "sim", "--successors", "next"], "successors: there is no 'next'"),
    ],
)
def test_bad_options(more, said, tmp_path, data, capsys):
    assert said in complaint(words(tmp_path, data, *more), capsys)
    assert not (tmp_path / "out").exists()


def test_data_that_is_missing_or_of_another_task(tmp_path, capsys):
    assert "--data: h2oplus learns from real data" in complaint([*TINY, "--gap", "sim"], capsys)
    other = d4rl(tmp_path / "other.hdf5", 3, 2)
    error = complaint(words(tmp_path, other, "--gap", "sim"), capsys)
    assert "other.hdf5: has 3 observations and 2 actions, toy has 4 and 2; name the task" in error
    remembered = d4rl(tmp_path / "remembered.hdf5", 8, 2)
    error = complaint(words(tmp_path, remembered, "--gap", "sim"), capsys)
    assert "toy has 4 and 2; previous_actions=2 would fit" in error
    (table := tmp_path / "robot.txt").touch()
    assert "tables are logs of a wheel-legged robot" in complaint(words(tmp_path, table, "--gap", "sim"), capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_data_of_a_policy_that_saw_its_last_actions(tmp_path):
    """Its observations end with two actions of two numbers; so do those of simulators, real system and new policy."""
    data = d4rl(tmp_path / "remembered.hdf5", 4 + 2 * 2, 2)
    hybrid.main(words(tmp_path, data, "--gap", "sim", "--previous-actions", "2"))
    folder = tmp_path / "out/hybrid/toy/sim/remembered/h2oplus/seeds-0-1"
    policy = sgft_jax.load_policy(folder / "policy/seed-0")
    assert (policy.env.obs_dim, policy.env.previous_actions) == (8, 2)


@pytest.mark.slow
def test_other_data_are_refused_when_a_run_goes_on(tmp_path, data, capsys):
    hybrid.main(words(tmp_path, data, "--gap", "sim"))
    d4rl(data, 4, 2, n=70)
    assert "data" in complaint(words(tmp_path, data, "--gap", "sim", "--resume"), capsys)


def test_presets_are_the_defaults_of_their_options():
    paper, released = (hybrid.arguments("h2oplus", preset=name).options for name in ("", "released"))
    assert (paper.value_share, released.value_share) == (0.1, 0.5)


def parsed(words, monkeypatch):
    """The arguments with which a command line runs, and what it says before JAX starts."""
    seen = []
    monkeypatch.setattr("experiments.runner.hybrid_run.run", lambda args, *_: seen.append(args))
    hybrid.main(words.split())
    return seen[0]


def test_rebrac_takes_the_preset_of_the_data_set_unless_one_is_named(monkeypatch, capsys, tmp_path):
    given = f"--task walker2d --method rebrac --data {tmp_path}/walker2d_medium-v2.hdf5 --out {tmp_path}"
    for name in ("medium", "mine"):
        (tmp_path / f"walker2d_{name}-v2.hdf5").touch()
    found = parsed(given, monkeypatch)
    assert (found.preset, found.options.critic_penalty, found.variant) == ("walker2d-medium", 0.1, "")
    assert capsys.readouterr().out == "rebrac: preset walker2d-medium\n"
    named = parsed(f"{given} --preset halfcheetah-medium --options.critic-penalty 0.5", monkeypatch)
    assert (named.preset, named.options.actor_penalty) == ("halfcheetah-medium", 0.001)
    assert named.options.critic_penalty == 0.5
    other = parsed(given.replace("_medium", "_mine"), monkeypatch)
    assert other.preset == "" and other.options.actor_penalty == 0.01
    assert "preset halfcheetah-medium-replay, as none is called after walker2d_mine-v2\n" in capsys.readouterr().out


def test_a_schedule_by_name_gives_the_defaults_that_single_options_change(monkeypatch, capsys, tmp_path):
    found = parsed(f"--method sac --schedule-preset released --schedule.updates 5000 --out {tmp_path}", monkeypatch)
    assert (found.schedule.simulators, found.schedule.steps_per_round, found.schedule.updates) == (1, 1000, 5000)
    assert "sac: 5,000 updates, schedule released (simulators: 1; " in capsys.readouterr().out
    assert parsed(f"--method sac --out {tmp_path}", monkeypatch).schedule.simulators == 25


def test_folders_are_named_after_what_a_method_learns_from(tmp_path):
    args = hybrid.arguments("h2oplus", data=tmp_path / "halfcheetah_medium-v2.hdf5", seeds=1)
    parts = run_folder(args, "gravity").parts[-5:]
    assert parts == ("halfcheetah", "gravity", "halfcheetah_medium-v2", "h2oplus", "seed-0")
    other = hybrid.arguments("h2oplus", data=tmp_path / "log.txt", seeds=1, real="robot", task="wheel-legged")
    assert run_folder(other, "sim").parts[-5:-1] == ("wheel-legged", "sim-for-robot", "log.txt", "h2oplus")
    assert data_name(tmp_path / "mine-v0/data/main_data.hdf5") == "mine-v0" == data_name(tmp_path / "mine-v0")


@pytest.mark.slow
def test_a_table_of_the_wheel_legged_robot(tmp_path):
    """The real robot is a gap, the simulator is the nominal one."""
    draw = np.random.default_rng(0)
    np.savetxt(tmp_path / "standing.txt", np.column_stack([0.05 * draw.normal(size=(80, 5)), np.zeros(80)]))
    argv = f"""--task wheel-legged --gap sim --real robot --data {tmp_path}/standing.txt --seeds 1 --no-video
        --schedule.updates 4 --schedule.simulators 2 --schedule.buffer 64 --schedule.chunk-updates 2 --eval-every 4
        --eval-episodes 1 --options.hidden 8 --options.rows 8 --options.ratio-rows 8 --out {tmp_path}""".split()
    with jax.numpy_rank_promotion("allow"):  # MJX promotes ranks
        hybrid.main(argv)
    folder = tmp_path / "hybrid/wheel-legged/sim-for-robot/standing.txt/h2oplus/seed-0"
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["real"], summary["data"]["layout"], summary["data"]["transitions"]) == ("robot", "table", 79)
    last = read_jsonl(folder / "eval.jsonl")[-1]
    assert summary["measures"] == {name: last[name] for name in ("upright_s", "in_place_s")}
    assert 0 < last["in_place_s"][0] <= last["upright_s"][0] < 10  # s: it has not learned to stand


def test_returns_on_the_scale_of_d4rl():
    assert normalised("halfcheetah", -280.178953) == 0 and normalised("walker2d", 4592.3) == 100
    assert normalised("halfcheetah", 6861.0) == pytest.approx(57.5, abs=0.1)  # H2O+'s mark, section 7 of its table
    assert normalised("toy", 1.0) is None


def test_unknown_methods_are_named():
    with pytest.raises(UserError, match="did you mean 'sac'"):
        hybrid.arguments("sacc")
