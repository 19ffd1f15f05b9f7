"""Verification of a session against its journal: every file is hashed, nothing is repaired.

Files are read in large pieces by a few threads: reading and SHA-256 both let others run, so the
slower of disk and processor sets the pace.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.session.journal import Entry
from emmc_rig.session.session import Session
from emmc_rig.session.storage import Disk

PIECE_BYTES = 1 << 20
THREADS = min(8, os.cpu_count() or 1)


@dataclass(frozen=True)
class FrameVerdict:
    """What became of one frame; `fault` is "" for a good one."""

    id: str
    fault: str


@dataclass(frozen=True)
class Verdict:
    """What became of a session.

    planned: frames, but for `spared` ones that the scene was found not to need. missing: frames not
    captured yet. damaged: by id, what is wrong. frozen: files that were
    changed since the session began. unreadable: journal lines torn or damaged.
    leftovers, foreign: files that do not count, relative to the session.
    """

    planned: int
    good: int
    missing: tuple[str, ...]
    damaged: dict[str, str] = field(default_factory=dict)
    frozen: tuple[str, ...] = ()
    unreadable: int = 0
    leftovers: tuple[str, ...] = ()
    foreign: tuple[str, ...] = ()
    spared: int = 0

    @property
    def is_complete(self) -> bool:
        """Whether every planned frame is there and good, and the plan is the one begun with."""
        return self.good == self.planned and not self.frozen

    def lines(self) -> Iterator[str]:
        """Yield what there is to say, worst first."""
        yield from self.frozen
        for name, fault in self.damaged.items():
            yield f"{name}: {fault}"
        if self.missing:
            shown = ", ".join(self.missing[:5]) + (", ..." if len(self.missing) > 5 else "")
            yield f"{len(self.missing)} of {self.planned} frames not captured yet: {shown}"
        if self.spared:
            yield f"{self.spared} more frame(s) planned, which the scene did not need"
        if self.unreadable:
            yield f"{self.unreadable} journal line(s) torn or damaged; their frames do not count"
        if self.leftovers:
            count = len(self.leftovers)
            yield f"{count} leftover(s) of a crash; `emmc-rig session prune` removes them"
        for name in self.foreign:
            yield f"{name}: not of this session, left alone"


def digest_file(disk: Disk, path: Path, buffer: bytearray) -> tuple[int, str]:
    """Return size and SHA-256 of a file, read into `buffer` piece by piece; raises `OSError`."""
    digest, size = hashlib.sha256(), 0
    view = memoryview(buffer)
    with disk.reader(path) as file:
        while count := file.readinto(buffer):  # type: ignore[attr-defined]
            digest.update(view[:count])
            size += count
    return size, digest.hexdigest()


def verify_frames(
    session: Session,
    entries: Iterable[Entry],
    on_frame: Callable[[str], None] = lambda frame_id: None,
    threads: int = THREADS,
) -> dict[str, str]:
    """Return, by id, what is wrong with the files of journal lines; nothing for good ones."""

    def check(part: list[Entry]) -> list[FrameVerdict]:
        buffer, verdicts = bytearray(PIECE_BYTES), []
        for entry in part:
            verdicts.append(FrameVerdict(entry["id"], _fault(session, entry, buffer)))
            on_frame(entry["id"])
        return verdicts

    rows = list(entries)
    parts = [rows[i::threads] for i in range(min(threads, len(rows)))]
    if len(parts) < 2:
        verdicts = check(rows)
    else:
        with ThreadPoolExecutor(len(parts), "verify") as pool:
            verdicts = [one for part in pool.map(check, parts) for one in part]
    return {one.id: one.fault for one in verdicts if one.fault}


def _fault(session: Session, entry: Entry, buffer: bytearray) -> str:
    try:
        size, digest = digest_file(session.disk, session.path_of(entry), buffer)
    except FileNotFoundError:
        return f"{entry['file']} is gone"
    except OSError as fault:
        return f"{entry['file']} cannot be read ({fault.strerror})"
    if size != entry["bytes"]:
        return f"{entry['file']} has {size} bytes instead of {entry['bytes']}"
    if digest != entry["sha256"]:
        return f"{entry['file']} is damaged: its SHA-256 is not the journal's"
    return ""


def verify(
    session: Session,
    on_frame: Callable[[str], None] = lambda frame_id: None,
    threads: int = THREADS,
) -> Verdict:
    """Return what became of a session; raises AppError when its plan cannot be read at all."""
    frozen = []
    for name in session.digests:
        try:
            session.frozen_file(name)
        except AppError as fault:
            frozen.append(str(fault))
    planned = {frame.id for frame in session.needed}
    stored = {name: entry for name, entry in session.stored.items() if name in planned}
    damaged = verify_frames(session, stored.values(), on_frame, threads)
    leftovers, foreign = session.unexpected_files()
    return Verdict(
        planned=len(planned),
        good=len(stored) - len(damaged),
        missing=tuple(frame.id for frame in session.missing()),
        damaged=damaged,
        frozen=tuple(frozen),
        unreadable=session.journal.unreadable,
        leftovers=tuple(leftovers),
        foreign=tuple(foreign),
        spared=len(session.frames) - len(planned),
    )


def counts(session: Session) -> dict[str, tuple[int, int]]:
    """Return, by kind of frame, how many are stored and how many are needed."""
    needed = session.needed
    planned = Counter(frame.kind for frame in needed)
    stored = Counter(frame.kind for frame in needed if frame.id in session.stored)
    return {kind: (stored[kind], planned[kind]) for kind in planned}
