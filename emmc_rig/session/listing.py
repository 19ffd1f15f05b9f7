"""Sessions at a glance: no frame is read.

What a session holds comes from the heads of its journal lines, how far its light field is to be
trusted from the figures that `reconstruct` left in it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.files.folders import is_session, refuse_missing
from emmc_rig.files.results import METRICS
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.reading import read_yaml
from emmc_rig.session.journal import count_stored, ended, found_complete, heads, metered
from emmc_rig.session.session import (
    HEADER,
    JOURNAL,
    LISTED,
    PLAN,
    RECONSTRUCTION,
)


@dataclass(frozen=True)
class Summary:
    """What a session says of itself; planned: frames, but those that the scene did not need.

    camera: as its plan names it. verdict, stated_db: of the light field that lies in it, "" and
    None without one, or where the method states no PSNR. folder: where it lies.
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


def summary(folder: Path) -> Summary:
    """Return a session's summary; raises AppError when it cannot be read."""
    refuse_missing(folder, LISTED)
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
    verdict, stated_db = reconstructed(folder)
    return Summary(
        name,
        title,
        created,
        state,
        len(stored),
        planned,
        size,
        _camera_name(folder / PLAN),
        verdict,
        stated_db,
        folder,
    )


def _camera_name(plan: Path) -> str:
    """Return which camera a plan is for, "" where it cannot be read."""
    try:
        read = read_yaml(plan, AppError)
    except AppError:
        return ""
    return str(read.get("camera", "")) if isinstance(read, dict) else ""


def reconstructed(session: Path) -> tuple[str, float | None]:
    """Return verdict and stated PSNR of its reconstruction, "" and None where there is none."""
    metrics = session / RECONSTRUCTION / METRICS
    try:
        read = parse_json(metrics.read_bytes(), str(metrics), AppError)
        stated_db = read.get("stated_db")
        return str(read["verdict"]["level"]), None if stated_db is None else float(stated_db)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, AppError):
        return "", None


def sessions_in(folder: Path) -> Iterator[Summary]:
    """Yield the sessions in a folder and below it by name, itself too where it is one.

    Hidden folders, and what lies in sessions, are passed over. Raises AppError.
    """
    refuse_missing(folder, "`emmc-rig capture PLAN` makes sessions")
    try:
        next(folder.iterdir(), None)
    except OSError as fault:
        raise AppError(f"{folder}: cannot be read ({fault.strerror})") from fault
    for place, below, _ in os.walk(folder):
        below[:] = sorted(name for name in below if not name.startswith("."))
        one = Path(place)
        if not is_session(one):
            continue
        below.clear()
        try:
            yield summary(one)
        except AppError as fault:
            yield Summary(one.resolve().name, str(fault), "", "damaged", 0, 0, 0, folder=one)


