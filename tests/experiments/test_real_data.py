"""Real rollouts out of runs and logs into them: what is exported, what a run begins with, what a replay draws."""

import json

import h5py
import jax
import numpy as np
import pytest
import toy
from priors_by_hand import save_prior
from test_finetune import complaint, killed, rollouts, same_results

from envs import gaps
from envs.observations import with_previous_actions
from envs.rollout import real_worlds
from envs.types import UserError
from experiments import export_data, finetune, replay
from experiments.runner import pictures
from experiments.runner.options import episodes_of
from sgft_jax.datasets import logs
from sgft_jax.io.log import read_jsonl
from sgft_jax.io.real import RealStore
from sgft_jax.train import finetuning

ENV, STEPS = toy.make(), 5
GAP = "[params]\nmass = 2.0\n[effects]\naction_rotation = 0.52\n"
VALID = np.array([[5, 3], [2, 0]])  # steps of seeds 3 and 4 in two rollouts; the second one of seed 3 terminates
OPTIONS = """--task toy --method sac --rollouts 2 --checkpoint-every 1 --no-video --devices 1
    --options.initial-rollouts 1 --options.utd 0.2 --options.batch-size 8 --options.critic-warmup 0
    --options.replay-capacity 64"""
# iql learns from the simulator first: killed in that phase, then among the updates on logs.
KILL = """
finetuning.OFFLINE_PART = 10
checkpoint = FinetuneRecord.checkpoint
def offline(self, progress, step, **facts):
    checkpoint(self, progress, step, **facts)
    if int(progress.offline) == {updates}:
        die()
FinetuneRecord.checkpoint = offline
"""


pytestmark = pytest.mark.usefixtures("toy_task")


def rollout(number):
    """What a run of two seeds stores: observations count up from 100 * seed + 10 * number, and end with a memory."""
    steps, seeds = np.arange(STEPS), np.arange(2)[:, None]
    valid = steps < VALID[:, number][:, None]
    first = np.where(valid, 100.0 * seeds + 10 * number + steps, 0.0)[..., None]
    obs = np.concatenate([np.repeat(first, 4, axis=2), np.full((2, STEPS, 4), -9.0)], axis=2)
    terminated = (number == 1) & (seeds == 0) & (steps == 2)
    action = np.repeat(first, 2, axis=2) / 1000
    none = np.zeros(2, bool)
    discount, success = np.where(valid & ~terminated, 0.9, 0.0), np.array([number == 1, False])
    next_obs = np.concatenate([obs[..., :4] + 1, obs[..., 4:]], axis=2)
    trace = np.arange(2 * (STEPS + 1) * 2.0).reshape(2, STEPS + 1, 2)
    facts = (
        {"obs": obs, "action": action, "reward": valid * 1.0, "discount": discount, "next_obs": next_obs}
        | {"valid": valid, "total_reward": valid.sum(1), "success": success, "exploded": none, "score": none}
        | {"world": np.zeros(2, int), "trace": trace, "command": 2 * action}
    )
    return {name: x.astype(np.float32) if x.dtype == float else x for name, x in facts.items()}


@pytest.fixture
def home(tmp_path):
    """A run with two rollouts of the seeds 3 and 4, whose policies saw their last two actions."""
    folder = tmp_path / "finetune/toy/turned/sac/seeds-3-4"
    store = RealStore(folder)
    for number in range(2):
        store.append(rollout(number))
    (tmp_path / "turned.toml").write_text(GAP)
    config = {"task": "toy", "seed": 3, "method": "sac", "impl": "auto", "set": []}
    config["real"] = str(tmp_path / "turned.toml")
    (folder / "config.json").write_text(json.dumps({"config": config}))
    return folder


def says(main, args, capsys):
    main(args)
    return capsys.readouterr().out.splitlines()


# --- out --------------------------------------------------------------------------------------------------------------


def test_minari_holds_what_was_measured_and_how_episodes_ended(home, capsys):
    """Not the memory, and not what came after an end; the episode without a valid step is left out."""
    (line,) = says(export_data.main, export_data.ExportDataArgs(home, "minari"), capsys)
    folder = home / "export/minari/toy-turned-sac-seeds-3-4-v0"
    assert line == f"{folder}: 3 episodes, 10 transitions, 1 successes"
    with h5py.File(folder / "data/main_data.hdf5") as file:
        assert sorted(file) == ["episode_0", "episode_1", "episode_2"]
        np.testing.assert_array_equal(file["episode_1/observations"], np.repeat([[10], [11], [12], [13]], 4, axis=1))
        np.testing.assert_allclose(file["episode_2/actions"][:, 1], [0.1, 0.101])
        assert file["episode_1/terminations"][()].tolist() == [False, False, True]
        assert file["episode_2/truncations"][()].tolist() == [False, True]
        assert [bool(file[f"episode_{i}"].attrs["success"]) for i in range(3)] == [False, True, False]
    card = json.loads((folder / "data/metadata.json").read_text())
    assert card["observation"][0] == {"name": "xy", "unit": "m", "size": 2, "error": 0.0}
    assert (card["control_dt"], card["task"], card["algorithm_name"]) == (0.1, "toy", "sac")


def test_one_seed_alone(home, capsys):
    (line,) = says(export_data.main, export_data.ExportDataArgs(home / "real", "minari", seed=4), capsys)
    assert line == f"{home}/export/minari/toy-turned-sac-seed-4-v0: 1 episodes, 2 transitions, 0 successes"
    with pytest.raises(UserError, match=r"--seed 5: .* has the seeds 3, 4"):
        export_data.main(export_data.ExportDataArgs(home, "minari", seed=5))


def test_all_layouts_say_the_same(home):
    """As one another, and as the rollouts themselves."""
    pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'sgft-jax[lerobot]'")
    found = [logs.load(home, gamma=0.9, env=ENV), logs.load(home / "real", gamma=0.9, env=ENV)]
    for to in ("minari", "lerobot"):
        export_data.main(export_data.ExportDataArgs(home, to))
        found.append(logs.load(home / f"export/{to}/toy-turned-sac-seeds-3-4-v0", gamma=0.9, env=ENV))
    assert [log.facts.layout for log in found] == ["rollouts", "rollouts", "minari", "lerobot"]
    for log in found:
        jax.tree.map(np.testing.assert_array_equal, log.rows, found[0].rows)
        assert log.last.tolist() == [i in (4, 7, 9) for i in range(10)]
        assert (log.facts.terminal, log.facts.return_max, log.facts.episodes) == (1, 5.0, 3)
    np.testing.assert_array_equal(found[0].rows.obs[:, 0], [0, 1, 2, 3, 4, 10, 11, 12, 100, 101])


def test_rollouts_are_read_for_a_policy_that_sees_other_things(home):
    """One last action, where the policy that played has seen two: it follows from the episode."""
    log = logs.load(home, gamma=0.9, env=with_previous_actions(ENV, 1))
    np.testing.assert_allclose(log.rows.obs[:, 5], [0, 0, 0.001, 0.002, 0.003, 0, 0.01, 0.011, 0, 0.1], atol=1e-7)
    np.testing.assert_allclose(log.rows.next_obs[:, 4], log.rows.action[:, 0], atol=1e-7)


def test_what_cannot_be_exported(home, tmp_path):
    args = export_data.ExportDataArgs(home, "minari")
    export_data.main(args)
    with pytest.raises(UserError, match="exists already; choose another --out"):
        export_data.main(args)
    with pytest.raises(UserError, match="Minari wants a version at the end, such as set-v0"):
        export_data.main(export_data.ExportDataArgs(home, "minari", out=tmp_path / "set"))
    with pytest.raises(UserError, match="holds no recorded rollouts"):
        export_data.main(export_data.ExportDataArgs(tmp_path, "minari"))
    (home / "config.json").unlink()
    with pytest.raises(UserError, match="does not say of which task it is; name it with --task"):
        export_data.main(export_data.ExportDataArgs(home, "minari", out=tmp_path / "set-v0"))


# --- in ---------------------------------------------------------------------------------------------------------------


def test_episodes_of_logs_are_padded_and_keep_their_borders(home):
    log = logs.load(home, gamma=0.9, env=ENV)
    rows, valid = logs.episodes([log, log])
    assert valid.sum(1).tolist() == [5, 3, 2, 5, 3, 2] and rows.obs.shape == (6, 5, 4)
    np.testing.assert_array_equal(rows.obs[1, :, 0], [10, 11, 12, 0, 0])
    np.testing.assert_array_equal(rows.discount[4], np.float32([0.9, 0.9, 0, 0, 0]))


@pytest.fixture
def words(home, tmp_path):
    """The words of a run that begins with these logs, and its folder."""
    save_prior(tmp_path / "prior", 0)
    given = ["--prior", tmp_path / "prior", "--real", tmp_path / "turned.toml", "--out", tmp_path / "runs"]

    def words(*more, data=(home,), seeds=1):
        logged = ["--real-data", *map(str, data)] if data else []
        return [*OPTIONS.split(), "--seeds", str(seeds), *map(str, given), *logged, *map(str, more)]

    return words


@pytest.mark.heavy
def test_a_run_begins_with_logs(words, home, tmp_path, capsys):
    """Ten transitions are half a rollout, which allows two of four updates. They are no transitions of its own."""
    finetune.main(words("--eval-episodes", "0"))
    assert "10 transitions of 3 episodes, return 3.333" in capsys.readouterr().out
    folder = tmp_path / "runs/finetune/toy/turned/sac/seed-0"
    lines = read_jsonl(folder / "metrics.jsonl")
    assert [(line["rollouts"], line["step"]) for line in lines] == [(0, 0), (1, 20), (2, 40)]
    assert "critic/loss" in lines[0] and "real/return" not in lines[0]
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["logged"] == 10 and summary["final"]["transitions"] == 40
    assert len(rollouts(folder)) == 2


@pytest.mark.slow
def test_logs_may_lie_elsewhere_when_a_run_goes_on_but_not_be_others(words, home, tmp_path, capsys):
    finetune.main(words("--eval-episodes", "0"))
    folder = tmp_path / "runs/finetune/toy/turned/sac/seed-0"
    home.rename(tmp_path / "moved")
    finetune.main([*words("--eval-episodes", "0", "--rollouts", "3", "--resume", data=[tmp_path / "moved"])])
    assert len(rollouts(folder)) == 3
    again = words("--eval-episodes", "0", "--rollouts", "4", "--resume", data=[folder])
    assert "cannot resume with other real_data" in complaint(again, capsys)
    assert "cannot resume with other real_data" in complaint(words("--eval-episodes", "0", "--resume", data=[]), capsys)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--options.replay-capacity", "9"], "10 transitions, but an agent keeps 9; raise --options.replay-capacity"),
        (["--real-updates", "-1"], "--real-updates -1: 0 or more"),
        (["--successors", "shift"], "--successors: there is no 'shift', did you mean 'shifted'?"),
        (["--real-data", "nowhere"], "--real-data nowhere: no such file or folder"),
    ],
)
def test_logs_that_cannot_be_begun_with(more, said, words, capsys):
    assert said in complaint(words(*more), capsys)


def test_a_file_without_next_observations_is_read_with_shifted_ones(words, tmp_path, capsys):
    with h5py.File(tmp_path / "bare.hdf5", "w") as file:
        file["observations"], file["actions"] = np.zeros((6, 4)), np.zeros((6, 2))
        file["rewards"], file["terminals"] = np.zeros(6), np.zeros(6, bool)
        file["timeouts"] = np.arange(6) == 3
    given = words("--options.replay-capacity", "3", data=[tmp_path / "bare.hdf5"])
    assert "has no 'next_observations'; set successors to 'shifted'" in complaint(given, capsys)
    assert "4 transitions, but an agent keeps 3" in complaint([*given, "--successors", "shifted"], capsys)
    said = complaint([*words(data=[]), "--successors", "shifted"], capsys)
    assert "--successors shifted: is for --real-data, which must be named" in said


def test_logs_of_another_task_are_refused(words, tmp_path, capsys):
    wide = {name: np.repeat(x, 2, axis=2) if name in ("action", "command") else x for name, x in rollout(0).items()}
    RealStore(tmp_path / "wide").append(wide)
    error = complaint(words(data=[tmp_path / "wide"]), capsys)
    assert "wide: has 4 observations and 4 actions, toy has 4 and 2; name the task" in error
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
@pytest.mark.parametrize("updates", [20, 30])
def test_killed_before_or_among_the_updates_on_logs(words, tmp_path, updates, monkeypatch):
    """The end is the same to the bit; episodes of the logs are kept once."""
    monkeypatch.setattr(finetuning, "OFFLINE_PART", 10)
    simulated = ["--options.offline-updates", "20", "--options.simulated-transitions", "80", "--eval-episodes", "2"]
    more = ["--method", "iql", *simulated, "--real-updates", "20", "--out"]
    common = [word for word in words(seeds=2) if "critic-warmup" not in word]
    common.remove("0")
    whole, cut = ([*common, *more, str(tmp_path / name)] for name in ("whole", "cut"))
    finetune.main(whole)
    killed(KILL.format(updates=updates), cut)
    finetune.main([*cut, "--resume"])
    folders = [tmp_path / name / "finetune/toy/turned/iql/seeds-0-1" for name in ("cut", "whole")]
    lines = [read_jsonl(folder / "metrics.jsonl") for folder in folders]
    assert [line["rollouts"] for line in lines[0]] == [0, 0, 0, 0, 1, 2]
    same_results(*folders)


# --- a look -----------------------------------------------------------------------------------------------------------


def test_panels_show_measurements_commands_and_what_was_sent(home):
    """Three steps of 0.1 s have four states; what was sent stays to the end of its step."""
    panels = {panel.name: panel for panel in pictures.panels(ENV, episodes_of(home, 3)[1:])}
    sent = panels.get("force, sent; dotted: commanded")
    assert list(panels)[:2] == ["xy", "velocity"] and len(panels) == 4 and panels["velocity"].unit == "m/s"
    np.testing.assert_allclose(panels["xy"].lines["[1]"], [10, 11, 12, 13, np.nan])
    np.testing.assert_allclose(panels["xy"].time[:4], [0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(sent.lines["[0]"], [0.01, 0.011, 0.012, 0.012, np.nan], rtol=1e-6)
    np.testing.assert_allclose(sent.dotted["[0]"][:2], [0.02, 0.022], rtol=1e-6)
    assert sent.held and not panels["xy"].held


def test_episodes_stand_one_after_another(home):
    """The second begins where the first has ended, with a gap in the line."""
    panel = pictures.panels(ENV, episodes_of(home, 3))[0]
    np.testing.assert_allclose(panel.lines["[0]"], [0, 1, 2, 3, 4, 5, np.nan, 10, 11, 12, 13, np.nan])
    np.testing.assert_allclose(panel.time[[0, 5, 7, 10]], [0, 0.5, 0.5, 0.8])
    bare = [own._replace(command=None) for own in episodes_of(home, 3)]
    panel = pictures.panels(ENV, bare)[2]
    assert panel.name == "force, sent" and not panel.dotted


def test_a_replay_draws_and_films(home, tmp_path, monkeypatch, capsys):
    """In the world in which the rollout took place, until it ended."""
    seen = []
    monkeypatch.setattr(toy, "SCENE", object(), raising=False)
    monkeypatch.setattr(pictures, "select_renderer", lambda: None)
    monkeypatch.setattr("envs.mujoco.render.render_episode", lambda *given: seen.append(given))
    said = says(replay.main, replay.ReplayArgs(home, rollout=(0, 1), out=tmp_path / "seen"), capsys)
    picture, *films = (tmp_path / "seen" / name for name in ("seed-3-rollout-0-1.png", "videos/seed-3-rollout-1.mp4"))
    assert said[0] == f"picture: {picture}" and picture.stat().st_size > 10_000 and said[2] == f"video: {films[0]}"
    theta = real_worlds(ENV, [gaps.load(ENV, str(tmp_path / "turned.toml"))], jax.random.key(0)).theta.params[0, 0]
    np.testing.assert_allclose(seen[1][1], theta)
    np.testing.assert_array_equal(seen[1][2], rollout(1)["trace"][0][:4])


def test_what_cannot_be_replayed(home, capsys):
    with pytest.raises(UserError, match=r"--rollout 1: .* has 0 to 0"):
        replay.main(replay.ReplayArgs(home, rollout=(1,), seed=4))
    (home / "config.json").unlink()
    said = says(replay.main, replay.ReplayArgs(home, task="toy"), capsys)
    assert said[1] == f"no video of rollout 1: {home} does not say in which gap it was played"
    RealStore(home).append({**rollout(0), "trace": np.zeros((2, STEPS + 1, 0))})
    said = says(replay.main, replay.ReplayArgs(home, task="toy"), capsys)
    assert said[1] == "no video of rollout 2: its states were not stored; a simulated real system leaves them"
