"""The sequencer: every missing frame of a session, one after the other, until it is complete.

For each frame: attend (lamp, board, masks), move, settle, expose and download, read the stage
back, check, hand over. A writer thread stores and journals the frame while the stage already moves
to the next. A fault is met by mending what it broke and trying again, within a budget. However a
run ends, the lamp is off and the stage stands when `run` returns or raises.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.camera import Camera as CameraDevice
from drivers.clock import SYSTEM_CLOCK
from drivers.errors import DriverError
from drivers.raw import RawFrame
from emmc_rig.acquisition.checks import (
    LEAST_LIKENESS,
    Figures,
    FrameRefusedError,
    check,
    figures,
)
from emmc_rig.acquisition.control import Control, uninterrupted
from emmc_rig.acquisition.estimate import Exposures, known_exposures, pace_of
from emmc_rig.acquisition.metering import (
    METERING_TRIES,
    asked_of_scene,
    better_metering_s,
    first_meterings,
    metered_exposure_s,
)
from emmc_rig.acquisition.plan import Boards, Plan
from emmc_rig.acquisition.preflight import refuse_impossible
from emmc_rig.acquisition.retries import Budget, mending
from emmc_rig.acquisition.suspend import Suspend
from emmc_rig.acquisition.watcher import CaptureWatcher, RunEnd
from emmc_rig.acquisition.writer import Writer
from emmc_rig.bench.hardware import Rig
from emmc_rig.bench.registration import Shift, registered
from emmc_rig.bench.trigger import EDGE_WAIT_S, signalling, triggered
from emmc_rig.errors import AppError
from emmc_rig.files.results import command_line, shown_bytes, versions
from emmc_rig.session.decisions import metered, metered_words
from emmc_rig.session.frame_file import decode_frame, frame_facts, frame_file
from emmc_rig.session.journal import Entry
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session, wall_time
from emmc_rig.session.verify import verify_frames

TOLD_BYTES = 1_000_000_000
"""Hashing more takes long enough to be reported."""
TELL_LEFT_S = 1.0
"""Between two times that the time left is said."""
ALL_TAKEN = "all frames are taken: finish, or take some once more"
LARGEST_EXPOSURE_RATIO = 1.5
"""A camera may take the nearest of full stops, which is off by at most half a stop."""


@dataclass
class _Applied:
    """What was last sent to the devices; empty: nothing is known."""

    bench: tuple | None = None
    lamp: str | None = None
    offsets_um: dict[str, float] = field(default_factory=dict)
    exposure_s: float | None = None
    gain: float | None = None


Choose = Callable[[Callable[[], float]], tuple[PlannedFrame, ...]]
"""What to take next, asked again once that is on the disk; it gets the seconds of the run."""


class Sequencer:
    """A run over a session; `run` once.

    choose: by default all that is missing. exposures: what is known of those that will be metered,
    for the time that is left. suspended: why it has to wait. timer: seconds that never run
    backwards, for the timeline; wall: the time of day, for people.
    """

    def __init__(
        self,
        session: Session,
        plan: Plan,
        rig: Rig,
        watcher: CaptureWatcher | None = None,
        control: Control | None = None,
        choose: Choose | None = None,
        timer: Callable[[], float] = time.perf_counter,
        wall: Callable[[], str] = wall_time,
        exposures: Exposures | None = None,
        suspended: Suspend = lambda: "",
    ) -> None:
        self._session, self._plan, self._rig = session, plan, rig
        self._watcher = watcher or CaptureWatcher()
        self._control = control or Control()
        self._choose = choose or (lambda now_s: session.missing())
        self._timer, self._wall = timer, wall
        self._suspended = suspended
        self._exposures = exposures or Exposures(plan)
        self._pace = pace_of(rig, plan, rig.clock is SYSTEM_CLOCK)
        self._left_told_s = -TELL_LEFT_S
        self._camera: CameraDevice = rig.camera
        self._applied = _Applied()
        self._budget = Budget(plan.retries)
        self._writer = Writer()
        self._before: NDArray[np.uint16] | None = None
        self._metered: dict[str, Entry] = {}
        self._triggered = False
        self._left_of_shot: dict[int, set[str]] = {}
        self._began_s = 0.0
        self._taken = self._run = self._more = 0
        # How long the frame before took to hand over: its own line is written by then.
        self._handed: dict[str, list[float]] = {}
        self._may_saturate = _may_saturate(session.frames)

    def run(self) -> RunEnd:
        """Take what is missing.

        Raises AppError with one line, a `DriverError` that mending cannot cure, `OSError` of the
        disk, or `KeyboardInterrupt`; what was stored until then is kept.
        """
        session = self._session
        self._began_s = self._timer()
        with self._writer, self._bench_left_safe():
            session.make_ready()
            session.note("run", **self._facts())
            self._run = session.runs
            whole = set(session.stored)
            self._discard_damaged(whole)
            self._metered = first_meterings(session)
            missing, needed = session.missing(), len(session.needed)
            self._watcher.begin(needed - len(missing), needed)
            refuse_impossible(self._rig, missing)
            self._left_of_shot = self._missing_of_shots()
            frames = self._choose(self._now_s) or self._next()
            if frames:
                self._retrying("home", self._home)
                self._compare_with_last_good()
            while frames and self._take_all(frames):
                self._writer.flush()
                taken = {frame.id for frame in frames}
                for name, fault in self._discard_damaged(taken).items():
                    self._budget.spend(name, DriverError(fault), 1)
                frames = self._next()
            self._writer.flush()
            left = len(session.missing())
            if not left and not session.is_complete:
                session.note("complete", frames=len(session.needed), wall=self._wall())
        return RunEnd(
            not left, self._taken, left, self._budget.spent, self._timer() - self._began_s
        )

    def _next(self) -> tuple[PlannedFrame, ...]:
        """Return what to take next; none where the run is to end.

        Where it stays when all is taken, the lamp is off until frames are wanted once more.
        """
        if not self._may_go_on():
            return ()
        self._discard_unwanted()
        frames = self._choose(self._now_s)
        if frames or not self._control.stays or self._session.missing():
            return frames
        if self._applied.lamp not in (None, "off"):
            self._rig.attendant.set_lamp("off")
            self._applied.lamp = "off"
        return self._next() if self._may_go_on(ALL_TAKEN) else ()

    def _discard_unwanted(self) -> None:
        """Let frames that somebody wants once more count as not taken."""
        ids = [name for name in self._control.pop_again() if name in self._session.stored]
        if not ids:
            return
        self._writer.flush()
        for name in ids:
            self._session.discard(name, "wanted once more")
        self._left_of_shot = self._missing_of_shots()
        # A simulated frame may come out as it was before.
        self._before = None
        self._more += len(ids)
        self._watcher.more(len(self._session.needed) + self._more)
        self._watcher.tell(f"taken once more: {', '.join(ids)}")

    def _missing_of_shots(self) -> dict[int, set[str]]:
        """Return by shot which frames of it are still to be taken."""
        found: dict[int, set[str]] = {}
        for frame in self._session.missing():
            if frame.kind == "shot":
                found.setdefault(frame.bench.shot, set()).add(frame.id)
        return found

    def _facts(self) -> dict[str, Any]:
        rig, camera = self._rig, self._camera
        settings = {}
        with suppress(DriverError):
            # Other values, such as the battery's, a camera may not report.
            settings = dict(getattr(camera, "details", dict)())
        return {
            "wall": self._wall(),
            "versions": versions(),
            "command": command_line(),
            "resumed": bool(self._session.stored),
            "camera": {**asdict(camera.identity), "shape": list(camera.shape), "cfa": camera.cfa},
            "camera_settings": settings,
            "stage": {
                axis: {
                    "limits_um": list(rig.stage.limits_um(axis)),
                    "speed_um_s": rig.stage.speed_um_s(axis),
                    "zero_um": rig.zero_um.get(axis, 0.0),
                }
                for axis in rig.stage.axes
            },
        }

    def _home(self) -> None:
        if self._rig.stage.axes:
            self._rig.stage.home()
        if self._rig.stands_um:
            self._rig.stage.move_to_um(self._rig.stands_um)
        self._applied = _Applied()

    def _take_all(self, frames: tuple[PlannedFrame, ...]) -> bool:
        """Take the frames; returns False when the capture was asked to stop.

        Ends early where metering the scene asked for more frames than were known of.
        """
        for frame in frames:
            if not self._may_go_on():
                return False
            if self._control.again:
                return True
            if frame.is_exposed_as_shots and self._decide_exposures():
                return True
            self._take(frame)
        return True

    def _may_go_on(self, otherwise: str = "") -> bool:
        """Wait while somebody or a condition wants it; returns False when the run is to end.

        otherwise: why to wait while nothing is wanted; "": there is no need to.
        """
        control = self._control

        def reason() -> str:
            wished = control.stopping or control.again
            return self._why_wait() or ("" if wished else otherwise)

        why = reason()
        if why and not control.stopping:
            began_s = self._now_s()
            self._note("paused", reason=why, wall=self._wall())
            self._watcher.paused(why)
            while why and not control.stopping:
                control.wait()
                why = reason()
            seconds = self._now_s() - began_s
            self._note("resumed", seconds=seconds, wall=self._wall())
            self._watcher.resumed(seconds)
        return not control.stopping

    def _why_wait(self) -> str:
        return "somebody asked for it" if self._control.paused else self._suspended()

    def _decide_exposures(self) -> bool:
        """Decide once by what metered shots are exposed; returns whether frames were added."""
        session = self._session
        if metered(session.journal.entries) is not None:
            return False
        asked = asked_of_scene(
            session.frames, self._metered, self._plan.metering, self._camera.exposure_limits_s
        )
        self._note("metered", **asked, wall=self._wall())
        self._writer.flush()
        self._watcher.tell(metered_words(asked))
        self._left_told_s = -TELL_LEFT_S
        if not asked["asked"]:
            return False
        self._left_of_shot = self._missing_of_shots()
        self._watcher.more(len(session.needed) + self._more)
        return True

    def _take(self, planned: PlannedFrame) -> None:
        spans: dict[str, list[float]] = {}
        attempts = 0

        def attempt() -> None:
            nonlocal attempts
            attempts += 1
            spans.clear()
            frame, found, read_um = self._attempt(planned, spans)
            self._watcher.taken(planned, frame, found)
            spans.update(self._handed)
            self._handed = {}
            with self._span("hand over", planned, self._handed):
                self._hand_over(planned, frame, found, read_um, spans, attempts)
            self._before = frame.mosaic

        began_s, before_um = self._now_s(), dict(self._applied.offsets_um)
        self._retrying(planned.id, attempt)
        self._taken += 1
        if attempts == 1:
            by_hand_s = spans["attend"][1] - spans["attend"][0]
            self._pace.learn(
                self._now_s() - began_s - by_hand_s,
                self._applied.exposure_s or 0.0,
                self._pace.moving_s(planned, before_um),
            )
        self._tell_left(planned)

    def _tell_left(self, taken: PlannedFrame) -> None:
        """Say from time to time how long the rest will take."""
        now_s = self._now_s()
        if now_s - self._left_told_s < TELL_LEFT_S:
            return
        self._left_told_s = now_s
        left = [frame for frame in self._session.missing() if frame.id != taken.id]
        known = known_exposures(self._exposures, self._metered, self._session.journal.entries)
        rest = self._pace.estimate(left, known, self._applied.offsets_um)
        self._watcher.left(rest.seconds, rest.guessed)

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
                self._note("retry", id=name, fault=str(error), attempt=faults, at_s=self._now_s())
                self._budget.spend(name, error, faults)
                self._watcher.tell(f"{name}, try {faults}: {error}")
                todo = partial(self._mend, error, faults)

    def _mend(self, error: DriverError, faults: int) -> None:
        what = mending(error, faults)
        self._rig.clock.sleep(what.wait_s)
        self._applied = _Applied()
        if what.reopen_camera and self._rig.reopen_camera is not None:
            with suppress(DriverError):
                self._camera.close()
            self._camera = self._rig.reopen_camera()
        if what.reconnect_stage:
            self._rig.stage.reconnect()
        if what.home:
            self._home()

    def _attempt(
        self, planned: PlannedFrame, spans: dict[str, list[float]]
    ) -> tuple[RawFrame, Figures, dict[str, float]]:
        rig = self._rig
        with self._span("attend", planned, spans):
            self._attend(planned)
        axis = self._axis_that_triggers(planned)
        self._triggered = axis is not None
        if axis is not None:
            frame = self._arrive_and_expose(planned, axis, spans)
            found = figures(frame)
        else:
            with self._span("move", planned, spans):
                moved = self._move(planned)
            if moved and self._plan.settle_s:
                with self._span("settle", planned, spans):
                    rig.clock.sleep(self._plan.settle_s)
            with self._span("expose", planned, spans):
                exposure_s = self._exposure_s(planned)
                frame, found = self._expose(planned, exposure_s)
        with self._span("read back", planned, spans):
            read_um = self._read_back(planned)
        with self._span("check", planned, spans):
            may_saturate = planned.id in self._may_saturate
            check(planned, frame, found, self._before, self._plan.checks, may_saturate)
        return frame, found, read_um

    def _attend(self, planned: PlannedFrame) -> None:
        rig, bench, applied = self._rig, planned.bench, self._applied
        if bench.lamp != "off" and applied.bench != bench.set_by_hand:
            applied.bench = None
            rig.attendant.place(bench.target, bench.board_turn_deg)
            rig.attendant.fit_masks(bench.fitting, bench.masks_in)
            applied.bench = bench.set_by_hand
        if applied.lamp != bench.lamp:
            applied.lamp = None
            rig.attendant.set_lamp(bench.lamp)
            applied.lamp = bench.lamp

    def _move(self, planned: PlannedFrame) -> bool:
        """Bring the stage to its place; returns whether it moved."""
        applied, zero_um = self._applied.offsets_um, self._rig.zero_um
        wanted = self._wanted_um(planned)
        if not wanted:
            return False
        for axis in wanted:
            applied.pop(axis, None)
        self._rig.stage.move_to_um({axis: zero_um[axis] + um for axis, um in wanted.items()})
        applied |= wanted
        return True

    def _wanted_um(self, planned: PlannedFrame) -> dict[str, float]:
        """Return by axis where the stage does not stand yet, from each axis's zero."""
        applied = self._applied.offsets_um
        return {
            axis: um for axis, um in planned.bench.offsets_um.items() if applied.get(axis) != um
        }

    def _axis_that_triggers(self, planned: PlannedFrame) -> str | None:
        """Return the axis whose arrival begins the exposure; None: the program asks for it.

        A controller raises its output when one axis arrives, so that it must be the only one that
        moves. Metering looks at a frame before it takes the next.
        """
        wanted = list(self._wanted_um(planned))
        trigger = self._rig.trigger
        if trigger is None or planned.kind == "metering" or len(wanted) != 1:
            return None
        return wanted[0] if wanted[0] in trigger.outputs else None

    def _arrive_and_expose(
        self, planned: PlannedFrame, axis: str, spans: dict[str, list[float]]
    ) -> RawFrame:
        rig, applied = self._rig, self._applied.offsets_um
        assert rig.trigger is not None
        offset_um = planned.bench.offsets_um[axis]
        rig.about_to_expose(planned.id)
        self._set_camera(planned, self._exposure_s(planned))
        delay_s = rig.trigger.delay_s + self._plan.settle_s
        with triggered(self._camera).armed(rig.trigger.line, delay_s) as receive:
            with self._span("move", planned, spans):
                applied.pop(axis, None)
                target_um = rig.zero_um[axis] + offset_um
                output = rig.trigger.outputs[axis]
                signalling(rig.stage).move_and_signal_um(axis, target_um, output)
                applied[axis] = offset_um
            with self._span("expose", planned, spans):
                return receive(EDGE_WAIT_S)

    def _read_back(self, planned: PlannedFrame) -> dict[str, float]:
        """Return where the axes stand after the exposure; raises when they do not stand there."""
        read_um = {}
        for axis, offset_um in planned.bench.offsets_um.items():
            at_um = self._rig.stage.position_um(axis) - self._rig.zero_um[axis]
            if abs(at_um - offset_um) > self._plan.checks.stage_um:
                raise FrameRefusedError(
                    planned.id,
                    f"was exposed while {axis} stood {at_um - offset_um:+.2f} um off its place",
                    "check that nothing pushes the stage",
                )
            read_um[axis] = at_um
        return read_um

    def _exposure_s(self, planned: PlannedFrame) -> float:
        """Return the exposure to ask the camera for."""
        if planned.id in self._rig.recorded_s:
            return self._rig.recorded_s[planned.id]
        if planned.exposure_s is not None:
            return planned.exposure_s
        if planned.is_exposed_as_shots:
            asked = metered(self._session.journal.entries)
            assert asked is not None
            return asked["exposures_s"][str(planned.bench.shot)] * planned.light
        assert planned.metered_by is not None
        entry = self._metered[planned.metered_by]
        level = (self._plan.whiteboards or Boards()).level
        return metered_exposure_s(entry, level, planned.light, self._camera.exposure_limits_s)

    def _expose(self, planned: PlannedFrame, exposure_s: float) -> tuple[RawFrame, Figures]:
        if planned.kind != "metering" or planned.id in self._rig.recorded_s:
            return self._snap(planned, exposure_s)
        low_s, high_s = self._camera.exposure_limits_s
        if planned.bench.target == "scene":
            high_s = min(high_s, self._plan.metering.longest_s)
        for _ in range(METERING_TRIES):
            frame, found = self._snap(planned, exposure_s)
            next_s = better_metering_s(frame, found, exposure_s, (low_s, high_s))
            if next_s is None:
                break
            exposure_s = next_s
        return frame, found

    def _snap(self, planned: PlannedFrame, exposure_s: float) -> tuple[RawFrame, Figures]:
        self._rig.about_to_expose(planned.id)
        self._set_camera(planned, exposure_s)
        frame = self._camera.snap()
        return frame, figures(frame)

    def _set_camera(self, planned: PlannedFrame, exposure_s: float) -> None:
        camera, applied = self._camera, self._applied
        if applied.gain != planned.gain:
            applied.gain = None
            camera.set_gain(planned.gain)
            applied.gain = planned.gain
        if applied.exposure_s != exposure_s:
            applied.exposure_s = None
            camera.set_exposure_s(exposure_s)
            ratio = camera.exposure_s / exposure_s
            if not 1 / LARGEST_EXPOSURE_RATIO < ratio < LARGEST_EXPOSURE_RATIO:
                raise FrameRefusedError(
                    planned.id,
                    f"would be exposed for {camera.exposure_s:g} s instead of {exposure_s:g} s",
                    "set the camera to manual exposure",
                )
            applied.exposure_s = exposure_s

    def _hand_over(
        self,
        planned: PlannedFrame,
        frame: RawFrame,
        found: Figures,
        read_um: Mapping[str, float],
        spans: dict[str, list[float]],
        attempts: int,
    ) -> None:
        exposure_s = frame.exposure_s if frame.exposure_s is not None else self._camera.exposure_s
        entry = {
            "run": self._run,
            "plan": self._session.amendments,
            **frame_facts(frame),
            "exposure_s": exposure_s,
            "gain": frame.gain if frame.gain is not None else self._camera.gain,
            "lamp": planned.bench.lamp,
            "commanded_um": dict(planned.bench.offsets_um),
            "read_um": dict(read_um),
            "figures": found.as_dict(),
            "triggered": self._triggered,
            "attempts": attempts,
            "wall": self._wall(),
        }
        if planned.kind == "metering":
            self._metered.setdefault(planned.id, entry)
        kept = dict(spans)
        self._writer.put(partial(self._store, planned, frame, entry, kept))

    def _store(
        self,
        planned: PlannedFrame,
        frame: RawFrame,
        entry: Entry,
        spans: dict[str, list[float]],
    ) -> None:
        """Write a frame and its journal line; runs in the writer's thread."""
        self._watcher.step("write", planned)
        began_s = self._now_s()
        file = frame_file(frame)

        def facts() -> Entry:
            return {**file.facts, **entry, "spans_s": {**spans, "write": [began_s, self._now_s()]}}

        session, shot = self._session, planned.bench.shot
        session.store(planned, file.suffix, file.data, file.sha256, facts)
        self._watcher.stored(planned)
        left = self._left_of_shot.get(shot, set())
        if planned.id in left:
            left.remove(planned.id)
            if not left:
                self._watcher.shot_done(shot)

    def _discard_damaged(self, ids: set[str]) -> dict[str, str]:
        """Read files again; returns, by id, what is wrong with those that no longer count."""
        session = self._session
        planned = {frame.id for frame in session.frames} & ids
        entries = [entry for name, entry in session.stored.items() if name in planned]
        size = sum(entry["bytes"] for entry in entries)
        if size > TOLD_BYTES:
            self._watcher.tell(f"hashing {len(entries)} frames, {shown_bytes(size)}")
        damaged = verify_frames(session, entries)
        for name, fault in damaged.items():
            session.discard(name, fault)
            self._watcher.tell(f"{fault}; it is taken again")
        return damaged

    def _compare_with_last_good(self) -> None:
        """Take the last good whiteboard once more; raises AppError when the bench has shifted.

        Without a whiteboard the last shot of the scene serves; without that either, nothing does.
        """
        session = self._session
        by_id = {frame.id: frame for frame in session.frames}
        latest = [by_id[name] for name in reversed(session.stored) if name in by_id]
        candidates = [f for kind in ("whiteboard", "shot") for f in latest if f.kind == kind]
        if not candidates:
            return
        planned = candidates[0]
        entry = session.stored[planned.id]
        then = decode_frame(session.read(planned.id), entry)
        shift = Shift(0.0, 0.0, 0.0)

        def compare() -> None:
            nonlocal shift
            self._attend(planned)
            if self._move(planned) and self._plan.settle_s:
                self._rig.clock.sleep(self._plan.settle_s)
            now, _ = self._snap(planned, entry["exposure_s"])
            shift = registered(now, then)

        self._retrying(planned.id, compare)
        limit_px = self._plan.checks.registration_px
        facts = {"id": planned.id, **asdict(shift), "limit_px": limit_px}
        if shift.likeness < LEAST_LIKENESS or shift.length_px > limit_px:
            self._note("refused", **facts)
            what = (
                f"lies {shift.length_px:.2f} px ({shift.x_px:+.2f}, {shift.y_px:+.2f}) off"
                if shift.likeness >= LEAST_LIKENESS
                else f"looks different (likeness {shift.likeness:.2f})"
            )
            raise AppError(
                f"the bench is no longer as it was: frame {planned.id}, taken again, {what}; put "
                "the masks back and check lamp and board, or begin another session with --out"
            )
        self._note("registered", **facts)

    def _note(self, kind: str, **facts: Any) -> None:
        self._writer.put(partial(self._session.note, kind, **facts))

    def _now_s(self) -> float:
        return round(self._timer() - self._began_s, 6)

    @contextmanager
    def _span(
        self, name: str, planned: PlannedFrame, spans: dict[str, list[float]]
    ) -> Iterator[None]:
        self._watcher.step(name, planned)
        began_s = self._now_s()
        yield
        spans[name] = [began_s, self._now_s()]

    @contextmanager
    def _bench_left_safe(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            with uninterrupted():
                with suppress(DriverError):
                    self._rig.stage.stop()
                self._note_stop(error)
            raise
        finally:
            with uninterrupted():
                if self._applied.lamp != "off":
                    with suppress(DriverError, AppError):
                        self._rig.attendant.set_lamp("off")
                if self._camera is not self._rig.camera:
                    with suppress(DriverError):
                        self._camera.close()

    def _note_stop(self, error: BaseException) -> None:
        """Write the reason to the journal; where that fails, the failure is reported already."""
        if isinstance(error, Exception | KeyboardInterrupt):
            with suppress(Exception):
                reason = str(error) or "stopped at once by the user"
                self._note("stopped", reason=reason, wall=self._wall())


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
