"""A session as one page: what was captured, how long it took, and a small picture of each frame.

The page is one file that opens offline and asks for nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

import cv2

from emmc_rig.drivers.errors import DriverError
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.model.files import write_text
from emmc_rig.report.frame_view import AS_READ, Balance, preview, white_balance
from emmc_rig.report.page import (
    Card,
    Head,
    Section,
    data_address,
    fragment,
    framed,
    number,
    part,
    provenance_section,
    typed,
)
from emmc_rig.session.brightness import GOOD_LEVELS, exposure_reasons, shot_exposures, thinned
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.journal import DecidedEntry, FrameEntry, RetryEntry, ended, of_kind
from emmc_rig.session.planned import KINDS, PlannedFrame
from emmc_rig.session.session import REPORT, Session
from emmc_rig.session.verify import reconstructed
from emmc_rig.store.folders import result_folder
from emmc_rig.store.results import shown_bytes, write_metrics

LONGEST_PX, JPEG_QUALITY = 176, 80
MOST_PICTURES, FIRST_PICTURES = 200, 12
"""On the page, and of the shots without unfolding the rest."""
QUICK_BYTES = 1 << 30
PICTURE_PIXELS = 1 << 17
TONES = {"trust": "good", "doubt": "watch", "do not use": "bad"}
BOARDS = ("reference", "open")
"""Kinds of frames that show a whiteboard through the whole aperture."""
HEADINGS = {
    "dark": "Darks: the lamp is off",
    "metering": "Metering: the exposures are set by these",
    "reference": "References: whiteboard, open aperture, no masks",
    "whiteboard": "Whiteboards: the pinhole before each view",
    "open": "Open whiteboards: masks in, whole aperture",
    "held-out": "Validation: open whiteboards that test the calibration",
    "check": "Checks: whiteboards seen again, for lamp and response",
    "turned": "Turned board: the white board turned by 90 degrees and more",
    "shot": "Shots: the scene",
}


def write_sheet(session: Session, out: Path, pictures: int = MOST_PICTURES) -> None:
    """Write report.html and metrics.json into the session, or another folder; raises AppError."""
    own = Path(os.path.realpath(out)) == Path(os.path.realpath(session.folder))
    with result_folder(out, "session sheet", belongs_to=session.folder, adds=own) as folder:
        write_text(folder / REPORT, sheet(session, pictures))
        write_metrics(folder, session_metrics(session))


def quick_pictures(session: Session) -> int:
    """Return how many pictures can be made without reading more than QUICK_BYTES."""
    largest = max((entry.bytes for entry in session.stored.values()), default=1)
    return min(MOST_PICTURES, QUICK_BYTES // largest)


def sheet(session: Session, pictures: int = MOST_PICTURES) -> str:
    """Return the page; of more frames than `pictures` only some of each kind are shown."""
    sections = []
    taken = of_kind(session.journal.entries, DecidedEntry)
    if taken:
        body = _decisions(taken, ended(session.journal.entries))
        about = f"The accuracy estimated after each of {len(taken)} shots, and which came next."
        sections.append(Section("decisions", "Choice of shots", body, about=about))
    happened = list(events(session))
    body = part("facts", happened)
    sections += [
        *_frames(session, pictures),
        Section(
            "events", "Events", body, about=f"{len(happened)}: runs, retries, what was changed."
        ),
    ]
    sources = {
        "command": session.header["command"],
        **session.header["versions"],
        **{f"SHA-256 of {name}": digest for name, digest in session.digests.items()},
    }
    sections.append(provenance_section(sources))
    lead = part("cards", _cards(session))
    return framed(
        session.header["title"], [_about(session)], sections=sections, styles=["session.css"],
        lead=lead, head=_head(session),
    )  # fmt: skip


def _decisions(taken: Sequence[DecidedEntry], last: DecidedEntry | None) -> str:
    """Return the accuracy estimated after each shot as HTML, and which shot came next."""

    def numbers(shots: Sequence[int]) -> str:
        return ", ".join(str(shot + 1) for shot in shots)

    words = (
        "After each shot the light field was reconstructed; its own standard deviation, checked on "
        "validation readings, stands for the estimated accuracy."
    )
    if last is not None and last.spared:
        words += f" Of the plan, shots {numbers(last.spared)} were not needed."
    heads = ("Shots taken", "Estimated accuracy, dB", "Target, dB", "Next shot", "Why")
    rows = [
        (
            numbers(entry.shots),
            number(entry.stated_db, ".2f"),
            number(entry.target_db, "g"),
            "none" if entry.next is None else entry.next + 1,
            "; ".join(filter(None, (entry.why, entry.advice))),
        )
        for entry in taken
    ]
    return part("lead", words) + part("table", heads, rows)


def _head(session: Session) -> Head:
    """Return whether all is captured and well exposed, and the next command."""
    name = typed(session.folder)
    if missing := len(session.missing()):
        why = f"{missing} of {len(session.needed)} frames are missing"
        return Head(
            "This session is not complete", why, [f"go on with: `emmc-rig capture {name}`"], "watch"
        )
    reasons = exposure_reasons(shot_exposures(session))
    commands = [f"get the light field: `emmc-rig reconstruct {name}`"]
    if reconstructed(session.folder)[0]:
        commands = [f"look into the light field: `emmc-rig export {name}`"]
    elif any(frame.kind in BOARDS for frame in session.needed):
        commands.insert(0, f"measure Psi from the whiteboards: `emmc-rig calibrate {name}`")
    return Head(
        "This session is complete" + (", but" if reasons else ""),
        "; ".join(reason.what for reason in reasons) or "every frame is stored and verified",
        [*(reason.remedy for reason in reasons), *commands],
        "watch" if reasons else "good",
    )


def _about(session: Session) -> str:
    by = ""
    if session.first_run is not None:
        camera = session.first_run.camera
        by = f", by {camera['model'] or 'a camera'} {camera['serial']}".rstrip()
    return f"Session {session.folder.name}, begun {session.header['created']}{by}."


def _cards(session: Session) -> list[Card]:
    stored, planned = len(session.stored), len(session.needed)
    size = sum(entry.bytes for entry in session.stored.values())
    retries = len(of_kind(session.journal.entries, RetryEntry))
    note = f"{shown_bytes(size)}; good: all" + (f"; {retries} taken again" if retries else "")
    tone = "good" if session.is_complete else "watch"
    cards = [Card("Frames", f"{stored} of {planned}", note, tone)]
    if shots := shot_exposures(session):
        levels = [shot.level for shot in shots]
        reached = f"{min(levels):.0%}" + (f" to {max(levels):.0%}" if len(shots) > 1 else "")
        note = f"of white, the brightest readings of the shots; good: about {GOOD_LEVELS[0]:.0%}"
        tone = "watch" if exposure_reasons(shots) else "good"
        cards.append(Card("Exposure", reached, note, tone))
    verdict, stated_db = reconstructed(session.folder)
    if verdict:
        note = "" if stated_db is None else f"estimated accuracy {stated_db:.1f} dB"
        cards.append(Card("Light field", verdict, note, TONES.get(verdict, "")))
    if runs := run_times(session):
        last = runs[-1]
        note = f"the last run; {last['moving_s']:.1f} s moving, {last['exposing_s']:.1f} s exposing"
        cards.append(Card("Time", f"{last['seconds']:.1f} s", note))
    return cards


def run_times(session: Session) -> list[dict[str, float]]:
    """Return the frames of each run, and its seconds in all, moving, exposing and writing."""
    runs: dict[int, list[FrameEntry]] = {}
    for entry in of_kind(session.journal.entries, FrameEntry):
        if entry.spans_s:
            runs.setdefault(entry.run, []).append(entry)

    def times(entries: list[FrameEntry]) -> dict[str, float]:
        spans = [(name, *span) for entry in entries for name, span in entry.spans_s.items()]

        def spent(*names: str) -> float:
            return sum(end - start for name, start, end in spans if name in names)

        return {
            "frames": len(entries),
            "seconds": max(end for _, _, end in spans) - min(start for _, start, _ in spans),
            "moving_s": spent("move", "settle"),
            "exposing_s": spent("expose"),
            "writing_s": spent("write"),
        }

    return [times(entries) for entries in runs.values()]


def session_metrics(session: Session) -> dict[str, object]:
    """Return the figures of a session: frames, bytes, retries, and how its runs spent time."""
    entries, needed = session.journal.entries, session.needed
    return {
        "title": session.header["title"],
        "frames": len(needed),
        "spared": len(session.frames) - len(needed),
        "decided": [entry.model_dump(mode="json") for entry in of_kind(entries, DecidedEntry)],
        "stored": len(session.stored),
        "complete": session.is_complete,
        "bytes": sum(entry.bytes for entry in session.stored.values()),
        "exposures": [asdict(shot) for shot in shot_exposures(session)],
        "retries": len(of_kind(entries, RetryEntry)),
        "runs": run_times(session),
        "command": session.header["command"],
        "versions": session.header["versions"],
    }


def _frames(session: Session, pictures: int) -> Iterator[Section]:
    """Yield a section for each kind of frame; all but the shots of the scene are folded."""
    left, balance = pictures, _balance(session)
    for kind in reversed(KINDS):
        frames = [frame for frame in session.needed if frame.kind == kind]
        if not frames:
            continue
        # Frames are listed in the order of capture, which mixes shots and views.
        frames.sort(key=lambda f: (f.bench.shot, f.view or (), f.exposure_s or 0.0, f.repeat))
        shown = _chosen(frames, left)
        left -= len(shown)
        body = fragment(
            "session_frames.html",
            pictures=[_picture(session, frame, balance) for frame in shown],
            first=FIRST_PICTURES if kind == "shot" else len(shown),
            total=len(frames),
        )
        title, _, words = HEADINGS[kind].partition(": ")
        about = "" if kind == "shot" else f"{_count(session, frames)}, {words}."
        yield Section(kind, title, body, about=about)


def _count(session: Session, frames: Sequence[PlannedFrame]) -> str:
    """Return how many frames there are, and how many of them are missing."""
    missing = sum(frame.id not in session.stored for frame in frames)
    count = "1 frame" if len(frames) == 1 else f"{len(frames)} frames"
    return f"{count}, {missing} of them missing" if missing else count


def _chosen(frames: Sequence[PlannedFrame], most: int) -> list[PlannedFrame]:
    """Return at most `most` frames, evenly spread."""
    if len(frames) <= most:
        return list(frames)
    return [frames[i * len(frames) // max(most, 1)] for i in range(most)]


def _balance(session: Session) -> Balance:
    """Return the white balance of the first whiteboard under white light; AS_READ without any."""
    for planned in session.needed:
        entry = session.stored.get(planned.id)
        if entry and planned.kind in BOARDS and planned.bench.lamp == "white":
            with suppress(AppError, DriverError):
                return white_balance(decode_frame(session.read(planned.id), entry))
    return AS_READ


def _picture(session: Session, planned: PlannedFrame, balance: Balance) -> dict[str, object]:
    """Return a frame as the page shows it: its picture, or the reason for its absence."""
    entry = session.stored.get(planned.id)
    if entry is None:
        return {"id": planned.id, "why": "not captured"}
    try:
        picture = stored_jpeg(session, planned.id, balance)
        return {**entry.model_dump(), "why": "", "picture": data_address(picture, ".jpg")}
    except (AppError, DriverError) as fault:
        return {"id": planned.id, "why": str(fault)}


def stored_jpeg(session: Session, name: str, balance: Balance = AS_READ) -> bytes:
    """Return a small picture of a stored frame; raises AppError or a `DriverError`."""
    return small_jpeg(decode_frame(session.read(name), session.stored[name]), balance)


def small_jpeg(frame: RawFrame, balance: Balance = AS_READ) -> bytes:
    """Return a small picture of a frame, of whole colour tiles evenly spread over it."""
    picture = preview(replace(frame, mosaic=thinned(frame.mosaic, PICTURE_PIXELS)), balance)
    scale = LONGEST_PX / max(picture.shape[:2])
    size = [max(1, round(n * scale)) for n in picture.shape[1::-1]]
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def events(session: Session) -> Iterator[tuple[str, str]]:
    """Yield kind and text of what happened, besides frames that were taken."""
    for entry in session.journal.entries:
        if text := str(entry):
            yield entry.kind, text
    if session.journal.unreadable:
        yield "torn", f"damaged lines of the journal, not counted: {session.journal.unreadable}"
