"""Impure: HDF5 files of anybody: numbers that lie in the file itself, no larger than they look.

An HDF5 file may take its numbers from any other file (external storage, links, virtual data sets), may ask for code
that unpacks them (plug-ins), and may claim any size. All of that is refused before a number is read.
"""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from envs.types import UserError
from sgft_jax.files.arrays import check_claim, check_plain, damage

# Codes of HDF5's own filters: shuffle and checksums; deflate, szip, n-bit, scale-offset, and h5py's LZF.
_REORDERING, _PACKING = {2, 3}, {1, 4, 5, 6, 32000}
_HARD = 0  # a link that is none
_SHOWN = 8  # names in a message


class Reader:
    """An open file. All that it returns together is no more than what the file can really hold."""

    def __init__(self, path: Path, content: h5py.File) -> None:
        self.path, self.content = path, content
        self._claimed = self._stored = 0  # bytes, of all arrays so far

    def has(self, group: h5py.Group | None, name: str) -> bool:
        """Whether something has that name in a group, None for the root."""
        with damage(self.path):
            return (self.content if group is None else group).id.links.exists(name.encode())

    def groups(self, pattern: str) -> list[h5py.Group]:
        """Those of the root with names that fit, in the order of the number that is the pattern's only group."""
        with damage(self.path):
            matches = [match for name in sorted(self.content) if (match := re.fullmatch(pattern, name))]
        members = [self._member(self.content, match[0]) for match in sorted(matches, key=lambda match: int(match[1]))]
        return [member for member in members if isinstance(member, h5py.Group)]

    def array(self, group: h5py.Group | None, name: str, rank: int) -> np.ndarray:
        """The numbers of a data set in a group, None for the root: [rows, entries], or [rows], also from [rows, 1]."""
        data = self._member(self.content if group is None else group, name)
        name = str(data.name)
        if not isinstance(data, h5py.Dataset):
            raise UserError(f"{self.path}: {name} is a group; only vectors are read, so flatten it before recording")
        with damage(self.path):
            shape: tuple[int, ...] | None = data.shape  # None: an empty data set
            kind = data.dtype
            fits = shape is not None and (len(shape) == rank or (rank == 1 and shape[1:] == (1,)))
            if shape is None or not fits or kind.kind not in "biuf" or 0 in shape[1:]:
                wanted = "[rows]" if rank == 1 else "[rows, entries]"
                size = "nothing" if shape is None else list(shape)
                raise UserError(f"{self.path}: {name} is {kind} {size}, not numbers {wanted}; supply another file")
            self._check(name, data)
            array = np.asarray(data[()])
        return array[:, 0] if array.ndim > rank else array

    def attribute(self, group: h5py.Group, name: str) -> int | None:
        """A whole number beside a group; None where there is none."""
        with damage(self.path):
            value = np.asarray(group.attrs[name]) if name in group.attrs else None
        if value is not None and (value.shape != () or value.dtype.kind not in "iu"):
            raise UserError(f"{self.path}: {name} of {group.name} is no whole number; supply a whole file")
        return None if value is None else int(value)

    def _member(self, group: h5py.Group, name: str) -> Any:
        """What lies in the file under that name; a link is not followed."""
        with damage(self.path):
            if not self.has(group, name):
                names = [member if member.isprintable() else repr(member) for member in sorted(group)]
                others = ", ".join(names[:_SHOWN]) + ", ..." * (len(names) > _SHOWN) or "nothing"
                missing = f"there is no {name!r} in {group.name}, only {others}"
                raise UserError(f"{self.path}: {missing}; supply a D4RL or Minari file")
            if group.id.links.get_info(name.encode()).type != _HARD:
                raise UserError(f"{self.path}: {name} is a link; {_COPY}")
            return group[name]

    def _check(self, name: str, data: h5py.Dataset) -> None:
        """Raises UserError for numbers of other files, filters that are not HDF5's own, and sizes that cannot be."""
        if data.is_virtual or data.external:
            raise UserError(f"{self.path}: {name} takes its numbers from other files; {_COPY}")
        about = data.id.get_create_plist()
        filters = [about.get_filter(i)[0] for i in range(about.get_nfilters())]
        packing = [code for code in filters if code not in _REORDERING]
        if len(packing) > 1 or not _PACKING.issuperset(packing):
            raise UserError(f"{self.path}: {name} is packed by the filters {filters}; pack it by gzip alone")
        chunk = math.prod(data.chunks) if data.chunks else 0
        self._claimed += math.prod(data.shape) * data.dtype.itemsize
        self._stored += data.id.get_storage_size()
        stored = min(self._stored, self.path.stat().st_size)  # the same numbers may have many names
        check_claim(self.path, self._claimed + chunk * data.dtype.itemsize, stored)


_COPY = "copy the numbers into the file, such as with h5repack"


@contextmanager
def opened(path: Path) -> Iterator[Reader]:
    """A plain file; raises UserError for what is none, or no HDF5."""
    check_plain(path)
    if not h5py.is_hdf5(path):
        raise UserError(f"{path}: is not an HDF5 file; supply the .hdf5 of D4RL or of Minari")
    with damage(path):
        content = h5py.File(path, "r")
    with content:
        yield Reader(path, content)
