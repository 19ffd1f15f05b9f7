"""Files that are on the disk when a call returns: the only way in which a session is written.

A file appears under its name whole or not at all: it is written under another name, synced,
renamed, and its folder synced. Everything goes through a `Disk`, so that one in a test can lose its
power between any two operations.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import sys
from collections.abc import Mapping
from contextlib import suppress
from io import BytesIO, FileIO
from pathlib import Path

from emmc_rig.files.lock_file import is_running

PART = ".part"


class OpenFile:
    """A file that is being written; what was not synced may be lost."""

    def __init__(self, path: Path, flags: int) -> None:
        flags |= os.O_WRONLY | os.O_CREAT | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
        # A link under the name would lead the bytes out of the session.
        self._descriptor = os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)

    def write(self, data: bytes | memoryview) -> None:
        """Write all of `data` at the end."""
        left = memoryview(data).cast("B")
        while left:
            left = left[os.write(self._descriptor, left) :]

    def sync(self) -> None:
        """Return when everything written is on the disk."""
        _sync(self._descriptor)

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._descriptor)


class Disk:
    """The computer's file system; every operation raises `OSError`."""

    def create(self, path: Path) -> OpenFile:
        """Begin an empty file; one of that name is emptied."""
        return OpenFile(path, os.O_TRUNC)

    def append(self, path: Path) -> OpenFile:
        """Begin to write at the end of a file, made where missing."""
        return OpenFile(path, os.O_APPEND)

    def reader(self, path: Path) -> FileIO | BytesIO:
        """Open a file for reading."""
        return open(path, "rb", buffering=0)

    def replace(self, source: Path, target: Path) -> None:
        """Rename a file or folder; a file of that name is replaced, at no moment missing."""
        os.replace(source, target)

    def remove(self, path: Path) -> None:
        """Remove a file."""
        os.remove(path)

    def make_folder(self, path: Path) -> None:
        """Make a folder and those above it; one that is there already is left alone."""
        path.mkdir(parents=True, exist_ok=True)

    def remove_folder(self, path: Path) -> None:
        """Remove a folder and what is in it."""
        shutil.rmtree(path)

    def sync_folder(self, path: Path) -> None:
        """Return when the names in a folder are on the disk; Windows cannot say."""
        if os.name == "nt":
            return
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0))
        try:
            _sync(descriptor)
        finally:
            os.close(descriptor)

    def sizes(self, folder: Path) -> dict[str, int]:
        """Return the size of everything in a folder by name, -1 for anything but a plain file."""
        with os.scandir(folder) as entries:
            return {
                entry.name: entry.stat().st_size if entry.is_file(follow_symlinks=False) else -1
                for entry in entries
            }

    def free_bytes(self, folder: Path) -> int:
        """Return how much more this user can write."""
        return shutil.disk_usage(folder).free


SYSTEM_DISK = Disk()


def _sync(descriptor: int) -> None:
    if sys.platform == "darwin":
        import fcntl

        # There fsync leaves the bytes in the drive's own cache.
        with suppress(OSError):
            fcntl.fcntl(descriptor, fcntl.F_FULLFSYNC)
            return
    os.fsync(descriptor)


def part_of(path: Path) -> Path:
    """Return the name under which a file is written before it takes its own, another each time."""
    return path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}{PART}")


def is_part(name: str) -> bool:
    """Return whether a name is one that `part_of` gives."""
    return name.startswith(".") and name.endswith(PART)


def is_abandoned(name: str) -> bool:
    """Return whether no program on this computer writes a part any more."""
    writer = re.search(rf"\.(\d+)-[0-9a-f]+{re.escape(PART)}$", name)
    return is_part(name) and (writer is None or not is_running(int(writer[1])))


def write_whole(disk: Disk, path: Path, data: bytes | memoryview) -> None:
    """Write a file: on the disk under its name when this returns, or not at all.

    A file of that name is replaced. Raises `OSError`; what was begun is then cleared away.
    """
    part = part_of(path)
    try:
        write_synced(disk, part, data)
        disk.replace(part, path)
    except OSError:
        with suppress(OSError):
            disk.remove(part)
        raise
    disk.sync_folder(path.parent)


def write_synced(disk: Disk, path: Path, data: bytes | memoryview) -> None:
    """Write a file and its bytes to the disk; its name is not there before a `sync_folder`."""
    file = disk.create(path)
    try:
        file.write(data)
        file.sync()
    finally:
        file.close()


def read_whole(disk: Disk, path: Path) -> bytes:
    """Return the bytes of a file; raises `OSError`."""
    with disk.reader(path) as file:
        return file.read()


def make_folder_whole(disk: Disk, folder: Path, files: Mapping[str, bytes]) -> None:
    """Make a folder with files in it, all of it or nothing; a name in `files` may end with /.

    Raises `OSError`, with nothing left; the folder must not be there.
    """
    part = part_of(folder)
    try:
        _make_synced(disk, folder.parent)
        disk.make_folder(part)
        for name, data in files.items():
            if name.endswith("/"):
                disk.make_folder(part / name)
            else:
                write_synced(disk, part / name, data)
        disk.sync_folder(part)
        disk.replace(part, folder)
    except OSError:
        with suppress(OSError):
            disk.remove_folder(part)
        raise
    disk.sync_folder(folder.parent)


def _make_synced(disk: Disk, folder: Path) -> None:
    """Make a folder and those above it, with their names on the disk."""
    try:
        disk.sizes(folder)
    except FileNotFoundError:
        _make_synced(disk, folder.parent)
        disk.make_folder(folder)
        disk.sync_folder(folder.parent)
