"""The sequencer: every missing frame of a session, one after the other, until it is complete.

`run` sets up, takes frame after frame, and leaves the bench safe. Of each frame `_take_once` shows
the steps: set up (lamp, board, masks), expose (move, settle, expose, download, read back, check),
store. A writer thread stores and journals the frame while the stage already moves to the next. The
frames of a film, which cannot be tried again, have `_take_film`: each is taken at its time, or
dropped. A fault is met by mending what it broke and trying again, within a budget. However a run
ends, the lamp is off and the stage stands when `run` returns or raises.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from functools import partial
from itertools import groupby, takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.bench.environment import read_all
from emmc_rig.bench.hardware import FOCUS, Rig
from emmc_rig.bench.registration import LEAST_LIKENESS, Shift, registered
from emmc_rig.captures.between import Between, HookError, plain
from emmc_rig.captures.by_hand import HandPlaces, WrongPlaceError
from emmc_rig.captures.checks import check, is_same, refuse_impossible
from emmc_rig.captures.control import Control, uninterrupted
from emmc_rig.captures.devices import Devices, Spans
from emmc_rig.captures.estimate import known_exposures, pace_of
from emmc_rig.captures.events import RunEnd, named
from emmc_rig.captures.film import (
    ARRIVAL_POLL_S,
    INTERRUPTED,
    LATE,
    SENT_TWICE,
    Arrived,
    Ring,
    room_for,
    streams,
)
from emmc_rig.captures.focus import FocusFound
from emmc_rig.captures.metering import asked_of_scene, first_meterings, metered_exposure_s
from emmc_rig.captures.plan import Boards, Plan
from emmc_rig.captures.retries import Budget, mending
from emmc_rig.captures.writer import Writer
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.errors import DriverError
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError, StopCapture
from emmc_rig.model.camera import Camera
from emmc_rig.model.json_text import one_line
from emmc_rig.model.settings import validated
from emmc_rig.progress import Event, Watcher
from emmc_rig.session.brightness import figures, level_of
from emmc_rig.session.frame_file import decode_frame, frame_entry, frame_file
from emmc_rig.session.journal import (
    ComparedEntry,
    CompleteEntry,
    DroppedEntry,
    Entry,
    Figures,
    FilmEntry,
    FocusEntry,
    FrameEntry,
    HaltEntry,
    HookEntry,
    ResumedEntry,
    RetryEntry,
    RunEntry,
    SourceEntry,
    metered,
    of_kind,
)
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session, wall_time
from emmc_rig.session.verify import verify_frames
from emmc_rig.store.results import command_line, shown_bytes, versions

REPORTED_BYTES = 1_000_000_000
"""Hashing more takes long enough to be reported."""
REMAINING_TIME_INTERVAL_S = 1.0
"""Least time between two reports of the remaining time."""
STAGE_READ_INTERVAL_S = 1.0
"""How often the stage is read while a film streams: it stands still, and answers slowly."""
ALL_TAKEN = "all frames are taken: finish, or take some once more"
Choose = Callable[[Callable[[], float]], tuple[PlannedFrame, ...]]
"""What to take next, asked again once that is on the disk; it gets the seconds of the run."""


class Sequencer:
    """A run over a session; `run` once.

    choose: by default all that is missing. between: the plan's hook. wall: the time of day.
    """

    def __init__(
        self,
        session: Session,
        plan: Plan,
        rig: Rig,
        watcher: Watcher | None = None,
        control: Control | None = None,
        choose: Choose | None = None,
        between: Between | None = None,
        wall: Callable[[], str] = wall_time,
    ) -> None:
        self._session, self._plan, self._rig = session, plan, rig
        self._watcher = watcher or Watcher()
        self._control = control or Control()
        self._choose = choose or (lambda now_s: session.missing())
        self._between = between
        self._prepared: tuple[str, int] | None = None
        self._silent: dict[str, str] = {}
        self._focused_at: int | None = None
        self._wall = wall
        self._pace = pace_of(rig, plan, rig.clock is SYSTEM_CLOCK)
        self._remaining_reported_s = -REMAINING_TIME_INTERVAL_S
        self._devices = Devices(rig, plan, wall)
        self._budget = Budget(plan.retries)
        self._writer = Writer()
        self._places = self._hand_places()
        self._before: NDArray[np.uint16] | None = None
        self._metered: dict[str, FrameEntry] = {}
        self._left_of_shot: dict[int, set[str]] = {}
        self._began_s = 0.0
        self._taken = self._run = self._more = self._done = self._planned = 0
        # How long the frame before took to hand over: its own line is written by then.
        self._handed: dict[str, tuple[float, float]] = {}
        self._may_saturate = _may_saturate(session.frames)
        self._segment = len(of_kind(session.journal.entries, FilmEntry)) - 1
        # On the clock of the rig, when the first frame of a film's segment was asked for.
        self._film_began_s: float | None = None

    def run(self) -> RunEnd:
        """Take what is missing.

        Raises AppError with one line, a `DriverError` that mending cannot cure, `OSError` of the
        disk, or `KeyboardInterrupt`; stored frames are kept in each case.
        """
        self._began_s = time.perf_counter()
        with self._writer, self._bench_left_safe():
            self._open_session()
            try:
                self._take_missing()
            except StopCapture as end:
                assert self._between is not None
                reason = f"{self._between.name} ended the capture: {one_line(end)}"
                self._note(HaltEntry(kind="stopped", reason=reason))
                self._watcher.tell(reason)
            left = self._close_session()
        return RunEnd(
            not left, self._taken, left, self._budget.spent, time.perf_counter() - self._began_s
        )

    def _take_missing(self) -> None:
        """Take frames until none is to be taken, and let the hook know when all are."""
        frames = self._choose(self._now_s) or self._next()
        ends_by_hook = self._between is not None and not self._session.is_complete
        if frames or (ends_by_hook and not self._session.missing()):
            self._retrying("home", self._devices.home)
        if frames:
            self._compare_with_last_good()
        while frames and self._take_all(frames):
            self._verify_stored({frame.id for frame in frames})
            frames = self._next()
        if ends_by_hook and not self._session.missing():
            self._prepare(None)

    # Set up.

    def _open_session(self) -> None:
        """Note the run, let damaged frames count as missing, and check what is to be taken."""
        session = self._session
        session.make_ready()
        session.note(
            RunEntry(
                versions=versions(),
                command=command_line(),
                resumed=bool(session.stored),
                environment={
                    source.config.name: source.config.unit for source in self._rig.sources
                },
                between={} if self._between is None else self._between.facts(),
                **self._devices.facts(),
            )
        )
        self._run = session.runs
        self._discard_damaged(set(session.stored))
        self._metered = first_meterings(session)
        missing, needed = session.missing(), len(session.needed)
        self._done, self._planned = needed - len(missing), needed
        self._emit("begin", done=self._done, planned=needed)
        refuse_impossible(self._rig, missing)
        self._left_of_shot = self._missing_of_shots()

    def _compare_with_last_good(self) -> None:
        """Take the last good whiteboard once more; raises AppError when the bench has shifted.

        Without a whiteboard the last shot of the scene serves; without that either, nothing does.
        """
        session, devices = self._session, self._devices
        by_id = {frame.id: frame for frame in session.frames}
        latest = [by_id[name] for name in reversed(session.stored) if name in by_id]
        # The scene of a film may be another one by now.
        candidates = [
            *(frame for frame in latest if frame.kind == "whiteboard"),
            *(frame for frame in latest if frame.is_still_shot),
        ]
        if not candidates:
            return
        planned = candidates[0]
        entry = session.stored[planned.id]
        then = decode_frame(session.read(planned.id), entry)
        shift = Shift(0.0, 0.0, 0.0)

        def compare() -> None:
            nonlocal shift
            devices.attend(planned)
            self._prepare(planned)
            if devices.move(planned) and self._plan.settle_s:
                devices.settle()
            shift = registered(devices.snap(planned, entry.exposure_s)[0], then)

        self._retrying(planned.id, compare)
        limit_px = self._plan.checks.registration_px
        good = shift.likeness >= LEAST_LIKENESS and shift.length_px <= limit_px
        facts = {"id": planned.id, **asdict(shift), "limit_px": limit_px}
        self._note(ComparedEntry(kind="registered" if good else "refused", **facts))
        if good:
            return
        what = (
            f"is shifted by {shift.length_px:.2f} px ({shift.x_px:+.2f}, {shift.y_px:+.2f})"
            if shift.likeness >= LEAST_LIKENESS
            else f"looks different (correlation {shift.likeness:.2f})"
        )
        raise AppError(
            f"the bench has changed: frame {planned.id}, captured again, {what}; put "
            "the masks back and check lamp and board, or begin another session"
        )

    def _hand_places(self) -> HandPlaces:
        """Return what finds in frames where hands put things, as the frames so far show the mask.

        Raises AppError where a frame of a session cannot be read.
        """
        session, rig = self._session, self._rig
        hands = rig.hands if self._plan.checks.places_by_hand else frozenset()
        camera = validated(Camera, session.camera, str(session.folder), AppError)
        places = HandPlaces(camera, rig.camera.shape, hands)
        by_id = {frame.id: frame for frame in session.frames}
        for name, entry in session.stored.items() if hands else ():
            if name in by_id and places.shows(by_id[name]):
                places.stand(by_id[name], decode_frame(session.read(name), entry))
                places.set_anew()
                break
        return places

    # What comes next.

    def _next(self) -> tuple[PlannedFrame, ...]:
        """Return what to take next; none where the run is to end.

        Where it stays when all is taken, the lamp is off until frames are wanted once more.
        """
        if not self._may_go_on():
            return ()
        self._discard_retakes()
        frames = self._choose(self._now_s)
        if frames or not self._control.stays or self._session.missing():
            return frames
        if self._devices.sent.lamp is not None:
            self._devices.set_lamp("off")
        return self._next() if self._may_go_on(ALL_TAKEN) else ()

    def _discard_retakes(self) -> None:
        """Count the frames that are wanted once more as not taken; those of a film stay."""
        film = {frame.id for frame in self._session.frames if frame.film is not None}
        wanted = [name for name in self._control.pop_again() if name in self._session.stored]
        if film & set(wanted):
            self._watcher.tell("frames of a film cannot be taken again: their time is over")
        ids = [name for name in wanted if name not in film]
        if not ids:
            return
        self._writer.flush()
        for name in ids:
            self._session.discard(name, "wanted once more")
        self._left_of_shot = self._missing_of_shots()
        # A simulated frame may come out as it was before.
        self._before = None
        self._more += len(ids)
        self._count_planned()
        self._watcher.tell(f"taken once more: {', '.join(ids)}")

    def _missing_of_shots(self) -> dict[int, set[str]]:
        """Return the frames that are missing, by shot."""
        found: dict[int, set[str]] = {}
        for frame in self._session.missing():
            if frame.is_still_shot:
                found.setdefault(frame.bench.shot, set()).add(frame.id)
        return found

    def _may_go_on(self, otherwise: str = "") -> bool:
        """Wait while somebody wants it; returns False when the run is to end.

        otherwise: why to wait while nothing is wanted; "": there is no need to.
        """
        control = self._control

        def reason() -> str:
            wanted = control.stopping or control.again
            if control.paused:
                return "somebody asked for it"
            return "" if wanted else otherwise

        why = reason()
        if why and not control.stopping:
            began_s = self._now_s()
            self._note(HaltEntry(kind="paused", reason=why))
            self._emit("pause", reason=why)
            while why and not control.stopping:
                control.wait()
                why = reason()
            seconds = self._now_s() - began_s
            self._note(ResumedEntry(seconds=seconds))
            self._emit("resume", seconds=round(seconds, 3))
        return not control.stopping

    # Take.

    def _take_all(self, frames: tuple[PlannedFrame, ...]) -> bool:
        """Take the frames; returns False when the capture was asked to stop.

        Ends early where metering the scene asked for more frames than were known of.
        """
        for place, frame in enumerate(frames):
            if not self._may_go_on():
                return False
            if self._control.again:
                return True
            if frame.is_exposed_as_shots and self._decide_exposures():
                return True
            self._prepared = None
            if self._focus_is_due(frame) and not self._focus(frame):
                return False
            if frame.film is not None:
                return self._take_film(frames[place:])
            self._take(frame)
        return True

    def _focus_is_due(self, planned: PlannedFrame) -> bool:
        """Return whether the plan wants the scene focused before a frame; a recording is not."""
        asked = self._plan.focus
        if asked is None or planned.kind != "shot" or self._rig.recorded_s:
            return False
        taken = None if self._focused_at is None else self._taken - self._focused_at
        return taken is None or (asked.every is not None and taken >= asked.every)

    def _focus(self, planned: PlannedFrame) -> bool:
        """Focus on the scene of a frame; returns False when the capture was asked to stop.

        Where no peak is seen the axis is left where it stood, which is told.
        """
        assert self._plan.focus is not None
        devices, span_um = self._devices, self._plan.focus.span_um
        began_s = self._now_s()
        found: FocusFound | None = None
        from_um: float | None = None
        fault = ""

        def attempt() -> None:
            nonlocal found, from_um, fault
            devices.attend(planned)
            self._prepare(planned)
            devices.move(planned)
            if from_um is None:
                from_um = self._rig.stage.position_um(FOCUS)
            else:
                self._rig.stage.move_to_um({FOCUS: from_um})
            try:
                found = devices.focus(
                    planned,
                    self._exposure_s(planned),
                    span_um,
                    lambda: self._control.stopping,
                )
            except AppError as unseen:
                fault = str(unseen)

        self._retrying(planned.id, attempt)
        if found is None and not fault:
            return False
        assert from_um is not None
        self._focused_at = self._taken
        place_um, deviation_um = (
            (None, None) if found is None else (found.place_um, found.deviation_um)
        )
        entry = FocusEntry(
            id=planned.id,
            from_um=from_um,
            place_um=place_um,
            deviation_um=deviation_um,
            fault=fault,
            at_s=began_s,
            seconds=round(self._now_s() - began_s, 6),
        )
        self._note(entry)
        self._watcher.tell(str(entry))
        return True

    def _take(self, planned: PlannedFrame) -> None:
        """Take a frame, with as many tries as it needs, and learn from it how long frames take."""
        attempts = 0
        span = Spans(self._now_s, self._emit_step)

        def attempt() -> None:
            nonlocal attempts, span
            attempts += 1
            span = Spans(self._now_s, self._emit_step)
            self._take_once(planned, span, attempts)

        began_s, before_um = self._now_s(), dict(self._devices.sent.offsets_um)
        self._retrying(planned.id, attempt)
        self._taken += 1
        if attempts == 1:
            attended = span.seconds["attend"]
            self._pace.learn(
                self._now_s() - began_s - (attended[1] - attended[0]),
                self._devices.sent.exposure_s or 0.0,
                self._pace.moving_s(planned, before_um),
            )
        self._report_remaining(planned)

    def _take_once(self, planned: PlannedFrame, span: Spans, attempts: int) -> None:
        """Set up, expose, store; raises a `DriverError` for a frame that cannot be right."""
        devices = self._devices
        with span("attend", planned):
            devices.attend(planned)
        if self._between is not None:
            with span("between", planned):
                self._prepare(planned)
        frame, found = devices.move_and_expose(planned, self._exposure_s(planned), span)
        with span("read back", planned):
            read_um, unsure_um = devices.read_back_um(planned), {}
            beside = {**devices.beside(), "environment": self._read_sources()}
        with span("check", planned):
            may_saturate = planned.id in self._may_saturate
            check(planned, frame, found, self._before, self._plan.checks, may_saturate)
            place = self._places.found(planned, frame)
            if place is not None:
                read_um |= place.um
                unsure_um = dict.fromkeys(place.um, place.deviation_um)
        self._emit_taken(planned, frame, found)
        span.seconds.update(self._handed)
        handing = Spans(self._now_s, self._emit_step)
        with handing("hand over", planned):
            self._hand_over(
                planned,
                frame,
                found,
                dict(span.seconds),
                read_um=read_um,
                deviation_um=unsure_um,
                attempts=attempts,
                **beside,
            )
        self._handed, self._before = handing.seconds, frame.mosaic

    def _take_film(self, frames: tuple[PlannedFrame, ...]) -> bool:
        """Take a film's frames, each at its time; returns False when asked to stop.

        A pause, or a fault that is mended, ends a segment: the film goes on at its next place in
        a new segment. Frames missing before the last stored frame stay missing.
        """
        self._writer.flush()
        session = self._session
        film = [frame for frame in session.frames if frame.film is not None]
        last = max((_place(frame) for frame in film if frame.id in session.stored), default=-1)
        left = list(frames)
        self._drop(left, last + 1, lambda place: INTERRUPTED)
        is_streamed = streams(self._plan, self._devices.camera)
        take = self._take_stream if is_streamed else self._take_steps
        while left and self._may_go_on():
            if self._control.again:
                return True
            self._retrying(left[0].id, partial(take, left))
        self._writer.flush()
        self._count_planned()
        return not left

    def _begin_segment(self, planned: PlannedFrame) -> None:
        assert self._plan.film is not None
        self._segment, self._film_began_s = self._segment + 1, None
        rate = self._plan.film.rate
        self._note(FilmEntry(segment=self._segment, id=planned.id, rate_hz=rate))

    def _drop(self, left: list[PlannedFrame], end: int, why: Callable[[int], str]) -> None:
        """Take note that the frames left before a place are dropped; why: by place."""
        gone = list(takewhile(lambda frame: _place(frame) < end, left))
        del left[: len(gone)]
        for reason, frames in groupby(gone, lambda frame: why(_place(frame))):
            entry = DroppedEntry(ids=[frame.id for frame in frames], reason=reason)
            self._note(entry)
            self._watcher.tell(str(entry))

    @property
    def _halting(self) -> bool:
        """Whether somebody wants something else than the next frame."""
        control = self._control
        return control.stopping or control.paused or control.again

    def _take_stream(self, left: list[PlannedFrame]) -> None:
        """Take a segment of a film from the camera's stream; what is taken or dropped leaves left.

        Ends early where somebody pauses or stops; raises what the camera raises.
        """
        devices, rig, film = self._devices, self._rig, self._plan.film
        assert film is not None
        first = left[0]
        devices.attend(first)
        self._prepare(first)
        if devices.move(first) and self._plan.settle_s:
            devices.settle()
        devices.set_camera(first, self._exposure_s(first))
        self._begin_segment(first)
        read_s, beside = -STAGE_READ_INTERVAL_S, dict[str, Any]()
        places = range(_place(first), _place(left[-1]) + 1)
        with Ring(devices.camera, film.rate, places, room_for(devices.camera, rig.clock)) as ring:
            for arrived in ring:
                if self._halting:
                    ring.stop()
                if arrived is None:
                    continue
                self._drop(left, arrived.place, ring.why_missing)
                if self._now_s() - read_s >= STAGE_READ_INTERVAL_S:
                    read_s = self._now_s()
                    beside = {
                        "read_um": devices.read_back_um(left[0]),
                        **devices.beside(streaming=True),
                        "environment": self._read_sources(),
                    }
                devices.asked = self._wall(), rig.clock.now_s()
                self._take_arrived(left, arrived, beside)
        if not self._halting:
            self._drop(left, places.stop, ring.why_missing)

    def _take_arrived(
        self, left: list[PlannedFrame], arrived: Arrived, beside: Mapping[str, Any]
    ) -> None:
        """Store the next frame left of a film, or drop it where the camera sent one twice.

        A segment's first must pass every check; a flash or darkness later is the scene's own.
        """
        planned, frame, found = left[0], arrived.frame, figures(arrived.frame)
        self._emit_step("check", planned)
        if arrived.film_s == 0:
            check(planned, frame, found, self._before, self._plan.checks)
        if self._before is not None and is_same(frame.mosaic, self._before):
            self._drop(left, arrived.place + 1, lambda place: SENT_TWICE)
            return
        left.pop(0)
        self._emit_taken(planned, frame, found)
        self._hand_over(planned, frame, found, {}, film_s=arrived.film_s, **beside)
        self._before = frame.mosaic
        self._taken += 1
        self._report_remaining(planned)

    def _take_steps(self, left: list[PlannedFrame]) -> None:
        """Take a segment of a film frame by frame, the stage moving in between, as `_take_stream`.

        A frame whose time is over by more than half a period is dropped.
        """
        rig, film, first = self._rig, self._plan.film, left[0]
        assert film is not None
        self._begin_segment(first)
        while left and not self._halting:
            if self._film_began_s is not None and not rig.recorded_s:
                passed = (rig.clock.now_s() - self._film_began_s) * film.rate
                due = _place(first) + passed
                self._drop(left, math.ceil(due - 0.5), lambda place: LATE)
                if left and _place(left[0]) > due:
                    # A hook is called before any axis moves.
                    if self._between is None and self._devices.move(left[0]):
                        continue
                    wait_s = (_place(left[0]) - due) / film.rate
                    rig.clock.sleep(min(wait_s, ARRIVAL_POLL_S))
                    continue
            if left:
                self._prepared = None
                self._take(left[0])
                left.pop(0)

    def _film_s(self, planned: PlannedFrame) -> float:
        """Return when a film's frame was asked for, in seconds from the first of its segment."""
        assert self._plan.film is not None
        asked_s = self._devices.asked[1]
        if self._film_began_s is None:
            self._film_began_s = asked_s
        if self._rig.recorded_s:
            return _place(planned) / self._plan.film.rate
        return asked_s - self._film_began_s

    def _prepare(self, planned: PlannedFrame | None) -> None:
        """Call the plan's hook, once a frame, and again where the stage was homed since.

        planned: None after the last one. Raises `HookError`; `StopCapture` before a frame.
        """
        hook, devices = self._between, self._devices
        now = ("" if planned is None else planned.id), devices.homings
        if hook is None or self._prepared == now:
            return
        self._writer.flush()
        began_s, noted, fault = self._now_s(), dict[str, Any](), "stopped"
        rig = replace(self._rig, camera=devices.camera)
        self._control.between_frames = True
        try:
            hook.call(rig, planned, lambda **facts: noted.update(plain(facts)))
            fault = ""
        except StopCapture as end:
            fault = f"ended the capture: {one_line(end)}"
            if planned is not None:
                raise
        except (Exception, SystemExit) as error:
            fault = hook.shown(error)
            raise HookError(hook, now[0], error) from error
        finally:
            self._control.between_frames = False
            self._note(
                HookEntry(
                    id=now[0],
                    name=hook.name,
                    notes=noted,
                    fault=fault,
                    at_s=began_s,
                    seconds=round(self._now_s() - began_s, 6),
                )
            )
        devices.look_again()
        if planned is not None:
            devices.attend(planned)
        self._prepared = now

    def _read_sources(self) -> dict[str, float]:
        """Return what the rig's sources say; one that fails, or does again, is noted once."""
        values, faults = read_all(self._rig.sources)
        for name in faults.keys() | self._silent.keys():
            fault = faults.get(name, "")
            if fault != self._silent.get(name, ""):
                entry = SourceEntry(name=name, fault=fault)
                self._note(entry)
                self._watcher.tell(f"environment, {name}: {fault or 'gives values again'}")
        self._silent = faults
        return values

    def _exposure_s(self, planned: PlannedFrame) -> float:
        """Return the exposure to ask the camera for."""
        if planned.id in self._rig.recorded_s:
            return self._rig.recorded_s[planned.id]
        if planned.exposure_s is not None:
            return planned.exposure_s
        if planned.is_exposed_as_shots:
            asked = metered(self._session.journal.entries)
            assert asked is not None
            return asked.exposures_s[planned.bench.shot] * planned.light
        assert planned.metered_by is not None
        entry = self._metered[planned.metered_by]
        level = (self._plan.whiteboards or Boards()).level
        limits_s = self._devices.camera.exposure_limits_s
        return metered_exposure_s(entry, level, planned.light, limits_s)

    def _decide_exposures(self) -> bool:
        """Decide once by what metered shots are exposed; returns whether frames were added."""
        session = self._session
        if metered(session.journal.entries) is not None:
            return False
        low_s, high_s = self._devices.camera.exposure_limits_s
        limits_s = low_s, min(high_s, self._plan.longest_s)
        asked = asked_of_scene(session.frames, self._metered, self._plan.metering, limits_s)
        self._note(asked)
        self._writer.flush()
        self._watcher.tell(str(asked))
        self._remaining_reported_s = -REMAINING_TIME_INTERVAL_S
        if not asked.asked:
            return False
        self._left_of_shot = self._missing_of_shots()
        self._count_planned()
        return True

    def _report_remaining(self, taken: PlannedFrame) -> None:
        """Report from time to time how long the rest will take."""
        now_s = self._now_s()
        if now_s - self._remaining_reported_s < REMAINING_TIME_INTERVAL_S:
            return
        self._remaining_reported_s = now_s
        left = [frame for frame in self._session.missing() if frame.id != taken.id]
        decided = metered(self._session.journal.entries)
        known = known_exposures(self._plan, self._metered, decided)
        rest = self._pace.estimate(left, known, self._devices.sent.offsets_um)
        self._emit("left", seconds=round(rest.seconds, 3), guessed=rest.guessed)

    def _retrying(self, name: str, attempt: Callable[[], None]) -> None:
        """Try until it works or the budget is spent."""
        faults = 0
        todo = attempt
        while True:
            try:
                todo()
                if todo is attempt:
                    return
                todo = attempt
            except DriverError as error:
                faults += 1
                at_s = self._now_s()
                self._note(RetryEntry(id=name, fault=str(error), attempt=faults, at_s=at_s))
                self._budget.spend(name, error, faults)
                self._watcher.tell(f"{name}, try {faults}: {error}")
                if isinstance(error, WrongPlaceError):
                    self._rig.attendant.again(error.axes)
                todo = partial(self._devices.mend, mending(error, faults))

    # Store.

    def _hand_over(
        self,
        planned: PlannedFrame,
        frame: RawFrame,
        found: Figures,
        spans_s: dict[str, tuple[float, float]],
        **about: Any,
    ) -> None:
        """Give a frame to the writer's thread, with what its journal line says (`about` it)."""
        camera = self._devices.camera
        wall, monotonic_s = self._devices.asked
        if planned.film is not None:
            about = {"segment": self._segment, "film_s": self._film_s(planned)} | about
        entry = frame_entry(
            frame,
            # Only asked for where it is needed: a camera may read its next frame for that.
            camera.exposure_s if frame.exposure_s is None else frame.exposure_s,
            camera.gain if frame.gain is None else frame.gain,
            run=self._run,
            plan=self._session.amendments,
            lamp=planned.bench.lamp,
            commanded_um=dict(planned.bench.offsets_um),
            figures=found,
            wall=wall,
            monotonic_s=monotonic_s,
            **about,
        )
        if planned.kind == "metering":
            self._metered.setdefault(planned.id, entry)
        self._writer.put(partial(self._store, planned, frame, entry, spans_s))

    def _store(
        self,
        planned: PlannedFrame,
        frame: RawFrame,
        entry: FrameEntry,
        spans_s: dict[str, tuple[float, float]],
    ) -> None:
        """Write a frame and its journal line; runs in the writer's thread."""
        self._emit_step("write", planned)
        began_s = self._now_s()
        file = frame_file(frame)

        def written() -> FrameEntry:
            spans = {**spans_s, "write": (began_s, self._now_s())}
            return entry.model_copy(update={"spans_s": spans})

        session, shot = self._session, planned.bench.shot
        session.store(planned, file, written)
        self._done += 1
        self._emit("frame.written", **named(planned), done=self._done, planned=self._planned)
        left = self._left_of_shot.get(shot, set())
        if planned.id in left:
            left.remove(planned.id)
            if not left:
                self._emit("shot.done", shot=shot)

    def _verify_stored(self, ids: set[str]) -> None:
        """Read back what was written; a damaged frame is spent from the budget and taken again."""
        self._writer.flush()
        for name, fault in self._discard_damaged(ids).items():
            self._budget.spend(name, DriverError(fault), 1)

    def _discard_damaged(self, ids: set[str]) -> dict[str, str]:
        """Read files again; return the faults of damaged files, which no longer count, by id."""
        session = self._session
        planned = {frame.id for frame in session.frames} & ids
        entries = [entry for name, entry in session.stored.items() if name in planned]
        size = sum(entry.bytes for entry in entries)
        if size > REPORTED_BYTES:
            self._watcher.tell(f"hashing {len(entries)} frames, {shown_bytes(size)}")
        damaged = verify_frames(session, entries)
        for name, fault in damaged.items():
            session.discard(name, fault)
            self._watcher.tell(f"{fault}; it is taken again")
        return damaged

    # Make known.

    def _emit(self, name: str, **facts: Any) -> None:
        self._watcher.event(Event(name, facts))

    def _emit_step(self, step: str, planned: PlannedFrame) -> None:
        facts = {"id": planned.id, "step": step}
        self._watcher.event(Event("step", facts, {"planned": planned}))

    def _emit_taken(self, planned: PlannedFrame, frame: RawFrame, found: Figures) -> None:
        facts = {
            **named(planned),
            "exposure_s": frame.exposure_s,
            "level": level_of(frame, found),
            "saturated": found.saturated,
        }
        self._watcher.event(Event("frame.taken", facts, {"planned": planned, "frame": frame}))

    def _count_planned(self) -> None:
        """Count the frames to take in all, which are more or fewer than before."""
        self._planned = len(self._session.needed) + self._more
        self._emit("planned", planned=self._planned)

    def _note(self, entry: Entry) -> None:
        self._writer.put(partial(self._session.note, entry))

    # Tear down.

    def _close_session(self) -> int:
        """Note that the session is complete where it is; return how many frames are missing."""
        self._writer.flush()
        session = self._session
        left = len(session.missing())
        if not left and not session.is_complete:
            session.note(CompleteEntry(frames=len(session.needed)))
        return left

    @contextmanager
    def _bench_left_safe(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            with uninterrupted():
                with suppress(DriverError):
                    self._rig.stage.stop()
                # Where the disk fails, that is reported already.
                if isinstance(error, Exception | KeyboardInterrupt):
                    with suppress(Exception):
                        reason = str(error) or "stopped at once by the user"
                        self._note(HaltEntry(kind="stopped", reason=reason))
            raise
        finally:
            with uninterrupted():
                self._devices.make_safe()

    def _now_s(self) -> float:
        return round(time.perf_counter() - self._began_s, 6)


def _place(frame: PlannedFrame) -> int:
    """Return the place in time of a film's frame."""
    assert frame.film is not None
    return frame.film


def _may_saturate(frames: tuple[PlannedFrame, ...]) -> set[str]:
    """Return the ids of metering frames, and of those with a shorter exposure in their bracket."""

    def exposed(frame: PlannedFrame) -> float:
        return frame.light if frame.exposure_s is None else frame.exposure_s

    shortest: dict[int, float] = {}
    for frame in frames:
        if frame.kind == "shot":
            shot = frame.bench.shot
            shortest[shot] = min(exposed(frame), shortest.get(shot, exposed(frame)))
    return {
        frame.id
        for frame in frames
        if frame.kind == "metering"
        or (frame.kind == "shot" and exposed(frame) != shortest[frame.bench.shot])
    }
