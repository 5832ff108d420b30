"""Data sets in LeRobot's layout: every column of small sets, those of others, and what is not whole."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import toy

from envs.observations import with_previous_actions
from envs.rewards import sparse
from envs.types import UserError
from sgft_jax.datasets import lerobot, logs
from sgft_jax.datasets.recording import Recorded
from sgft_jax.files import arrays

pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'sgft-jax[lerobot]'")
pq = pytest.importorskip("pyarrow.parquet")

ENV = toy.make()
CHECK = """
import sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
found = LeRobotDataset("someone/toy", root=sys.argv[1], delta_timestamps={"action": [-0.1, 0.0, 0.1]})
assert (found.num_episodes, found.num_frames, found.fps) == (2, 5, 10), found
first, last = found[0], found[4]
assert first["task"] == "toy" and first["action"].shape == (3, 2) and last["observation.state"].tolist() == [51.0] * 4
assert first["action_is_pad"].tolist() == [True, False, False] and last["next.observation.state"].tolist() == [52.0] * 4
assert [bool(found[i]["next.done"]) for i in range(5)] == [False, False, True, False, True]
assert found.meta.names["observation.state"] == ["xy.0", "xy.1", "velocity.0", "velocity.1"]
assert found.meta.stats["next.reward"]["mean"].tolist() == [1.0]
only = LeRobotDataset("someone/toy", root=sys.argv[1], episodes=[1])
assert len(only) == 2 and only[0]["action"].tolist() == [0.5, 0.5]
"""


def episode(first, steps, *, terminated=False, success=False):
    """Observations that count up from `first`; actions are a hundredth of them."""
    obs = np.repeat((first + np.arange(steps + 1.0))[:, None], 4, axis=1).astype(np.float32)
    return Recorded(obs, obs[:-1, :2] / 100, np.ones(steps, np.float32), terminated, success=success)


EPISODES = [episode(0, 3, terminated=True, success=True), episode(50, 2)]


def write(folder, episodes=EPISODES):
    lerobot.write(folder, episodes, ENV)
    return folder


def changed(folder, drop=(), **columns):
    """The set without some columns, or with others in their place, as others might have written it."""
    path, info = folder / "data/chunk-000/file-000.parquet", json.loads((folder / "meta/info.json").read_text())
    table = pq.read_table(path)
    for name, values in columns.items():
        name = name.replace("__", ".")
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    pq.write_table(table.drop_columns(list(drop)), path)
    info["features"] = {name: about for name, about in info["features"].items() if name not in drop}
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


NEEDED = ("action", "observation.state", "frame_index", "episode_index")


def refused(folder, **options):
    with pytest.raises(UserError) as caught:
        logs.load(folder, gamma=0.9, **options)
    said = str(caught.value)
    assert "\n" not in said and str(folder) in said
    return said


# --- what is written --------------------------------------------------------------------------------------------------


def test_every_step_is_a_frame(tmp_path):
    table = pq.read_table(write(tmp_path / "set") / "data/chunk-000/file-000.parquet")
    columns = table.to_pydict()
    assert columns["observation.state"][3] == [50.0] * 4 and columns["next.observation.state"][2] == [3.0] * 4
    np.testing.assert_allclose(columns["action"][4], [0.51, 0.51])
    assert columns["next.done"] == [False, False, True, False, True]
    assert columns["next.truncated"] == [False, False, False, False, True]
    assert columns["next.success"] == [False, False, True, False, False]
    np.testing.assert_allclose(columns["timestamp"], [0, 0.1, 0.2, 0, 0.1], rtol=1e-6)
    assert columns["frame_index"] == [0, 1, 2, 0, 1] and columns["episode_index"] == [0, 0, 0, 1, 1]
    assert columns["index"] == [0, 1, 2, 3, 4] and columns["task_index"] == [0] * 5
    assert table.schema.field("observation.state").type == pa.list_(pa.float32(), 4)
    assert pq.ParquetFile(tmp_path / "set/data/chunk-000/file-000.parquet").num_row_groups == 2


def test_names_units_and_counts_lie_beside_them(tmp_path):
    folder = write(tmp_path / "set")
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"], info["total_frames"]) == ("v3.0", 10, 2, 5)
    state, action = info["features"]["observation.state"], info["features"]["action"]
    assert state["names"] == ["xy.0", "xy.1", "velocity.0", "velocity.1"] and state["shape"] == [4]
    assert state["info"]["units"] == ["m", "m", "m/s", "m/s"] and action["info"]["units"] == ["4 N", "4 N"]
    (first, second) = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert (second["length"], second["dataset_from_index"], second["dataset_to_index"]) == (2, 3, 5)
    assert first["tasks"] == ["toy"] and first["stats/observation.state/max"] == [2.0] * 4
    stats = json.loads((folder / "meta/stats.json").read_text())["observation.state"]
    assert stats["count"] == [5] and stats["q50"] == [2.0] * 4 and stats["mean"] == pytest.approx([20.8] * 4)
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    assert tasks.to_pylist() == [{"task_index": 0, "task": "toy"}]


@pytest.mark.slow
def test_lerobots_own_loader_opens_it(tmp_path):
    """In an environment of its own: LeRobot needs other versions than we do, and PyTorch."""
    python = os.environ.get("SGFT_LEROBOT_PYTHON")
    if python is None:
        pytest.skip("name the Python of an environment with lerobot[dataset] in SGFT_LEROBOT_PYTHON")
    folder = write(tmp_path / "set")
    alone = {"PATH": os.environ["PATH"], "HF_HOME": str(tmp_path / "hub"), "HF_HUB_OFFLINE": "1"}
    subprocess.run([python, "-c", CHECK, str(folder)], check=True, env=alone, timeout=300)


# --- what is read -----------------------------------------------------------------------------------------------------


def test_what_is_written_is_read_again(tmp_path):
    rows, facts, last = logs.load(write(tmp_path / "set"), gamma=0.9, env=ENV)
    np.testing.assert_array_equal(rows.obs[:, 0], [0, 1, 2, 50, 51])
    np.testing.assert_array_equal(rows.next_obs, rows.obs + 1)
    np.testing.assert_allclose(rows.action, rows.obs[:, :2] / 100)
    np.testing.assert_array_equal(rows.discount, np.float32([0.9, 0.9, 0.0, 0.9, 0.9]))
    assert last.tolist() == [False, False, True, False, True]
    assert (facts.layout, facts.successors, facts.dropped, facts.episodes) == ("lerobot", "stored", 0, 2)
    assert (facts.return_max, facts.return_min, facts.terminal) == (3.0, 2.0, 1) and len(facts.sha256) == 64


def test_frames_of_others_lack_the_last_successor(tmp_path):
    """The frame below is the successor, so the last of an episode has none: [50, 51] is no step from [2, 3]."""
    folder = changed(write(tmp_path / "set"), drop=["next.observation.state"])
    rows, facts, last = logs.load(folder, gamma=0.9)
    np.testing.assert_array_equal(rows.obs[:, 0], [0, 1, 50])
    np.testing.assert_array_equal(rows.next_obs[:, 0], [1, 2, 51])
    assert (facts.successors, facts.dropped) == ("shifted", 2) and last.tolist() == [False, True, True]


def test_the_task_tells_rewards_and_ends_that_others_do_not(tmp_path):
    folder = changed(write(tmp_path / "set"), drop=["next.reward", "next.truncated"])
    log = logs.load(folder, gamma=0.9, env=ENV._replace(terminated=lambda obs, action, next_obs: next_obs[0] > 51.5))
    np.testing.assert_allclose(log.rows.reward, -np.sqrt(2) * np.array([1, 2, 3, 51, 52]), rtol=1e-6)  # of xy alone
    np.testing.assert_array_equal(log.rows.discount, np.float32([0.9, 0.9, 0.9, 0.9, 0.0]))
    assert "tells no rewards, and neither does a task" in refused(folder)


def test_a_task_that_pays_success_alone_pays_recorded_steps_so(tmp_path):
    close = ENV._replace(success=lambda obs: obs[0] > 2.5)
    log = logs.load(write(tmp_path / "set"), gamma=0.9, env=sparse(close))
    assert log.rows.reward.tolist() == [0, 0, 1, 1, 1] and log.facts.return_max == 2.0


def test_done_alone_is_no_termination(tmp_path):
    folder = changed(write(tmp_path / "set"), drop=["next.truncated"])
    assert logs.load(folder, gamma=0.9).facts.terminal == 0


def test_last_actions_are_added_for_a_policy_that_sees_them(tmp_path):
    """The newest first, and zero before the first step of each episode."""
    log = logs.load(write(tmp_path / "set"), gamma=0.9, env=with_previous_actions(ENV, 2))
    assert log.rows.obs.shape == (5, 8)
    np.testing.assert_allclose(log.rows.obs[:, 4::2], [[0, 0], [0, 0], [0.01, 0], [0, 0], [0.5, 0]], atol=1e-7)
    np.testing.assert_allclose(log.rows.next_obs[:, 4::2], [[0, 0], [0.01, 0], [0.02, 0.01], [0.5, 0], [0.51, 0.5]])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"codebase_version": "v2.1"}, "is LeRobot v2.1; convert it to v3.0"),
        ({"total_frames": 6}, "holds total_frames 5, but meta/info.json says 6"),
        ({"total_episodes": 3}, "holds total_episodes 2, but meta/info.json says 3"),
        ({"features": {"action": {}}}, "has no observation.state, only action"),
        ({"fps": "fast"}, "info.json: fps is a text, not a number; supply a whole data set"),
        ({"features": []}, "info.json: features is a list, not an object; supply a whole data set"),
        ({"features": {"action": {}, "observation.state": {}}}, "has no frame_index; supply a whole data set"),
        ({"features": dict.fromkeys(NEEDED, "vector")}, "info.json: observation.state: is no JSON object"),
        ({"fps": 0}, "info.json: fps: expected float > 0"),
        ({"fps": True}, "info.json: fps is true or false, not a number"),
        ({"codebase_version": 3}, "info.json: codebase_version is a whole number, not a text"),
        ({"total_frames": -1}, "info.json: total_frames: expected int >= 0"),
        ({"data_path": "../../other/{chunk_index}.parquet"}, "is not in data/"),
        ({"data_path": "data/../../{chunk_index}.parquet"}, "is not in data/"),
        ({"features": {key: {"shape": []} for key in NEEDED}}, "is no column of numbers []; only vectors are read"),
        ({"features": {key: {"shape": [4, 1]} for key in NEEDED}}, "is no column of numbers [4, 1]"),
        ({"features": {key: {"shape": [0]} for key in NEEDED}}, "shape[0]: expected int >= 1"),
        ({"features": {key: {"shape": [7]} for key in NEEDED}}, "is no column of numbers [7]"),
        ({"fps": 30}, "has 30 steps a second, toy has 10; resample it"),
    ],
)
def test_odd_sets_are_refused(change, said, tmp_path):
    folder = write(tmp_path / "set")
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps(info | change))
    assert said in refused(folder, env=ENV)


def test_hidden_files_are_no_part_of_a_set(tmp_path):
    """What macOS and download tools leave beside files: neither read nor in the digest."""
    folder = write(tmp_path / "set")
    facts = logs.load(folder, gamma=0.9).facts
    (folder / ".DS_Store").write_text("x")
    (folder / "data/chunk-000/._file-000.parquet").write_bytes(b"\0\5\26\7")
    (folder / ".cache/data/chunk-000").mkdir(parents=True)
    (folder / ".cache/data/chunk-000/file-000.parquet").write_text("x")
    assert logs.load(folder, gamma=0.9).facts == facts


def test_folders_that_lie_elsewhere_are_neither_read_nor_in_the_digest(tmp_path):
    """Links to files are followed: download tools keep their files so."""
    folder, other = write(tmp_path / "set"), tmp_path / "other"
    facts = logs.load(folder, gamma=0.9).facts
    (folder / "data/chunk-000/file-000.parquet").rename(tmp_path / "blob")
    (folder / "data/chunk-000/file-000.parquet").symlink_to(tmp_path / "blob")
    assert logs.load(folder, gamma=0.9).facts == facts
    (folder / "data/chunk-000").rename(other)
    (folder / "data/chunk-000").symlink_to(other)
    assert "holds no data/*/*.parquet" in refused(folder)


def test_files_may_differ_in_the_types_of_their_columns(tmp_path):
    """Lists of any or of one length, numbers as float64 or float32, flags as any numbers, in files of one set."""
    one, two = (write(tmp_path / name) for name in ("one", "two"))
    rows = logs.load(one, gamma=0.9).rows
    path = two / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.slice(0, 3), path)
    for name, kind in (("action", pa.list_(pa.float64())), ("observation.state", pa.large_list(pa.float32()))):
        values = pa.array(table[name].to_pylist(), kind)
        table = table.set_column(table.column_names.index(name), name, values)
    for name in ("next.done", "next.truncated"):
        values = table[name].to_numpy().astype(np.float32)
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    pq.write_table(table.slice(3), path.with_name("file-001.parquet"))
    for x, y in zip(logs.load(two, gamma=0.9).rows, rows, strict=True):
        np.testing.assert_array_equal(x, y)


def test_info_may_begin_with_a_byte_order_mark(tmp_path):
    folder = write(tmp_path / "set")
    (folder / "meta/info.json").write_bytes(b"\xef\xbb\xbf" + (folder / "meta/info.json").read_bytes())
    assert logs.load(folder, gamma=0.9).facts.transitions == 5


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"next__done": [0.0, 0.0, float("nan"), 0.0, 1.0]}, "next.done of row 2 is nan, not 0 or 1"),
        ({"next__truncated": [0, 0, 0, 0, 2]}, "next.truncated of row 4 is 2, not 0 or 1"),
        ({"next__done": [False, None, True, False, True]}, "next.done is no column of numbers [1]"),
        ({"next__reward": [0.0, 1e39, 0.0, 0.0, 0.0]}, "reward of row 1 is too large for float32"),
        ({"action": [[0.0, 1e39]] * 5}, "action of row 0 is too large for float32"),
        ({"next__reward": ["a"] * 5}, "next.reward is no column of numbers [1]"),
        ({"next__reward": [{"a": 1.0}] * 5}, "next.reward is no column of numbers [1]"),
        ({"observation__state": [[[0.0] * 2] * 2] * 5}, "observation.state is no column of numbers [4]"),
        ({"observation__state": [[0.0] * 3] + [[0.0] * 5] + [[0.0] * 4] * 3}, "observation.state is no column of"),
        ({"observation__state": [None] + [[0.0] * 8] + [[0.0] * 4] * 3}, "observation.state is no column of numbers"),
        ({"episode_index": [0, 0, 0, 2, 2]}, "row 3 is of episode 2 where 1 is due"),
        ({"episode_index": [1, 1, 1, 0, 0]}, "row 0 is of episode 1 where 0 is due"),
        ({"episode_index": [0.0, 0.0, 0.0, 1.0, 1.0]}, "episode_index holds float64, not whole numbers"),
        ({"frame_index": [0, 1, None, 0, 1]}, "frame_index is no column of numbers [1]"),
    ],
)
def test_odd_columns_are_refused(columns, words, tmp_path):
    assert words in refused(changed(write(tmp_path / "set"), **columns))


@pytest.mark.parametrize("drop", ["next.reward", "action", "episode_index"])
def test_a_column_that_info_names_and_no_file_has(drop, tmp_path):
    folder = write(tmp_path / "set")
    info = (folder / "meta/info.json").read_text()
    (changed(folder, drop=[drop]) / "meta/info.json").write_text(info)
    assert drop in refused(folder)


def test_a_file_that_claims_more_than_it_can_hold_is_refused(tmp_path, monkeypatch):
    folder = write(tmp_path / "set")
    path = folder / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    pq.write_table(pa.table({name: pa.chunked_array([table[name].chunk(0)] * 9) for name in table.column_names}), path)
    monkeypatch.setattr(arrays, "_FREE", 0)
    monkeypatch.setattr(arrays, "_RATIO", 0.01)
    monkeypatch.setattr(lerobot, "_numbers", None)  # nothing is unpacked
    assert "claim to hold" in refused(folder)


def test_damaged_and_missing_frames_are_refused(tmp_path):
    folder = changed(write(tmp_path / "set"), frame_index=[0, 1, 2, 1, 2])
    assert "episode 1 has frame 1 where 0 is due" in refused(folder)
    folder = changed(write(tmp_path / "other"), observation__state=[[0.0] * 4] * 4 + [[0.0] * 3])
    assert "observation.state is no column of numbers" in refused(folder)
    path = tmp_path / "set/data/chunk-000/file-000.parquet"
    path.write_bytes(path.read_bytes()[:-40])
    assert "damaged or cut off" in refused(tmp_path / "set")
    path.unlink()
    assert "holds no data/*/*.parquet" in refused(tmp_path / "set")


def test_actions_in_other_units_are_refused(tmp_path):
    """Degrees, say: clipped they would all be the same."""
    folder = write(tmp_path / "set", [own._replace(action=own.action * 100 + 2) for own in EPISODES])
    assert "most actions lie beyond [-1, 1]; scale them to what toy commands" in refused(folder, env=ENV)
    assert logs.load(folder, gamma=0.9).facts.clipped == 5


def test_without_pyarrow(tmp_path, monkeypatch):
    folder = write(tmp_path / "set")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert "needs pyarrow; pip install 'sgft-jax[lerobot]'" in refused(folder)
