"""A session as one page: what was captured, how long it took, and a small picture of each frame.

The page is one file that opens offline and asks for nothing.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path

import cv2

from drivers.errors import DriverError
from emmc_rig.errors import AppError
from emmc_rig.files.results import metrics_text, shown_bytes
from emmc_rig.pages.frame_view import preview, thinned
from emmc_rig.pages.page import Section, framed, provenance_table, table_head, text
from emmc_rig.pages.timeline import (
    COLOURS,
    LEGEND,
    SHOWN_FRAMES,
    overlap,
    run_entries,
    session_metrics,
    timeline_svg,
)
from emmc_rig.session.decisions import decided_words, decisions, ended
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.journal import Entry
from emmc_rig.session.planned import KINDS, PlannedFrame
from emmc_rig.session.session import METRICS, Session
from emmc_rig.session.storage import write_whole
from emmc_rig.session.verify import counts

LONGEST_PX, JPEG_QUALITY = 176, 80
MOST_PICTURES = 200
QUICK_BYTES = 1 << 30
PICTURE_PIXELS = 1 << 17
HEADINGS = {
    "dark": "Darks",
    "metering": "Metering",
    "reference": "References: whiteboard, open aperture, no masks",
    "whiteboard": "Whiteboards: the pinhole before each view",
    "open": "Open whiteboards: masks in, whole aperture",
    "held-out": "Held out: open whiteboards that judge the calibration",
    "shot": "Shots of the scene",
}


def write_sheet(session: Session, path: Path, pictures: int = MOST_PICTURES) -> None:
    """Write the page, and metrics.json beside it, each whole or not at all; raises AppError."""
    page = sheet(session, pictures)
    figures = metrics_text(session_metrics(session))
    try:
        write_whole(session.disk, path.with_name(METRICS), figures.encode())
        write_whole(session.disk, path, page.encode())
    except OSError as fault:
        raise AppError(f"{path}: cannot be written ({fault.strerror})") from fault


def quick_pictures(session: Session) -> int:
    """Return how many pictures can be made without reading more than QUICK_BYTES."""
    largest = max((entry["bytes"] for entry in session.stored.values()), default=1)
    return min(MOST_PICTURES, QUICK_BYTES // largest)


def sheet(session: Session, pictures: int = MOST_PICTURES) -> str:
    """Return the page; of more frames than `pictures` only some of each kind are shown."""
    sections = [*_frames(session, pictures), ("timeline", "Timeline", _timeline(session))]
    if decisions(session.journal.entries):
        sections.append(("decisions", "Shots: what they gave, and which was next", _shots(session)))
    sections.append(("events", "Events", _events(session)))
    sections.append(("provenance", "Provenance", _provenance(session)))
    style = resources.files("emmc_rig.pages").joinpath("session.css").read_text("utf-8")
    return framed(
        session.header["title"],
        [_about(session)],
        (),
        [Section(key, name.partition(":")[0], name, body) for key, name, body in sections],
        style,
        lead=f'<div class="cards">{"".join(_cards(session))}</div>',
    )


def _about(session: Session) -> str:
    camera = next((e["camera"] for e in session.journal.entries if e["kind"] == "run"), None)
    by = (
        ""
        if camera is None
        else f", by {camera['model'] or 'a camera'} {camera['serial']}".rstrip()
    )
    return f"Session {session.folder.name}, begun {session.header['created']}{by}."


def _cards(session: Session) -> Iterator[str]:
    stored, planned = len(session.stored), len(session.needed)
    tone, state = ("good", "complete") if session.is_complete else ("watch", "not complete")
    yield _card(
        tone, "State", state, "every frame verified" if session.is_complete else "resume it"
    )
    yield _card("", "Frames", f"{stored} of {planned}", _kinds(session))
    size = sum(entry["bytes"] for entry in session.stored.values())
    yield _card("", "Size", shown_bytes(size), "the camera's own bytes")
    retries = sum(entry["kind"] == "retry" for entry in session.journal.entries)
    yield _card("watch" if retries else "", "Retries", str(retries), f"in {session.runs} run(s)")
    runs = run_entries(session.journal.entries)
    if runs:
        last = overlap(runs[-1])
        yield _card(
            "",
            "Hidden writing",
            f"{last.hidden_share:.0%}",
            f"of {last.writing_s:.1f} s of hashing and writing, while the bench worked",
        )


def _card(tone: str, name: str, value: str, note: str) -> str:
    return (
        f'<div class="card {tone}"><h3>{text(name)}</h3><p class="value">{text(value)}</p>'
        f'<p class="note">{text(note)}</p></div>'
    )


def _kinds(session: Session) -> str:
    return ", ".join(f"{done} {kind}" for kind, (done, _) in counts(session).items())


def _frames(session: Session, pictures: int) -> Iterator[tuple[str, str, str]]:
    """Yield a section for each kind of frame; shots of the scene get the most room."""
    left = pictures
    for kind in reversed(KINDS):
        frames = sorted((f for f in session.needed if f.kind == kind), key=_place_in_plan)
        if not frames:
            continue
        shown = _chosen(frames, left)
        left -= len(shown)
        more = (
            ""
            if len(shown) == len(frames)
            else f'<p class="quiet">{len(shown)} of {len(frames)} are shown.</p>'
        )
        body = "".join(_picture(session, frame) for frame in shown)
        yield kind, HEADINGS[kind], f'<div class="sheet">{body}</div>{more}'


def _place_in_plan(frame: PlannedFrame) -> tuple:
    """Return what frames are shown in the order of: they were taken in another one."""
    return frame.bench.shot, frame.view or (), frame.exposure_s or 0.0, frame.repeat


def _chosen(frames: Sequence[PlannedFrame], most: int) -> list[PlannedFrame]:
    """Return at most `most` frames, evenly spread."""
    if len(frames) <= most:
        return list(frames)
    return [frames[i * len(frames) // max(most, 1)] for i in range(most)]


def _picture(session: Session, planned: PlannedFrame) -> str:
    entry = session.stored.get(planned.id)
    if entry is None:
        return _absent(planned, "not captured")
    try:
        data = _jpeg(session, planned, entry)
    except (AppError, DriverError) as fault:
        return _absent(planned, str(fault))
    figures = entry["figures"]
    saturated = f", {figures['saturated']:.1%} saturated" if figures["saturated"] >= 0.001 else ""
    return (
        f'<figure><img src="data:image/jpeg;base64,{data}" alt="{text(planned.id)}">'
        f"<figcaption><strong>{text(planned.id)}</strong><br>{entry['exposure_s']:.4g} s"
        f"{saturated}</figcaption></figure>"
    )


def _absent(planned: PlannedFrame, why: str) -> str:
    return (
        f'<figure class="absent"><p>{text(why)}</p>'
        f"<figcaption>{text(planned.id)}</figcaption></figure>"
    )


def _jpeg(session: Session, planned: PlannedFrame, entry: Entry) -> str:
    frame = decode_frame(session.read(planned.id), entry)
    picture = preview(replace(frame, mosaic=thinned(frame.mosaic, PICTURE_PIXELS)))
    scale = LONGEST_PX / max(picture.shape[:2])
    size = [max(1, round(n * scale)) for n in picture.shape[1::-1]]
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return base64.b64encode(
        cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    ).decode()


def _timeline(session: Session) -> str:
    runs = run_entries(session.journal.entries)
    if not runs:
        return '<p class="lead">No frame was taken yet.</p>'
    longest = max(runs, key=len)
    told = overlap(longest)
    run = longest[0]["run"]
    decided = [one for one in decisions(session.journal.entries) if one["run"] == run]
    legend = "".join(
        f'<li><i style="background:{COLOURS[name]}"></i>{text(meaning)}</li>'
        for name, meaning in LEGEND.items()
        if decided or name != "decide"
    )
    # Shots, and what is decided between them, come last.
    shown = longest[-SHOWN_FRAMES:] if decided else longest[:SHOWN_FRAMES]
    which = "last" if decided else "first"
    return (
        f'<p class="lead">Run {run}, its {which} {len(shown)} of {len(longest)} frames. '
        f"In all {told.seconds:.1f} s: {told.moving_s:.1f} s moving and settling, "
        f"{told.exposing_s:.1f} s exposing and downloading, {told.writing_s:.1f} s hashing and "
        f"writing, of which {told.hidden_share:.0%} while the bench worked.</p>"
        f'<ul class="legend">{legend}</ul>'
        f'<div class="scroll">{timeline_svg(shown, decided)}</div>'
    )


def _shots(session: Session) -> str:
    """Return a table of what was decided after each shot."""
    rows = "".join(
        f"<tr><td>{text(', '.join(map(str, one['shots'])))}</td>"
        f"<td>{one['stated_db']:.2f}</td><td>{one['target_db']:g}</td>"
        f"<td>{text('none' if one['next'] is None else one['next'])}</td>"
        f"<td>{text('; '.join(filter(None, (one['why'], one['advice']))))}</td></tr>"
        for one in decisions(session.journal.entries)
    )
    names = ("shots taken", "stated PSNR, dB", "wanted, dB", "next shot", "why")
    last = ended(session.journal.entries)
    spared = (
        f" Of the plan, shots {', '.join(map(str, last['spared']))} were not needed."
        if last is not None and last["spared"]
        else ""
    )
    return (
        '<p class="lead">After each shot the light field was reconstructed; its own standard '
        "deviation, checked on readings kept from the fit, stands for the PSNR stated. Shots count "
        f"from 0, as in the plan.{spared}</p>"
        f"<table>{table_head(names)}<tbody>{rows}</tbody></table>"
    )


def events(session: Session) -> Iterator[tuple[str, str]]:
    """Yield kind and text of what happened, besides frames that were taken."""
    for entry in session.journal.entries:
        told = _told(entry)
        if told:
            yield entry["kind"], told
    if session.journal.unreadable:
        yield "torn", f"{session.journal.unreadable} journal line(s) do not count"


def _events(session: Session) -> str:
    rows = "".join(
        f'<tr><th scope="row">{text(kind)}</th><td>{text(told)}</td></tr>'
        for kind, told in events(session)
    )
    return f'<table class="narrow"><tbody>{rows}</tbody></table>'


def _told(entry: Entry) -> str:
    """Return what an entry that is no frame says, "" for a frame."""
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
    if kind == "decided":
        return decided_words(entry)
    if kind == "amended":
        return f"{entry['wall']}: plan {entry['plan']} holds: {'; '.join(entry['changes'])}"
    return f"{entry['wall']}: every frame verified" if kind == "complete" else ""


def _provenance(session: Session) -> str:
    rows = {
        "command": session.header["command"],
        **session.header["versions"],
        **{f"SHA-256 of {name}": digest for name, digest in session.digests.items()},
    }
    return provenance_table(rows)
