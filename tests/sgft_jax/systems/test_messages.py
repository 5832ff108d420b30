"""What a learner takes from a robot, and what it does with everything else."""

import msgpack
import numpy as np
import pytest

from sgft_jax.systems import robot_client
from sgft_jax.systems.messages import Began, Hello, Moved, VersionError, read
from sgft_jax.systems.robot_client import pack, unpack

HELLO = {
    "version": 2,
    "token": "t",
    "robot": "r",
    "obs_size": 2,
    "action_size": 1,
    "period": 0.1,
    "answer_within": 0.05,
}
MOVED = {
    "episode": 1,
    "step": 0,
    "sent": b"",
    "obs": b"",
    "reward": None,
    "terminated": False,
    "truncated": False,
    "success": None,
    "late": False,
}


def signed(body):
    return robot_client.zlib.crc32(body).to_bytes(4, "little") + body


def test_messages_by_hand():
    assert read(pack("hello", **HELLO)) == Hello(**HELLO)
    assert read(pack("moved", **MOVED, more=[1])) == Moved(**MOVED)  # what a later version adds
    assert read(pack("began", episode=3, obs=np.ones(1))) == Began(3, b"\x00\x00\x80?")


@pytest.mark.parametrize(
    "data",
    [
        "text",
        b"",
        b"nonsense",
        b"x" * 70_000,
        signed(b"\xc1"),
        signed(b"\x80"),
        signed(msgpack.packb([1])),
        *(signed(msgpack.packb({"type": kind})) for kind in ([1], {}, None, 7, "fly", "reset", "x" * 60_000)),
        signed(b"\x81\xa4type\xa2\xff\xfe"),
        signed(b"\x82\xa4type\xa6rested\xa1z" + b"\x91" * 60_000),
        signed(b"\xdd\xff\xff\xff\xff"),
        signed(b"\x82\xa4type\xa6rested\xa7episode\xc6\xff\xff\xff\xff"),
        signed(msgpack.packb({"type": "rested", "episode": msgpack.ExtType(5, b"x")})),
        signed(msgpack.packb({"type": "rested", "episode": msgpack.Timestamp(0)})),
        pack("rested", episode=-1),
        *(
            pack("hello", **{**HELLO, **more})
            for more in (
                {"answer_within": float("nan")},
                {"answer_within": -1.0},
                {"answer_within": 1e9},
                {"token": b"t"},
                {"obs_size": -1},
                {"obs_size": True},
                {"obs_size": 1.5},
                {"period": "0.1"},
                {"version": "2"},
            )
        ),
        *(
            pack("moved", **{**MOVED, **more})
            for more in (
                {"obs": "text"},
                {"reward": "much"},
                {"terminated": None},
                {"terminated": 1},
                {"success": 0},
                {"step": 1.0},
            )
        ),
        pack("failed", episode=1),
        pack("failed", episode=1, reason=None),
    ],
    ids=lambda data: repr(data[4:40]),
)
def test_what_is_no_message_is_one_line(data):
    with pytest.raises(ValueError, match=r"^(is|has|was|does) ") as stopped:
        read(data)
    assert len(str(stopped.value)) < 200 and str(stopped.value).isprintable()


def test_another_version_is_said_whatever_its_fields_are():
    with pytest.raises(VersionError, match="the robot has 3, the learner 2"):
        read(pack("hello", version=3, period="as it was then"))


@pytest.mark.parametrize("kind", [[1], {}, None, 7, "moved"])
def test_a_robot_takes_no_message_of_an_unknown_type(kind):
    with pytest.raises(ValueError, match="is of the unknown type"):
        unpack(signed(msgpack.packb({"type": kind})))


def test_random_changes_of_messages_are_refused_or_read():
    """Nothing but ValueError comes out, whatever the bytes are; the checksum is right."""
    rng = np.random.default_rng(0)
    good = [pack("hello", **HELLO)[4:], pack("moved", **MOVED)[4:]]
    read_well = 0
    for i in range(3000):
        body = bytearray(good[i % 2])
        for place in rng.integers(0, len(body), rng.integers(1, 4)):
            body[place] = rng.integers(256)
        for take in (read, unpack):
            try:
                take(signed(bytes(body)))
                read_well += 1
            except ValueError:
                pass
    assert read_well < 6000
