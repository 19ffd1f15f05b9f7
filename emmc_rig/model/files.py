"""Files and folders that appear whole under their name, or not at all, and are on the disk then.

A file is written under another name beside its own, synced and renamed; then its folder is synced.
A session writes through a `Disk`: that of a test can lose its power between any two operations.
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

PART = ".part"
PLAIN_FILE = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
"""Flags of a file that is written: a link under its name leads the bytes elsewhere
(POSIX), and the line ends of a file of text are changed (Windows)."""


class Disk:
    """The computer's file system; every operation raises `OSError`."""

    def write(self, path: Path, data: bytes | memoryview) -> None:
        """Write a file, one of that name anew; its bytes are on the disk when this returns.

        Its name is when its folder is synced.
        """
        _write(path, data, os.O_TRUNC)

    def append(self, path: Path, data: bytes) -> None:
        """Write at the end of a file, made where missing; it is on the disk when this returns."""
        _write(path, data, os.O_APPEND)

    def read(self, path: Path) -> bytes:
        """Return the bytes of a file."""
        return path.read_bytes()

    def replace(self, source: Path, target: Path) -> None:
        """Rename a file or folder; a file of that name is replaced, at no moment missing."""
        os.replace(source, target)

    def remove(self, path: Path) -> None:
        """Remove a file, or a folder and what is in it; links are not followed."""
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()

    def make_folder(self, path: Path) -> None:
        """Make a folder, with its missing parents."""
        path.mkdir(parents=True, exist_ok=True)

    def sync(self, path: Path) -> None:
        """Return when the bytes of a file, or the names in a folder, are on the disk.

        Windows syncs files alone, those opened for writing; its file systems keep a journal of
        names.
        """
        if sys.platform == "win32" and path.is_dir():
            return
        descriptor = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
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


def _write(path: Path, data: bytes | memoryview, flags: int) -> None:
    descriptor = os.open(path, flags | os.O_WRONLY | os.O_CREAT | PLAIN_FILE, 0o666)
    try:
        left = memoryview(data).cast("B")
        while left:
            left = left[os.write(descriptor, left) :]
        _sync(descriptor)
    finally:
        os.close(descriptor)


def part_of(path: Path) -> Path:
    """Return a temporary name for a file before it takes its own; each call returns another."""
    return path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}{PART}")


def is_part(name: str) -> bool:
    """Return whether a name is one that `part_of` gives."""
    return name.startswith(".") and name.endswith(PART)


def is_abandoned(name: str) -> bool:
    """Return whether no program on this computer writes a part any more."""
    writer = re.search(rf"\.(\d+)-[0-9a-f]+{re.escape(PART)}$", name)
    return is_part(name) and (writer is None or not is_running(int(writer[1])))


def is_running(process: int) -> bool:
    """Return whether another process of that number runs."""
    import psutil  # `os.kill(process, 0)` would end the process on Windows

    return 0 < process < 2**31 and process != os.getpid() and psutil.pid_exists(process)


@contextmanager
def whole(path: Path, disk: Disk = SYSTEM_DISK) -> Iterator[Path]:
    """Yield another name beside `path`; the file or folder made there takes the name at the end.

    A file of that name is replaced. What is made must be synced when the block ends; the name is on
    the disk after it. After an error nothing is left. Raises OSError.
    """
    part = part_of(path)
    try:
        yield part
        disk.replace(part, path)
    except BaseException:
        with suppress(OSError):
            disk.remove(part)
        raise
    disk.sync(path.parent)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield another name beside `path`; the file written there takes the name, on the disk.

    A file of that name is replaced. After an error nothing is left. Raises OSError.
    """
    with whole(path) as part:
        yield part
        SYSTEM_DISK.sync(part)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside `path`, which takes the name with all files in it, on the disk.

    A file or folder of that name is replaced. After an error nothing is left. Raises OSError.
    """
    with whole(path) as part:
        part.mkdir()
        yield part
        for inside in (*part.rglob("*"), part):
            SYSTEM_DISK.sync(inside)
        if path.exists():
            SYSTEM_DISK.remove(path)


def write_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8), whole or not at all; raises OSError."""
    write_whole(SYSTEM_DISK, path, text.encode())


def write_whole(disk: Disk, path: Path, data: bytes | memoryview) -> None:
    """Write a file: on the disk under its name when this returns, or not at all.

    A file of that name is replaced. Raises `OSError`; what was begun is then cleared away.
    """
    with whole(path, disk) as part:
        disk.write(part, data)


def make_folder_whole(disk: Disk, folder: Path, files: Mapping[str, bytes]) -> None:
    """Make a folder with its files, whole or not at all; a name that ends with / is a folder.

    Raises `OSError`, with nothing left. The folder must not exist.
    """
    _make_synced(disk, folder.parent)
    with whole(folder, disk) as part:
        disk.make_folder(part)
        for name, data in files.items():
            if name.endswith("/"):
                disk.make_folder(part / name)
            else:
                disk.write(part / name, data)
        disk.sync(part)


def _make_synced(disk: Disk, folder: Path) -> None:
    """Make a folder with its missing parents, and sync their names."""
    try:
        disk.sizes(folder)
    except FileNotFoundError:
        _make_synced(disk, folder.parent)
        disk.make_folder(folder)
        disk.sync(folder.parent)
