"""Recorded sets: every row of small files that are written here, both conventions, and files that are not whole."""

import dataclasses
import hashlib
import json
import os

import h5py
import jax
import numpy as np
import pytest
import toy

from envs.base import Entry
from envs.types import Transition, UserError
from experiments.runner.recorded import read_log
from sgft_jax.data import replay, sequences, sources
from sgft_jax.datasets import layouts, logs
from sgft_jax.datasets.logs import Facts
from sgft_jax.files import arrays
from sgft_jax.types import SimulatedData

# Row by row: an episode that ends by falling, one that the time limit ends, one that falls at its time limit, and one
# that the end of the file cuts off.
TERMINAL = np.array([0, 1, 0, 0, 0, 1, 0], bool)
TIMEOUT = np.array([0, 0, 0, 1, 0, 1, 0], bool)
REWARD = np.array([1, 2, 3, 4, 5, 6, 7], np.float32)
N = len(REWARD)


def numbers(offset, width=2):
    """[N, width] numbers that cannot be mistaken for others."""
    return (offset + np.arange(N)[:, None] + 0.1 * np.arange(width)).astype(np.float32)


def d4rl(**changes):
    """The arrays of a D4RL file; None leaves one out."""
    arrays = {
        "observations": numbers(0),
        "actions": np.linspace(-0.9, 0.9, N)[:, None],
        "next_observations": numbers(100),
        "rewards": REWARD,
        "terminals": TERMINAL,
        "timeouts": TIMEOUT,
        "metadata/algorithm": np.bytes_("SAC"),
    }
    return {name: array for name, array in {**arrays, **changes}.items() if array is not None}


@pytest.fixture
def write(tmp_path):
    def write(arrays, name="some.hdf5"):
        with h5py.File(tmp_path / name, "w") as file:
            for key, array in arrays.items():
                file[key] = array
        return tmp_path / name

    return write


# --- D4RL -----------------------------------------------------------------------------------------------------------


def test_stored_successors_keep_every_row(write):
    rows, facts, _ = logs.load(write(d4rl()), gamma=0.9)
    np.testing.assert_array_equal(rows.obs, numbers(0))
    np.testing.assert_array_equal(rows.next_obs, numbers(100))
    np.testing.assert_array_equal(rows.reward, REWARD)
    np.testing.assert_array_equal(rows.action, np.float32(np.linspace(-0.9, 0.9, N)[:, None]))
    # row 3 ends by the time limit alone: what could still be had counts
    np.testing.assert_array_equal(rows.discount, np.float32([0.9, 0, 0.9, 0.9, 0.9, 0, 0.9]))
    assert all(x.dtype == np.float32 for x in rows)
    assert (facts.layout, facts.successors, facts.dropped) == ("d4rl", "stored", 0)


def test_shifted_successors_drop_time_limits_and_the_last_row(write):
    """Row 5 is both terminal and a time limit: D4RL's own reader drops it."""
    rows, facts, _ = logs.load(write(d4rl(next_observations=None)), gamma=0.9, successors="shifted")
    np.testing.assert_array_equal(rows.reward, [1, 2, 3, 5])
    np.testing.assert_array_equal(rows.obs[:, 0], [0, 1, 2, 4])
    np.testing.assert_array_equal(rows.next_obs[:, 0], [1, 2, 3, 5])
    np.testing.assert_array_equal(rows.discount, np.float32([0.9, 0, 0.9, 0.9]))
    assert (facts.successors, facts.dropped, facts.terminal) == ("shifted", 3, 1)


def test_facts_by_hand(write):
    path = write(d4rl())
    facts = logs.load(path, gamma=0.99).facts
    # whole episodes: 1 + 2, 3 + 4, 5 + 6; the 7 belongs to one that is cut off
    assert (facts.transitions, facts.episodes, facts.whole_episodes, facts.terminal) == (7, 4, 3, 2)
    assert (facts.return_mean, facts.return_min, facts.return_max) == (7.0, 3.0, 11.0)
    assert facts.return_std == pytest.approx(np.sqrt(32 / 3))  # (16 + 0 + 16) / 3
    assert facts.size == path.stat().st_size and facts.path == str(path)
    assert facts.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    json.dumps(dataclasses.asdict(facts))


def test_the_checksum_tells_files_apart(write):
    one, other = (logs.load(write(d4rl(rewards=REWARD + i)), gamma=0.9).facts.sha256 for i in range(2))
    assert one != other


def test_without_a_whole_episode_the_rest_counts(write):
    facts = logs.load(write(d4rl(terminals=np.zeros(N, bool), timeouts=np.zeros(N, bool))), gamma=0.9).facts
    assert (facts.episodes, facts.whole_episodes, facts.return_mean, facts.return_std) == (1, 0, 28.0, 0.0)


def test_actions_are_clipped_and_counted(write):
    action = np.zeros((N, 2))
    action[1], action[4] = [1.5, 0.2], [0.1, -3.0]
    rows, facts, _ = logs.load(write(d4rl(actions=action)), gamma=0.9)
    np.testing.assert_array_equal(rows.action[[1, 4]], np.float32([[1, 0.2], [0.1, -1]]))
    assert facts.clipped == 2


def test_a_log_can_be_sampled(write, key):
    rows = logs.load(write(d4rl()), gamma=0.9).rows
    state = replay.full(rows)
    assert state.size == N and state.position == 0
    batch = jax.jit(replay.sample, static_argnums=2)(state, key, 500)
    assert set(np.asarray(batch.reward).tolist()) == set(REWARD.tolist())
    np.testing.assert_array_equal(batch.next_obs[:, 0], 99 + batch.reward)
    simulated = SimulatedData(lambda key, n: jax.tree.map(lambda x: x[:n], rows), REWARD)
    mixed = sources.mixture(4, 3).sample((state, simulated), key)
    assert mixed.is_sim.tolist() == [False] * 4 + [True] * 3


@pytest.mark.heavy
def test_windows_of_a_log_do_not_cross_episodes(write, key):
    """Nor gaps where rows were dropped: 3 after 2 of the shifted rows, and 5 after 4, are not there."""
    for successors, last in (("stored", [0, 1, 0, 1, 0, 1, 1]), ("shifted", [0, 1, 1, 1])):
        log = logs.load(write(d4rl()), gamma=0.9, successors=successors)
        assert log.last.tolist() == [bool(x) for x in last]
        batch = sequences.sample(sequences.full(log.rows, log.last), key, 200, 2)
        assert batch.valid[:, 0].all() and set(batch.reward[:, 0].tolist()) == set(log.rows.reward.tolist())
        for (first, second), follows in zip(batch.reward.tolist(), batch.valid[:, 1].tolist(), strict=True):
            assert follows == (not last[log.rows.reward.tolist().index(first)])
            assert second == (first + 1 if follows else 0)


# --- files that are not what they should be ---------------------------------------------------------------------------


def refused(path, **options):
    """The one line that the user reads; it names the file."""
    with pytest.raises(UserError) as caught:
        logs.load(path, gamma=0.9, **options)
    said = str(caught.value)
    assert "\n" not in said and str(path) in said
    return said


def test_a_missing_or_foreign_file_is_refused(tmp_path, write):
    assert "no such file" in refused(tmp_path / "absent.hdf5")
    assert "cannot be read (file name too long)" in refused(tmp_path / ("x" * 300))
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert "cannot be read (too many levels of symbolic links)" in refused(tmp_path / "loop")
    with pytest.raises(UserError, match="is no name of a file"):
        logs.load("zero\0byte.hdf5", gamma=0.9)
    (tmp_path / "foreign.hdf5").write_text("<html>403 Forbidden</html>")
    assert "not an HDF5 file" in refused(tmp_path / "foreign.hdf5")
    assert "no 'observations' in /, only images" in refused(write({"images": np.zeros(3)}))
    assert "holds no data/main_data.hdf5" in refused(tmp_path)


@pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
def test_a_file_that_was_cut_off_is_refused(write, share):
    path = write(d4rl(observations=np.zeros((N, 5000))))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert "cut off" in refused(path) and "supply a whole file" in refused(path)


def test_damaged_chunks_are_refused(tmp_path):
    """The file opens, and its numbers do not."""
    path = tmp_path / "damaged.hdf5"
    with h5py.File(path, "w") as file:
        for name, array in d4rl().items():
            if array.shape:
                file.create_dataset(name, data=array, compression="gzip", fletcher32=True)
        where = file["rewards"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[where.byte_offset : where.byte_offset + where.size] = bytes(where.size)
    path.write_bytes(content)
    assert "damaged or cut off" in refused(path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"next_observations": None}, "set successors to 'shifted'"),
        ({"rewards": REWARD[:-1]}, "numbers of rows differ (actions 7, rewards 6, terminals 7"),
        ({"terminals": TERMINAL[:-1]}, "numbers of rows differ (actions 7, rewards 7, terminals 6, timeouts 7)"),
        ({"timeouts": TIMEOUT[:-1]}, "numbers of rows differ (actions 7, rewards 7, terminals 7, timeouts 6)"),
        ({"observations": numbers(0)[:-1]}, "numbers of rows differ (observations 6, rewards 7"),
        ({"next_observations": numbers(0)[:-1]}, "rewards 7, next_observations 6)"),
        ({"next_observations": numbers(0, width=3)}, "next observations are [7, 3], observations [7, 2]"),
        ({"observations": np.where(np.arange(N)[:, None] == 4, np.nan, numbers(0))}, "obs of row 4 is not finite"),
        ({"rewards": np.where(np.arange(N) == 2, np.inf, REWARD)}, "reward of row 2 is not finite"),
        ({"observations": np.zeros((N, 8, 8, 3))}, "not numbers [rows, entries]; supply another file"),
        ({"rewards": np.stack([REWARD, REWARD], axis=1)}, "not numbers [rows]"),
        ({"rewards": np.float32(1)}, "/rewards is float32 [], not numbers [rows]"),
        ({"rewards": h5py.Empty("f8")}, "/rewards is float64 nothing, not numbers [rows]"),
        ({"rewards": np.zeros(N, [("x", "f4")])}, "not numbers [rows]"),
        ({"rewards": REWARD * 1j}, "not numbers [rows]"),
        ({"observations": np.zeros((N, 0))}, "not numbers [rows, entries]"),
        ({"actions": np.full((N, 1), b"left")}, "not numbers [rows, entries]; supply another file"),
        ({"observations/state": numbers(0), "observations": None}, "/observations is a group"),
        ({name: array[:0] for name, array in d4rl().items() if array.shape}, "holds no transitions"),
    ],
)
def test_odd_arrays_are_refused(write, changes, said):
    assert said in refused(write(d4rl(**changes)))


@pytest.mark.parametrize("name", ["observations", "actions", "next_observations", "rewards"])
def test_numbers_are_finite_after_the_cast(write, name):
    """1e39 is a number in float64 and infinite in what is learned from."""
    large = d4rl()[name].astype(np.float64)
    large[3] = -1e39
    assert "of row 3 is too large for float32; leave the row out of the file" in refused(write(d4rl(**{name: large})))


@pytest.mark.parametrize("flag", [np.nan, -1, 0.5, 2, np.inf])
@pytest.mark.parametrize("name", ["terminals", "timeouts"])
def test_flags_are_0_or_1(write, name, flag):
    odd = d4rl()[name].astype(np.float64)
    odd[4] = flag
    assert f"{name} of row 4 is {flag:g}, not 0 or 1" in refused(write(d4rl(**{name: odd})))


@pytest.mark.parametrize("dtype", [bool, np.int8, np.uint64, np.float32])
def test_columns_may_have_any_type_and_an_axis_of_one(write, dtype):
    """As the data sets of OTDF have them."""
    column = {"rewards": REWARD, "terminals": TERMINAL.astype(dtype), "timeouts": TIMEOUT.astype(dtype)}
    rows, facts, _ = logs.load(write(d4rl(**{name: x[:, None] for name, x in column.items()})), gamma=0.9)
    jax.tree.map(np.testing.assert_array_equal, rows, logs.load(write(d4rl(), "same.hdf5"), gamma=0.9).rows)
    assert facts.terminal == 2 and not facts.assumed


# --- files without time limits ----------------------------------------------------------------------------------------

CHAINED = np.append(numbers(1)[:-1], numbers(50)[:1], axis=0)  # what follows is the row below, except after the last


def test_without_timeouts_an_episode_ends_where_the_row_below_begins_anew(write):
    """After row 3 the robot is elsewhere; rows 1 and 5 are terminal, the file ends with row 6."""
    follows = CHAINED.copy()
    follows[3] += 5
    log = logs.load(write(d4rl(timeouts=None, next_observations=follows)), gamma=0.9)
    assert log.last.tolist() == [False, True, False, True, False, True, True]
    assert (log.facts.episodes, log.facts.whole_episodes, log.facts.dropped) == (4, 3, 0)
    assert log.facts.assumed.startswith("has no 'timeouts': ") and log.facts.assumed.endswith("begins anew")
    # shifted: the row that time has ended has no successor, as D4RL's own reader has it, and so has the last
    shifted = logs.load(write(d4rl(timeouts=None, next_observations=follows)), gamma=0.9, successors="shifted")
    assert shifted.rows.reward.tolist() == [1, 2, 3, 5, 6] and shifted.facts.dropped == 2


def test_without_timeouts_and_successors_the_task_tells_how_long_an_episode_lasts(write):
    """Rows 1 and 5 are terminal; the third step after the first of them is the last of its episode."""
    sizes = {"observations": numbers(0, width=4), "actions": np.zeros((N, 2))}
    path = write(d4rl(timeouts=None, next_observations=None, **sizes))
    log = logs.load(path, gamma=0.9, successors="shifted", env=toy.make()._replace(episode_length=3))
    assert log.rows.reward.tolist() == [1, 2, 3, 4, 6]
    assert log.facts.assumed.endswith("or after the 3 steps of the task")
    alone = logs.load(path, gamma=0.9, successors="shifted")
    assert alone.rows.reward.tolist() == [1, 2, 3, 4, 5, 6] and alone.facts.assumed.endswith("a terminal row alone")


def test_a_command_says_what_was_assumed(write, capsys):
    sizes = {"observations": numbers(0, width=4), "next_observations": numbers(9, width=4), "actions": np.zeros((N, 2))}
    read_log(write(d4rl(timeouts=None, **sizes)), toy.make(), gamma=0.9)
    assert "some.hdf5: has no 'timeouts': an episode is taken to end" in capsys.readouterr().out


# --- files that read others, run code, or claim any size --------------------------------------------------------------


def with_rewards(tmp_path, make):
    """A file whose rewards are made by another hand."""
    with h5py.File(tmp_path / "odd.hdf5", "w") as file:
        for name, array in d4rl(rewards=None).items():
            file[name] = array
        make(file)
    return tmp_path / "odd.hdf5"


def test_numbers_that_lie_in_other_files_are_refused(tmp_path, write):
    """A log that somebody sends may not read what lies on this machine."""
    (tmp_path / "secret").write_bytes(bytes(8 * N))
    outside = [("secret", 0, 8 * N)]
    virtual = h5py.VirtualLayout((N,), "f8")
    virtual[:] = h5py.VirtualSource(write(d4rl()), "rewards", (N,))
    for make, words in (
        (lambda file: file.create_dataset("rewards", (N,), "f8", external=outside), "takes its numbers from other"),
        (lambda file: file.create_virtual_dataset("rewards", virtual), "takes its numbers from other files"),
        (lambda file: file.__setitem__("rewards", h5py.ExternalLink("some.hdf5", "/rewards")), "rewards is a link"),
        (lambda file: file.__setitem__("rewards", h5py.SoftLink("/next_observations")), "rewards is a link"),
    ):
        assert words in refused(with_rewards(tmp_path, make))
    (tmp_path / "walk-v0").mkdir()
    with h5py.File(tmp_path / "walk-v0/main_data.hdf5", "w") as file:
        file["episode_0"] = h5py.ExternalLink("../some.hdf5", "/")
    assert "episode_0 is a link" in refused(tmp_path / "walk-v0")


def packed(file, *filters):
    """Rewards that need these filters; none of them is there."""
    about = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    about.set_chunk((N,))
    for code in filters:
        about.set_filter(code, h5py.h5z.FLAG_OPTIONAL)
    h5py.h5d.create(file.id, b"rewards", h5py.h5t.IEEE_F64LE, h5py.h5s.create_simple((N,)), about)


@pytest.mark.parametrize("filters", [(32015,), (1, 1)])
def test_filters_from_outside_and_packed_packages_are_refused(tmp_path, filters):
    """HDF5 would load the code of the first from a folder of plug-ins; the second unpacks a million to one."""
    assert f"is packed by the filters {list(filters)}" in refused(with_rewards(tmp_path, lambda f: packed(f, *filters)))


@pytest.mark.parametrize(
    "options",
    [
        {"shape": (10**12,)},
        {"shape": (10**12,), "chunks": (1000,)},
        {"shape": (N,), "chunks": (2**28,), "maxshape": (None,)},
        {"data": np.zeros(10**7 + 1), "compression": "gzip", "chunks": (10**7 + 1,)},
    ],
)
def test_a_file_that_claims_more_than_it_can_hold_is_refused(tmp_path, options):
    assert "claim to hold" in refused(
        with_rewards(tmp_path, lambda f: f.create_dataset("rewards", dtype="f8", **options))
    )


def test_one_array_under_many_names_counts_each_time(write, monkeypatch):
    monkeypatch.setattr(arrays, "_FREE", 0)
    monkeypatch.setattr(arrays, "_RATIO", 1)
    with layouts.opened(write({"x": np.ones(1000)})) as content:
        content.array(None, "x", 1)
        with pytest.raises(UserError, match="claim to hold 16,000"):
            content.array(None, "x", 1)


def test_what_is_no_plain_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.hdf5")
    os.mkfifo(tmp_path / "pipe.csv")
    assert "is no plain file" in refused(tmp_path / "pipe.hdf5")
    with pytest.raises(UserError, match="is no plain file"):
        logs.load(tmp_path / "pipe.csv", gamma=0.9, env=robot())


def test_an_unknown_convention_is_refused(write):
    with pytest.raises(UserError, match="did you mean 'shifted'"):
        logs.load(write(d4rl()), gamma=0.9, successors="shift")


def test_a_fixed_set_needs_a_row():
    with pytest.raises(UserError, match="at least 1 transition"):
        replay.full(Transition(*map(np.zeros, ((0, 1), (0, 1), 0, 0, (0, 1)))))
    with pytest.raises(UserError, match="at least 1 transition"):
        sequences.full(Transition(*map(np.zeros, ((0, 1), (0, 1), 0, 0, (0, 1)))), np.zeros(0, bool))


# --- Minari ---------------------------------------------------------------------------------------------------------


def episode(number, steps, *, terminated):
    """The arrays of one episode, whose observations are 10 * number + step."""
    last = np.arange(steps) == steps - 1
    return {
        "observations": np.repeat(10.0 * number + np.arange(steps + 1)[:, None], 2, axis=1),
        "actions": np.full((steps, 1), 0.5),
        "rewards": np.ones(steps),
        "terminations": last & terminated,
        "truncations": last & (not terminated),
        "infos/qpos": np.zeros((steps + 1, 3)),
    }


@pytest.fixture
def minari(tmp_path):
    """Writes a data set of twelve episodes: 10 comes after 9, not after 1."""

    def write(change=lambda file: None, **card):
        data = tmp_path / "toy" / "walk-v0" / "data"
        data.mkdir(parents=True, exist_ok=True)
        with h5py.File(data / "main_data.hdf5", "w") as file:
            for number in range(12):
                group = file.create_group(f"episode_{number}")
                group.attrs["total_steps"] = 2
                for name, array in episode(number, 2, terminated=number % 2 == 1).items():
                    group[name] = array
            change(file)
        said = {"data_format": "hdf5", "total_episodes": 12, "total_steps": 24, **card}
        (data / "metadata.json").write_text(json.dumps(said))
        return data.parent

    return write


def test_minari_episodes_have_their_own_successors(minari):
    folder = minari()
    rows, facts, _ = logs.load(folder, gamma=0.9)
    first = np.array([10 * number + step for number in range(12) for step in range(2)])
    np.testing.assert_array_equal(rows.obs[:, 0], first)
    np.testing.assert_array_equal(rows.next_obs[:, 0], first + 1)
    # even episodes end by the time limit, odd ones for good
    np.testing.assert_array_equal(rows.discount, np.float32([0.9, 0.9, 0.9, 0.0] * 6))
    assert (facts.layout, facts.successors, facts.transitions, facts.episodes) == ("minari", "episode", 24, 12)
    assert (facts.return_mean, facts.return_std, facts.terminal, facts.whole_episodes) == (2.0, 0.0, 6, 12)
    for same in (folder / "data", folder / "data" / "main_data.hdf5"):
        assert logs.load(same, gamma=0.9).facts == facts


def test_odd_minari_sets_are_refused(minari):
    folder = minari(total_steps=30)
    with pytest.raises(UserError, match=r"holds total_steps 24, but metadata.json says 30; supply a whole data set"):
        logs.load(folder, gamma=0.9)

    def shorten(file):
        del file["episode_3/observations"]
        file["episode_3/observations"] = np.zeros((2, 2))

    with pytest.raises(UserError, match=r"/episode_3 has 2 observations for 2 of 2 rewards"):
        logs.load(minari(shorten), gamma=0.9)
    with pytest.raises(UserError, match="leave successors at 'stored'"):
        logs.load(minari(), gamma=0.9, successors="shifted")
    (folder / "data" / "main_data.hdf5").unlink()
    (folder / "data" / "metadata.json").write_text(json.dumps({"data_format": "arrow"}))
    with pytest.raises(UserError, match="data_format is arrow; make the data set with data_format='hdf5'"):
        logs.load(folder, gamma=0.9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"actions": np.zeros((2, 3))}, "/episode_3 has other sizes of observations or actions than /episode_0"),
        ({"terminations": np.full(2, np.nan)}, "/episode_3: terminations of row 0 is nan, not 0 or 1"),
        ({"truncations": np.array([0, 0.5])}, "truncations of row 1 is 0.5, not 0 or 1"),
        ({"truncations": np.zeros(3)}, "numbers of rows differ (actions 2, rewards 2, terminations 2, truncations 3)"),
        ({"rewards": np.array([0, 1e39])}, "reward of row 7 is too large for float32"),
        ({"rewards": None}, "there is no 'rewards' in /episode_3"),
        ({"total_steps": "two"}, "total_steps of /episode_3 is no whole number"),
        ({"total_steps": [2, 2]}, "total_steps of /episode_3 is no whole number"),
    ],
)
def test_odd_minari_episodes_are_refused(minari, changes, words):
    def change(file):
        for name, values in changes.items():
            if name == "total_steps":
                file["episode_3"].attrs[name] = values
            else:
                del file[f"episode_3/{name}"]
                if values is not None:
                    file[f"episode_3/{name}"] = values

    assert words in refused(minari(change))


@pytest.mark.parametrize("value", [0, None, "0.1", -1, [], float("nan")])
def test_the_length_of_a_step_is_a_positive_number(minari, value):
    assert "metadata.json: " in refused(minari(control_dt=value))


@pytest.mark.filterwarnings("ignore::UserWarning")  # its advice on authors and links
def test_what_minaris_own_library_writes_can_be_read(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari", reason="make setup EXTRAS=dev, or pip install 'sgft-jax[minari]'")
    import gymnasium

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    box = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    episodes = []
    for number in range(3):
        arrays = episode(number, 4, terminated=number == 1)
        arrays.pop("infos/qpos")
        episodes.append(minari.data_collector.EpisodeBuffer(id=number, infos={}, **arrays))
    minari.create_dataset_from_buffers(
        "toy/walk-v0",
        episodes,
        observation_space=box,
        action_space=gymnasium.spaces.Box(-1, 1, (1,), np.float64),
        data_format="hdf5",
    )
    rows, facts, _ = logs.load(tmp_path / "toy" / "walk-v0", gamma=0.9)
    np.testing.assert_array_equal(rows.obs[:, 0], [10 * number + step for number in range(3) for step in range(4)])
    np.testing.assert_array_equal(rows.next_obs, rows.obs + 1)
    assert (facts.episodes, facts.terminal) == (3, 1)


# --- tables of a wheel-legged robot -----------------------------------------------------------------------------------

# x, v, pitch, pitch velocity, torque, done. Row 2 is too strong, row 3 too, with the other sign; row 7 has fallen.
TABLE = np.array(
    [
        [0.0, 0.1, 0.2, 0.3, 1.5, 0],
        [1.0, 1.1, 1.2, 1.3, -3.0, 0],
        [2.0, 2.1, 2.2, 2.3, 3.1, 0],
        [3.0, 3.1, 3.2, 3.3, -3.1, 0],
        [4.0, 4.1, 4.2, 4.3, 0.0, 0],
        [5.0, 5.1, 5.2, 5.3, 0.3, 0],
        [6.0, 6.1, 6.2, 6.3, 0.6, 0],
        [7.0, 7.1, 7.2, 7.3, 9.0, 1],
        [8.0, 8.1, 8.2, 8.3, 0.0, 0],
        [9.0, 9.1, 9.2, 9.3, 0.0, 0],
    ]
)


def robot(reward=lambda obs, action, next_obs: obs[0], size=4):
    """A task that measures the last of the first four columns, and commands the fifth."""
    entries = {"observation": (Entry("state", "", size),), "action": (Entry("torque", "3 N m", 1),)}
    return toy.make()._replace(table=True, reward=reward, **entries)


@pytest.mark.parametrize(("ending", "delimiter"), [(".txt", " "), (".csv", ",")])
def test_tables_drop_strong_torques_of_both_signs_and_split_there(ending, delimiter, tmp_path):
    path = tmp_path / f"log{ending}"
    np.savetxt(path, TABLE, delimiter=delimiter)
    log = logs.load(path, gamma=0.9, env=robot(lambda obs, action, next_obs: next_obs[0] + action[0]))
    # row 1 has no successor that counts, row 7 is over, row 9 is the last
    np.testing.assert_allclose(log.rows.obs[:, 0], [0, 4, 5, 6, 8])
    np.testing.assert_allclose(log.rows.next_obs, log.rows.obs + 1, rtol=1e-6)
    np.testing.assert_allclose(log.rows.action[:, 0], [0.5, 0, 0.1, 0.2, 0], rtol=1e-6)
    np.testing.assert_allclose(log.rows.reward, [1.5, 5, 6.1, 7.2, 9], rtol=1e-6)
    np.testing.assert_allclose(log.rows.discount, [0.9, 0.9, 0.9, 0.0, 0.9])
    assert log.last.tolist() == [True, False, False, True, True]
    facts = log.facts
    assert (facts.layout, facts.transitions, facts.dropped, facts.terminal, facts.episodes) == ("table", 5, 5, 1, 3)


def test_a_table_may_begin_with_a_byte_order_mark(tmp_path):
    np.savetxt(tmp_path / "log.csv", TABLE, delimiter=",")
    (tmp_path / "log.csv").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "log.csv").read_bytes())
    log = logs.load(tmp_path / "log.csv", gamma=0.9, env=robot())
    assert log.facts.transitions == 5


def test_tables_without_position(tmp_path):
    np.savetxt(tmp_path / "log.txt", TABLE)
    log = logs.load(tmp_path / "log.txt", gamma=0.9, env=robot(size=3))
    np.testing.assert_allclose(log.rows.obs[0], [0.1, 0.2, 0.3], rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x v\n1 2\n", "is not a table of numbers .*; supply six columns without a head"),
        ("1 2 3\n4 5 6\n", "has 3 columns, not x, v, pitch, its velocity, torque and done"),
        ("0 0 0 0 9 0\n0 0 0 0 9 0\n", "holds no transitions"),
        ("0 0 0 nan 1 0\n0 0 0 0 1 0\n", "a number of row 0 is not finite"),
        ("0 0 0 0 1 0\n0 0 0 1e39 1 0\n", "a number of row 1 is too large for float32"),
        ("0 0 0 0 1 0\n0 0 0 0 1 0.5\n", "done of row 1 is 0.5, not 0 or 1"),
        ("0 0 0 0 1 0\n0 0 0 0 1\n", "is not a table of numbers"),
        ("0 0 0 0 1 \x00\n", "is not a table of numbers"),
        ("\n", "holds no transitions"),
    ],
)
def test_odd_tables_are_refused(text, words, tmp_path):
    (tmp_path / "log.txt").write_text(text)
    with pytest.raises(UserError, match=words):
        logs.load(tmp_path / "log.txt", gamma=0.9, env=robot())
    with pytest.raises(UserError, match="no such file"):
        logs.load(tmp_path / "none.txt", gamma=0.9, env=robot())


NONE = Facts("", "d4rl", 0, "", "stored", 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0)


def passed(name, *, mean_length=1000.0, **facts):
    """By criterion."""
    found = logs.judge(name, dataclasses.replace(NONE, **facts), mean_length=mean_length)
    return {verdict.criterion: verdict.passed for verdict in found}


@pytest.mark.parametrize(
    ("mean", "good"),
    [(4531.0, False), (4532.0, True), (5008.0, True), (5009.0, False)],  # 4770.3 less or more 5 %, 238.5
)
def test_the_mean_of_a_medium_set(mean, good):
    assert passed("halfcheetah-medium", return_mean=mean) == {"mean return": good}


def test_a_walker_is_judged_by_spread_and_falls_too():
    """Bands: 2,709 to 2,995; 821 to 1,369; 714 to 966 steps."""
    found = passed("walker2d-medium", return_mean=2900.0, return_std=800.0, mean_length=1000.0)
    assert found == {"mean return": True, "std of returns": False, logs.LENGTH: False}
    assert all(passed("walker2d-medium", return_mean=2852.0, return_std=1100.0, mean_length=840.0).values())


def test_what_a_learner_left_is_judged_by_its_size():
    assert passed("halfcheetah-medium-replay", transitions=151_000) == {"transitions": False}
    assert passed("walker2d-medium-replay", transitions=377_000) == {"transitions": True}
    (verdict,) = logs.judge("halfcheetah-medium-replay", dataclasses.replace(NONE, transitions=250_000), mean_length=0)
    assert str(verdict) == "pass: transitions 250,000, accepted from 151,500 to 252,500"


def test_other_sets_are_not_judged():
    assert passed("halfcheetah-") == {} and passed("hopper-medium") == {}
