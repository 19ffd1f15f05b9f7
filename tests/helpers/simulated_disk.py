"""A disk in memory that can lose its power, fill up or fail between any two operations.

What a real disk promises is kept, and nothing more: bytes are there after a power cut once their
file was synced, names once their folder was. Unsynced bytes and names survive whole, in part, or
not at all: `after_power_cut` draws such an outcome. Changes of a folder's names survive in their
order, as on a journaling file system; the bytes of a file that grew may read as zeros.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from emmc_rig.model.files import Disk


class PowerCutError(BaseException):
    """A power cut. Programs that catch every `Exception` must not catch it."""


@dataclass(eq=False)
class _File:
    """A file: bytes as programs read them, and bytes on the platter."""

    data: bytearray = field(default_factory=bytearray)
    synced: bytes = b""


@dataclass(eq=False)
class _Folder:
    """Names as programs see them, those on the platter, and the changes between, in order."""

    entries: dict[str, _File | _Folder] = field(default_factory=dict)
    synced: dict[str, _File | _Folder] = field(default_factory=dict)
    pending: list[dict[str, _File | _Folder | None]] = field(default_factory=list)

    def change(self, names: dict[str, _File | _Folder | None]) -> None:
        """Give names to something, or take them away (None), all at once."""
        _apply(self.entries, names)
        self.pending.append(names)

    def sync(self) -> None:
        """Put the names on the platter."""
        self.synced = dict(self.entries)
        self.pending.clear()


def _apply(entries: dict[str, _File | _Folder], names: dict[str, _File | _Folder | None]) -> None:
    for name, node in names.items():
        if node is None:
            entries.pop(name, None)
        else:
            entries[name] = node


class SimulatedDisk(Disk):
    """A `Disk` in memory.

    before: called before every operation that writes, with its number and name; the operation
    raises the same exception. capacity_bytes: a larger write ends in `ENOSPC`, half written.
    """

    def __init__(
        self,
        before: Callable[[int, str], None] = lambda number, name: None,
        capacity_bytes: float = float("inf"),
    ) -> None:
        self.before = before
        self.capacity_bytes = capacity_bytes
        self.operations = 0
        self._root = _Folder()

    def cut_power_at(self, number: int) -> None:
        """Lose the power at an operation: that operation and later ones raise `PowerCutError`."""

        def before(now: int, name: str) -> None:
            if now >= number:
                raise PowerCutError

        self.before = before

    def after_power_cut(self, rng: np.random.Generator) -> SimulatedDisk:
        """Return a disk after a power cut, with contents drawn from the possible ones."""
        survived = SimulatedDisk(capacity_bytes=self.capacity_bytes)
        survived._root = _survivor(self._root, rng)
        return survived

    def write(self, path: Path, data: bytes | memoryview) -> None:
        """Write a file, one of that name anew, and put its bytes on the platter."""
        self._grow(self.create(path), data)

    def append(self, path: Path, data: bytes) -> None:
        """Write at the end of a file, made where missing, and put its bytes on the platter."""
        there = self._folder(path.parent).entries.get(path.name)
        self._grow(there if isinstance(there, _File) else self.create(path), data)

    def create(self, path: Path) -> _File:
        """Begin an empty file; an existing file of that name is emptied."""
        self._operate("create")
        folder = self._folder(path.parent)
        there = folder.entries.get(path.name)
        if isinstance(there, _Folder):
            raise _fault(errno.EISDIR)
        if isinstance(there, _File):
            del there.data[:]
            return there
        file = _File()
        folder.change({path.name: file})
        return file

    def _grow(self, file: _File, data: bytes | memoryview) -> None:
        """Add bytes, half of them when the power goes meanwhile or the disk is full; sync them."""
        half = len(data) // 2
        full = self.free_bytes(Path("/")) < len(data)
        try:
            self._operate("write")
            if full:
                raise _fault(errno.ENOSPC)
        except BaseException:
            file.data += data[:half]
            raise
        file.data += data
        self._operate("sync")
        file.synced = bytes(file.data)

    def read(self, path: Path) -> bytes:
        """Return the bytes of a file."""
        node = self._folder(path.parent).entries.get(path.name)
        if not isinstance(node, _File):
            raise _fault(errno.ENOENT if node is None else errno.EISDIR)
        return bytes(node.data)

    def replace(self, source: Path, target: Path) -> None:
        """Rename within a folder, replacing at once what has the name."""
        self._operate("replace")
        if source.parent != target.parent:
            raise ValueError("only names of one folder are replaced at once")
        folder = self._folder(source.parent)
        if source.name not in folder.entries:
            raise _fault(errno.ENOENT)
        if isinstance(there := folder.entries.get(target.name), _Folder) and there.entries:
            raise _fault(errno.ENOTEMPTY)
        folder.change({source.name: None, target.name: folder.entries[source.name]})

    def remove(self, path: Path) -> None:
        """Remove a file, or a folder and what is in it."""
        self._operate("remove")
        folder = self._folder(path.parent)
        if path.name not in folder.entries:
            raise _fault(errno.ENOENT)
        folder.change({path.name: None})

    def make_folder(self, path: Path) -> None:
        """Make a folder and those above it."""
        above = self._root
        for name in path.parts[1:]:
            node = above.entries.get(name)
            if node is None:
                self._operate("make folder")
                node = _Folder()
                above.change({name: node})
            if not isinstance(node, _Folder):
                raise _fault(errno.ENOTDIR)
            above = node

    def sync(self, path: Path) -> None:
        """Put the names in a folder on the platter."""
        self._operate("sync folder")
        self._folder(path).sync()

    def sizes(self, folder: Path) -> dict[str, int]:
        """Return the size of everything in a folder by name, -1 for a folder."""
        return {
            name: len(node.data) if isinstance(node, _File) else -1
            for name, node in self._folder(folder).entries.items()
        }

    def free_bytes(self, folder: Path) -> int:
        """Return how much more can be written."""
        return int(min(self.capacity_bytes - self.used_bytes, 1 << 60))

    @property
    def used_bytes(self) -> int:
        """How much is on it."""
        return _bytes_in(self._root)

    def _operate(self, name: str) -> None:
        self.operations += 1
        self.before(self.operations, name)

    def _folder(self, path: Path) -> _Folder:
        node: _File | _Folder | None = self._root
        for name in path.parts[1:]:
            node = node.entries.get(name) if isinstance(node, _Folder) else None
            if node is None:
                raise _fault(errno.ENOENT)
        if not isinstance(node, _Folder):
            raise _fault(errno.ENOTDIR)
        return node


def _survivor(node: _Folder, rng: np.random.Generator) -> _Folder:
    names = dict(node.synced)
    for change in node.pending[: rng.integers(len(node.pending) + 1)]:
        _apply(names, change)
    kept: dict[str, _File | _Folder] = {}
    for name, child in names.items():
        if isinstance(child, _Folder):
            kept[name] = _survivor(child, rng)
        else:
            data = _surviving_bytes(child, rng)
            kept[name] = _File(bytearray(data), data)
    return _Folder(kept, dict(kept))


def _surviving_bytes(file: _File, rng: np.random.Generator) -> bytes:
    """Return what may be read of a file: the synced bytes, and any part of what was not."""
    now, synced = bytes(file.data), file.synced
    if now == synced:
        return synced
    if not now.startswith(synced):
        # It was emptied and written again, without a sync: either, or nothing.
        return (synced, now[: rng.integers(len(now) + 1)], b"")[rng.integers(3)]
    kept = now[: rng.integers(len(synced), len(now) + 1)]
    zeros = bytes(len(now) - len(kept))
    return (synced, kept, kept + zeros, now)[rng.integers(4)]


def _bytes_in(folder: _Folder) -> int:
    return sum(
        len(node.data) if isinstance(node, _File) else _bytes_in(node)
        for node in folder.entries.values()
    )


def _fault(number: int) -> OSError:
    return OSError(number, os.strerror(number))
