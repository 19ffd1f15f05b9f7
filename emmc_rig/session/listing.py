"""Sessions at a glance, from the heads of their journal lines: no frame is read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.files.folders import is_session
from emmc_rig.model.reading import parse_json
from emmc_rig.session.decisions import ended, metered
from emmc_rig.session.journal import heads
from emmc_rig.session.session import HEADER, JOURNAL, count_stored, found_complete


@dataclass(frozen=True)
class Summary:
    """What a session says of itself; planned: frames, but those that the scene did not need."""

    name: str
    title: str
    created: str
    state: str
    stored: int
    planned: int
    bytes: int


def summary(folder: Path) -> Summary:
    """Return a session's summary; raises AppError when it cannot be read."""
    try:
        entries = heads((folder / JOURNAL).read_bytes())
        header = parse_json((folder / HEADER).read_bytes(), str(folder / HEADER), AppError)
        title, created = str(header["title"]), str(header["created"])
    except OSError as fault:
        raise AppError(f"{folder}: no session, or not readable ({fault.strerror})") from fault
    except (ValueError, KeyError, TypeError) as fault:
        raise AppError(f"{folder / HEADER}: is damaged; restore it from a copy") from fault
    if not entries or entries[0]["kind"] != "created":
        raise AppError(f"{folder / JOURNAL}: its first line is damaged; restore it from a copy")
    if found_complete(entries):
        state = "complete"
    else:
        state = "stopped" if entries[-1]["kind"] == "stopped" else "unfinished"
    stored = count_stored(entries)
    size = sum(entry["bytes"] for entry in stored.values())
    name = folder.resolve().name
    last = ended(entries)
    begun = next(e for e in reversed(entries) if e["kind"] in ("created", "amended"))
    planned = begun["frames"] - (0 if last is None else last["spared_frames"])
    asked = metered(entries)
    planned += 0 if asked is None else len(asked["asked"])
    return Summary(name, title, created, state, len(stored), planned, size)


def sessions_in(folder: Path) -> Iterator[Summary]:
    """Yield the sessions in a folder by name, itself too where it is one; raises AppError."""
    try:
        candidates = [folder, *sorted(folder.iterdir())]
    except OSError as fault:
        raise AppError(f"{folder}: cannot be read ({fault.strerror})") from fault
    for one in candidates:
        if is_session(one):
            try:
                yield summary(one)
            except AppError as fault:
                yield Summary(one.resolve().name, str(fault), "", "damaged", 0, 0, 0)
