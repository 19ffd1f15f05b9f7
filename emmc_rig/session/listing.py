"""Sessions at a glance, from their journals alone: no frame is read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.session.session import Session, is_session


@dataclass(frozen=True)
class Summary:
    """What a session says of itself."""

    name: str
    title: str
    created: str
    state: str
    stored: int
    planned: int
    bytes: int


def summary(session: Session) -> Summary:
    """Return a session's summary; raises AppError when it is damaged."""
    stored = session.stored
    if session.is_complete:
        state = "complete"
    elif session.journal.entries[-1]["kind"] == "stopped":
        state = "stopped"
    else:
        state = "unfinished"
    return Summary(
        session.folder.name,
        session.header["title"],
        session.header["created"],
        state,
        len(stored),
        session.created["frames"],
        sum(entry["bytes"] for entry in stored.values()),
    )


def sessions_in(folder: Path) -> Iterator[Summary]:
    """Yield the sessions in a folder by name, itself too where it is one; raises AppError."""
    try:
        candidates = [folder, *sorted(folder.iterdir())]
    except OSError as fault:
        raise AppError(f"{folder}: cannot be read ({fault.strerror})") from fault
    for one in candidates:
        if is_session(one):
            try:
                yield summary(Session(one))
            except AppError as fault:
                yield Summary(one.resolve().name, str(fault), "", "damaged", 0, 0, 0)
