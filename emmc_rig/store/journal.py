"""Journals: files of lines that are only ever appended to, each on the disk once it is added.

A line that a crash tore is closed before the next line is added, which stays readable.
"""

from __future__ import annotations

from pathlib import Path

from emmc_rig.model.files import SYSTEM_DISK, Disk


class Lines:
    """The lines of a journal file, as it was opened, and a way to add a line."""

    def __init__(self, path: Path, disk: Disk = SYSTEM_DISK) -> None:
        """Read the file; raises `OSError`."""
        self._disk, self._path = disk, path
        data = disk.read(path)
        self._torn = bool(data) and not data.endswith(b"\n")
        self.lines = [line for line in data.split(b"\n") if line]

    def append(self, line: bytes) -> None:
        """Add a line, which ends with its newline: it is on the disk when this returns.

        Raises `OSError`.
        """
        start, self._torn = (b"\n" if self._torn else b""), True
        self._disk.append(self._path, start + line)
        self._torn = False
