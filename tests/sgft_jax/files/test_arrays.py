"""Numbers from anybody: finite float32, flags 0 or 1, files no larger than they look."""

import os
import zipfile

import numpy as np
import pytest

from envs.types import UserError
from sgft_jax.files import arrays
from sgft_jax.systems import robot_client

FIX = "mend it"


def refusal(function, *args, **options):
    with pytest.raises(UserError) as error:
        function(*args, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_numbers_become_float32():
    rows = arrays.numbers("a", "obs", [[1, 2], [3, 4]], (None, 2), fix=FIX)
    assert rows.dtype == np.float32
    np.testing.assert_array_equal(rows, [[1, 2], [3, 4]])
    assert arrays.numbers("a", "reward", True, (), fix=FIX) == 1


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([[0, 0], [0, 1e39]], "obs of row 1 is too large for float32"),
        ([[0, 0], [0, -2e18]], "obs of row 1 is too large for float32"),  # its square is
        ([[0, np.nan], [0, 0]], "obs of row 0 is not finite"),
        ([[0, 0], [-np.inf, 0]], "obs of row 1 is not finite"),
        ([0, 1], "obs has shape [2], not [n, 2]"),
        ([[0, 1, 2]], "obs has shape [1, 3], not [n, 2]"),
        ([["a", "b"]], "obs holds str32, not numbers"),
        ([[1j, 0]], "obs holds complex128, not numbers"),
        ([[object(), None]], "obs holds object, not numbers"),
        ([[0], [0, 1]], "obs holds rows of different lengths"),
    ],
)
def test_other_numbers_are_refused(values, words):
    assert refusal(arrays.numbers, "a", "obs", values, (None, 2), fix=FIX) == f"a: {words}; {FIX}"


def test_files_and_robots_have_the_same_bound():
    assert arrays.LARGEST == robot_client.LARGEST and np.isfinite(np.float32(arrays.LARGEST) ** 2)
    assert arrays.numbers("a", "reward", arrays.LARGEST, (), fix=FIX) == np.float32(arrays.LARGEST)


def test_flags_are_0_or_1_and_nothing_else():
    for values in ([True, False], [1, 0], [1.0, 0.0]):
        np.testing.assert_array_equal(arrays.flags("a", "done", values, (2,), fix=FIX), [True, False])
    for odd in (np.nan, -1, 0.5, 2, np.inf):
        assert (
            refusal(arrays.flags, "a", "done", [0, odd], (2,), fix=FIX)
            == f"a: done of row 1 is {odd:g}, not 0 or 1; {FIX}"
        )
    assert "holds str32" in refusal(arrays.flags, "a", "done", ["a"], (1,), fix=FIX)


def test_an_archive_comes_back_as_it_was(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.arange(3), name="push")
    read = arrays.read_npz(tmp_path / "a.npz")
    assert set(read) == {"x", "name"} and read["name"] == "push"
    np.testing.assert_array_equal(read["x"], [0, 1, 2])


@pytest.mark.heavy
def test_archives_that_unpack_to_far_more_than_they_are(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(2 * 10**7))
    monkeypatch.setattr(arrays, "_read_member", None)  # nothing is unpacked
    assert "claim to hold 160,000," in refusal(arrays.read_npz, tmp_path / "a.npz")


def header_of(shape, descr="<f8"):
    text = str({"descr": descr, "fortran_order": False, "shape": shape}).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(
    ("member", "words"),
    [
        (header_of((10**12,)), "x.npy is shorter than its header says"),
        (header_of((1,), "|O") + b"........", "x.npy holds object, no plain numbers"),
        (b"no header", "damaged"),
    ],
)
def test_a_header_that_claims_what_is_not_there(tmp_path, member, words):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("x.npy", member)
    assert words in refusal(arrays.read_npz, tmp_path / "a.npz")


def test_what_is_no_archive(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    assert refusal(arrays.read_npz, tmp_path / "pipe.npz").endswith("is no plain file")
    assert refusal(arrays.read_npz, tmp_path / "none.npz").endswith("no such file")
    (tmp_path / "text.npz").write_text("text")
    assert "damaged or cut off (File is not a zip file)" in refusal(arrays.read_npz, tmp_path / "text.npz")
