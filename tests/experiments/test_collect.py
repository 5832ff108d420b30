"""Recording data sets of a real system on a point mass: both layouts, what SAC did and what it does then."""

import dataclasses
import json
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest
import toy
from priors_by_hand import save_prior

from envs.base import Entry
from envs.types import Transition, UserError
from experiments import collect, hybrid
from experiments.runner import collect_run
from sgft_jax.datasets import logs, recording
from sgft_jax.datasets.recording import Joints, Noted, Recorded

OPTIONS = """--task toy --level -100 --transitions 50 --seeds 2 --environments 3 --updates 60 --eval-every 30
    --eval-episodes 2"""
LEARN = OPTIONS.split()


pytestmark = pytest.mark.usefixtures("toy_task")


def episode(first, steps, *, terminated=False):
    """Observations that count up from `first`."""
    obs = (first + np.arange(steps + 1))[:, None].astype(np.float32)
    return Recorded(
        obs,
        obs[:-1] / 100,
        np.ones(steps, np.float32),
        terminated,
        joints=Joints(obs + 0.5, -np.tile(obs, 2)),
        log_prob=obs[:-1, 0] / 10,
    )


def noted_of(*episodes):
    """What is kept beside the rows of `rows_of`."""
    each = [
        Noted(jax.tree.map(lambda x: x[:-1], e.joints), jax.tree.map(lambda x: x[1:], e.joints), e.log_prob)
        for e in episodes
    ]
    return jax.tree.map(lambda *x: np.concatenate(x), *each)


def rows_of(*episodes):
    """Transitions [T] of episodes of one environment, one after the other."""
    discount = [np.append(np.full(len(e.reward) - 1, 0.9), 0.0 if e.terminated else 0.9) for e in episodes]
    return Transition(
        np.concatenate([e.obs[:-1] for e in episodes]),
        np.concatenate([e.action for e in episodes]),
        np.concatenate([e.reward for e in episodes]),
        np.concatenate(discount),
        np.concatenate([e.obs[1:] for e in episodes]),
    )


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_episodes_of_a_fleet_are_found_again_in_the_order_of_their_ends():
    """Two environments, eight steps: one falls after three; the recording cuts off both last episodes."""
    one = [episode(0, 3, terminated=True), episode(50, 5)]
    two = [episode(200, 6), episode(300, 2)]

    def mixed(a, b):
        return np.stack([a, b], 1).reshape(16, *a.shape[1:])

    rows, noted = (jax.tree.map(mixed, of(*one), of(*two)) for of in (rows_of, noted_of))
    found = recording.of_fleet(rows, 2, noted)
    for got, wanted in zip(found, [one[0], two[0], one[1], two[1]], strict=True):
        assert same(got, wanted)


def test_what_is_cut_off_is_not_terminal():
    episodes = [episode(0, 4, terminated=True), episode(10, 4, terminated=True)]
    first, second = recording.cut(episodes, 6)
    assert same(first, episodes[0]) and same(second, episode(10, 2))
    assert same(recording.cut(episodes, 8)[1], episodes[1])
    with pytest.raises(UserError, match="8 transitions were recorded, 9 are wanted"):
        recording.cut(episodes, 9)


@pytest.mark.parametrize("layout", ["d4rl", "minari"])
def test_what_is_written_is_read_again(layout, tmp_path):
    episodes = [episode(0, 3, terminated=True), episode(50, 2), episode(70, 4)]
    if layout == "d4rl":
        recording.write_d4rl(tmp_path / "a" / "set.hdf5", episodes, {"algorithm": "SAC"})
        log = logs.load(tmp_path / "a" / "set.hdf5", gamma=0.9)
    else:
        recording.write_minari(tmp_path / "set-v0", episodes, {"author": "me"})
        log = logs.load(tmp_path / "set-v0", gamma=0.9)
    wanted = rows_of(*episodes)
    for got, own in zip(log.rows, wanted, strict=True):
        np.testing.assert_allclose(got, own, rtol=1e-6)
    assert np.flatnonzero(log.last).tolist() == [2, 4, 8]
    assert (log.facts.episodes, log.facts.terminal, log.facts.return_max) == (3, 1, 4.0)
    assert not list(tmp_path.rglob("*.part"))


def test_joints_and_densities_lie_beside_what_was_observed(tmp_path):
    """A row for each step in D4RL's layout. Minari has one more for each episode; no action follows it."""
    episodes = [episode(0, 3, terminated=True), episode(50, 2)]
    recording.write_d4rl(tmp_path / "set.hdf5", episodes, {})
    recording.write_minari(tmp_path / "set-v0", episodes, {})
    with h5py.File(tmp_path / "set.hdf5") as file:
        infos = file["infos"]
        np.testing.assert_array_equal(infos["qpos"][:, 0], [0.5, 1.5, 2.5, 50.5, 51.5])
        assert infos["qvel"].shape == (5, 2) and infos["qvel"].dtype == np.float32
        np.testing.assert_allclose(infos["action_log_probs"], [0.0, 0.1, 0.2, 5.0, 5.1], rtol=1e-6)
    with h5py.File(tmp_path / "set-v0/data/main_data.hdf5") as file:
        infos = file["episode_1/infos"]
        np.testing.assert_array_equal(infos["qpos"][:, 0], [50.5, 51.5, 52.5])
        np.testing.assert_array_equal(infos["qvel"][:, 1], [-50, -51, -52])
        np.testing.assert_allclose(infos["action_log_probs"], [5.0, 5.1, np.nan], rtol=1e-6)
    bare = [own._replace(joints=None, log_prob=None) for own in episodes]
    recording.write_d4rl(tmp_path / "bare.hdf5", bare, {})
    with h5py.File(tmp_path / "bare.hdf5") as file:
        assert "infos" not in file


def test_a_table_is_read_again(tmp_path):
    """Of two episodes one falls after three steps, the other is cut off after two: five transitions, one terminal."""
    states = np.arange(28, dtype=np.float32).reshape(7, 4) / 64
    fallen = Recorded(states[:4], np.float32([[0.5], [-1.0], [1.0]]), np.zeros(3, np.float32), terminated=True)
    cut_off = Recorded(states[4:], np.float32([[0.25], [0.0]]), np.zeros(2, np.float32), terminated=False)
    recording.write_table(tmp_path / "new" / "log.txt", [fallen, cut_off], scale=3.0)
    entries = {"observation": (Entry("state", "", 4),), "action": (Entry("torque", "3 N m", 1),)}
    env = toy.make()._replace(table=True, reward=lambda obs, action, next_obs: obs[0], **entries)
    log = logs.load(tmp_path / "new" / "log.txt", gamma=0.9, env=env)
    np.testing.assert_array_equal(log.rows.obs, states[[0, 1, 2, 4, 5]])
    np.testing.assert_array_equal(log.rows.next_obs, states[[1, 2, 3, 5, 6]])
    np.testing.assert_allclose(log.rows.action[:, 0], [0.5, -1.0, 1.0, 0.25, 0.0])
    np.testing.assert_allclose(log.rows.discount, [0.9, 0.9, 0.0, 0.9, 0.9])
    assert log.last.tolist() == [False, False, True, False, True] and log.facts.dropped == 2


@pytest.mark.filterwarnings("ignore::UserWarning")  # its advice on authors and links
def test_minaris_own_library_opens_a_set(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari", reason="make setup EXTRAS=dev, or pip install 'sgft-jax[minari]'")
    recording.write_minari(tmp_path / "toy" / "point-v0", [episode(0, 3, terminated=True), episode(50, 2)], {})
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    found = list(minari.MinariDataset(tmp_path / "toy" / "point-v0" / "data").iterate_episodes())
    assert [len(own.rewards) for own in found] == [3, 2] and found[0].terminations.tolist() == [False, False, True]
    np.testing.assert_array_equal(found[1].observations[:, 0], [50, 51, 52])
    np.testing.assert_array_equal(found[1].infos["qpos"][:, 0], [50.5, 51.5, 52.5])


@pytest.mark.heavy
def test_sac_leaves_what_it_did_and_what_it_does(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(collect.LEVELS, "toy", -100.0)
    monkeypatch.setattr(logs, "BANDS", {"toy-medium-replay": {"transitions": logs.Band(300, 0.25)}})
    out = tmp_path / "data"
    play = collect_run._play

    def after_keeping(args, system, policy, params, seed):
        """What was learned from is on disk already: it is kept if recording fails."""
        assert (out / f"toy-medium-replay-regenerated-seed-{seed}.hdf5").exists()
        return play(args, system, policy, params, seed)

    monkeypatch.setattr(collect_run, "_play", after_keeping)
    collect.main([*LEARN, "--out", str(out)])
    said = capsys.readouterr().out
    for seed in (0, 1):
        medium = logs.load(out / f"toy-medium-regenerated-seed-{seed}.hdf5", gamma=0.99)
        assert medium.facts.transitions == 50 and medium.facts.episodes == 3
        again = logs.load(out / f"toy-medium-regenerated-seed-{seed}-v0", gamma=0.99)  # in Minari's layout
        np.testing.assert_array_equal(medium.rows.obs, again.rows.obs)
        old = logs.load(out / f"toy-medium-replay-regenerated-seed-{seed}.hdf5", gamma=0.99)
        fill = 3 * -(-256 // 3)  # a first batch, in whole steps of three environments
        assert old.facts.transitions == fill + 30 and f"seed-{seed}.hdf5: {fill + 30} transitions" in said
        assert old.facts.episodes == 3 * -(-(fill + 30) // 60)  # of 20 steps; three are cut off
        card = json.loads((out / f"toy-medium-replay-regenerated-seed-{seed}.json").read_text())
        assert card["sha256"] == old.facts.sha256 and card["provenance"]["versions"]
        assert card["acceptance"] == [
            {"criterion": "transitions", "value": fill + 30, "low": 225.0, "high": 375.0, "passed": True}
        ]
        assert not json.loads((out / f"toy-medium-regenerated-seed-{seed}.json").read_text())["acceptance"]
    assert said.count(f"  pass: transitions {fill + 30}, accepted from 225 to 375\n") == 2
    with h5py.File(out / "toy-medium-regenerated-seed-0.hdf5") as file:
        assert file["metadata/algorithm"][()] == b"SAC" and file["timeouts"][()].sum() == 3
    for kind in ("medium", "medium-replay"):
        with h5py.File(out / f"toy-{kind}-regenerated-seed-1.hdf5") as file:
            own = np.concatenate([file["infos/qpos"], file["infos/qvel"]], axis=1)
            assert (own == file["observations"][()]).all(1).mean() > 0.5  # the others were observed with noise
            found = file["infos/action_log_probs"][()]
            assert np.isfinite(found).all() and found.std() > 0.1


@pytest.mark.slow
def test_what_was_recorded_is_what_hybrid_learns_from(tmp_path):
    out = tmp_path / "data"
    collect.main([*LEARN, "--out", str(out)])
    data = out / "toy-medium-replay-regenerated-seed-0.hdf5"
    hybrid.main(
        f"""--task toy --method iql --data {data} --seeds 1 --no-video --schedule.updates 4 --schedule.chunk-updates 2
        --eval-every 2 --eval-episodes 2 --options.hidden 8 --options.rows 8 --out {tmp_path}""".split()
    )
    assert (tmp_path / "hybrid/toy/no-simulator/toy-medium-replay-regenerated-seed-0/iql/seed-0/policy").exists()
    policy = tmp_path / "hybrid/toy/no-simulator/toy-medium-replay-regenerated-seed-0/iql/seed-0/policy/seed-0"
    collect.main(["--task", "toy", "--transitions", "30", "--out", str(out), "--policy", str(policy)])
    (recorded,) = out.glob("toy-seed-0-seed-0.hdf5")
    assert logs.load(recorded, gamma=1.0).facts.transitions == 30
    with h5py.File(recorded) as file:
        assert {"qpos", "qvel", "action_log_probs"} == set(file["infos"])


@pytest.mark.heavy
def test_a_policy_is_recorded(tmp_path):
    save_prior(tmp_path / "prior/seed-0", 0)
    words = ["--task", "toy", "--transitions", "30", "--policy", str(tmp_path / "prior/seed-0")]
    collect.main([*words, "--out", str(tmp_path / "data")])
    (recorded,) = (tmp_path / "data").glob("*.hdf5")
    assert logs.load(recorded, gamma=1.0).facts.transitions == 30
    with h5py.File(recorded) as file:
        assert {"qpos", "qvel"} <= set(file["infos"])


@pytest.mark.slow
def test_what_was_learned_from_is_kept_if_recording_fails(tmp_path, monkeypatch):
    def fail(*args):
        raise UserError("no more")

    monkeypatch.setattr(collect_run, "_play", fail)
    with pytest.raises(SystemExit):
        collect.main([*LEARN, "--out", str(tmp_path)])
    assert logs.load(tmp_path / "toy-medium-replay-regenerated-seed-0.hdf5", gamma=0.99).facts.transitions > 256


@pytest.mark.parametrize(
    ("changes", "judged"),
    [
        ({}, True),
        ({"level": 4770.0}, True),
        ({"level": 1500.0}, False),
        ({"real": "gravity"}, False),
        ({"policy": Path("policy/seed-0")}, False),
    ],
)
def test_sets_made_in_another_way_are_not_judged(changes, judged):
    assert collect.is_d4rls(collect.CollectArgs(**changes)) == judged


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--task", "toy"], "--level: say at which mean return learning stops"),
        (["--task", "toy", "--policy", "nowhere"], "--policy nowhere: no such folder"),
        pytest.param(
            ["--task", "toy", "--level", "1e9", "--updates", "8", "--eval-every", "8"],
            "--level 1e+09: no seed reached it",
            marks=pytest.mark.slow,
        ),
        (["--task", "toy", "--level", "nan"], "--level nan: must be a finite number"),
        (["--task", "toy", "--level", "inf"], "--level inf: must be a finite number"),
        (
            ["--task", "toy", "--policy", ".", "--level", "5"],
            "--level 5: ends learning, and with --policy nothing learns",
        ),
        (
            ["--task", "wheel-legged", "--operator", "--level", "5"],
            "--level 5: ends learning, and with --operator nothing learns",
        ),
        (["--environments", "0"], "--environments is 0: must be at least 1"),
        (["--transitions", "0"], "--transitions is 0: must be at least 1"),
        (["--operator"], "--operator: halfcheetah has none, only wheel-legged, wheel-legged-forward"),
        (["--task", "wheel-legged", "--operator", "--policy", "."], "--operator and --policy exclude each other"),
    ],
)
def test_bad_input(words, said, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        collect.main([*words, "--out", str(tmp_path / "data")])
    error = capsys.readouterr().err
    (line,) = (line for line in error.splitlines() if not line.startswith("compiling"))  # which says how long it takes
    assert stopped.value.code == 2 and said in line
    assert not (tmp_path / "data").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("task", "reward"), [("wheel-legged", 29.0), ("wheel-legged-forward", 14.4)])
def test_the_log_of_an_operator_resembles_the_published_one(task, reward, tmp_path):
    """Spread within a factor of two of that of H2O+'s log, reward of a step within 1 % or 0.3."""
    args = collect.CollectArgs(task=task, real="robot", operator=True, transitions=6_000, out=tmp_path, impl="c")
    (facts,) = collect.collect(args)
    published = {"v": 0.197, "pitch": 0.0475, "pitch velocity": 0.534, "torque": 0.719}
    for name, value in published.items():
        assert value / 2 < facts["std"][name] < 2 * value, name
    assert next(iter(facts["reward"].values())) == pytest.approx(reward, abs=0.3)
    (log,) = tmp_path.glob(f"{task}-robot-operator-seed-0.txt")
    assert facts["transitions"] == 6_000 and json.loads(log.with_suffix(".json").read_text())["std"] == facts["std"]


def test_files_are_named_after_the_real_system(tmp_path):
    args = collect.CollectArgs(task="push", out=tmp_path, policy=Path("shipped:push/seed-0"))
    assert [path.name for path in collect.targets(args)] == ["push-priors-seed-0.hdf5"]
    args = dataclasses.replace(args, real="sets/hard.toml:deep")
    assert [path.name for path in collect.targets(args)] == ["push-deep-priors-seed-0.hdf5"]
    names = [path.name for path in collect.targets(dataclasses.replace(args, policy=None))]
    assert names == [f"push-deep-{kind}-regenerated-seed-0.hdf5" for kind in collect.PAIR]


def test_files_are_not_replaced(tmp_path, capsys):
    (tmp_path / "toy-medium-regenerated-seed-0.hdf5").touch()
    with pytest.raises(SystemExit):
        collect.main([*LEARN, "--out", str(tmp_path)])
    assert "exists already; --overwrite replaces it" in capsys.readouterr().err
