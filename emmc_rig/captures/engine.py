"""The engine: one frame of a session, from the bench as it stands to the frame in the recorder.

`Engine.take` shows the steps: attend (lamp, board, masks), the plan's hook, move, settle, expose,
read back, check, hand over. Each raises a `DriverError` for a frame that cannot be right. The
engine neither tries again nor chooses frames: the runner does, `emmc_rig.captures.sequencer`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.bench.environment import read_all
from emmc_rig.bench.hardware import FOCUS, Rig
from emmc_rig.bench.registration import Shift, registered
from emmc_rig.captures.between import Between, HookError, plain
from emmc_rig.captures.by_hand import places_in_session
from emmc_rig.captures.control import Control
from emmc_rig.captures.devices import Devices, Spans
from emmc_rig.captures.faults import check
from emmc_rig.captures.focus import FocusFound
from emmc_rig.captures.metering import Exposures
from emmc_rig.captures.plan import Plan
from emmc_rig.captures.recorder import Recorder
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError, StopCapture
from emmc_rig.model.json_text import one_line
from emmc_rig.session.frame_file import decode_frame, frame_entry
from emmc_rig.session.journal import Figures, FrameEntry, HookEntry, SourceEntry
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

Facts = Mapping[str, Any]


class Engine:
    """Takes one frame of a session at a time on the devices of a rig.

    devices: of the rig. before: mosaic of the frame before, None where equal frames are no fault.
    prepared: the frame's id ("" after the last one) and the number of homings when the hook was
    called last, whose own setting may be lost by homing; None: it is called for any frame. wall:
    the time of day.
    """

    def __init__(
        self,
        session: Session,
        plan: Plan,
        rig: Rig,
        recorder: Recorder,
        exposures: Exposures,
        control: Control,
        hook: Between | None,
        wall: Callable[[], str],
    ) -> None:
        self.session, self.plan, self.rig = session, plan, rig
        self.recorder, self._exposures = recorder, exposures
        self.control, self._hook = control, hook
        self.devices = Devices(rig, plan, wall)
        self.before: NDArray[np.uint16] | None = None
        self.prepared: tuple[str, int] | None = None
        self._places = places_in_session(session, rig, plan)
        # How long the frame before took to hand over: its own line is written by then.
        self._handed_s: dict[str, tuple[float, float]] = {}
        self._faults_of_sources: dict[str, str] = {}

    @property
    def has_hook(self) -> bool:
        """Whether a hook is called before each frame."""
        return self._hook is not None

    def take(self, planned: PlannedFrame, attempt: int, about: Callable[[], Facts] = dict) -> float:
        """Set up, expose, store; returns the seconds that somebody at the bench took.

        attempt: counted from 1. about: what else the journal line says, asked once exposed.
        """
        devices, span = self.devices, Spans(self.recorder.now_s, self.recorder.emit_step)
        with span("attend", planned):
            devices.attend(planned)
        if self._hook is not None:
            with span("between", planned):
                self.prepare(planned)
        frame, found = devices.move_and_expose(planned, self.exposure_s(planned), span)
        with span("read back", planned):
            read_um, unsure_um = devices.read_back_um(planned), {}
            beside = {**devices.beside(), "environment": self._read_sources()}
        with span("check", planned):
            may_saturate = self._exposures.may_saturate(planned)
            check(planned, frame, found, self.before, self.plan.checks, may_saturate)
            place = self._places.found(planned, frame)
            if place is not None:
                read_um |= place.um
                unsure_um = dict.fromkeys(place.um, place.deviation_um)
        self.recorder.emit_taken(planned, frame, found)
        span.seconds.update(self._handed_s)
        handing = Spans(self.recorder.now_s, self.recorder.emit_step)
        with handing("hand over", planned):
            self.hand_over(
                planned,
                frame,
                found,
                dict(span.seconds),
                read_um=read_um,
                deviation_um=unsure_um,
                attempts=attempt,
                **beside,
                **about(),
            )
        self._handed_s = handing.seconds
        began_s, ended_s = span.seconds["attend"]
        return ended_s - began_s

    def hand_over(
        self,
        planned: PlannedFrame,
        frame: RawFrame,
        found: Figures,
        spans_s: dict[str, tuple[float, float]],
        **about: Any,
    ) -> None:
        """Give a frame to the recorder, with what its journal line says (`about` it)."""
        camera = self.devices.camera
        entry = frame_entry(
            frame,
            # Only asked for where it is needed: a camera may read its next frame for that.
            camera.exposure_s if frame.exposure_s is None else frame.exposure_s,
            camera.gain if frame.gain is None else frame.gain,
            run=self.recorder.run,
            plan=self.session.amendments,
            lamp=planned.bench.lamp,
            triggered=self.plan.trigger is not None,
            lamp_read=self.devices.sent.lamp_read,
            commanded_um=dict(planned.bench.offsets_um),
            figures=found,
            wall=self.devices.asked_wall,
            monotonic_s=self.devices.asked_s,
            **about,
        )
        self._exposures.learn(planned, entry)
        self.recorder.store(planned, frame, entry, spans_s)
        self.before = frame.mosaic

    def set_up(self, planned: PlannedFrame) -> None:
        """Let the bench stand as a frame needs it, the stage settled; nothing is exposed."""
        self.devices.attend(planned)
        self.prepare(planned)
        if self.devices.move(planned) and self.plan.settle_s:
            self.devices.settle()

    def shift_since(self, planned: PlannedFrame, entry: FrameEntry) -> Shift:
        """Take a stored frame once more; return how far the picture is shifted from it."""
        then = decode_frame(self.session.read(planned.id), entry)
        self.set_up(planned)
        return registered(self.devices.snap(planned, entry.exposure_s)[0], then)

    def focus(
        self, planned: PlannedFrame, span_um: float, from_um: list[float]
    ) -> FocusFound | str | None:
        """Bring the focus axis to where the scene of a frame is sharpest.

        from_um: filled with where the axis stood at the first attempt, from which later attempts
        begin. Returns why no peak is seen, with the axis back there; None after a stop.
        """
        stage = self.rig.stage
        self.devices.attend(planned)
        self.prepare(planned)
        self.devices.move(planned)
        if from_um:
            stage.move_to_um({FOCUS: from_um[0]})
        else:
            from_um.append(stage.position_um(FOCUS))
        exposure_s = self.exposure_s(planned)
        try:
            return self.devices.focus(planned, exposure_s, span_um, lambda: self.control.stopping)
        except AppError as unseen:
            return str(unseen)

    def prepare(self, planned: PlannedFrame | None) -> None:
        """Call the plan's hook, once a frame, and again where the stage was homed since.

        planned: None after the last one. Raises `HookError`; `StopCapture` before a frame.
        """
        hook, devices, recorder = self._hook, self.devices, self.recorder
        now = ("" if planned is None else planned.id, devices.homings)
        if hook is None or self.prepared == now:
            return
        recorder.flush()
        began_s, noted, fault = recorder.now_s(), dict[str, Any](), "stopped"
        rig = replace(self.rig, camera=devices.camera)
        self.control.between_frames = True
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
            self.control.between_frames = False
            entry = HookEntry(
                id=now[0],
                name=hook.name,
                notes=noted,
                fault=fault,
                at_s=began_s,
                seconds=round(recorder.now_s() - began_s, 6),
            )
            recorder.note(entry)
        devices.look_again()
        if planned is not None:
            devices.attend(planned)
        self.prepared = now

    def exposure_s(self, planned: PlannedFrame) -> float:
        """Return the exposure to ask the camera for."""
        recorded_s = self.rig.recorded_s.get(planned.id)
        if recorded_s is not None:
            return recorded_s
        limits_s = self.devices.camera.exposure_limits_s
        exposure_s = self._exposures.exposure_s(planned, limits_s)
        assert exposure_s is not None  # what it is metered by was taken before
        return exposure_s

    def readings_of_stream(self, planned: PlannedFrame) -> dict[str, Any]:
        """Return what is read beside a frame while the camera streams."""
        return {
            "read_um": self.devices.read_back_um(planned),
            **self.devices.beside(streaming=True),
            "environment": self._read_sources(),
        }

    def _read_sources(self) -> dict[str, float]:
        """Return what the rig's sources say; one that fails, or does again, is noted once."""
        values, faults = read_all(self.rig.sources)
        for name in faults.keys() | self._faults_of_sources.keys():
            fault = faults.get(name, "")
            if fault != self._faults_of_sources.get(name, ""):
                told = f"environment, {name}: {fault or 'gives values again'}"
                self.recorder.note(SourceEntry(name=name, fault=fault), told)
        self._faults_of_sources = faults
        return values
