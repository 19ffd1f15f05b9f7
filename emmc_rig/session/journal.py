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
    """Of one frame: share of saturated pixels; mean, 99.9th percentile, median above black, DN."""

    saturated: float
    mean_dn: float
    bright_dn: float
    median_dn: float = 0.0


class Entry(BaseModel):
    """A line of the journal; as text what it says for people beside the frames, "" for nothing.

    One of a kind that only later programs know says nothing.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")
    kind: str

    def __str__(self) -> str:
        return ""


class TimedEntry(Entry):
    """An entry that says when it was noted, by the time of day."""

    wall: str = ""


class CreatedEntry(Entry):
    """The session was begun: SHA-256 of the frozen files, frames taken whatever metering says."""

    kind: Literal["created"] = "created"
    format: int = 1
    sha256: dict[str, str]
    frames: int


class AmendedEntry(TimedEntry):
    """Another plan holds from here on; kept: frames stored then."""

    kind: Literal["amended"] = "amended"
    plan: int
    sha256: dict[str, str]
    frames: int
    kept: int = 0
    changes: list[str] = []

    def __str__(self) -> str:
        return f"{self.wall}: plan {self.plan} holds: {'; '.join(self.changes)}"


class RunEntry(TimedEntry):
    """A capture was started, on these devices.

    environment: units, by the names of what is read beside frames. between: the plan's hook, its
    file and SHA-256.
    """

    kind: Literal["run"] = "run"
    versions: dict[str, Any] = {}
    command: str = ""
    resumed: bool = False
    camera: dict[str, Any]
    camera_settings: dict[str, Any] = {}
    stage: dict[str, Any] = {}
    environment: dict[str, str] = {}
    between: dict[str, str] = {}

    def __str__(self) -> str:
        return f"{self.wall}: {self.command}"


class ImportedEntry(TimedEntry):
    """The frames are of files that another program wrote.

    files: by path, the SHA-256 of their bytes. notes: assumptions for values that no file states.
    """

    kind: Literal["imported"] = "imported"
    files: dict[str, str]
    notes: list[str] = []

    def __str__(self) -> str:
        return "; ".join((f"{self.wall}: {len(self.files)} files imported", *self.notes))


class FrameEntry(Entry):
    """A frame is stored.

    run: counted from 1. plan: number of the amendment that it was taken by. camera_sha256: of the
    camera's own bytes, where `file` is a DNG of the mosaic that holds them. read_um: readings of
    the axes; of an axis moved by hand its place in the frame, with `deviation_um`. wall,
    monotonic_s: when its exposure was asked for, by the time of day and on the clock of the rig.
    stands_um: where axes of the stage read to stand that no plan moves. temperatures_c: of stage
    and camera, environment: of other sources, whose units the run's line has. segment: of a film's
    frame, see `FilmEntry`; film_s: when it was exposed, in seconds from the segment's first.
    spans_s: by step, its begin and end in seconds of the run.
    """

    kind: Literal["frame"] = "frame"
    id: str
    file: str
    bytes: int
    sha256: str
    run: int = 0
    plan: int = 0
    shape: tuple[int, int]
    cfa: str
    black_level_dn: list[list[float]]
    white_level_dn: int
    exposure_s: float
    gain: float
    camera_time_s: float | None = None
    host_time_s: float | None = None
    metadata: dict[str, Any] = {}
    camera_sha256: str | None = None
    lamp: str = ""
    commanded_um: dict[str, float] = {}
    read_um: dict[str, float] = {}
    deviation_um: dict[str, float] = {}
    figures: Figures
    triggered: bool = False
    attempts: int = 1
    wall: str = ""
    monotonic_s: float | None = None
    stands_um: dict[str, float] = {}
    temperatures_c: dict[str, float] = {}
    environment: dict[str, float] = {}
    segment: int | None = None
    film_s: float | None = None
    spans_s: dict[str, tuple[float, float]] = {}

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
    """The scene was metered: exposure by shot, longer frames `asked` for."""

    kind: Literal["metered"] = "metered"
    exposures_s: dict[int, float]
    asked: list[str]

    def __str__(self) -> str:
        by_exposure: dict[float, list[str]] = {}
        for shot, exposure_s in self.exposures_s.items():
            by_exposure.setdefault(exposure_s, []).append(str(shot + 1))
        exposures = ", ".join(
            f"shot{'s' * (len(shots) > 1)} {', '.join(shots)} exposure {exposure_s:.3g} s"
            for exposure_s, shots in by_exposure.items()
        )
        longer = f"; {len(self.asked)} longer frames for the dark parts" if self.asked else ""
        return f"{exposures}{longer}"


class UntilEntry(TimedEntry):
    """From here on shots are taken until this PSNR is stated."""

    kind: Literal["until"] = "until"
    target_db: float

    def __str__(self) -> str:
        return f"{self.wall}: shots are taken until the estimated accuracy is {self.target_db:g} dB"


class DecidedEntry(TimedEntry):
    """What the shots so far give, and which follows; next: None where no more are needed."""

    kind: Literal["decided"] = "decided"
    run: int = 0
    shots: list[int]
    stated_db: float
    target_db: float
    next: int | None
    why: str = ""
    expected_db: dict[int, float] = {}
    spared: list[int]
    spared_frames: int
    method: str = ""
    advice: str = ""
    spans_s: dict[str, tuple[float, float]] = {}

    def __str__(self) -> str:
        taken = ", ".join(str(shot + 1) for shot in self.shots)
        stated = (
            f"shot{'s' * (len(self.shots) > 1)} {taken}: estimated accuracy {self.stated_db:.2f} "
            f"dB, target {self.target_db:g} dB"
        )
        if self.next is None:
            spared = f", {len(self.spared)} shots not needed" if self.spared else ""
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

    def __str__(self) -> str:
        return f"{self.wall}: after {shown_seconds(self.seconds)}"


class RetryEntry(Entry):
    """A fault, met by another try."""

    kind: Literal["retry"] = "retry"
    id: str
    fault: str
    attempt: int
    at_s: float = 0.0

    def __str__(self) -> str:
        return f"{self.id}, attempt {self.attempt}: {self.fault}"


class ComparedEntry(Entry):
    """A frame was taken again before going on: the bench is unchanged, or capture is refused."""

    kind: Literal["registered", "refused"]
    id: str
    x_px: float
    y_px: float
    likeness: float
    limit_px: float = 0.0

    def __str__(self) -> str:
        return (
            f"{self.id} captured again: shifted by ({self.x_px:+.3f}, {self.y_px:+.3f}) px, "
            f"correlation {self.likeness:.3f}"
        )


class HookEntry(TimedEntry):
    """The plan's hook was called before frame `id`, "" after the last, and noted this.

    fault: what ended the capture there, "" where nothing did.
    """

    kind: Literal["hook"] = "hook"
    id: str = ""
    name: str = ""
    notes: dict[str, Any] = {}
    fault: str = ""
    at_s: float = 0.0
    seconds: float = 0.0

    def __str__(self) -> str:
        when = f"before {self.id}" if self.id else "after the last frame"
        return f"{self.wall}: {self.name}, {when}: {self.fault}" if self.fault else ""


class FocusEntry(TimedEntry):
    """The focus axis was brought to where the scene is sharpest, before frame `id`.

    place_um: where it is, to deviation_um; None where no peak was seen, see `fault`: then the axis
    stands where it did, from_um.
    """

    kind: Literal["focus"] = "focus"
    id: str
    from_um: float
    place_um: float | None = None
    deviation_um: float | None = None
    fault: str = ""
    at_s: float = 0.0
    seconds: float = 0.0

    def __str__(self) -> str:
        if self.place_um is None:
            return f"before {self.id}: not focused, {self.fault}"
        found = f"{self.place_um:.1f} um, to {self.deviation_um:.1f} um"
        return f"before {self.id}: sharpest at {found}; it stood at {self.from_um:.1f} um"


class SourceEntry(TimedEntry):
    """A source of the rig's environment failed, or gives values again (fault "")."""

    kind: Literal["source"] = "source"
    name: str
    fault: str = ""

    def __str__(self) -> str:
        return f"{self.wall}: {self.name}: {self.fault or 'gives values again'}"


class FilmEntry(TimedEntry):
    """A segment of a film begins, from frame `id` on: time goes on within it without a break.

    segment: counted from 0. The first begins with the film, the next after each interruption, in
    which the scene may have changed.
    """

    kind: Literal["film"] = "film"
    segment: int
    id: str
    rate_hz: float

    def __str__(self) -> str:
        return f"{self.wall}: film, segment {self.segment + 1} begins with {self.id}"


class DroppedEntry(TimedEntry):
    """Frames of a film that were not stored at their time, which cannot be made up for."""

    kind: Literal["dropped"] = "dropped"
    ids: list[str]
    reason: str = ""

    def __str__(self) -> str:
        shown = ", ".join(self.ids[:5]) + (", ..." if len(self.ids) > 5 else "")
        return f"{len(self.ids)} dropped ({self.reason}): {shown}"


class CompleteEntry(TimedEntry):
    """Every frame was read back and found good."""

    kind: Literal["complete"] = "complete"
    frames: int = 0

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
