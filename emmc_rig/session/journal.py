"""The journal of a session: one checked JSON line for each thing that happened, only ever appended.

A line is on the disk when `append` returns. A line that a crash tore, or whose checksum is wrong,
counts as never written: its step is done again.
"""

from __future__ import annotations

import json
import re
import zlib
from pathlib import Path
from typing import Any

from emmc_rig.model.json_text import parse_json
from emmc_rig.session.storage import Disk, read_whole

Entry = dict[str, Any]
NEEDED: dict[str, dict[str, type]] = {
    "created": {"sha256": dict, "frames": int},
    "amended": {"sha256": dict, "frames": int},
    "frame": {"id": str, "file": str, "bytes": int, "sha256": str},
    "discarded": {"id": str},
    "metered": {"exposures_s": dict, "asked": list},
    "decided": {"shots": list, "spared": list, "spared_frames": int},
}
"""What a line of a kind holds at least, and of which type: one without it counts as damaged."""
_CHECK = ',"crc32":"'
_TAIL_CHARACTERS = len(_CHECK) + len('01234567"}')
_FRAME_HEAD = re.compile(rb'\{"kind":"frame","id":"[^"\\]*","file":"[^"\\]*","bytes":\d+')


def encode_line(entry: Entry) -> bytes:
    """Return a line with its newline; raises `ValueError` for what JSON cannot say."""
    body = json.dumps(entry, separators=(",", ":"), allow_nan=False)[:-1]
    return f'{body}{_CHECK}{zlib.crc32(body.encode()):08x}"}}\n'.encode()


def decode_line(line: bytes) -> Entry | None:
    """Return the entry in a line without its newline; None for one that is torn or damaged."""
    body = _checked(line)
    entry = None if body is None else _decoded(body)
    return entry if entry is not None and _whole(entry) else None


def _whole(entry: Entry) -> bool:
    """Whether an entry holds what every reader of its kind takes from it."""
    return all(
        isinstance(entry.get(name), kind) for name, kind in NEEDED.get(entry["kind"], {}).items()
    )


def _checked(line: bytes) -> bytes | None:
    """Return the line before its checksum, None where that is wrong."""
    cut = len(line) - _TAIL_CHARACTERS
    body, tail = line[:cut], line[cut:]
    right = cut > 0 and tail == b'%s%08x"}' % (_CHECK.encode(), zlib.crc32(body))
    return body if right else None


def _decoded(body: bytes) -> Entry | None:
    try:
        entry = parse_json(body + b"}", "an entry", ValueError)
    except ValueError:
        return None
    return entry if isinstance(entry, dict) and isinstance(entry.get("kind"), str) else None


def heads(data: bytes) -> list[Entry]:
    """Return the entries of a journal, of a frame only kind, id, file and bytes.

    Ten times as fast as decoding all of them; what is torn or damaged is left out.
    """
    found = []
    for line in data.split(b"\n"):
        body = _checked(line)
        if body is None:
            continue
        head = _FRAME_HEAD.match(body)
        entry = _decoded(body if head is None else head[0])
        if entry is not None and (head is not None or _whole(entry)):
            found.append(entry)
    return found


class Journal:
    """The entries of a journal file, oldest first, and a way to add one.

    unreadable: how many lines were torn or damaged.
    """

    def __init__(self, disk: Disk, path: Path) -> None:
        """Read the file; raises `OSError`."""
        self._disk, self._path = disk, path
        data = read_whole(disk, path)
        self._torn = bool(data) and not data.endswith(b"\n")
        decoded = [decode_line(line) for line in data.split(b"\n") if line]
        self.entries: list[Entry] = [entry for entry in decoded if entry is not None]
        self.unreadable = len(decoded) - len(self.entries)

    def append(self, entry: Entry) -> None:
        """Add an entry: it is on the disk when this returns. Raises `OSError`."""
        line = encode_line(entry)
        # A torn line is closed first, so that it cannot swallow this one.
        start, self._torn = (b"\n" if self._torn else b""), True
        file = self._disk.append(self._path)
        try:
            file.write(start + line)
            file.sync()
        finally:
            file.close()
        self._torn = False
        self.entries.append(entry)
