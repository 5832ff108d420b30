"""Tables of anybody."""

import gzip

import pytest

from envs.types import UserError
from sgft_jax.files.disk import finite, read_csv, whole, write_csv


def test_a_table_comes_back_by_its_head(tmp_path):
    (tmp_path / "a.csv").write_bytes(b'\xef\xbb\xbfname,n\npush,1\n"a, ""b""\nc",\n')
    assert read_csv(tmp_path / "a.csv", needed=("n",)) == [{"name": "push", "n": "1"}, {"name": 'a, "b"\nc', "n": ""}]
    assert read_csv(tmp_path / "none.csv") == []


def test_a_compressed_table_comes_back_and_is_the_same_bytes_every_time(tmp_path):
    rows = [{"name": "push", "n": "1"}, {"name": 'a, "b"', "n": ""}]
    for name in ("a.csv.gz", "b.csv.gz", "c.csv"):
        write_csv(tmp_path / name, ("name", "n"), rows)
        assert read_csv(tmp_path / name) == rows
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()
    assert gzip.decompress((tmp_path / "a.csv.gz").read_bytes()) == (tmp_path / "c.csv").read_bytes()


@pytest.mark.parametrize("content", [b"name,n\n", b"", gzip.compress(b"name,n\n" * 9, mtime=0)[:-9]])
def test_what_is_no_gzip_file_is_refused(content, tmp_path):
    (tmp_path / "a.csv.gz").write_bytes(content)
    if content:
        with pytest.raises(UserError, match=r"a.csv.gz: is no gzip file .*; put it back as it was"):
            read_csv(tmp_path / "a.csv.gz")
    else:
        assert read_csv(tmp_path / "a.csv.gz") == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"name,n\npush\n", "row 1 has no n"),
        (b"name,n,more\npush,1\n", "row 1 has other columns than the head"),
        (b"name,n\npush,1,2\n", "row 1 has other columns than the head"),
        (b"name,n\npu\0sh,1\n", "is no table .a zero byte."),
        (b"name,n\n" + b"x" * 200_000 + b",1\n", "is no table .field larger than"),
        (b"name,n\n\xff,1\n", "is no UTF-8 text"),
    ],
)
def test_what_is_no_table_is_refused(content, words, tmp_path):
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(UserError, match=f"a.csv: {words}"):
        read_csv(tmp_path / "a.csv", needed=("name", "n"))


def test_cells_are_numbers_or_an_error():
    assert whole("n", "20") == 20 and whole("n", 3.0) == 3 and finite("x", "-1e3") == -1000
    for cell in ("-1", "0.5", "nan", "inf", "1e30", "", "a", "9" * 5000):
        with pytest.raises(ValueError):
            whole("n", cell)
    for cell in ("nan", "-inf", "1e999", "", "a"):
        with pytest.raises(ValueError):
            finite("x", cell)
