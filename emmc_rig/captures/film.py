"""Films: checks before a film begins, and the frames of a camera's stream at their places in time.

A place in time is a whole number of periods of the film's rate after a segment's first frame. A
frame that comes late, or for which memory has no room, is dropped: it cannot be taken again. The
camera never waits. The time of a frame is by the camera's clock if it states one, else by the
clock of this computer when the frame arrived.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from itertools import groupby, pairwise, takewhile
from queue import Empty, Full, Queue
from threading import Event
from typing import Any, Literal, NamedTuple, Self

from emmc_rig.bench.hardware import Rig
from emmc_rig.captures.engine import Engine, Facts
from emmc_rig.captures.faults import check, is_same
from emmc_rig.captures.plan import Plan
from emmc_rig.captures.schedule import pace_of
from emmc_rig.drivers.camera import Camera as CameraDevice
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.errors import CaptureError
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.session.brightness import figures
from emmc_rig.session.journal import DroppedEntry, FilmEntry, LateEntry, of_kind
from emmc_rig.session.planned import PlannedFrame

RING_BYTES = 256_000_000
"""Of frames that wait for the disk: some seconds of most cameras, little beside a result."""
LEAST_ROOM = 2
STAGE_READ_INTERVAL_S = 1.0
"""How often the stage is read while a film streams: it stands still, and answers slowly."""
ARRIVAL_POLL_S = 0.1
"""How soon a key counts while no frame comes."""
SLOW_DISK = "the disk was too slow"
NONE_CAME = "the camera sent no frame at that time"
NO_PULSE = "no pulse came at that time, or the camera did not see it"
SKIPPED = "the camera skipped the pulse: its frame numbers have a gap"
LATE = "the bench was not ready at that time"
SENT_TWICE = "identical to the frame before it"
INTERRUPTED = "the film was interrupted"
HOST_CLOCK = "film: times by the host clock, for the camera states none: some ms to a period late"
LONGEST_DELAY_S = 60.0
"""Of a frame's arrival by the camera's clock: no camera's buffer holds as long a stream."""
LATE_SHARE = 0.5
"""Of a period: a frame that arrives later than this would have another time by the host clock."""


def streams(plan: Plan, camera: CameraDevice) -> bool:
    """Return whether a film comes from the camera's own stream: its masks stand still."""
    return hasattr(camera, "stream") and len(plan.shots) == 1


def refuse_impossible_film(plan: Plan, rig: Rig, frames: Sequence[PlannedFrame]) -> None:
    """Raise AppError with one line where camera or stage cannot reach a film's rate.

    frames: those still to be taken, in order.
    """
    frames = [frame for frame in frames if frame.film is not None]
    if plan.film is None or not frames or rig.recorded_s:
        return
    if len({frame.bench.set_by_hand(rig.hands) for frame in frames}) > 1:
        raise AppError(
            "film: its shots differ in what somebody does by hand; a film steps the mask by the "
            "stage alone: give its shots the same masks and filter"
        )
    rate_hz, exposure_s = plan.film.rate, frames[0].exposure_s or 0.0
    why = f"a frame is exposed for {exposure_s:g} s"
    if streams(plan, rig.camera):
        camera_s = 1 / getattr(rig.camera, "rate_limits_hz", (0.0, rate_hz))[1]
        period_s = max(exposure_s, camera_s)
        if period_s > exposure_s:
            why = f"the camera sends at most {1 / camera_s:.3g} frames/s"
    else:
        pace, cycle = pace_of(rig, plan), frames[: 1 + len(plan.shots)]
        longest_s = max(
            (pace.moving_s(to, by.bench.offsets_um) for by, to in pairwise(cycle)), default=0.0
        )
        period_s = longest_s + exposure_s + pace.usual_s
        why += f" and takes about {period_s:.2g} s, of which the stage moves {longest_s:.2g} s"
    if period_s > 1 / rate_hz:
        raise AppError(f"film: {why}: lower film.rate from {rate_hz:g} to {1 / period_s:.3g}")


class Arrived(NamedTuple):
    """A frame of a film at its place in time."""

    place: int
    film_s: float
    """Seconds from the segment's first frame."""
    frame: RawFrame
    late_s: float = 0.0
    """Delay of its arrival by the host clock, s, beyond the smallest delay in the segment."""

    @property
    def clock(self) -> Literal["camera", "host"]:
        """Whose clock `film_s` is by."""
        return "host" if self.frame.camera_time_s is None else "camera"


class Ring:
    """Frames on their way from a camera's stream to the disk, read by a thread of its own.

    places: of the film, those to be filled. room: frames that may wait, 0 for any number.
    triggered: pulses give the rate. Use it in a `with` block, which stops the camera.
    """

    def __init__(
        self, camera: Any, rate_hz: float, places: range, room: int, triggered: bool = False
    ) -> None:
        self._camera, self._rate_hz, self._places = camera, rate_hz, places
        self._triggered, self._skipped = triggered, set[int]()
        self._frames: Queue[Arrived] = Queue(room)
        self._overflowed: set[int] = set()
        self._stopped = Event()
        self._thread = ThreadPoolExecutor(1, "film-reader")

    def __enter__(self) -> Self:
        self._reading = self._thread.submit(self._read)
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()
        self._thread.shutdown()

    def stop(self) -> None:
        """Stop the camera's stream; frames that wait in the queue can still be iterated."""
        self._stopped.set()

    def __iter__(self) -> Iterator[Arrived | None]:
        """Yield the frames, and None where none came for a while.

        Raises what the camera raised, once all frames before that were had.
        """
        while not (self._reading.done() and self._frames.empty()):
            try:
                arrived = self._frames.get(timeout=ARRIVAL_POLL_S)
            except Empty:
                arrived = None
            yield arrived
        self._reading.result()

    def why_missing(self, place: int) -> str:
        """Return why there is no frame for a place before one that was returned."""
        if place in self._overflowed:
            return SLOW_DISK
        if self._triggered:
            return SKIPPED if place in self._skipped else NO_PULSE
        return NONE_CAME

    def _read(self) -> None:
        for place, sent in groupby(self._sent(), lambda frame: frame.place):
            due_s = (place - self._places.start) / self._rate_hz
            nearest = min(sent, key=lambda frame: abs(frame.film_s - due_s))
            try:
                self._frames.put_nowait(nearest)
            except Full:
                self._overflowed.add(place)

    def _sent(self) -> Iterator[Arrived]:
        """Yield what the camera sends until the film's time is over, at the nearest places."""
        camera, last = self._camera, self._places.stop - 1
        paced = hasattr(camera, "stream_at") and not self._triggered
        place, first_s, least_delay_s = self._places.start, None, math.inf
        with closing(camera.stream_at(self._rate_hz) if paced else camera.stream()) as stream:
            for frame in stream:
                host_s = frame.host_time_s
                at_s = host_s if frame.camera_time_s is None else frame.camera_time_s
                assert at_s is not None
                delay_s = 0.0 if host_s is None else host_s - at_s
                least_delay_s = min(least_delay_s, delay_s)
                first_s = at_s if first_s is None else first_s
                passed = (at_s - first_s) * self._rate_hz
                before, place = place, self._places.start + round(passed)
                if int(frame.metadata.get("frames_lost", 0)):
                    self._skipped |= {*range(before + 1, place)}
                if place < before:
                    raise CaptureError("its time stamps run backwards", "open the camera again")
                if delay_s - least_delay_s > LONGEST_DELAY_S:
                    raise CaptureError("its clock stands still", "open the camera again")
                if place <= last:
                    yield Arrived(place, at_s - first_s, frame, delay_s - least_delay_s)
                if self._places.start + passed >= last or self._stopped.is_set():
                    return


def room_for(camera: CameraDevice, clock: object) -> int:
    """Return how many frames of a camera may wait in memory, 0 for any number.

    On a simulated clock no time passes while frames are written, and none is dropped for it.
    """
    rows, columns = camera.shape
    return max(LEAST_ROOM, RING_BYTES // (2 * rows * columns)) if clock is SYSTEM_CLOCK else 0


class FilmRun:
    """The frames of a film in one run: each is taken at its time, or dropped.

    A segment is taken without a break, on a time of its own. take: takes a frame with as many
    tries as it needs, its second argument as `Engine.take`'s `about`. finish: gets each frame that
    the camera's stream brought.
    """

    def __init__(
        self,
        engine: Engine,
        take: Callable[[PlannedFrame, Callable[[], Facts]], None],
        finish: Callable[[PlannedFrame], None],
    ) -> None:
        assert engine.plan.film is not None
        self._engine, self._session, self._rig = engine, engine.session, engine.rig
        self._recorder, self._control = engine.recorder, engine.control
        self._take, self._finish = take, finish
        self._plan, self._rate_hz = engine.plan, engine.plan.film.rate
        self._segment = len(of_kind(self._session.journal.entries, FilmEntry)) - 1
        # On the clock of the rig, when the first frame of the segment was asked for.
        self._began_s: float | None = None

    def take_segment(self, left: list[PlannedFrame]) -> None:
        """Take a segment, until no frame is left or somebody halts it.

        Taken and dropped frames leave `left`; those before the last stored frame are dropped.
        Raises what the camera or stage raises, with the segment at its end.
        """
        self._recorder.flush()
        stored = self._session.stored
        film = [frame for frame in self._session.frames if frame.film is not None]
        last = max((_place(frame) for frame in film if frame.id in stored), default=-1)
        self._drop(left, last + 1, lambda place: INTERRUPTED)
        if left:
            is_streamed = streams(self._plan, self._engine.devices.camera)
            (self._take_stream if is_streamed else self._take_steps)(left)
        self._recorder.flush()

    def _begin_segment(self, planned: PlannedFrame) -> None:
        self._segment, self._began_s = self._segment + 1, None
        self._recorder.note(FilmEntry(segment=self._segment, id=planned.id, rate_hz=self._rate_hz))

    def _drop(self, left: list[PlannedFrame], end: int, why: Callable[[int], str]) -> None:
        """Note that the frames left before a place are dropped; why: by place."""
        gone = list(takewhile(lambda frame: _place(frame) < end, left))
        del left[: len(gone)]
        for reason, frames in groupby(gone, lambda frame: why(_place(frame))):
            entry = DroppedEntry(ids=[frame.id for frame in frames], reason=reason)
            self._recorder.note(entry, str(entry))

    def _take_stream(self, left: list[PlannedFrame]) -> None:
        """Take a segment from the camera's stream; the stage stands still."""
        engine, devices, control = self._engine, self._engine.devices, self._control
        now_s, first = self._recorder.now_s, left[0]
        engine.set_up(first)
        devices.set_camera(first, engine.exposure_s(first))
        self._begin_segment(first)
        read_s, beside = -STAGE_READ_INTERVAL_S, dict[str, Any]()
        late_s: dict[str, float] = {}
        places = range(_place(first), _place(left[-1]) + 1)
        room = room_for(devices.camera, self._rig.clock)
        triggered = self._plan.trigger is not None
        with Ring(devices.camera, self._rate_hz, places, room, triggered) as ring:
            for arrived in ring:
                if control.halting:
                    ring.stop()
                if arrived is None:
                    continue
                self._drop(left, arrived.place, ring.why_missing)
                if now_s() - read_s >= STAGE_READ_INTERVAL_S:
                    read_s = now_s()
                    beside = engine.readings_of_stream(left[0])
                devices.ask()
                if arrived.late_s > LATE_SHARE / self._rate_hz:
                    late_s[left[0].id] = arrived.late_s
                self._take_arrived(left, arrived, beside)
        if late_s:
            late = LateEntry(ids=list(late_s), longest_s=round(max(late_s.values()), 6))
            self._recorder.note(late, str(late))
        if not control.halting:
            self._drop(left, places.stop, ring.why_missing)

    def _take_arrived(self, left: list[PlannedFrame], arrived: Arrived, beside: Facts) -> None:
        """Store the next frame left, or drop it where the camera sent one twice.

        A segment's first must pass every check; a flash or darkness later is the scene's own.
        """
        engine, recorder = self._engine, self._recorder
        planned, frame, found = left[0], arrived.frame, figures(arrived.frame)
        recorder.emit_step("check", planned)
        if arrived.film_s == 0:
            if arrived.clock == "host":
                recorder.tell(HOST_CLOCK)
            check(planned, frame, found, engine.before, self._plan.checks)
        if engine.before is not None and is_same(frame.mosaic, engine.before):
            self._drop(left, arrived.place + 1, lambda place: SENT_TWICE)
            return
        left.pop(0)
        recorder.emit_taken(planned, frame, found)
        when = {
            "segment": self._segment,
            "film_s": arrived.film_s,
            "film_clock": arrived.clock,
        }
        engine.hand_over(planned, frame, found, {}, **when, **beside)
        self._finish(planned)

    def _take_steps(self, left: list[PlannedFrame]) -> None:
        """Take a segment frame by frame, the stage moving in between.

        A frame whose time is over by more than half a period is dropped.
        """
        clock = self._rig.clock
        self._begin_segment(left[0])
        first = _place(left[0])
        while left and not self._control.halting:
            if self._began_s is not None and not self._rig.recorded_s:
                due = first + (clock.now_s() - self._began_s) * self._rate_hz
                self._drop(left, math.ceil(due - 0.5), lambda place: LATE)
                if left and _place(left[0]) > due:
                    # A hook is called before any axis moves.
                    if not self._engine.has_hook and self._engine.devices.move(left[0]):
                        continue
                    wait_s = (_place(left[0]) - due) / self._rate_hz
                    clock.sleep(min(wait_s, ARRIVAL_POLL_S))
                    continue
            if left:
                self._engine.prepared = None
                self._take(left[0], partial(self._when, left[0]))
                left.pop(0)

    def _when(self, planned: PlannedFrame) -> Facts:
        """Return the segment of a frame, and its time in seconds from the segment's first."""
        asked_s = self._engine.devices.asked_s
        if self._began_s is None:
            self._began_s = asked_s
        recorded = bool(self._rig.recorded_s)
        film_s = _place(planned) / self._rate_hz if recorded else asked_s - self._began_s
        return {"segment": self._segment, "film_s": film_s, "film_clock": "host"}


def _place(frame: PlannedFrame) -> int:
    """Return the place in time of a film's frame."""
    assert frame.film is not None
    return frame.film
