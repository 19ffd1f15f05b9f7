"""Films: checks before a film begins, and the frames of a camera's stream at their places in time.

A place in time is a whole number of periods of the film's rate after a segment's first frame. A
frame that comes late, or for which memory has no room, is dropped: it cannot be taken again. The
camera never waits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from itertools import groupby, pairwise
from queue import Empty, Full, Queue
from threading import Event
from typing import Any, NamedTuple, Self

from emmc_rig.bench.hardware import Rig
from emmc_rig.captures.estimate import pace_of
from emmc_rig.captures.plan import Plan
from emmc_rig.drivers.camera import Camera as CameraDevice
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.errors import CaptureError
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.session.planned import PlannedFrame

RING_BYTES = 256_000_000
"""Of frames that wait for the disk: some seconds of most cameras, little beside a result."""
LEAST_ROOM = 2
ARRIVAL_POLL_S = 0.1
"""How soon a key counts while no frame comes."""
SLOW_DISK = "the disk was too slow"
NONE_CAME = "the camera sent no frame at that time"
LATE = "the bench was not ready at that time"
SENT_TWICE = "identical to the frame before it"
INTERRUPTED = "the film was interrupted"


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
    """A frame of a film at its place in time; film_s: seconds from the segment's first."""

    place: int
    film_s: float
    frame: RawFrame


class Ring:
    """Frames on their way from a camera's stream to the disk, read by a thread of its own.

    places: of the film, those to be filled. room: frames that may wait, 0 for any number. Use it in
    a `with` block, which stops the camera.
    """

    def __init__(self, camera: Any, rate_hz: float, places: range, room: int) -> None:
        self._camera, self._rate_hz, self._places = camera, rate_hz, places
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
        return SLOW_DISK if place in self._overflowed else NONE_CAME

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
        paced = hasattr(camera, "stream_at")
        place, first_s = self._places.start, None
        with closing(camera.stream_at(self._rate_hz) if paced else camera.stream()) as stream:
            for frame in stream:
                # By the camera's own clock, else when it arrived.
                at_s = frame.host_time_s if frame.camera_time_s is None else frame.camera_time_s
                assert at_s is not None
                first_s = at_s if first_s is None else first_s
                passed = (at_s - first_s) * self._rate_hz
                before, place = place, self._places.start + round(passed)
                if place < before:
                    raise CaptureError("its time stamps run backwards", "open the camera again")
                if place <= last:
                    yield Arrived(place, at_s - first_s, frame)
                if self._places.start + passed >= last or self._stopped.is_set():
                    return


def room_for(camera: CameraDevice, clock: object) -> int:
    """Return how many frames of a camera may wait in memory, 0 for any number.

    On a simulated clock no time passes while frames are written, and none is dropped for it.
    """
    rows, columns = camera.shape
    return max(LEAST_ROOM, RING_BYTES // (2 * rows * columns)) if clock is SYSTEM_CLOCK else 0
