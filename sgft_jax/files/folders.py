"""Impure: files and folders that appear whole, and folders that one process writes at a time. Imports no JAX."""

import contextlib
import fcntl
import os
import shutil
import weakref
from collections.abc import Iterator
from pathlib import Path

from envs.types import UserError

# Of a folder NAME, beside it: the one that is being written, and the one that it is about to replace.
NEW, ASIDE = ".sgft-new-", ".sgft-old-"
_LOCK = ".lock"


class InUseError(UserError):
    """Another process has the folder open."""


class Lock:
    """An exclusive lock on a folder, held until `release()`, collection or the end of the process, however it ends.

    Raises InUseError if another process, or another lock of this one, holds it.
    """

    def __init__(self, folder: Path) -> None:
        handle = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        self.release = weakref.finalize(self, os.close, handle)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise InUseError(f"{folder}: another process is writing to it") from None


def in_use(folder: Path) -> bool:
    """Whether somebody holds the lock of a folder."""
    if not (folder / _LOCK).exists():
        return False
    try:
        Lock(folder).release()
    except InUseError:
        return True
    return False


def empty(folder: Path, *, last: str = "") -> None:
    """Delete the content of a folder but its lock, the file called `last` last; links are removed, never followed."""
    for path in sorted(folder.iterdir(), key=lambda path: path.name == last):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != _LOCK:
            path.unlink()


@contextlib.contextmanager
def written(path: Path, part: Path | None = None) -> Iterator[Path]:
    """Give a path to write a file to, which then takes the place of `path`, flushed to disk.

    A process killed at any moment leaves the old file or the new one, and perhaps a part; an error leaves the old one.
    part: where to write, by default hidden beside `path`.
    """
    part = part or path.with_name(NEW + path.name)
    try:
        yield part
        sync(part)
        part.replace(path)
        sync(path.parent)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def sync(path: Path) -> None:
    """Flush a file to disk, or of a folder the names in it, so that they survive a power cut."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def part_of(folder: Path) -> Path:
    """Where `replaced` lets a folder be written."""
    real = _real(folder)
    return real.with_name(NEW + real.name)


def present(folder: Path) -> Path:
    """The folder, or what was there before, if a writer was killed while it put the new one in its place."""
    return aside if not folder.exists() and (aside := _aside_of(_real(folder))).is_dir() else folder


@contextlib.contextmanager
def replaced(folder: Path) -> Iterator[Path]:
    """Give a folder to fill, which then takes the place of `folder`, or of what that links to.

    A process killed at any moment leaves the old or the new one, see `present`; an error leaves the old one. What the
    new one lacks, such as an export that somebody has put into a policy's folder, moves over. Raises InUseError while
    another process replaces the same folder.
    """
    part, folder = part_of(folder), _real(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UserError(f"{folder}: cannot be made, something else than a folder is in its way") from None
    for path in (folder, part):
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise UserError(f"{path}: is no folder, and stands where one has to be written; move it elsewhere")
    part.mkdir(exist_ok=True)
    lock = Lock(part)
    try:
        settle(folder)
        empty(part)  # what a killed writer has left
        yield part
        if folder.exists():
            folder.rename(_aside_of(folder))
        part.rename(folder)
        (folder / _LOCK).unlink()
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    finally:
        settle(folder)
        lock.release()


def settle(folder: Path) -> None:
    """Ends what a killed writer has begun: what it had put aside is put back, or goes."""
    aside = _aside_of(folder)
    if not aside.is_dir() or aside.is_symlink():
        return
    if not folder.exists():
        aside.rename(folder)
        return
    for path in aside.iterdir():
        if path.name != _LOCK and not os.path.lexists(folder / path.name):
            path.rename(folder / path.name)
    shutil.rmtree(aside)


def _aside_of(folder: Path) -> Path:
    return folder.with_name(ASIDE + folder.name)


def _real(folder: Path) -> Path:
    """With the last part as it is on disk: no link, no dot."""
    return Path(os.path.realpath(folder)) if folder.is_symlink() or folder.name in ("", "..") else folder
