"""The journal of a session: one checked JSON line for each thing that happened, only ever appended.

A line is on the disk when `append` returns. A line that a crash tore, or whose checksum is wrong,
counts as never written: its step is done again.

This module alone knows the kinds of entries and what they mean together:

| kind | says |
|---|---|
| `created`, `amended` | the plan that holds from here on: digests of its files |
| `run` | a capture was started: versions, command, devices |
| `frame`, `discarded` | a frame is stored; it no longer counts |
| `metered` | by what `exposures_s` each shot is taken, which longer frames are `asked` for |
| `until` | from now on the wanted PSNR is `target_db` |
| `decided` | what of `shots` is stated; `next` to take, or which are `spared` and `why` |
| `paused`, `resumed`, `retry`, `registered`, `refused`, `stopped`, `complete` | how a run went |

After an amendment of the plan metering and shots are decided anew.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from emmc_rig.files.results import shown_seconds
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


def kinds_of(entries: Iterable[Entry], kind: str) -> list[Entry]:
    """Return the entries of a kind, oldest first."""
    return [entry for entry in entries if entry["kind"] == kind]


def camera_of_first_run(entries: Iterable[Entry]) -> Mapping[str, Any] | None:
    """Return what the first run says of its camera; None before any run."""
    runs = kinds_of(entries, "run")
    return runs[0]["camera"] if runs else None


def count_stored(entries: Iterable[Entry]) -> dict[str, Entry]:
    """Return the journal line of every frame that counts, by its id, oldest first."""
    found: dict[str, Entry] = {}
    for entry in entries:
        count_entry(found, entry)
    return found


def count_entry(found: dict[str, Entry], entry: Entry) -> None:
    """Let an entry count among the journal lines of the frames that are stored."""
    if entry["kind"] == "frame":
        found[entry["id"]] = entry
    elif entry["kind"] == "discarded":
        found.pop(entry["id"], None)


def found_complete(entries: Sequence[Entry]) -> bool:
    """Return whether every frame was found good after the last one was stored."""
    for entry in reversed(entries):
        if entry["kind"] in ("complete", "frame", "discarded", "amended"):
            return entry["kind"] == "complete"
    return False


def wanted_db(entries: Sequence[Entry], begun_with: float | None) -> float | None:
    """Return the PSNR at which no further shot is taken; None where all are.

    begun_with: what the session was begun with.
    """
    last = next((entry for entry in reversed(entries) if entry["kind"] == "until"), None)
    return begun_with if last is None else last["target_db"]


def decisions(entries: Iterable[Entry]) -> list[Entry]:
    """Return what was decided, oldest first."""
    return kinds_of(entries, "decided")


def ended(entries: Sequence[Entry]) -> Entry | None:
    """Return the decision that no more shots are needed; None while there is none, or no longer."""
    for entry in reversed(entries):
        if entry["kind"] in ("decided", "until", "amended"):
            return entry if entry.get("next", 0) is None else None
    return None


def spared_shots(entries: Sequence[Entry]) -> frozenset[int]:
    """Return the shots that need not be taken."""
    last = ended(entries)
    return frozenset(() if last is None else last["spared"])


def metered(entries: Sequence[Entry]) -> Entry | None:
    """Return what metering of the scene asks for; None while that is open."""
    for entry in reversed(entries):
        if entry["kind"] in ("metered", "amended"):
            return entry if entry["kind"] == "metered" else None
    return None


def metered_words(entry: Entry) -> str:
    """Return what metering asks for, for people."""
    by_exposure: dict[float, list[str]] = {}
    for shot, exposure_s in entry["exposures_s"].items():
        by_exposure.setdefault(exposure_s, []).append(shot)
    exposures = ", ".join(
        f"shots {', '.join(shots)} by {exposure_s:.3g} s"
        for exposure_s, shots in by_exposure.items()
    )
    longer = f"; {len(entry['asked'])} longer frames, for the dark parts" if entry["asked"] else ""
    return f"metered: {exposures}{longer}"


def decided_words(entry: Entry) -> str:
    """Return a decision for people."""
    taken = ", ".join(str(shot) for shot in entry["shots"])
    stated = f"shots {taken}: {entry['stated_db']:.2f} dB stated, {entry['target_db']:g} wanted"
    if entry["next"] is None:
        spared = f", {len(entry['spared'])} shots spared" if entry["spared"] else ""
        return f"{stated}; no more, {entry['why']}{spared}"
    return f"{stated}; next shot {entry['next']}, {entry['why']}"


def entry_text(entry: Entry) -> str:
    """Return what an entry that is no frame says, for people; "" for a frame."""
    kind = entry["kind"]
    if kind == "run":
        return f"{entry['wall']}: {entry['command']}"
    if kind == "retry":
        return f"{entry['id']}, try {entry['attempt']}: {entry['fault']}"
    if kind == "discarded":
        return f"{entry['id']}: {entry['reason']}"
    if kind in ("registered", "refused"):
        return (
            f"{entry['id']} taken again: shifted by ({entry['x_px']:+.3f}, {entry['y_px']:+.3f}) "
            f"px, likeness {entry['likeness']:.3f}"
        )
    if kind == "stopped":
        return f"{entry['wall']}: {entry['reason']}"
    if kind == "until":
        return f"{entry['wall']}: shots are taken until {entry['target_db']:g} dB are stated"
    if kind == "paused":
        return f"{entry['wall']}: {entry['reason']}"
    if kind == "resumed":
        return f"{entry['wall']}: after {shown_seconds(entry['seconds'])}"
    if kind == "decided":
        return decided_words(entry)
    if kind == "metered":
        return metered_words(entry)
    if kind == "amended":
        return f"{entry['wall']}: plan {entry['plan']} holds: {'; '.join(entry['changes'])}"
    return f"{entry['wall']}: every frame verified" if kind == "complete" else ""
