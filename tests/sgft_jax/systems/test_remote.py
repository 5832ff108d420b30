"""A robot behind a socket: nothing moves twice, nothing is lost, whoever dies or talks nonsense."""

import ast
import contextlib
import random
import socket
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import msgpack
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from envs.types import UserError
from sgft_jax.systems import robot_client
from sgft_jax.systems.door import STRANGERS
from sgft_jax.systems.messages import Hello, read
from sgft_jax.systems.remote import Remote, _Link
from sgft_jax.systems.robot_client import Limits, RefusedError, array, pack, play, unpack


class Point:
    """A point that moves by its action; counts how often it was moved."""

    obs_size, action_size = 2, 2

    def __init__(self):
        self.at, self.moves, self.resets, self.stops = np.zeros(2), [], [], 0

    def reset(self, seed):
        self.resets.append(seed)
        self.at = np.zeros(2)
        return self.at

    def step(self, action):
        self.moves.append(action.copy())
        self.at = self.at + action
        return self.at, float(self.at[0]), bool(self.at[0] > 2.5), False, {"success": self.at[0] > 2.5}

    def stop(self):
        self.stops += 1


class Arm(Point):
    """The same by the clock: it moves by its last command in every period."""

    def reset(self, seed):
        self.command = np.zeros(2)
        return super().reset(seed)

    def read(self):
        self.at = self.at + self.command
        return self.at

    def send(self, action):
        self.moves.append(action.copy())
        self.command = action


class Pair:
    """A learner and a robot that connects from a thread."""

    def __init__(self, driver, **options):
        self.said, self.driver = [], driver
        self.remote = Remote(
            2, 2, steps=options.pop("steps", None), again=options.pop("again", 5.0), say=self.said.append
        )
        self.counts, self.options = None, options
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self):
        with contextlib.suppress(RefusedError, SystemExit):
            self.counts = play(
                self.driver, self.remote.url, token=self.remote.token, retry=0.01, say=self.said.append, **self.options
            )


@pytest.fixture
def pair():
    pairs = []

    def make(driver, **options):
        pairs.append(Pair(driver, **options))
        return pairs[-1]

    yield make
    for own in pairs:
        own.remote.close()
        own.thread.join(timeout=10)


RIGHT = np.array([1.0, 0.0], np.float32)


class Moved(NamedTuple):
    obs: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    info: dict


def begin(own, seed):
    return own.remote.reset(seed=seed)[0]


def move(own, action):
    return Moved(*own.remote.step(action))


def test_episodes_and_their_end(pair):
    own = pair(Point())
    np.testing.assert_array_equal(begin(own, 7), [0, 0])
    moved = [move(own, RIGHT) for _ in range(3)]
    assert [x.obs[0] for x in moved] == [1, 2, 3] and [x.reward for x in moved] == [1, 2, 3]
    assert [x.terminated for x in moved] == [False, False, True] and moved[-1].info["is_success"] is True
    assert not any("invalid" in x.info or x.info["late"] for x in moved)
    np.testing.assert_array_equal(begin(own, 8), [0, 0])
    assert own.driver.resets == [7, 8] and len(own.driver.moves) == 3
    own.remote.close()
    own.thread.join(timeout=10)
    assert own.counts == {"steps": 3, "late": 0} and own.driver.stops >= 2


def test_commands_are_kept_within_limits_and_what_was_sent_is_said(pair):
    own = pair(Point(), limits=Limits(low=-0.5, high=0.5, change=0.4))
    begin(own, 0)
    sent = [move(own, RIGHT).info["sent"][0] for _ in range(3)]
    np.testing.assert_allclose(sent, [0.4, 0.5, 0.5])
    np.testing.assert_allclose([x[0] for x in own.driver.moves], sent)


def test_an_episode_ends_where_the_workspace_does(pair):
    own = pair(Point(), limits=Limits(workspace=([-np.inf, -1.0], [1.5, 1.0])))
    begin(own, 0)
    moved = [move(own, RIGHT) for _ in range(2)]
    assert [x.truncated for x in moved] == [False, True] and [x.obs[0] for x in moved] == [1, 2]
    assert own.driver.stops >= 2 and "invalid" not in moved[-1].info
    assert any("measured number 0 is 2, beyond the workspace; the robot is stopped" in line for line in own.said)


def test_no_episode_begins_beyond_the_workspace(pair):
    driver = Point()
    starts = iter([np.array([0.0, 3.0]), np.zeros(2)])
    driver.reset = lambda seed: next(starts)
    own = pair(driver, limits=Limits(workspace=([-1.0, -1.0], [1.0, 1.0])), again=0.05)
    np.testing.assert_array_equal(begin(own, 0), [0, 0])
    assert any("measured number 1 is 3, beyond the workspace" in line for line in own.said)


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("driver", [Point, Arm])
def test_lost_doubled_and_damaged_messages_move_nothing_twice(pair, driver, monkeypatch):
    """Every fourth message is lost, some come twice, some are damaged, in both directions."""
    rng, real = random.Random(0), pack

    def spoil(socket):
        send = socket.send

        def worse(data):
            luck = rng.random()
            if luck < 0.25 and not isinstance(read(data), Hello):
                return
            if luck > 0.9:
                send(data[:-1] + bytes([data[-1] ^ 255]))
            for _ in range(1 + (luck > 0.8)):
                send(data)

        socket.send = worse
        return socket

    monkeypatch.setattr(robot_client, "connect", lambda *a, **k: spoil(connect(*a, **k)))
    options = {"period": 0.01, "answer_within": 0.009, "patience": 10**6} if driver is Arm else {}
    own = pair(driver(), again=0.02, **options)
    assert real is pack
    send = _Link.send
    monkeypatch.setattr(_Link, "send", lambda link, message: rng.random() < 0.25 or send(link, message))
    seen = []
    for episode in range(3):
        at = begin(own, episode)
        for _ in range(20):
            moved = move(own, 0.1 * RIGHT)
            assert "invalid" not in moved.info
            np.testing.assert_allclose(moved.obs, at + moved.info["sent"], atol=1e-5)
            at = moved.obs
            seen.append(moved.info["sent"][0])
    if driver is Point:  # by the clock more steps may follow the last one that was asked for
        assert len(own.driver.moves) == 60 and own.driver.resets == [0, 1, 2]
    monkeypatch.setattr(_Link, "send", send)
    assert len(seen) == 60


def test_a_late_command_is_replaced_and_counted(pair):
    own = pair(Arm(), period=0.05)
    begin(own, 0)
    first = move(own, 0.5 * RIGHT)
    time.sleep(0.2)
    late = move(own, -RIGHT)
    assert not first.info["late"] and late.info["late"] and late.info["sent"][0] == 0.5  # held
    own.remote.rest()
    safe = pair(Arm(), period=0.05, late=[0.0, 0.0])
    begin(safe, 0)
    move(safe, 0.5 * RIGHT)
    time.sleep(0.2)
    late = move(safe, -RIGHT)
    assert late.info["late"] and late.info["sent"][0] == 0.0


@pytest.mark.parametrize(
    ("limits", "late", "first", "sent"),
    [
        (Limits(low=-0.2, high=0.2), [5.0, 0.0], 0.1, [0.2, 0.0]),
        (Limits(change=0.1), [-1.0, 0.0], 0.1, [0.0, 0.0]),  # from what was sent last, not from zero
        (Limits(low=[-0.5, -0.1], high=[0.5, 0.1], change=[1.0, 0.3]), [-1.0, 1.0], 0.4, [-0.5, 0.1]),
    ],
    ids=str,
)
def test_a_late_command_is_kept_within_limits(pair, limits, late, first, sent):
    own = pair(Arm(), period=0.05, late=late, limits=limits)
    begin(own, 0)
    move(own, first * RIGHT)
    time.sleep(0.08)
    moved = move(own, RIGHT)
    assert moved.info["late"]
    np.testing.assert_allclose(moved.info["sent"], sent, atol=1e-6)
    np.testing.assert_allclose(own.driver.moves[1], sent, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"late": "safe"}, "late is 'safe'; give \"hold\", or 2 finite numbers"),
        ({"late": [0.0, 0.0, 0.0]}, "late is .*2 finite numbers"),
        ({"late": [np.nan, 0.0]}, "late is .*2 finite numbers"),
        ({"late": None}, "late is None; give"),
        ({"limits": Limits(low=np.nan)}, "low and high need finite numbers"),
        ({"limits": Limits(high=np.inf)}, "low and high need finite numbers"),
        ({"limits": Limits(low=[0.0, 0.5], high=0.4)}, "low is above high"),
        ({"limits": Limits(low=[0.0])}, r"low is \[0.0\]; give one number, or 2"),
        ({"limits": Limits(high=[1.0, 1.0, 1.0])}, "limits: high is .*or 2 of them"),
        ({"limits": Limits(high="much")}, "limits: high is 'much'; give one number"),
        ({"limits": Limits(change=np.nan)}, "change must be above 0"),
        ({"limits": Limits(change=[0.1, 0.0])}, "change must be above 0"),
        ({"limits": Limits(change=[0.1, 0.1, 0.1])}, "limits: change is .*or 2 of them"),
        ({"limits": Limits(workspace=([0.0], [1.0]))}, "a lowest and a highest value for each of 2 measured numbers"),
        ({"limits": Limits(workspace=([0.0, 0.0], [1.0]))}, "a lowest and a highest value"),
        ({"limits": Limits(workspace=([0.0, 0.0],))}, "a lowest and a highest value"),
        ({"limits": Limits(workspace=([0.0, np.nan], [1.0, 1.0]))}, "lowest value of the workspace"),
        ({"limits": Limits(workspace=([0.0, 2.0], [1.0, 1.0]))}, "lowest value of the workspace"),
        ({"period": None}, "needs a period"),
        ({"period": 0.0}, "period is 0.0; give the seconds"),
        ({"period": np.nan}, "period is nan"),
        ({"answer_within": 0.0}, "answer_within is 0.0; .*at most the period of 0.05"),
        ({"answer_within": 0.06}, "answer_within is 0.06"),
        ({"answer_within": np.nan}, "answer_within is nan"),
        ({"patience": 0}, "patience is 0"),
    ],
    ids=str,
)
def test_arguments_that_cannot_be_right_are_refused_before_the_robot_moves(given, words):
    driver = Arm()
    with pytest.raises(ValueError, match=words):
        play(driver, "ws://127.0.0.1:1", **{"token": "", "period": 0.05, **given})
    assert not driver.resets and not driver.moves


@pytest.mark.parametrize("given", [{"answer_within": 0.02}, {"late": [0.0, 0.0]}, {"patience": 3}], ids=str)
def test_a_driver_that_waits_for_commands_is_not_told_what_to_do_about_late_ones(given):
    driver = Point()
    with pytest.raises(ValueError, match=f"{next(iter(given))}: no command is late for a driver with `step`"):
        play(driver, "ws://127.0.0.1:1", token="", **given)
    assert not driver.resets and not driver.moves


@pytest.mark.parametrize("kind", [Point, Arm])
def test_what_was_sent_is_reported_though_the_driver_changes_its_array(pair, kind):
    class Scaling(kind):
        def step(self, action):
            action *= 100.0
            return super().step(action)

        def send(self, action):
            action *= 100.0
            super().send(action)

    if kind is Point:
        del Scaling.send
    own = pair(Scaling(), period=0.02)
    begin(own, 0)
    moved = move(own, 0.5 * RIGHT)
    assert own.driver.moves[0][0] == 50.0
    np.testing.assert_array_equal(moved.info["sent"], 0.5 * RIGHT)


def test_a_learner_that_does_not_answer_ends_the_episode(pair):
    own = pair(Arm(), period=0.01, patience=3)
    begin(own, 0)
    time.sleep(0.3)
    assert not move(own, RIGHT).info["late"]  # the clock starts with the first command
    time.sleep(0.3)
    moved = [move(own, RIGHT) for _ in range(3)]
    assert [x.truncated for x in moved] == [False, False, True] and all(x.info["late"] for x in moved)
    assert own.driver.stops and any("in a row" in line for line in own.said)


def test_a_wall_clock_that_jumps_changes_no_period(pair, monkeypatch):
    """An hour forwards and backwards at every look; periods are still 20 ms, and nothing is late."""
    real, jumps = time.time, iter([3600.0, -3600.0] * 1000)
    own = pair(Arm(), period=0.02, answer_within=0.018)
    begin(own, 0)
    monkeypatch.setattr(robot_client.time, "time", lambda: real() + next(jumps))
    started = time.monotonic()
    moved = [move(own, RIGHT) for _ in range(10)]
    assert 0.2 <= time.monotonic() - started < 2.0
    assert not any(x.truncated or "invalid" in x.info for x in moved)


def test_an_episode_is_over_after_its_steps_though_nobody_says_so(pair):
    own = pair(Arm(), period=0.01, steps=3)
    begin(own, 0)
    assert not move(own, RIGHT).truncated
    time.sleep(0.2)
    assert [move(own, RIGHT).truncated for _ in range(2)] == [False, True]
    assert own.counts is None and len(own.driver.resets) == 1
    made = own.driver.at[0]
    time.sleep(0.1)
    assert own.driver.at[0] == made and own.driver.stops


def test_rest_is_said_until_it_is_heard(pair, monkeypatch):
    own = pair(Arm(), period=0.02, again=0.05, patience=10**6)
    begin(own, 0)
    move(own, RIGHT)
    send, lost = _Link.send, []
    monkeypatch.setattr(_Link, "send", lambda link, message: lost.append(1) if len(lost) < 2 else send(link, message))
    stops = own.driver.stops
    own.remote.rest()
    assert len(lost) == 2 and own.driver.stops == stops + 1


def test_a_rest_that_comes_late_does_not_end_the_next_episode(pair):
    """A slow network may bring it then; the robot would answer no command of that episode any more."""
    own = pair(Point())
    begin(own, 0)
    late = pack("rest", episode=own.remote._episode)
    begin(own, 1)
    stops = own.driver.stops
    own.remote._played.send(late)
    assert move(own, RIGHT).obs[0] == 1 and own.driver.stops == stops


def test_a_driver_that_fails_is_stopped_and_its_step_is_in_doubt(pair):
    driver = Point()
    driver.step = lambda action: (np.array([np.nan, 0]), 0.0, False, False, {})
    own = pair(driver, again=0.05)
    begin(own, 0)
    moved = move(own, RIGHT)
    assert moved.info["invalid"] and driver.stops and any("not finite" in line for line in own.said)
    np.testing.assert_array_equal(begin(own, 1), [0, 0])  # the next episode is a new chance


def test_a_robot_that_dies_leaves_one_step_in_doubt(pair):
    driver, own = Point(), None

    def die(action):
        raise SystemExit

    own = pair(driver, again=0.05)
    begin(own, 0)
    move(own, RIGHT)
    driver.step = die
    moved = move(own, RIGHT)
    assert moved.info["invalid"] and moved.truncated and any("gone" in line and "step 1" in line for line in own.said)
    driver = Point()
    again = threading.Thread(
        target=play, args=(driver, own.remote.url), kwargs={"token": own.remote.token}, daemon=True
    )
    again.start()
    np.testing.assert_array_equal(begin(own, 5), [0, 0])
    assert driver.resets == [5] and driver.stops


def test_a_connection_lost_between_steps_ends_the_episode_though_the_robot_is_back(pair):
    own = pair(Point(), again=0.05)
    begin(own, 0)
    move(own, RIGHT)
    first = own.remote._link
    first.connection.close()
    while own.remote._link in (None, first):
        time.sleep(0.01)
    assert move(own, RIGHT).info["invalid"] and len(own.driver.moves) == 1
    np.testing.assert_array_equal(begin(own, 1), [0, 0])
    assert move(own, RIGHT).obs[0] == 1


def hello(remote, **changes):
    fields = {
        "version": 2,
        "token": remote.token,
        "robot": "r",
        "obs_size": 2,
        "action_size": 2,
        "period": None,
        "answer_within": None,
        **changes,
    }
    with connect(remote.url) as socket:
        socket.send(pack("hello", **fields))
        return unpack(socket.recv(timeout=5))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"token": "guess"}, "wrong token"),
        ({"version": 3}, "protocol version: the robot has 3, the learner 2; give both the same robot_client.py"),
        ({"version": 1, "period": "as before there was one"}, "protocol version: the robot has 1, the learner 2"),
        ({"obs_size": 3}, "numbers measured: the robot has 3, the learner 2"),
        ({"action_size": 7}, "numbers commanded: the robot has 7, the learner 2"),
        ({"period": 0.1}, "r: seconds of a step: the robot has 0.1, the learner's task 0.2; change the period"),
        ({"period": 0.205}, "the robot has 0.205, the learner's task 0.2"),
        ({"period": float("nan")}, "the robot has nan, the learner's task 0.2"),
    ],
)
def test_a_robot_that_does_not_fit_is_refused(changes, reason):
    said = []
    remote = Remote(2, 2, period=0.2, say=said.append)
    refused = hello(remote, **changes)
    assert refused["final"] and reason in refused["reason"] and reason in said[-1]
    assert remote.token not in said[-1]
    remote.close()


@pytest.mark.parametrize(("own", "theirs"), [(0.2, None), (None, 0.1), (1 / 30, 0.0333), (0.2, 0.2)])
def test_periods_that_are_the_same_or_not_known_on_both_sides_fit(own, theirs):
    remote = Remote(2, 2, period=own, say=lambda line: None)
    assert hello(remote, period=theirs)["type"] == "welcome"
    remote.close()


def test_the_client_says_why_it_was_refused():
    remote = Remote(2, 2, period=0.2, say=lambda line: None)
    with pytest.raises(RefusedError, match="wrong token"):
        play(Point(), remote.url, token="guess", say=lambda line: None)
    for driver in (Point(), Arm()):
        with pytest.raises(RefusedError, match=r"the robot has 0.1, the learner's task 0.2"):
            play(driver, remote.url, token=remote.token, period=0.1, say=lambda line: None)
        assert driver.stops and not driver.resets
    remote.close()


def test_there_is_one_robot(pair):
    own = pair(Point())
    begin(own, 0)
    refused = hello(own.remote)
    assert "another robot" in refused["reason"] and not refused["final"]  # perhaps it is the same one, back again
    assert move(own, RIGHT).obs[0] == 1


def test_connections_that_talk_nonsense_are_refused_in_one_line():
    said = []
    remote = Remote(2, 2, say=said.append)
    for _ in range(30):
        with connect(remote.url) as socket:
            socket.send(b"nonsense")
            assert not unpack(socket.recv(timeout=5))["final"]
    assert sum("refused" in line for line in said) == 1
    thread = threading.Thread(
        target=play, args=(Point(), remote.url), kwargs={"token": remote.token, "say": lambda line: None}, daemon=True
    )
    thread.start()
    remote.reset(seed=0)
    remote.close()
    thread.join(timeout=10)


def test_nonsense_changes_nothing(pair):
    own = pair(Point())
    begin(own, 0)
    rng = np.random.default_rng(0)
    good = pack("hello", version=2, token="x", robot="r", obs_size=2, action_size=2, period=None, answer_within=None)
    with contextlib.suppress(Exception):
        for _ in range(20):
            with connect(own.remote.url) as socket:
                socket.send(rng.bytes(int(rng.integers(1, 200))))
                socket.send("text")
    for _ in range(2000):
        cut = good[: rng.integers(0, len(good))] if rng.random() < 0.5 else rng.bytes(int(rng.integers(0, 300)))
        with pytest.raises(ValueError, match="damaged"):
            unpack(cut)
    assert move(own, RIGHT).obs[0] == 1


def test_messages_of_the_learner_by_hand():
    fields = unpack(pack("act", episode=3, step=4, action=np.array([0.5, -1.0])))
    assert fields["type"] == "act" and array(fields["action"], 2, "x").tolist() == [0.5, -1.0]
    for data, words in (
        ("text", "is text"),
        (b"x" * 70_000, "at most 65,536"),
        (pack("act", episode=3, step=4), "no proper 'action'"),
        (pack("act", episode=3, step=True, action=b""), "no proper 'step'"),
    ):
        with pytest.raises(ValueError, match=words):
            unpack(data)
    for size, words in ((3, "has 2 numbers, expected 3"), (2, "not finite, or beyond 1e")):
        with pytest.raises(ValueError, match=words):
            array(np.float32([0.0, 3e38]).tobytes(), size, "an action")


def test_every_command_is_on_disk_before_it_is_sent(pair, tmp_path):
    driver, path = Point(), tmp_path / "commands"
    step, lengths = driver.step, []
    driver.step = lambda action: (lengths.append(len(list(commands(path)))), step(action))[1]
    own = pair(driver, log=path)
    begin(own, 0)
    for _ in range(2):
        move(own, RIGHT)
    assert lengths == [1, 2] and [x["step"] for x in commands(path)] == [0, 1]


def played_alone(driver, **options):
    """What `play` raises for a learner that asks for one step, what the two said, and whether the step is in doubt."""
    said, raised = [], []
    remote = Remote(2, 2, again=0.05, say=said.append)

    def run():
        try:
            play(driver, remote.url, token=remote.token, retry=0.01, say=said.append, **options)
        except OSError as error:
            raised.append((time.monotonic(), error))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    remote.reset(seed=0)
    doubt = remote.step(RIGHT)[-1].get("invalid", False)
    if not doubt:
        remote.rest()
    thread.join(timeout=10)
    assert not thread.is_alive()
    remote.close()
    return raised[0][1], said, doubt


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a disk that is always full is one of Linux")
@pytest.mark.parametrize(("driver", "options"), [(Point, {}), (Arm, {"period": 0.02})])
def test_a_log_that_cannot_be_written_stops_the_robot_and_is_no_lost_connection(driver, options):
    own = driver()
    error, said, doubt = played_alone(own, log="/dev/full", **options)
    assert str(error).startswith("the log /dev/full: No space left on device; the robot is stopped. Make room")
    assert doubt and own.stops and not own.moves and len(own.resets) == 1
    assert not any("no connection" in line for line in said)


def test_a_log_that_cannot_be_opened_is_said_before_the_robot_moves(tmp_path):
    driver = Point()
    with pytest.raises(OSError, match=r"the log .*nowhere/log: No such file or directory; .*choose another file"):
        play(driver, "ws://127.0.0.1:1", token="", log=tmp_path / "nowhere/log")
    assert not driver.resets


def test_a_driver_that_cannot_stop_is_no_lost_connection():
    driver = Point()
    stops = iter([None])  # at the reset

    def stop():
        driver.stops += 1
        if next(stops, 0) == 0:
            raise OSError("the bus is off")

    driver.stop = stop
    error, said, doubt = played_alone(driver)
    assert str(error) == "the bus is off" and not doubt and len(driver.resets) == 1
    assert driver.stops == 4  # at the reset; told to rest; twice more on the way out
    assert not any("no connection" in line for line in said)


def test_a_learner_that_is_not_there_is_waited_for_and_said_once():
    """First nobody listens, then somebody hangs up in the middle of the greeting, then the learner is there."""
    listener, said = socket.socket(), []
    listener.bind(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    options = {"token": "t", "retry": 0.01, "say": said.append}
    thread = threading.Thread(target=play, args=(Point(), f"ws://127.0.0.1:{port}"), kwargs=options, daemon=True)
    thread.start()
    time.sleep(0.2)
    listener.listen()
    for _ in range(2):
        one, _ = listener.accept()
        one.recv(10)
        one.close()
    listener.close()
    remote = Remote(2, 2, port=port, token="t", say=lambda line: None)
    remote.reset(seed=0)
    remote.close()
    thread.join(timeout=10)
    assert not thread.is_alive() and said[-1].startswith("connected")
    assert len(said) == len(set(said)) and all("trying again" in line for line in said[:-1])


def commands(path):
    with open(path, "rb") as file:
        yield from msgpack.Unpacker(file)


def test_ports_sizes_and_times_that_cannot_be_are_refused():
    remote = Remote(2, 2, say=lambda line: None)
    port = int(remote.url.rsplit(":", 1)[1])
    for given, words in (
        ({"port": port}, "choose another port"),
        ({"port": 80_000}, "port 80000: ports go from 1 to 65535"),
        ({"host": "256.1.1.1"}, "neither a name nor an address"),
        ({"period": float("nan")}, "a step cannot take nan seconds"),
        ({"steps": 0}, "must be more than 0"),
        ({"again": float("nan")}, "must be more than 0"),
    ):
        with pytest.raises(UserError, match=words):
            Remote(2, 2, **given)
    remote.close()


# --- drivers that fail ------------------------------------------------------------------------------------------------


def as_an_environment(driver):
    driver.reset = lambda seed: (driver.resets.append(seed), (np.zeros(2), {}))[1]


def fails_at_every_start(driver):
    def reset(seed):
        driver.resets.append(seed)
        raise TypeError("no such motor\n\x1b[31m" + 60_000 * "x")

    driver.reset = reset


def returns(*moved):
    def change(driver):
        driver.step = lambda action: moved

    return change


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (as_an_environment, "an observation is .*not numbers alone"),
        (fails_at_every_start, "TypeError: no such motor"),
        (returns(np.zeros(2), np.ones(2), False, False, {}), "reward is array"),
        (returns(np.zeros(2), "much", False, False, {}), "reward is 'much'"),
        (returns(np.zeros(2), 0.0, None, False, {}), "terminated is None"),
        (returns(np.zeros(2), 0.0, False, "no", {}), "truncated is 'no'"),
        (returns(np.zeros(2), 0.0, False, False, {"success": np.ones(2)}), "info.*success.* is array"),
        (returns(np.zeros(2), 0.0, False, {}), "step does not return obs, reward, terminated, truncated, info"),
        (returns(np.full(2, 3e38), 0.0, False, False, {}), "not finite, or beyond 1e"),
        (returns(np.zeros(3), 0.0, False, False, {}), "has 3 numbers, expected 2"),
        (returns("ab", 0.0, False, False, {}), "an observation is 'ab'"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_a_permanent_mistake_of_the_driver_ends_in_one_line(pair, mistake, words):
    driver = Point()
    mistake(driver)
    own = pair(driver, again=0.001)
    with pytest.raises(UserError, match=f"^robot at .* has failed 5 times in a row: .*{words}") as stopped:
        for episode in range(50):  # on a busy machine a slow answer is asked for again, and does not count
            begin(own, episode)
            assert move(own, RIGHT).info["invalid"]
    assert len(driver.resets) >= 5 and driver.stops >= 5
    assert all(line.isprintable() and len(line) <= 600 for line in [str(stopped.value)[:600], *own.said])


def test_a_driver_that_fails_now_and_then_goes_on(pair):
    """Four times in a row, again and again: a step that is made is a new beginning."""
    driver, own = Point(), None
    step, fail = driver.step, []

    def now_and_then(action):
        if fail:
            raise OSError(fail.pop())
        return step(action)

    driver.step = now_and_then
    own = pair(driver, again=0.001)
    for _ in range(3):
        fail.extend(["busy"] * 4)
        for episode in range(5):
            begin(own, episode)
            assert move(own, 0.1 * RIGHT).info.get("invalid", False) == (episode < 4)
    assert len(driver.resets) == 15


@pytest.mark.parametrize("outcome", [(np.ones(1), None, np.ones(1, bool)), (None, False, None)])
def test_a_judge_may_return_arrays_of_one_and_none(pair, outcome):
    driver = Arm()
    driver.judge = lambda obs: (outcome[0], outcome[1] or np.zeros(1), outcome[2])
    own = pair(driver, period=0.01)
    begin(own, 0)
    moved = move(own, RIGHT)
    assert moved.reward == 1.0 or np.isnan(moved.reward)
    assert moved.terminated is False and moved.info["is_success"] is (True if outcome[0] is not None else None)


def test_late_commands_and_limits_beyond_an_action_are_kept_within_it():
    limits = Limits(low=-3.0, high=[0.5, 9.0])
    np.testing.assert_array_equal(limits.of(np.array([-5.0, 5.0]), np.zeros(2)), [-1.0, 1.0])
    for wrong in (Limits(low=2.0, high=3.0), Limits(high=[1.0, -2.0], low=-3.0)):
        with pytest.raises(ValueError, match="allow no action"):
            wrong.check(2, 2)


# --- strangers --------------------------------------------------------------------------------------------------------


def test_idle_strangers_cannot_keep_the_robot_out(pair):
    """Those that say nothing, and those that have begun to speak; the driver comes last."""
    own, strangers = pair(Point()), []
    begin(own, 0)
    port = own.remote._door.port
    for i in range(3 * STRANGERS):
        strangers.append(socket.create_connection(("127.0.0.1", port), timeout=5))
        if i % 2:
            strangers[-1].sendall(b"GET / HTTP/1.1\r\nHost: x\r\n")
    assert "another robot" in hello(own.remote)["reason"]  # all before it have come in
    assert move(own, RIGHT).obs[0] == 1
    own.remote._link.connection.close()
    begin(own, 1)  # it is back
    assert move(own, RIGHT).obs[0] == 1
    for one in strangers:
        one.close()


@pytest.mark.parametrize(
    ("host", "refused"),
    [
        ("evil.example", True),
        ("", True),
        ("a b", True),
        ("[::1", True),
        ("localhost:1", False),
        ("[::1]:4", False),
        ("10.0.0.7", False),
        (socket.gethostname(), False),
        (f"{socket.gethostname()}.local:8765", False),
    ],
)
def test_a_foreign_host_is_refused(host, refused, monkeypatch):
    remote = Remote(2, 2, say=lambda line: None)
    monkeypatch.setattr("websockets.client.build_host", lambda *given, **more: host)
    answer = hello(remote)
    assert (answer["type"] == "refused") == refused and (not refused or "it asked for the host" in answer["reason"])
    remote.close()


def test_a_web_page_is_refused():
    remote = Remote(2, 2, say=lambda line: None)
    with pytest.raises(InvalidStatus, match="403"), connect(remote.url, origin="http://evil.example"):
        pass
    remote.close()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"robot": "\x1b[31m\n" * 9000, "obs_size": 3}, "...: numbers measured: the robot has 3"),
        ({"period": 0.2, "answer_within": 0.3}, "r: answer_within is 0.3: give at most the period"),
        ({"answer_within": 0.1}, "r: answer_within is 0.1"),
        ({"period": -1.0}, "r: seconds of a step: the robot has -1, which cannot be"),
        ({"period": float("nan")}, "the robot has nan, which cannot be"),
        ({"answer_within": float("nan")}, "its first message does not fit the protocol"),
        ({"token": b"\xff"}, "its first message does not fit the protocol"),
        ({"obs_size": [1]}, "its first message does not fit the protocol"),
    ],
    ids=str,
)
def test_a_greeting_that_cannot_be_is_refused_in_a_short_line(changes, reason):
    said = []
    remote = Remote(2, 2, say=said.append)
    refused = hello(remote, **changes)["reason"]
    assert reason in refused and refused.isprintable() and len(refused) < 250 and refused in said[-1]
    remote.close()


@contextlib.contextmanager
def robot_by_hand(said=None):
    """A learner, a robot that it has taken, and what answers the learner's next question."""
    remote = Remote(2, 2, again=0.2, say=[].append if said is None else said.append)
    fields = {"obs_size": 2, "action_size": 2, "period": None, "answer_within": None}
    with connect(remote.url) as robot:
        robot.send(pack("hello", version=2, token=remote.token, robot="r", **fields))
        assert unpack(robot.recv(timeout=5))["type"] == "welcome"

        def answered(ask, kind, **fields):
            with ThreadPoolExecutor(1) as pool:
                asked = pool.submit(ask)
                while not asked.done():  # it asks again where an answer was dropped
                    with contextlib.suppress(TimeoutError):
                        message = unpack(robot.recv(timeout=0.05))
                        same = {name: message[name] for name in ("episode", "step") if name in message}
                        robot.send(pack(kind, **{**same, **fields}))
                return asked.result()

        answered(lambda: remote.reset(seed=0), "began", obs=np.zeros(2))
        yield remote, robot, answered
    remote.close()


MOVED = {
    "sent": np.zeros(2),
    "obs": np.ones(2),
    "reward": 1.0,
    "terminated": False,
    "truncated": False,
    "success": None,
    "late": False,
}


def test_messages_that_a_robot_cannot_mean_are_dropped_and_nothing_is_lost():
    said = []
    bodies = (msgpack.packb({"type": [1]}), b"\x80", b"\xc1", b"\x82\xa4type\xa6rested\xa1z" + b"\x91" * 60_000)
    with robot_by_hand(said) as (remote, robot, answered):
        for body in bodies:
            robot.send(robot_client.zlib.crc32(body).to_bytes(4, "little") + body)
        robot.send("text")
        for _ in range(500):
            robot.send(pack("rested", episode=1))
        obs, reward, *_ = answered(lambda: remote.step(np.zeros(2)), "moved", **MOVED)
    assert obs.tolist() == [1.0, 1.0] and reward == 1.0
    ignored = [line for line in said if "ignored" in line]
    assert len(ignored) == 1 and "does not fit the protocol" in ignored[0]


def test_answers_that_nobody_has_asked_for_take_no_memory():
    with robot_by_hand() as (remote, robot, answered):
        for _ in range(2000):
            robot.send(pack("rested", episode=1))
        answered(lambda: remote.step(np.zeros(2)), "moved", **MOVED)
        for _ in range(2000):
            robot.send(pack("rested", episode=1))
        robot.ping().wait(5)
        assert remote._link.inbox.qsize() <= 64


@pytest.mark.parametrize(
    "wrong",
    [
        {"sent": np.array([1e30, 0])},
        {"sent": np.array([1.1, 0])},
        {"obs": np.array([3e38, 0])},
        {"obs": np.zeros(3)},
    ],
    ids=str,
)
def test_a_step_with_numbers_that_cannot_be_is_in_doubt(wrong):
    with robot_by_hand() as (remote, _, answered):
        assert answered(lambda: remote.step(np.zeros(2)), "moved", **{**MOVED, **wrong})[-1] == {"invalid": True}


def test_the_token_is_in_no_line(pair):
    own = pair(Point())
    begin(own, 0)
    lines = [*own.said, str(own.remote)]
    assert any("its token is in the attribute `token`" in line for line in lines)
    assert not any(own.remote.token in line for line in lines)


@pytest.mark.skipif(not socket.has_ipv6, reason="this Python has no IPv6")
def test_a_learner_listens_at_an_ipv6_address():
    try:
        remote = Remote(2, 2, host="::1", say=lambda line: None)
    except UserError:
        pytest.skip("this computer has no IPv6")
    assert remote.url.startswith("ws://[::1]:") and hello(remote)["type"] == "welcome"
    remote.close()


def test_the_client_is_one_file_for_old_pythons():
    tree = ast.parse(Path(robot_client.__file__).read_text(), feature_version=(3, 9))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {
        (node.module if isinstance(node, ast.ImportFrom) else node.names[0].name).split(".")[0] for node in imports
    }
    assert names - sys.stdlib_module_names == {"numpy", "msgpack", "websockets"}
