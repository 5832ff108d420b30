"""Tables of anybody."""

import pytest

from envs.types import UserError
from sgft_jax.files.csvfile import finite, read_csv, whole


def test_a_table_comes_back_by_its_head(tmp_path):
    (tmp_path / "a.csv").write_bytes(b'\xef\xbb\xbfname,n\npush,1\n"a, ""b""\nc",\n')
    assert read_csv(tmp_path / "a.csv", needed=("n",)) == [{"name": "push", "n": "1"}, {"name": 'a, "b"\nc', "n": ""}]
    assert read_csv(tmp_path / "none.csv") == []


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
