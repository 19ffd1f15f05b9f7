"""Films: what refuses one before it begins, and the frames of a camera's stream at their places.

A place in time is a whole number of periods of the film's rate after a segment's first frame. A
frame that does not come at its place, or that finds no room in memory, is dropped: it cannot be
taken again. The camera is never made to wait.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from itertools import pairwise
from typing import Any, Self

from drivers.camera import Camera as CameraDevice
from drivers.clock import Clock
from drivers.errors import CaptureError
from drivers.raw import RawFrame
from emmc_rig.acquisition.estimate import pace_of
from emmc_rig.acquisition.plan import Plan
from emmc_rig.bench.hardware import Rig
from emmc_rig.errors import AppError
from emmc_rig.session.planned import PlannedFrame

RING_BYTES = 256_000_000
"""Of frames that wait for the disk: some seconds of most cameras, little beside a result."""
LEAST_ROOM = 2
ARRIVAL_POLL_S = 0.1
"""How soon a key counts while no frame comes."""
ON_TIME = 0.05
"""Of a period, by which a frame may come before its place's time without the next being awaited:
that one is nearer only of a camera that is ten times as fast as the film."""
SLOW_DISK = "the disk was too slow"
NONE_CAME = "the camera sent no frame at that time"
LATE = "the bench was not ready at that time"
INTERRUPTED = "the film was interrupted"


def streams(plan: Plan, camera: CameraDevice) -> bool:
    """Return whether a film comes from the camera's own stream: its masks stand still."""
    return hasattr(camera, "stream") and len(plan.shots) == 1


def refuse_impossible_film(plan: Plan, rig: Rig, frames: Sequence[PlannedFrame]) -> None:
    """Raise AppError with one line where camera or stage cannot reach a film's rate.

    frames: those of the film still to be taken, in order.
    """
    if plan.film is None or not frames or rig.recorded_s:
        return
    rate_hz, first = plan.film.rate, frames[0]
    if len({frame.bench.set_by_hand(rig.hands) for frame in frames}) > 1:
        raise AppError(
            "film: its shots differ in what somebody does by hand; a film steps the mask by the "
            "stage alone: give its shots the same masks and filter"
        )
    exposure_s = first.exposure_s or 0.0
    if exposure_s > 1 / rate_hz:
        raise AppError(
            f"film: an exposure of {exposure_s:g} s is longer than a period of {1 / rate_hz:g} s: "
            f"lower film.rate to {1 / exposure_s:.3g}, or expose shorter"
        )
    if streams(plan, rig.camera):
        most_hz = getattr(rig.camera, "rate_limits_hz", (0.0, rate_hz))[1]
        why = f"the camera sends at most {most_hz:.3g} frames/s"
    else:
        pace, cycle = pace_of(rig, plan), frames[: 1 + len(plan.shots)]
        longest_s = max(
            (pace.moving_s(to, by.bench.offsets_um) for by, to in pairwise(cycle)), default=0.0
        )
        frame_s = longest_s + exposure_s + pace.usual_s
        most_hz = 1 / frame_s
        why = f"a frame takes about {frame_s:.2g} s, of which the stage moves {longest_s:.2g} s"
    if most_hz < rate_hz:
        raise AppError(f"film: {why}: lower film.rate from {rate_hz:g} to {most_hz:.3g}")


class Ring:
    """Frames on their way from a camera's stream to the disk, read by a thread of its own.

    places: of the film, those to be filled. room: frames that may wait. waits: whether a frame
    without room waits for it, as on a simulated clock, where no time passes meanwhile. announce:
    gets the place of the next frame before its exposure. Use it in a `with` block, which stops the
    camera.
    """

    def __init__(
        self,
        camera: Any,
        rate_hz: float,
        places: range,
        room: int,
        clock: Clock,
        waits: bool,
        announce: Callable[[int], None],
    ) -> None:
        self._camera, self._rate_hz, self._places, self._room = camera, rate_hz, places, room
        self._clock, self._waits, self._announce = clock, waits, announce
        self._frames: deque[tuple[int, float, RawFrame]] = deque()
        self._overflowed: set[int] = set()
        self._changed = threading.Condition()
        self._ended = self._finished = False
        self._fault: BaseException | None = None
        self._thread = threading.Thread(target=self._read, name="film-reader")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()
        self._thread.join()

    def stop(self) -> None:
        """Let the camera send no further frame; those that wait can still be had."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def next(self) -> tuple[int, float, RawFrame] | None:
        """Return the next frame, its place and seconds from the segment's first; None: none yet.

        Raises what the camera raised, once all frames before that are returned.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._finished, ARRIVAL_POLL_S)
            if self._frames:
                self._changed.notify_all()
                return self._frames.popleft()
        if self._fault is not None:
            raise self._fault
        return None

    @property
    def over(self) -> bool:
        """Whether no further frame comes: the film's time is over, or it was stopped."""
        with self._changed:
            return self._finished and self._fault is None and not self._frames

    def why_missing(self, place: int) -> str:
        """Return why there is no frame for a place before one that was returned."""
        return SLOW_DISK if place in self._overflowed else NONE_CAME

    def _read(self) -> None:
        try:
            for place, film_s, frame in self._placed():
                self._keep(place, film_s, frame)
        except BaseException as fault:
            self._fault = fault
        with self._changed:
            self._finished = True
            self._changed.notify_all()

    def _placed(self) -> Iterator[tuple[int, float, RawFrame]]:
        """Yield the frame nearest in time to each place, with its place and time.

        Of a camera that is faster than the film the others are left out.
        """
        start, end = self._places.start, self._places.stop
        done, first_s, held_off = start - 1, None, 0.0
        held: tuple[int, float, RawFrame] | None = None
        paced = getattr(self._camera, "stream_at", None)
        stream = self._camera.stream() if paced is None else paced(self._rate_hz)
        with closing(stream):
            self._announce(start)
            for frame in stream:
                at_s = self._time_s(frame)
                first_s = at_s if first_s is None else first_s
                passed = (at_s - first_s) * self._rate_hz
                place = start + round(passed)
                if place < (done if held is None else held[0]):
                    raise CaptureError("its time stamps run backwards", "open the camera again")
                if held is not None and place > held[0]:
                    yield held
                    done, held = held[0], None
                if done < place < end:
                    off = passed - (place - start)
                    if held is None or abs(off) < held_off:
                        held, held_off = (place, at_s - first_s, frame), abs(off)
                    if off >= -ON_TIME:
                        yield held
                        done, held = place, None
                if place >= end or done + 1 >= end or self._ended:
                    break
                self._announce((done if held is None else place) + 1)
            if held is not None:
                yield held

    def _time_s(self, frame: RawFrame) -> float:
        """Return when a frame was taken: by the camera's own clock, else when it arrived."""
        if frame.camera_time_s is not None:
            return frame.camera_time_s
        return self._clock.now_s() if frame.host_time_s is None else frame.host_time_s

    def _keep(self, place: int, film_s: float, frame: RawFrame) -> None:
        with self._changed:
            if self._waits:
                self._changed.wait_for(lambda: len(self._frames) < self._room or self._ended)
            if len(self._frames) >= self._room:
                self._overflowed.add(place)
                return
            self._frames.append((place, film_s, frame))
            self._changed.notify_all()


def room_for(frame_bytes: int) -> int:
    """Return how many frames of this size may wait in memory."""
    return max(LEAST_ROOM, RING_BYTES // frame_bytes)
