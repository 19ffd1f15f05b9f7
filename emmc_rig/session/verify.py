"""State of sessions: verified against the journal, or at a glance without reading a frame.

Verification hashes every file and repairs nothing. Files are read by a few threads: reading and
SHA-256 both let others run, so the slower of disk and processor sets the pace. The verdict on a
session's light field comes from the figures that `reconstruct` left in the session.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.progress import Watcher
from emmc_rig.session.journal import FrameEntry, dropped
from emmc_rig.session.session import Session
from emmc_rig.store.folders import SESSION_RECONSTRUCTION, is_session, refuse_missing
from emmc_rig.store.result_files import read_metrics

THREADS = min(8, os.cpu_count() or 1)


@dataclass(frozen=True)
class Verdict:
    """What became of a session.

    planned: frames of the plan, without spared shots and dropped frames of a film. missing: frames
    not captured yet. damaged: by id, what is wrong. frozen: files that were changed since the
    session began. unreadable: journal lines torn or damaged. leftovers, foreign: files that do not
    count, relative to the session.
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
    dropped: int = 0

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
            yield f"not needed: {self.spared} more of the planned frames"
        if self.dropped:
            yield f"dropped from the film: {self.dropped} of its frames, named in the journal"
        if self.unreadable:
            yield f"damaged lines of the journal, whose frames do not count: {self.unreadable}"
        if self.leftovers:
            yield f"left over from a crash, not counted: {', '.join(self.leftovers)}"
        for name in self.foreign:
            yield f"{name}: not part of this session"


def verify_frames(
    session: Session, entries: Iterable[FrameEntry], watcher: Watcher | None = None
) -> dict[str, str]:
    """Return, by id, what is wrong with the files of journal lines; nothing for good ones."""
    step = (watcher or Watcher()).step

    def fault_of(entry: FrameEntry) -> tuple[str, str]:
        fault = _fault(session, entry)
        step(entry.id)
        return entry.id, fault

    with ThreadPoolExecutor(THREADS, "verify") as pool:
        return {name: fault for name, fault in pool.map(fault_of, entries) if fault}


def _fault(session: Session, entry: FrameEntry) -> str:
    try:
        data = session.disk.read(session.path_of(entry))
    except FileNotFoundError:
        return f"{entry.file} is gone"
    except OSError as fault:
        return f"{entry.file} cannot be read ({fault.strerror})"
    if len(data) != entry.bytes:
        return f"{entry.file} has {len(data)} bytes instead of {entry.bytes}"
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        return f"{entry.file} is damaged: its SHA-256 is not the journal's"
    return ""


def verify(session: Session, watcher: Watcher | None = None) -> Verdict:
    """Return what became of a session; raises AppError when its plan cannot be read at all."""
    frozen = []
    for name in session.digests:
        try:
            session.frozen_file(name)
        except AppError as fault:
            frozen.append(str(fault))
    planned = {frame.id for frame in session.needed}
    stored = {name: entry for name, entry in session.stored.items() if name in planned}
    damaged = verify_frames(session, stored.values(), watcher)
    leftovers, foreign = session.unexpected_files()
    gone = len(dropped(session.journal.entries))
    return Verdict(
        planned=len(planned),
        good=len(stored) - len(damaged),
        missing=tuple(frame.id for frame in session.missing()),
        damaged=damaged,
        frozen=tuple(frozen),
        unreadable=session.journal.unreadable,
        leftovers=tuple(leftovers),
        foreign=tuple(foreign),
        spared=len(session.frames) - len(planned) - gone,
        dropped=gone,
    )


def counts(session: Session) -> dict[str, tuple[int, int]]:
    """Return, by kind of frame, how many are stored and how many are needed."""
    needed = session.needed
    planned = Counter(frame.kind for frame in needed)
    stored = Counter(frame.kind for frame in needed if frame.id in session.stored)
    return {kind: (stored[kind], planned[kind]) for kind in planned}


@dataclass(frozen=True)
class Summary:
    """What a session says of itself; planned: frames, but those that the scene did not need.

    camera: as its plan names it. verdict, stated_db: of its light field; "" and None for a session
    that is not reconstructed, and None for a method without a stated PSNR. folder: of the session.
    """

    name: str
    title: str
    created: str
    state: str
    stored: int
    planned: int
    bytes: int
    camera: str = ""
    verdict: str = ""
    stated_db: float | None = None
    folder: Path = Path()


def summary(session: Session) -> Summary:
    """Return a session's summary; raises AppError when it cannot be read."""
    header, last = session.header, session.journal.entries[-1]
    stopped = "stopped" if last.kind == "stopped" else "unfinished"
    plan = session.plan_data()
    verdict, stated_db = reconstructed(session.folder)
    return Summary(
        session.folder.name,
        header["title"],
        header["created"],
        "complete" if session.is_complete else stopped,
        len(session.stored),
        len(session.needed),
        sum(entry.bytes for entry in session.stored.values()),
        str(plan.get("camera", "")) if isinstance(plan, dict) else "",
        verdict,
        stated_db,
        session.folder,
    )


def reconstructed(session: Path) -> tuple[str, float | None]:
    """Return verdict and stated PSNR of its reconstruction, "" and None where there is none."""
    try:
        read = read_metrics(session / SESSION_RECONSTRUCTION)
        stated_db = read.get("stated_db")
        return str(read["verdict"]["level"]), None if stated_db is None else float(stated_db)
    except (ValueError, KeyError, TypeError, AppError):
        return "", None


def sessions_in(folder: Path) -> Iterator[Summary]:
    """Yield the sessions in a folder, at any depth, by name; the folder itself may be a session.

    Hidden folders, and what lies in sessions, are passed over. Raises AppError.
    """
    refuse_missing(folder, "name a folder that holds sessions")
    try:
        next(folder.iterdir(), None)
    except OSError as fault:
        raise AppError(f"{folder}: cannot be read ({fault.strerror})") from fault
    for place, below, _ in os.walk(folder):
        below[:] = sorted(name for name in below if not name.startswith("."))
        found = Path(place)
        if not is_session(found):
            continue
        below.clear()
        try:
            yield summary(Session(found))
        except AppError as fault:
            yield Summary(found.resolve().name, str(fault), "", "damaged", 0, 0, 0, folder=found)
