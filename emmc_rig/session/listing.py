"""Sessions at a glance, and which of many are meant: no frame is read.

What a session holds comes from the heads of its journal lines, how far its light field is to be
trusted from the figures that `reconstruct` left in it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.files.folders import is_session, refuse_missing
from emmc_rig.files.results import METRICS
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.reading import read_yaml
from emmc_rig.session.exposure import shot_exposures
from emmc_rig.session.journal import count_stored, ended, found_complete, heads, kinds_of, metered
from emmc_rig.session.session import (
    HEADER,
    JOURNAL,
    LISTED,
    PLAN,
    RECONSTRUCTION,
    Session,
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


@dataclass(frozen=True)
class Wanted:
    """Which sessions are meant; what is None or "" is not asked for.

    camera: a part of its name. since, before: the day, as 2026-11-22, or the beginning of one.
    least_db: of the PSNR stated.
    """

    camera: str = ""
    since: str = ""
    before: str = ""
    verdict: str = ""
    least_db: float | None = None

    def fits(self, one: Summary) -> bool:
        """Return whether a session is meant."""
        return (
            self.camera.lower() in one.camera.lower()
            and (not self.since or one.created[: len(self.since)] >= self.since)
            and (not self.before or one.created[: len(self.before)] < self.before)
            and (not self.verdict or one.verdict == self.verdict)
            and (self.least_db is None or (one.stated_db or -1e9) >= self.least_db)
        )


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


def compared(ones: Sequence[Session]) -> list[tuple[str, list[str]]]:
    """Return what two or more sessions say of themselves where they differ: name, and each one's.

    Raises AppError for a session that cannot be read.
    """
    rows = [_described(one) for one in ones]
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = [(name, [row.get(name, "") for row in rows]) for name in names]
    return [(name, values) for name, values in table if len(set(values)) > 1]


def _described(session: Session) -> dict[str, str]:
    """Return figures and settings of a session, by names for people."""
    listed = summary(session.folder)
    shots = shot_exposures(session)
    exposures_s = sorted(
        {
            float(session.stored[frame.id]["exposure_s"])
            for frame in session.needed
            if frame.kind == "shot" and frame.id in session.stored
        }
    )
    retries = len(kinds_of(session.journal.entries, "retry"))
    return {
        "begun": listed.created,
        "state": listed.state,
        "frames": f"{listed.stored} of {listed.planned}",
        "retries": str(retries),
        "exposures of shots, s": ", ".join(f"{one:.3g}" for one in exposures_s),
        "brightest readings, of white": ", ".join(f"{one.level:.0%}" for one in shots),
        "verdict": listed.verdict or "not reconstructed",
        "PSNR stated, dB": "" if listed.stated_db is None else f"{listed.stated_db:.2f}",
        **_flat(session.rig, "rig"),
        **_flat(session.plan_data() or {}, "plan"),
    }


def _flat(data: object, name: str) -> dict[str, str]:
    """Return plain data with the path to each value as its name."""
    if isinstance(data, dict):
        parts = [_flat(value, f"{name}.{key}") for key, value in data.items()]
    elif isinstance(data, list):
        parts = [_flat(value, f"{name}.{place}") for place, value in enumerate(data)]
    else:
        return {name: str(data)}
    return {key: value for part in parts for key, value in part.items()}
