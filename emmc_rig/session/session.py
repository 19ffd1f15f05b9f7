"""A session: the frozen plan, one file per frame, and the journal.

    SESSION/
        session.json   when, by what command and versions; what the session is for
        plan.yaml      the plan as the user wrote it
        camera.json    the camera as planned: each shot with its masks and where they stand
        rig.json       what stage and camera were asked for, and where the axes are centred
        frames.json    every frame to be taken, in the order of the capture
        frames/        00012-shot-02.dng: decodes to the frame (see `frame_file`)
        journal.jsonl  what happened
        amended-1-plan.yaml, ...camera.json, ...rig.json, ...frames.json
                       the plan as edited meanwhile, and what follows from it: these hold now
        session.lock   while a program writes the session: which one (see `lock`)
        report.html    pictures, events, times; with metrics.json and files.json
        calibration/, reconstruction/   what `calibrate` and `reconstruct` made of it

Where a capture ends when the scene needs no more shots, the journal says which are spared: these
count as not planned (see `journal`).

The first journal line holds the SHA-256 of the frozen files, an `amended` line that of the files
of an amendment: a captured frame keeps its plan, whose number is in its line. A frame counts when
its journal line is readable and its file has the bytes that the line states; a frame that was
captured twice counts by its last line. A crash between the two leaves a file without a line: that
frame is captured again, under the same name. No counted frame is lost, and none is stored twice.

No file is ever changed in place, and nothing that the session did not make is touched.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from emmc_rig.calibration.frames import MeanFrame
from emmc_rig.errors import AppError
from emmc_rig.model.arguments import path_of
from emmc_rig.model.files import (
    SYSTEM_DISK,
    Disk,
    is_abandoned,
    is_part,
    make_folder_whole,
    part_of,
    write_whole,
)
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.reading import parse_yaml
from emmc_rig.session.frame_file import FrameFile
from emmc_rig.session.journal import (
    AmendedEntry,
    CreatedEntry,
    DiscardedEntry,
    Entry,
    FrameEntry,
    HookEntry,
    Journal,
    RunEntry,
    TimedEntry,
    UntilEntry,
    count_entry,
    count_stored,
    dropped,
    encode_line,
    ended,
    found_complete,
    metered,
    of_kind,
)
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.store.folders import (
    FILES,
    PARTIAL,
    SESSION_HEADER,
    SESSION_JOURNAL,
    SESSION_RECONSTRUCTION,
)
from emmc_rig.store.results import METRICS

HEADER, JOURNAL = SESSION_HEADER, SESSION_JOURNAL
PLAN, CAMERA, RIG, ORDER = "plan.yaml", "camera.json", "rig.json", "frames.json"
FROZEN = (HEADER, PLAN, CAMERA, RIG, ORDER)
AMENDED = (PLAN, CAMERA, RIG, ORDER)
FRAMES, REPORT, LOCK = "frames", "report.html", "session.lock"
CALIBRATION = "calibration"
KNOWN = {
    *FROZEN, JOURNAL, FRAMES, REPORT, METRICS, LOCK, CALIBRATION, SESSION_RECONSTRUCTION, FILES,
    PARTIAL,
}  # fmt: skip
FORMAT = 1


@dataclass(frozen=True)
class Frozen:
    """The frozen start of a session: texts, and the frames to be taken."""

    plan_yaml: str
    camera: Mapping[str, Any]
    rig: Mapping[str, Any]
    frames: tuple[PlannedFrame, ...]


class Session:
    """A session: the folder of a capture or an import, opened by `Session(folder)`.

    One program at a time may add to it: see `lock.held`.

    folder: its absolute path. journal: what happened, entry by entry.
    means: of frames, by their ids and SHA-256, so that each is decoded once: see `frame_means`.

    Raises:
        AppError: a folder that is no session, or cannot be read.
        ArgumentError: no path.
    """

    def __init__(self, folder: str | Path, disk: Disk = SYSTEM_DISK) -> None:
        """Open a folder; raises AppError with one line when it is no session, or damaged."""
        folder = path_of(folder, "session", "the folder of a session")
        self.folder = Path(os.path.abspath(folder))
        self.disk = disk
        self.means: dict[tuple[tuple[str, str], ...], MeanFrame] = {}
        try:
            self.journal = Journal(disk, self.folder / JOURNAL)
        except (FileNotFoundError, NotADirectoryError) as fault:
            what = f"no session, it holds no {JOURNAL}"
            what = what if self.folder.exists() else "no such folder"
            raise AppError(f"{folder}: {what}", "list-sessions") from fault
        except OSError as fault:
            raise AppError(f"{folder}: cannot be read ({fault.strerror}); correct that") from fault

    def __repr__(self) -> str:
        taken, needed = len(self.stored), len(self.needed)
        return f"Session({str(self.folder)!r}, {taken} of {needed} frames)"

    @classmethod
    def create(
        cls,
        folder: Path,
        frozen: Frozen,
        about: Mapping[str, Any],
        disk: Disk = SYSTEM_DISK,
    ) -> Session:
        """Make a session: the whole folder is on the disk when this returns, or nothing of it.

        about: what else the header says. Raises AppError where the folder cannot be made.
        """
        folder = Path(os.path.abspath(folder))
        files = {HEADER: _json({"format": FORMAT, **about}), **_planned_files(frozen)}
        begun = CreatedEntry(format=FORMAT, sha256=_digests(files), frames=_certain(frozen.frames))
        try:
            make_folder_whole(
                disk, folder, {**files, JOURNAL: encode_line(begun), f"{FRAMES}/": b""}
            )
        except OSError as fault:
            raise AppError(
                f"{folder}: cannot be made ({fault.strerror}); correct that, or name another folder"
            ) from fault
        return cls(folder, disk)

    def amend(self, frozen: Frozen, changes: Sequence[str]) -> Session:
        """Let another plan hold from now on, and return the session opened again.

        frozen: plan, camera, rig and frames; captured frames are unchanged. changes: of the plan,
        in words. Raises `OSError`; the earlier plan holds then.
        """
        number = self.amendments + 1
        files = {amended_name(name, number): data for name, data in _planned_files(frozen).items()}
        for name, data in files.items():
            write_whole(self.disk, self.folder / name, data)
        self.note(
            AmendedEntry(
                plan=number,
                sha256=_digests(files),
                frames=_certain(frozen.frames),
                kept=len(self.stored),
                changes=list(changes),
            )
        )
        return Session(self.folder, self.disk)

    def forget(self) -> None:
        """Remove a session in which no frame was ever stored, unless it holds other files."""
        if of_kind(self.journal.entries, FrameEntry) or self.unexpected_files()[1]:
            return
        with suppress(OSError):
            # Whole or not at all: what a crash leaves of it is cleared like one never made.
            part = part_of(self.folder)
            self.disk.replace(self.folder, part)
            self.disk.remove(part)
            self.disk.sync(part.parent)

    @cached_property
    def created(self) -> CreatedEntry:
        """The first entry; raises AppError when it is damaged, or of a later program."""
        first = next(iter(self.journal.entries), None)
        if not isinstance(first, CreatedEntry):
            raise AppError(
                f"{self.folder / JOURNAL}: its first line is damaged; restore it from a copy"
            )
        if first.format > FORMAT:
            raise AppError(f"{self.folder}: made by a later emmc-rig; update this one")
        return first

    @cached_property
    def id(self) -> str:
        """16 hexadecimal digits that tell this session from others; raises AppError."""
        return hashlib.sha256(encode_line(self.created)).hexdigest()[:16]

    @property
    def amendments(self) -> int:
        """How often the plan was amended: the number of the plan that holds, from 0."""
        return len(of_kind(self.journal.entries, AmendedEntry))

    @property
    def digests(self) -> dict[str, str]:
        """The SHA-256 of every frozen file, those of amendments too; raises AppError."""
        found = dict(self.created.sha256)
        for entry in of_kind(self.journal.entries, AmendedEntry):
            found |= entry.sha256
        return found

    def frozen_file(self, name: str) -> bytes:
        """Return a frozen file's bytes; raises AppError when it was changed."""
        path = self.folder / name
        try:
            data = self.disk.read(path)
        except OSError as fault:
            raise AppError(
                f"{path}: cannot be read ({fault.strerror}); restore it from a copy"
            ) from fault
        if hashlib.sha256(data).hexdigest() != self.digests.get(name):
            raise AppError(
                f"{path}: was changed after the session began; restore it from a copy, and to "
                "change the plan edit another copy and capture it into this session",
                "capture-edited",
                self.folder,
            )
        return data

    def holding(self, name: str) -> bytes:
        """Return plan, camera, rig or frames as they hold now: see `frozen_file`."""
        return self.frozen_file(amended_name(name, self.amendments))

    def _data(self, name: str) -> Any:
        """Return what a file of JSON says, as it was frozen; raises AppError."""
        return parse_json(self.frozen_file(name), str(self.folder / name), AppError)

    @cached_property
    def header(self) -> dict[str, Any]:
        """What session.json says."""
        return self._data(HEADER)

    @cached_property
    def plan_yaml(self) -> str:
        """The text of the plan that holds, as the user wrote it (YAML)."""
        return self.holding(PLAN).decode()

    def plan_data(self) -> object:
        """Return the plan as plain data; raises AppError.

        It may be larger than files of settings, which 0.2 took up to 16 MB.
        """
        return parse_yaml(self.plan_yaml, str(self.folder), AppError, most_bytes=16_000_000)

    @cached_property
    def camera(self) -> dict[str, Any]:
        """The camera as planned, plain data of an `emmc_rig.model.camera.Camera`."""
        return self._data(amended_name(CAMERA, self.amendments))

    @cached_property
    def rig(self) -> dict[str, Any]:
        """What devices were asked for."""
        return self._data(amended_name(RIG, self.amendments))

    @cached_property
    def frames(self) -> tuple[PlannedFrame, ...]:
        """All planned frames in the order of the capture: id, kind, exposure, bench positions.

        Raises AppError where the list was changed or damaged.
        """
        name = amended_name(ORDER, self.amendments)
        try:
            return tuple(PlannedFrame.from_dict(frame) for frame in self._data(name))
        except (AttributeError, KeyError, TypeError) as fault:
            raise AppError(
                f"{self.folder / name}: is no list of frames; restore it from a copy"
            ) from fault

    @cached_property
    def stored(self) -> dict[str, FrameEntry]:
        """The journal's entry of each captured frame by its id: file, SHA-256, time, positions."""
        return count_stored(self.journal.entries)

    @property
    def notes(self) -> dict[str, dict[str, Any]]:
        """What the plan's hook noted before each frame, by its id; by "" after the last one."""
        return {entry.id: entry.notes for entry in of_kind(self.journal.entries, HookEntry)}

    @property
    def runs(self) -> int:
        """How often a capture was started on it."""
        return len(of_kind(self.journal.entries, RunEntry))

    @property
    def first_run(self) -> RunEntry | None:
        """The first run, which says what camera took the frames; None before any."""
        return next(iter(of_kind(self.journal.entries, RunEntry)), None)

    @property
    def last_run(self) -> RunEntry | None:
        """The last run; None before any."""
        return next(reversed(of_kind(self.journal.entries, RunEntry)), None)

    @property
    def target_db(self) -> float | None:
        """The PSNR at which no further shot is taken; None: every planned shot is."""
        asked = of_kind(self.journal.entries, UntilEntry)
        return asked[-1].target_db if asked else self.header.get("until_db")

    @property
    def needed(self) -> tuple[PlannedFrame, ...]:
        """Every frame to be taken.

        Excluded are frames of spared shots, longer frames of brackets that metering does not ask
        for, and dropped frames of a film.
        """
        decided, exposed = ended(self.journal.entries), metered(self.journal.entries)
        spared = () if decided is None else decided.spared
        asked = () if exposed is None else set(exposed.asked)
        gone = dropped(self.journal.entries)
        return tuple(
            frame
            for frame in self.frames
            if not (frame.kind == "shot" and frame.bench.shot in spared)
            and not (frame.is_optional and frame.id not in asked)
            and frame.id not in gone
        )

    def missing(self) -> tuple[PlannedFrame, ...]:
        """Return the frames that are still to be taken, in order."""
        return tuple(frame for frame in self.needed if frame.id not in self.stored)

    @property
    def is_complete(self) -> bool:
        """Whether every frame was found good after the last one was stored; see `verify`."""
        return found_complete(self.journal.entries)

    def path_of(self, entry: FrameEntry) -> Path:
        """Return where the file of a frame's journal line lies."""
        return self.folder / FRAMES / entry.file

    def read(self, frame_id: str) -> bytes:
        """Return the bytes of a stored frame.

        Raises AppError when it is missing, or not what the journal states.
        """
        entry = self.stored.get(frame_id)
        if entry is None:
            raise AppError(
                f"{self.folder}: frame {frame_id} was not captured yet; resume the capture"
            )
        path = self.path_of(entry)
        try:
            data = self.disk.read(path)
        except OSError as fault:
            raise AppError(
                f"{path}: cannot be read ({fault.strerror}); resume the capture"
            ) from fault
        if hashlib.sha256(data).hexdigest() != entry.sha256:
            raise AppError(
                f"{path}: is damaged, its SHA-256 is not the journal's; resume the capture"
            )
        return data

    def store(self, frame: PlannedFrame, file: FrameFile, entry: Callable[[], FrameEntry]) -> None:
        """Keep a frame: its bytes, then its line, are on the disk when this returns.

        entry: what the line says besides the file, asked for when that is on the disk. Raises
        `OSError`; AppError when the bytes are no longer those that came from the camera.
        """
        name = f"{self._places[frame.id]:05d}-{frame.id}{file.suffix}"
        write_whole(self.disk, self.folder / FRAMES / name, file.data)
        if hashlib.sha256(file.data).hexdigest() != file.sha256:
            raise AppError(
                f"frame {frame.id}: its bytes changed in this computer's memory on the way to the "
                "disk; test the memory before going on"
            )
        held = {
            "id": frame.id,
            "file": name,
            "bytes": len(file.data),
            "sha256": file.sha256,
            "camera_sha256": file.camera_sha256,
        }
        self.note(entry().model_copy(update=held))

    def note(self, entry: Entry) -> None:
        """Add a line to the journal, timed now where it is timed; raises `OSError`."""
        if isinstance(entry, TimedEntry):
            entry = entry.model_copy(update={"wall": wall_time()})
        self.journal.append(entry)
        count_entry(self.stored, entry)

    def make_ready(self) -> None:
        """Make the folders that a capture needs and that may be missing; raises `OSError`.

        Parts that a killed program left go.
        """
        self.disk.make_folder(self.folder / FRAMES)
        self.disk.sync(self.folder)
        for name in self.parts():
            self.disk.remove(self.folder / name)

    def discard(self, frame_id: str, reason: str) -> None:
        """Count a frame as not taken; its file stays until it is taken again."""
        self.note(DiscardedEntry(id=frame_id, reason=reason))

    def parts(self) -> list[str]:
        """Return the files that a killed program was writing, relative to the folder."""
        found = [
            name
            for name, size in self.disk.sizes(self.folder).items()
            if size >= 0 and is_abandoned(name)
        ]
        with suppress(FileNotFoundError):
            # Frames are only written by the holder of the lock.
            sizes = self.disk.sizes(self.folder / FRAMES)
            found += [f"{FRAMES}/{name}" for name in sizes if is_part(name) and sizes[name] >= 0]
        return found

    def unexpected_files(self) -> tuple[list[str], list[str]]:
        """Return leftovers of a crash and files of other programs, relative to the folder."""
        ours = {entry.file for entry in self.stored.values()}
        known = {*KNOWN, *self.digests}
        unfinished = {amended_name(name, self.amendments + 1) for name in AMENDED}
        leftovers, foreign = self.parts(), []
        for name in self.disk.sizes(self.folder):
            if name in unfinished:
                leftovers.append(name)
            elif name not in known and not is_part(name):
                foreign.append(name)
        try:
            names = self.disk.sizes(self.folder / FRAMES)
        except FileNotFoundError:
            names = {}
        for name in names:
            if name in ours or is_part(name):
                continue
            taken = re.fullmatch(r"\d{5}-(.+)", Path(name).stem)
            which = leftovers if taken and taken[1] in self._ids else foreign
            which.append(f"{FRAMES}/{name}")
        return sorted(leftovers), sorted(foreign)

    @cached_property
    def _places(self) -> dict[str, int]:
        return {frame.id: place for place, frame in enumerate(self.frames)}

    @cached_property
    def _ids(self) -> set[str]:
        """The names of all frames ever planned."""
        earlier = [amended_name(ORDER, number) for number in range(self.amendments)]
        return {frame["id"] for name in earlier for frame in self._data(name)}.union(self._places)


def amended_name(name: str, number: int) -> str:
    """Return the file name of a frozen file by the amendment of that number; 0: as begun with."""
    return f"amended-{number}-{name}" if number else name


def wall_time() -> str:
    """Return the time of day to the millisecond; nothing is computed from it."""
    return datetime.now(UTC).astimezone().isoformat(timespec="milliseconds")


def _digests(files: Mapping[str, bytes]) -> dict[str, str]:
    return {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}


def _planned_files(frozen: Frozen) -> dict[str, bytes]:
    """Return the files of a plan; frames.json has a frame in each line."""
    frames = (frame.as_dict() for frame in frozen.frames)
    lines = ",\n".join(
        json.dumps(frame, separators=(",", ":"), allow_nan=False) for frame in frames
    )
    return {
        PLAN: frozen.plan_yaml.encode(),
        CAMERA: _json(frozen.camera),
        RIG: _json(frozen.rig),
        ORDER: f"[\n{lines}\n]\n".encode(),
    }


def _certain(frames: Iterable[PlannedFrame]) -> int:
    """Return how many frames are taken whatever metering asks for."""
    return sum(not frame.is_optional for frame in frames)


def _json(data: Mapping[str, Any]) -> bytes:
    return (json.dumps(data, indent=2, allow_nan=False) + "\n").encode()
