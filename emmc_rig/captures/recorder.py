"""What a run keeps and makes known: frames and notes in the session, events for the watcher.

A thread does the writing in order, so that a frame is written while the stage moves on. The first
job that fails ends the writing: later ones are dropped, and the fault is raised to whoever hands
over the next job, or closes. At most `room` jobs wait: memory stays flat.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from types import TracebackType
from typing import Any, Self

from emmc_rig.captures.events import named
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.progress import Event, Watcher
from emmc_rig.session.brightness import level_of
from emmc_rig.session.frame_file import frame_file
from emmc_rig.session.journal import CompleteEntry, Entry, Figures, FrameEntry, RunEntry
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session
from emmc_rig.session.verify import verify_frames
from emmc_rig.store.results import shown_bytes

Job = Callable[[], None]
ROOM = 3
REPORTED_BYTES = 1_000_000_000
"""Hashing more takes long enough to be reported."""


class Writer:
    """The thread; use it in a `with` block, which ends when every job is done."""

    def __init__(self, room: int = ROOM) -> None:
        self._jobs: queue.Queue[Job | threading.Event | None] = queue.Queue(room)
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="session-writer")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._jobs.put(None)
        self._thread.join()
        if error is None:
            self._check()

    def put(self, job: Job) -> None:
        """Hand a job over, waiting for room; raises what an earlier job raised."""
        self._check()
        self._jobs.put(job)

    def flush(self) -> None:
        """Return when every job handed over so far is done; raises the first fault of a job."""
        done = threading.Event()
        self._jobs.put(done)
        done.wait()
        self._check()

    def _check(self) -> None:
        if self._fault is not None:
            raise self._fault

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            if isinstance(job, threading.Event):
                job.set()
            elif self._fault is None:
                try:
                    job()
                except BaseException as fault:
                    self._fault = fault


class Recorder:
    """The record of one run over a session; use it in a `with` block, as `Writer`.

    run: number of the run, from 1.
    """

    def __init__(self, session: Session, watcher: Watcher) -> None:
        self._session, self._watcher = session, watcher
        self._writer = Writer()
        self._began_s = 0.0
        self._serial = ""
        self.run = 0
        # Frames that are stored, to be stored in all, and of these asked for once more.
        self._done = self._planned = self._retaken = 0
        self._left_of_shot: dict[int, set[str]] = {}

    def __enter__(self) -> Self:
        self._began_s = time.perf_counter()
        self._writer.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        self._writer.__exit__(*exception)

    def now_s(self) -> float:
        """Return the seconds since the run began."""
        return round(time.perf_counter() - self._began_s, 6)

    # The session.

    def begin(self, entry: RunEntry) -> None:
        """Note the run, let damaged frames count as missing, and emit how many are to be taken."""
        session = self._session
        session.make_ready()
        session.note(entry)
        self.run, self._serial = session.runs, entry.camera.get("serial", "")
        self.discard_damaged(session.stored)
        missing, self._planned = session.missing(), len(session.needed)
        self._done = self._planned - len(missing)
        self.emit("begin", done=self._done, planned=self._planned)
        self.count_shots()

    def note(self, entry: Entry, told: str | None = None) -> None:
        """Add a line to the journal, after what was handed over before; told: to people as well."""
        self._writer.put(partial(self._session.note, entry))
        if told is not None:
            self.tell(told)

    def flush(self) -> None:
        """Return when all is on the disk; raises the first fault of writing."""
        self._writer.flush()

    def store(
        self,
        planned: PlannedFrame,
        frame: RawFrame,
        entry: FrameEntry,
        spans_s: dict[str, tuple[float, float]],
    ) -> None:
        """Hand a frame and its journal line to the thread that writes them."""

        def write() -> None:
            self.emit_step("write", planned)
            began_s = self.now_s()
            file = frame_file(frame, entry.wall, self._serial)

            def written() -> FrameEntry:
                spans = {**spans_s, "write": (began_s, self.now_s())}
                return entry.model_copy(update={"spans_s": spans})

            self._session.store(planned, file, written)
            self._done += 1
            self.emit("frame.written", **named(planned), done=self._done, planned=self._planned)
            shot = planned.bench.shot
            left = self._left_of_shot.get(shot, set())
            if planned.id in left:
                left.remove(planned.id)
                if not left:
                    self.emit("shot.done", shot=shot)

        self._writer.put(write)

    def discard_damaged(self, ids: Iterable[str]) -> dict[str, str]:
        """Read files again; return the faults of damaged files, which no longer count, by id."""
        session = self._session
        planned = {frame.id for frame in session.frames}.intersection(ids)
        entries = [entry for name, entry in session.stored.items() if name in planned]
        size = sum(entry.bytes for entry in entries)
        if size > REPORTED_BYTES:
            self.tell(f"hashing {len(entries)} frames, {shown_bytes(size)}")
        damaged = verify_frames(session, entries)
        for name, fault in damaged.items():
            session.discard(name, fault)
            self.tell(f"{fault}; it is taken again")
        return damaged

    def discard_for_retake(self, ids: list[str]) -> None:
        """Count stored frames as missing, for they are wanted once more."""
        self.flush()
        for name in ids:
            self._session.discard(name, "wanted once more")
        self._retaken += len(ids)
        self.count_shots()
        self.count_planned()
        self.tell(f"taken once more: {', '.join(ids)}")

    def close(self) -> int:
        """Note that the session is complete where it is; return how many frames are missing."""
        self.flush()
        session = self._session
        missing = len(session.missing())
        if not missing and not session.is_complete:
            session.note(CompleteEntry(frames=len(session.needed)))
        return missing

    # People and displays.

    def tell(self, message: str) -> None:
        """Give people a note."""
        self._watcher.tell(message)

    def emit(self, name: str, **facts: Any) -> None:
        """Emit an event, see `emmc_rig.captures.events`."""
        self._watcher.event(Event(name, facts))

    def emit_step(self, step: str, planned: PlannedFrame) -> None:
        """Emit that a step of a frame begins."""
        facts = {"id": planned.id, "step": step}
        self._watcher.event(Event("step", facts, {"planned": planned}))

    def emit_taken(self, planned: PlannedFrame, frame: RawFrame, found: Figures) -> None:
        """Emit that a frame came from the camera, and passed every check."""
        facts = {
            **named(planned),
            "exposure_s": frame.exposure_s,
            "level": level_of(frame, found),
            "saturated": found.saturated,
        }
        self._watcher.event(Event("frame.taken", facts, {"planned": planned, "frame": frame}))

    def count_planned(self) -> None:
        """Count the frames to take in all, which are more or fewer than before."""
        self._planned = len(self._session.needed) + self._retaken
        self.emit("planned", planned=self._planned)

    def count_shots(self) -> None:
        """Count the missing frames of each shot: the last of them emits `shot.done`."""
        left: dict[int, set[str]] = {}
        for frame in self._session.missing():
            if frame.is_still_shot:
                left.setdefault(frame.bench.shot, set()).add(frame.id)
        self._left_of_shot = left
