"""A door that no stranger can fill, at any interface that this computer has."""

import contextlib
import errno
import socket

import pytest

from envs.types import UserError
from sgft_jax.systems.door import STRANGERS, Door, bound, check_host, url


@pytest.fixture
def last():
    with contextlib.ExitStack() as stack:
        yield stack


@pytest.fixture
def door(last):
    return last.enter_context(Door("127.0.0.1", 0))


@pytest.fixture
def knock(door, last):
    """A stranger comes: both ends of its connection."""

    def come():
        stranger = last.enter_context(socket.create_connection(("127.0.0.1", door.port), timeout=5))
        return stranger, last.enter_context(door.accept()[0])

    return come


def is_open(stranger):
    stranger.setblocking(False)
    try:
        return bool(stranger.recv(1))
    except BlockingIOError:
        return True


def test_the_oldest_strangers_make_room_and_who_is_admitted_stays(door, knock):
    first, inside = knock()
    door.admit(inside)
    others = [knock() for _ in range(STRANGERS + 5)]
    assert is_open(first) and [is_open(far) for far, _ in others] == [False] * 5 + [True] * STRANGERS
    for far, near in others:
        near.close()
        far.close()
    late, _ = knock()
    assert is_open(late) and len(door._strangers) == 1  # those that are gone do not count


def test_where_no_more_files_can_be_opened_strangers_make_room(knock, monkeypatch):
    others, real, left = [knock() for _ in range(4)], socket.socket.accept, [1, 1]

    def full(own):
        if left:
            left.pop()
            raise OSError(errno.EMFILE, "Too many open files")
        return real(own)

    monkeypatch.setattr(socket.socket, "accept", full)
    robot, _ = knock()
    assert is_open(robot) and [is_open(far) for far, _ in others] == [False, False, False, True]


def test_a_door_that_is_closed_accepts_nothing_more(door, knock):
    far, _ = knock()
    door.close()
    assert not is_open(far)
    with pytest.raises(OSError, match="Bad file descriptor"):
        door.accept()


@pytest.mark.parametrize(
    ("host", "port", "words"),
    [
        ("127.0.0.1", 80_000, "port 80000: ports go from 1 to 65535"),
        ("127.0.0.1", -1, "port -1: ports go"),
        ("127.0.0.1", "http", "port 'http': ports go"),
        ("256.1.1.1", 0, "host '256.1.1.1': is neither a name nor an address"),
        ("a b", 0, "host 'a b': is neither"),
        ("", 0, "host '': is neither"),
        ("x" * 300, 0, "is neither"),
        ("a..b", 0, "host 'a..b': is neither"),
        ("a\0b", 0, "is neither"),
        ("::zz", 0, "host '::zz': is neither"),
        ("1.2.3", 0, "host '1.2.3': is neither"),
        ("203.0.113.7", 0, "cannot listen at 203.0.113.7:0 .*an address of this computer"),
    ],
    ids=str,
)
def test_where_nobody_can_listen_is_one_line(host, port, words):
    with pytest.raises(UserError, match=words):
        bound(host, port)


def test_a_port_that_is_taken_is_one_line(door):
    with pytest.raises(UserError, match=f"cannot listen at 127.0.0.1:{door.port} .*choose another port"):
        Door("127.0.0.1", door.port)


def test_addresses_of_either_kind_have_their_url():
    check_host("fe80::1%eth0")
    check_host("my-arm.lab.example")
    assert url("::1", 8765) == "ws://[::1]:8765" and url("127.0.0.1", 1) == "ws://127.0.0.1:1"
    assert url("localhost", 2) == "ws://localhost:2"
