"""Folders that take the place of others whole: kills at any moment, and what stands beside them."""

import itertools
import os

import pytest

from envs.types import UserError
from sgft_jax.files.disk import NEW, InUseError, Lock, present, replaced, written

CHANGES = ("mkdir", "rename", "replace", "rmdir", "unlink")


class KilledError(BaseException):
    """Stands for SIGKILL: nothing that the process would still do on disk happens."""


def kill_at(monkeypatch, number):
    """From its `number`-th change on the process changes no folder any more; returns how many it has made."""
    made = itertools.count(1)

    def dying(change):
        def changed(*args, **kwargs):
            if next(made) >= number:
                raise KilledError
            return change(*args, **kwargs)

        return changed

    for name in CHANGES:
        monkeypatch.setattr(os, name, dying(getattr(os, name)))


def write(folder, content):
    with replaced(folder) as part:
        (part / "state").mkdir()
        (part / "state" / "numbers").write_text(content)
        (part / "manifest").write_text(content)


def content_of(folder):
    """What a reader finds; fails where the two files are not of one writer."""
    texts = {path.read_text() for path in (present(folder) / "state" / "numbers", present(folder) / "manifest")}
    assert len(texts) == 1
    return texts.pop()


def test_a_kill_at_any_moment_leaves_the_old_folder_or_the_new_one(tmp_path, monkeypatch):
    seen = []
    for number in itertools.count(1):
        folder = tmp_path / str(number) / "prior"
        write(folder, "old")
        (folder / "mine").write_text("stays")
        with monkeypatch.context() as patch:
            kill_at(patch, number)
            try:
                write(folder, "new")
            except KilledError:
                pass
            else:
                break
        seen.append(content_of(folder))
        write(folder, "later")
        assert content_of(folder) == "later" and (folder / "mine").read_text() == "stays"
        assert os.listdir(folder.parent) == ["prior"]
    assert seen == sorted(seen, reverse=True) and {"old", "new"} == set(seen)


def test_what_stands_beside_a_folder_is_nobodys_business(tmp_path):
    theirs = [tmp_path / name for name in (".tmp-notes", ".tmp-prior", f"{NEW}policy", ".hidden")]
    for folder in theirs:
        folder.mkdir()
        (folder / "mine.txt").write_text("not yours")
    (tmp_path / ".tmp-list").write_text("a file")
    (tmp_path / ".tmp-link").symlink_to(theirs[0])
    before = sorted(tmp_path.rglob("*"))
    write(tmp_path / "prior", "new")
    assert sorted(path for path in tmp_path.rglob("*") if tmp_path / "prior" not in (path, *path.parents)) == before


@pytest.mark.parametrize("name", ["prior", f"{NEW}prior"])
def test_a_file_or_a_link_in_the_way_stays(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match=f"/{name}: is no folder, and stands where one has to be written"):
        write(tmp_path / "prior", "new")
    assert os.listdir(tmp_path) == [name] and (tmp_path / name).read_text() == "mine"


def test_a_file_above_is_named_in_one_line(tmp_path):
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path / "file" / "prior", tmp_path / "file" / "a" / "prior"):
        with pytest.raises(UserError, match="prior: cannot be made, something else than a folder is in its way"):
            write(folder, "new")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for folder in (tmp_path / "loop", tmp_path / "loop" / "prior"):
        with pytest.raises(UserError, match=r"is no folder|something else than a folder"):
            write(folder, "new")


def test_a_link_stays_a_link(tmp_path):
    write(tmp_path / "here" / "prior", "old")
    (tmp_path / "prior").symlink_to(tmp_path / "here" / "prior")
    write(tmp_path / "prior", "new")
    assert (tmp_path / "prior").is_symlink() and content_of(tmp_path / "here" / "prior") == "new"
    assert sorted(os.listdir(tmp_path)) == ["here", "prior"] and os.listdir(tmp_path / "here") == ["prior"]


def test_an_error_leaves_the_old_folder_and_nothing_else(tmp_path):
    write(tmp_path / "prior", "old")
    with pytest.raises(OSError, match="full"), replaced(tmp_path / "prior") as part:
        (part / "state").mkdir()
        raise OSError("full")
    assert content_of(tmp_path / "prior") == "old" and os.listdir(tmp_path) == ["prior"]


def test_two_writers_of_one_folder_do_not_meet(tmp_path):
    with replaced(tmp_path / "prior") as part:
        (part / "manifest").write_text("first")
        with pytest.raises(InUseError, match="another process is writing to it"):
            write(tmp_path / "prior", "second")
        write(tmp_path / "other", "beside")
    assert (tmp_path / "prior" / "manifest").read_text() == "first" and content_of(tmp_path / "other") == "beside"
    Lock(tmp_path / "prior").release()


def test_a_file_is_the_old_one_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("old")
    with pytest.raises(ValueError, match="half"), written(path) as part:
        part.write_text("ne")
        raise ValueError("half")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with written(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]
