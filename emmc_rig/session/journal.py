"""The journal of a session: one checked JSON line for each thing that happened, only ever appended.

A line is on the disk when `append` returns. A line that a crash tore, or whose checksum is wrong,
counts as never written: its step is done again.

This module alone knows the content of lines, a class for each kind, and their joint meaning. Fields
that are newer than version 0.2 have defaults, for journals of that version. After an amendment of
the plan metering and shots are decided anew.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict

from emmc_rig.model.files import Disk
from emmc_rig.model.json_text import parse_json
from emmc_rig.store.journal import Lines
from emmc_rig.store.results import shown_seconds


@dataclass(frozen=True)
class Figures:
    """How bright a frame is, by some ten thousand of its pixels."""

    saturated: float
    """Share of the pixels, from 0 to 1."""
    mean_dn: float
    """Mean above black, DN."""
    bright_dn: float
    """99.9th percentile above black, DN, without hot pixels."""
    median_dn: float = 0.0
    """Median above black, DN."""


class Entry(BaseModel):
    """A line of the journal; as text what it says for people beside the frames, "" for nothing.

    One of a kind that only later programs know says nothing.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")
    kind: str

    def __str__(self) -> str:
        return ""


class TimedEntry(Entry):
    """An entry that says when it was noted."""

    wall: str = ""
    """Time of day, ISO 8601, to the millisecond."""


class CreatedEntry(Entry):
    """The session was begun."""

    kind: Literal["created"] = "created"
    format: int = 1
    """Version of the session's format."""
    sha256: dict[str, str]
    """SHA-256 of each frozen file, hexadecimal, by name."""
    frames: int
    """Number of frames that are taken whatever metering asks for."""


class AmendedEntry(TimedEntry):
    """Another plan holds from here on."""

    kind: Literal["amended"] = "amended"
    plan: int
    """Number of the amendment, from 1."""
    sha256: dict[str, str]
    """SHA-256 of each file of the amendment, hexadecimal, by name."""
    frames: int
    """Number of frames that the plan takes whatever metering asks for."""
    kept: int = 0
    """Number of frames stored by then."""
    changes: list[str] = []
    """Differences of the plans, in words."""

    def __str__(self) -> str:
        return f"{self.wall}: plan {self.plan} holds: {'; '.join(self.changes)}"


class RunEntry(TimedEntry):
    """A capture was started, on these devices."""

    kind: Literal["run"] = "run"
    versions: dict[str, Any] = {}
    """Versions of this program and its libraries."""
    command: str = ""
    resumed: bool = False
    """Whether frames were stored before."""
    camera: dict[str, Any]
    """Maker, model, serial number, shape (rows, columns) and colour filters."""
    camera_settings: dict[str, Any] = {}
    stage: dict[str, Any] = {}
    """By axis: identity, limits_um, speed_um_s and zero_um."""
    lights: dict[str, Any] = {}
    """Name and colours of what switches the lamp; {}: a person."""
    environment: dict[str, str] = {}
    """Units of what is read beside the frames, by name."""
    between: dict[str, str] = {}
    """The plan's hook: its name, file and the file's SHA-256."""

    def __str__(self) -> str:
        return f"{self.wall}: {self.command}"


class ImportedEntry(TimedEntry):
    """The frames are of files that another program wrote."""

    kind: Literal["imported"] = "imported"
    files: dict[str, str]
    """SHA-256 of each file, hexadecimal, by path."""
    notes: list[str] = []
    """Assumptions for values that no file states, in words."""

    def __str__(self) -> str:
        return "; ".join((f"{self.wall}: {len(self.files)} files imported", *self.notes))


class FrameEntry(Entry):
    """A frame is stored."""

    kind: Literal["frame"] = "frame"
    id: str
    file: str
    """Name in the session's folder of frames."""
    bytes: int
    """Size of the file."""
    sha256: str
    """Of the file, hexadecimal."""
    run: int = 0
    """Number of the run that took it, from 1."""
    plan: int = 0
    """Number of the amendment that it was taken by; 0: the plan that the session began with."""
    shape: tuple[int, int]
    """Rows and columns, pixels."""
    cfa: str
    """Colour filters of the first 2x2 pixels, row by row: "rggb"."""
    black_level_dn: list[list[float]]
    """Black level, DN, of each place in the tile of colour filters."""
    white_level_dn: int
    """Reading of a saturated pixel, DN."""
    exposure_s: float
    """As the camera states it, s."""
    gain: float
    """A factor, 1 at the camera's lowest."""
    camera_time_s: float | None = None
    """On the camera's clock, s; None where the camera states no time."""
    host_time_s: float | None = None
    """When the frame arrived, on this computer's clock, s; of an imported frame its time."""
    metadata: dict[str, Any] = {}
    """What else the camera states with the frame."""
    camera_sha256: str | None = None
    """Of the camera's own bytes, where `file` is a DNG of the mosaic that holds them."""
    lamp: str = ""
    """Colour of the lamp, or "off"."""
    lamp_read: str = ""
    """What the lights confirmed when they were last set; "" where a person switches the lamp."""
    commanded_um: dict[str, float] = {}
    """Planned place of each axis, um from its zero."""
    read_um: dict[str, float] = {}
    """Reading of each axis, um from its zero; of an axis moved by hand its place in the frame."""
    deviation_um: dict[str, float] = {}
    """Standard deviation, um, of the place of each axis moved by hand."""
    figures: Figures
    triggered: bool = False
    attempts: int = 1
    """Number of tries that the frame took."""
    wall: str = ""
    """When its exposure was asked for, time of day, ISO 8601."""
    monotonic_s: float | None = None
    """When its exposure was asked for, on the clock of the rig, s."""
    stands_um: dict[str, float] = {}
    """Reading, um, of each axis of the stage that no plan moves."""
    temperatures_c: dict[str, float] = {}
    """Of stage and camera, degrees Celsius."""
    environment: dict[str, float] = {}
    """Readings of other sources, in the units that the run's line has."""
    segment: int | None = None
    """Of a film's frame: its segment, see `FilmEntry`."""
    film_s: float | None = None
    """Of a film's frame: when it was exposed, s from the first frame of its segment."""
    film_clock: Literal["", "camera", "host"] = ""
    """Clock of `film_s`: the camera's, or this computer's; "" before version 0.4."""
    spans_s: dict[str, tuple[float, float]] = {}
    """Begin and end of each step, s from the begin of the run."""

    @property
    def black_dn(self) -> float:
        """Mean black level."""
        return sum(map(sum, self.black_level_dn)) / sum(map(len, self.black_level_dn))

    @property
    def level(self) -> float:
        """Its brightest readings, 1 at white."""
        return self.figures.bright_dn / (self.white_level_dn - self.black_dn)


class DiscardedEntry(Entry):
    """A frame no longer counts."""

    kind: Literal["discarded"] = "discarded"
    id: str
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.id}: {self.reason}"


class MeteredEntry(TimedEntry):
    """The scene was metered."""

    kind: Literal["metered"] = "metered"
    exposures_s: dict[int, float]
    """Exposure of each metered shot, s, by its number."""
    asked: list[str]
    """Ids of the longer frames of brackets that the scene needs."""

    def __str__(self) -> str:
        by_exposure: dict[float, list[str]] = {}
        for shot, exposure_s in self.exposures_s.items():
            by_exposure.setdefault(exposure_s, []).append(str(shot + 1))
        exposures = ", ".join(
            f"shot{'s' * (len(shots) > 1)} {', '.join(shots)} exposure {exposure_s:.3g} s"
            for exposure_s, shots in by_exposure.items()
        )
        longer = f"; longer frames for the dark parts: {len(self.asked)}" if self.asked else ""
        return f"{exposures}{longer}"


class UntilEntry(TimedEntry):
    """From here on shots are taken until this PSNR is stated."""

    kind: Literal["until"] = "until"
    target_db: float
    """PSNR, dB."""

    def __str__(self) -> str:
        return f"{self.wall}: shots are taken until the estimated accuracy is {self.target_db:g} dB"


class DecidedEntry(TimedEntry):
    """The accuracy that the shots so far give, and which shot follows."""

    kind: Literal["decided"] = "decided"
    run: int = 0
    """Number of the run, from 1."""
    shots: list[int]
    """Shots taken so far, from 0."""
    stated_db: float
    """Estimated PSNR of their light field, dB."""
    target_db: float
    """PSNR that was asked for, dB."""
    next: int | None
    """Shot to take next; None where no more are needed."""
    why: str = ""
    expected_db: dict[int, float] = {}
    """Expected PSNR with each further shot, dB, which earlier versions noted."""
    spared: list[int]
    """Planned shots that are not needed."""
    spared_frames: int
    """Number of their frames."""
    method: str = ""
    """Method of reconstruction."""
    advice: str = ""
    spans_s: dict[str, tuple[float, float]] = {}
    """Begin and end of the decision, s from the begin of the run."""

    def __str__(self) -> str:
        taken = ", ".join(str(shot + 1) for shot in self.shots)
        stated = (
            f"shot{'s' * (len(self.shots) > 1)} {taken}: estimated accuracy {self.stated_db:.2f} "
            f"dB, target {self.target_db:g} dB"
        )
        if self.next is None:
            spared = f", shots not needed: {len(self.spared)}" if self.spared else ""
            return f"{stated}; done, {self.why}{spared}"
        return f"{stated}; next shot {self.next + 1}{f', {self.why}' if self.why else ''}"


class HaltEntry(TimedEntry):
    """The capture waits, or a run ended before all was taken."""

    kind: Literal["paused", "stopped"]
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.wall}: {self.reason}"


class ResumedEntry(TimedEntry):
    """It goes on."""

    kind: Literal["resumed"] = "resumed"
    seconds: float
    """How long it waited, s."""

    def __str__(self) -> str:
        return f"{self.wall}: after {shown_seconds(self.seconds)}"


class RetryEntry(Entry):
    """A fault, met by another try."""

    kind: Literal["retry"] = "retry"
    id: str
    """Of the frame; "home" for homing."""
    fault: str
    attempt: int
    """Number of the fault among those in a row, from 1."""
    at_s: float = 0.0
    """Seconds from the begin of the run."""

    def __str__(self) -> str:
        return f"{self.id}, attempt {self.attempt}: {self.fault}"


class ComparedEntry(Entry):
    """A frame was taken again before going on: the bench is unchanged, or capture is refused."""

    kind: Literal["registered", "refused"]
    id: str
    x_px: float
    """Shift to the right, px."""
    y_px: float
    """Shift downwards, px."""
    likeness: float
    """Correlation with the stored frame, at most 1."""
    limit_px: float = 0.0
    """Largest shift that is allowed, px."""

    def __str__(self) -> str:
        return (
            f"{self.id} captured again: shifted by ({self.x_px:+.3f}, {self.y_px:+.3f}) px, "
            f"correlation {self.likeness:.3f}"
        )


class HookEntry(TimedEntry):
    """The plan's hook was called."""

    kind: Literal["hook"] = "hook"
    id: str = ""
    """Of the frame that follows; "" after the last frame."""
    name: str = ""
    """As the plan names the hook."""
    notes: dict[str, Any] = {}
    """What the hook noted."""
    fault: str = ""
    """What ended the capture there; "" where nothing did."""
    at_s: float = 0.0
    """Begin, s from the begin of the run."""
    seconds: float = 0.0
    """Duration, s."""

    def __str__(self) -> str:
        when = f"before {self.id}" if self.id else "after the last frame"
        return f"{self.wall}: {self.name}, {when}: {self.fault}" if self.fault else ""


class FocusEntry(TimedEntry):
    """The focus axis was brought to where the scene is sharpest."""

    kind: Literal["focus"] = "focus"
    id: str
    """Of the frame that follows."""
    from_um: float
    """Position before, um; where no peak was seen the axis is there again."""
    place_um: float | None = None
    """Position where the scene is sharpest, um; None where no peak was seen."""
    deviation_um: float | None = None
    """Standard deviation of `place_um`, um."""
    fault: str = ""
    """Why no peak was seen; "" where it was."""
    at_s: float = 0.0
    """Begin, s from the begin of the run."""
    seconds: float = 0.0
    """Duration, s."""

    def __str__(self) -> str:
        if self.place_um is None:
            return f"before {self.id}: not focused, {self.fault}"
        found = f"{self.place_um:.1f} um, to {self.deviation_um:.1f} um"
        return f"before {self.id}: sharpest at {found}; it stood at {self.from_um:.1f} um"


class SourceEntry(TimedEntry):
    """A source of the rig's environment failed, or gives values again."""

    kind: Literal["source"] = "source"
    name: str
    fault: str = ""
    """"" where it gives values again."""

    def __str__(self) -> str:
        return f"{self.wall}: {self.name}: {self.fault or 'gives values again'}"


class FilmEntry(TimedEntry):
    """A segment of a film begins: time goes on within it without a break.

    The first begins with the film, the next after each interruption, in which the scene may have
    changed.
    """

    kind: Literal["film"] = "film"
    segment: int
    """Number of the segment, from 0."""
    id: str
    """Of its first frame."""
    rate_hz: float
    """Frames per second."""

    def __str__(self) -> str:
        return f"{self.wall}: film, segment {self.segment + 1} begins with {self.id}"


class DroppedEntry(TimedEntry):
    """Frames of a film that were not stored at their time, which cannot be made up for."""

    kind: Literal["dropped"] = "dropped"
    ids: list[str]
    """Of the frames, in the order of time."""
    reason: str = ""

    def __str__(self) -> str:
        shown = ", ".join(self.ids[:5]) + (", ..." if len(self.ids) > 5 else "")
        return f"{len(self.ids)} dropped ({self.reason}): {shown}"


class LateEntry(TimedEntry):
    """Frames of a film that reached this computer late; `film_s` is by the camera's clock."""

    kind: Literal["late"] = "late"
    ids: list[str]
    """Of the frames, in the order of time."""
    longest_s: float
    """Largest delay of their arrival, s, beyond the smallest delay in the segment."""

    def __str__(self) -> str:
        shown = ", ".join(self.ids[:5]) + (", ..." if len(self.ids) > 5 else "")
        delay_ms = 1e3 * self.longest_s
        return f"{len(self.ids)} arrived up to {delay_ms:.0f} ms late (no error of time): {shown}"


class CompleteEntry(TimedEntry):
    """Every frame was read back and found good."""

    kind: Literal["complete"] = "complete"
    frames: int = 0
    """Number of frames."""

    def __str__(self) -> str:
        return f"{self.wall}: every frame verified"


_KINDS = {
    kind: entry
    for entry in (*Entry.__subclasses__(), *TimedEntry.__subclasses__())
    for kind in get_args(entry.model_fields["kind"].annotation)
}
_CHECK = ',"crc32":"'
_TAIL_CHARACTERS = len(_CHECK) + len('01234567"}')
AnyEntry = TypeVar("AnyEntry", bound=Entry)


def encode_line(entry: Entry) -> bytes:
    """Return a line with its newline; raises `ValueError` for what JSON cannot say."""
    data = entry.model_dump(mode="json")
    if data.get("camera_sha256", "") is None:
        del data["camera_sha256"]
    body = json.dumps(data, separators=(",", ":"), allow_nan=False)[:-1]
    return f'{body}{_CHECK}{zlib.crc32(body.encode()):08x}"}}\n'.encode()


def decode_line(line: bytes) -> Entry | None:
    """Return the entry in a line without its newline; None for a torn or damaged line."""
    cut = len(line) - _TAIL_CHARACTERS
    body, tail = line[:cut], line[cut:]
    if cut <= 0 or tail != b'%s%08x"}' % (_CHECK.encode(), zlib.crc32(body)):
        return None
    try:
        data = parse_json(body + b"}", "an entry", ValueError)
        return _KINDS.get(data["kind"], Entry).model_validate(data)
    except (KeyError, TypeError, ValueError):
        return None


class Journal:
    """The entries of a journal file, oldest first, and a way to add one.

    unreadable: how many lines were torn or damaged.
    """

    def __init__(self, disk: Disk, path: Path) -> None:
        """Read the file; raises `OSError`."""
        self._lines = Lines(path, disk)
        decoded = [decode_line(line) for line in self._lines.lines]
        self.entries: list[Entry] = [entry for entry in decoded if entry is not None]
        self.unreadable = len(decoded) - len(self.entries)

    def append(self, entry: Entry) -> None:
        """Add an entry: it is on the disk when this returns. Raises `OSError`."""
        self._lines.append(encode_line(entry))
        self.entries.append(entry)


def of_kind(entries: Iterable[Entry], kind: type[AnyEntry]) -> list[AnyEntry]:
    """Return the entries of a kind, oldest first."""
    return [entry for entry in entries if isinstance(entry, kind)]


def count_stored(entries: Iterable[Entry]) -> dict[str, FrameEntry]:
    """Return the journal line of every frame that counts, by its id, oldest first."""
    found: dict[str, FrameEntry] = {}
    for entry in entries:
        count_entry(found, entry)
    return found


def count_entry(found: dict[str, FrameEntry], entry: Entry) -> None:
    """Let an entry count among the journal lines of the frames that are stored."""
    if isinstance(entry, FrameEntry):
        found[entry.id] = entry
    elif isinstance(entry, DiscardedEntry):
        found.pop(entry.id, None)


def found_complete(entries: Sequence[Entry]) -> bool:
    """Return whether every frame was found good after the last one was stored."""
    last = _last_of(entries, CompleteEntry, FrameEntry, DiscardedEntry, AmendedEntry)
    return isinstance(last, CompleteEntry)


def ended(entries: Sequence[Entry]) -> DecidedEntry | None:
    """Return the decision that no more shots are needed; None without it or after an amendment."""
    last = _last_of(entries, DecidedEntry, UntilEntry, AmendedEntry)
    return last if isinstance(last, DecidedEntry) and last.next is None else None


def metered(entries: Sequence[Entry]) -> MeteredEntry | None:
    """Return what metering of the scene asks for; None while that is open."""
    last = _last_of(entries, MeteredEntry, AmendedEntry)
    return last if isinstance(last, MeteredEntry) else None


def dropped(entries: Iterable[Entry]) -> set[str]:
    """Return the ids of the frames of a film that were dropped."""
    return {name for entry in of_kind(entries, DroppedEntry) for name in entry.ids}


def _last_of(entries: Sequence[Entry], *kinds: type[Entry]) -> Entry | None:
    return next((entry for entry in reversed(entries) if isinstance(entry, kinds)), None)
