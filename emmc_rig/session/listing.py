"""Sessions at a glance: no frame is read.

How far a light field is to be trusted comes from the figures that `reconstruct` left in a session.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.session.session import Session
from emmc_rig.store.folders import SESSION_RECONSTRUCTION, is_session, refuse_missing
from emmc_rig.store.result_files import read_metrics


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
