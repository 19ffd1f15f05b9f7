"""A frame on the devices of a rig: the bench set up for it, exposed, and read back.

The last settings of each device are remembered, and equal settings are not sent again. A fault
clears this memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import count
from typing import Any

from emmc_rig.bench.hardware import FOCUS, STAGE_AXES, Rig, RigType
from emmc_rig.captures.faults import FrameRefusedError, Mending
from emmc_rig.captures.focus import FocusFound, focused, sharpness
from emmc_rig.captures.metering import METERABLE_LEVELS, METERING_TRIES
from emmc_rig.captures.plan import Plan
from emmc_rig.drivers.camera import Camera as CameraDevice
from emmc_rig.drivers.errors import CameraSettingError, DriverError
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.drivers.stage import Stage, StageIdentity
from emmc_rig.errors import AppError
from emmc_rig.session.brightness import figures, level_of, next_exposure_s
from emmc_rig.session.journal import Figures
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import wall_time

TEMPERATURES_EVERY_S = 5.0
"""Devices warm up over minutes; asking one takes some milliseconds of every frame."""
LARGEST_EXPOSURE_RATIO = 1.5
"""A camera may take the nearest of full stops, which is off by at most half a stop."""


def identity_of(stage: Stage, axis: str) -> StageIdentity:
    """Return who made the controller of an axis, where the stage says; of a plug-in it may not."""
    try:
        return getattr(stage, "identity", lambda axis: StageIdentity())(axis)
    except DriverError:
        return StageIdentity()


def with_trigger(rig: RigType, plan: Plan) -> RigType:
    """Return the rig, the lines of its camera set as a plan says, also when it is opened again.

    Raises AppError with one line if the camera lacks a line.
    """
    trigger, output, reopen = plan.trigger, plan.exposure_output, rig.reopen_camera
    wanted: list[tuple[str, str, tuple]] = []
    if trigger is not None:
        wanted.append(("trigger", "set_trigger", (trigger.source, trigger.edge, trigger.limit_s)))
    if output is not None:
        wanted.append(("exposure_output", "set_exposure_output", (output,)))

    def set_lines(camera: CameraDevice) -> CameraDevice:
        for key, method, arguments in wanted:
            try:
                if not hasattr(camera, method):
                    raise CameraSettingError(key, "is not supported by its driver")
                getattr(camera, method)(*arguments)
            except CameraSettingError as fault:
                remedy = f"change {key} in the plan, or leave it out"
                raise AppError(f"{key}: {fault}: {remedy}") from fault
        return camera

    if not wanted:
        return rig
    set_lines(rig.camera)
    return replace(rig, reopen_camera=None if reopen is None else lambda: set_lines(reopen()))


@dataclass
class Sent:
    """What was last sent to the devices; empty: nothing is known.

    lamp_read: what the lights confirmed.
    """

    bench: tuple | None = None
    lamp: str | None = None
    lamp_read: str = ""
    offsets_um: dict[str, float] = field(default_factory=dict)
    exposure_s: float | None = None
    gain: float | None = None


class Spans:
    """The seconds from the start of a run in which each step of a frame began and ended."""

    def __init__(
        self, now_s: Callable[[], float], on_step: Callable[[str, PlannedFrame], None]
    ) -> None:
        self._now_s, self._on_step = now_s, on_step
        self.seconds: dict[str, tuple[float, float]] = {}

    @contextmanager
    def __call__(self, step: str, planned: PlannedFrame) -> Iterator[None]:
        """Time a step of a frame, and show it."""
        self._on_step(step, planned)
        began_s = self._now_s()
        yield
        self.seconds[step] = began_s, self._now_s()


class Devices:
    """Stage, camera and attendant of a rig, as a capture by a plan uses them.

    asked_wall, asked_s: when the last exposure was asked for, by the time of day, ISO 8601, and on
    the clock of the rig. homings: how often the stage was homed.
    """

    def __init__(self, rig: Rig, plan: Plan, wall: Callable[[], str] = wall_time) -> None:
        self._rig, self._plan, self._wall = rig, plan, wall
        self.asked_wall, self.asked_s = "", 0.0
        self.camera = rig.camera
        self.sent = Sent()
        self.homings = 0
        self._warmth_s, self._warmth_c = -TEMPERATURES_EVERY_S, dict[str, float]()
        self._fixed_um = dict(rig.fixed_positions_um)

    def home(self) -> None:
        """Home the stage, and bring the axes that no plan moves to their places."""
        self.homings += 1
        if self._rig.stage.axes:
            self._rig.stage.home()
        if self._fixed_um:
            self._rig.stage.move_to_um(self._fixed_um)
        self.sent = Sent()

    def mend(self, what: Mending) -> None:
        """Wait, and repair the devices after a fault."""
        self._rig.clock.sleep(what.wait_s)
        self.sent = Sent()
        if what.reopen_camera and self._rig.reopen_camera is not None:
            with suppress(DriverError):
                self.camera.close()
            self.camera = self._rig.reopen_camera()
        if what.reconnect_lights and self._rig.lights is not None:
            self._rig.lights.reconnect()
        if what.reconnect_stage:
            self._rig.stage.reconnect()
        if what.home:
            self.home()

    def look_again(self) -> None:
        """Clear the remembered settings after other use of the devices; read the axes' positions.

        An axis that has moved, or that cannot be read, is moved again, and homed if needed.
        """
        before_um, self.sent = self.sent.offsets_um, Sent()
        with suppress(DriverError):
            for axis, um in before_um.items():
                off_um = self._rig.stage.position_um(axis) - self._rig.zero_um[axis] - um
                if abs(off_um) <= self._plan.checks.stage_um:
                    self.sent.offsets_um[axis] = um

    def attend(self, planned: PlannedFrame) -> None:
        """Let lamp, board and masks be as a frame needs them; nobody is asked for a dark."""
        bench, sent, attendant = planned.bench, self.sent, self._rig.attendant
        wanted = bench.set_by_hand(self._rig.hands)
        if bench.lamp != "off" and sent.bench != wanted:
            sent.bench = None
            attendant.place(bench.target, bench.board_turn_deg)
            attendant.fit_masks(bench.fitting, bench.masks_in)
            by_hand = {a: um for a, um in bench.offsets_um.items() if a in self._rig.hands}
            if by_hand:
                attendant.move(by_hand)
            sent.bench = wanted
        self.set_lamp(bench.lamp)

    def set_lamp(self, lamp: str) -> None:
        """Switch the lamp, unless it is so."""
        if self.sent.lamp != lamp:
            self.sent.lamp = None
            self.sent.lamp_read = self._rig.set_lamp(lamp)
            self.sent.lamp = lamp

    def move(self, planned: PlannedFrame) -> bool:
        """Bring the stage to its place; returns whether it moved."""
        sent = self.sent.offsets_um
        wanted = {a: um for a, um in self._driven_um(planned).items() if sent.get(a) != um}
        if not wanted:
            return False
        zero_um = self._rig.zero_um
        self._rig.stage.move_to_um({axis: zero_um[axis] + um for axis, um in wanted.items()})
        sent.update(wanted)
        return True

    def settle(self) -> None:
        """Wait after a move, as the plan asks."""
        self._rig.clock.sleep(self._plan.settle_s)

    def move_and_expose(
        self, planned: PlannedFrame, exposure_s: float, span: Spans
    ) -> tuple[RawFrame, Figures]:
        """Bring the stage to its place and expose there."""
        with span("move", planned):
            moved = self.move(planned)
        if moved and self._plan.settle_s:
            with span("settle", planned):
                self.settle()
        with span("expose", planned):
            return self._expose(planned, exposure_s)

    def read_back_um(self, planned: PlannedFrame) -> dict[str, float]:
        """Return where the axes stand after the exposure; raises when they do not stand there."""
        read_um = {}
        for axis, offset_um in self._driven_um(planned).items():
            at_um = self._rig.stage.position_um(axis) - self._rig.zero_um[axis]
            if abs(at_um - offset_um) > self._plan.checks.stage_um:
                raise FrameRefusedError(
                    planned.id,
                    f"was exposed while {axis} stood {at_um - offset_um:+.2f} um off its place",
                    "check that nothing pushes the stage",
                )
            read_um[axis] = at_um
        return read_um

    def beside(self, streaming: bool = False) -> dict[str, Any]:
        """Return readings beside a frame, see `FrameEntry`; unreadable values are left out.

        Temperatures are read every few seconds only, and not from a streaming camera: another
        thread reads its wire.
        """
        stage, stands_um = self._rig.stage, {}
        for axis in stage.axes:
            if axis not in STAGE_AXES:
                with suppress(DriverError):
                    stands_um[axis] = stage.position_um(axis)
        now_s = self._rig.clock.now_s()
        if now_s - self._warmth_s >= TEMPERATURES_EVERY_S:
            self._warmth_s, self._warmth_c = now_s, {}
            asked = [("stage", stage)] if streaming else [("camera", self.camera), ("stage", stage)]
            for name, device in asked:
                with suppress(DriverError):
                    told = getattr(device, "temperatures_c", dict)()
                    self._warmth_c |= {
                        f"{name} {key}": celsius
                        for key, celsius in told.items()
                        if math.isfinite(celsius)
                    }
        return {"stands_um": stands_um, "temperatures_c": dict(self._warmth_c)}

    def snap(self, planned: PlannedFrame, exposure_s: float) -> tuple[RawFrame, Figures]:
        """Expose one frame where everything stands."""
        self._rig.about_to_expose(planned.id)
        self.set_camera(planned, exposure_s)
        self.ask()
        frame = self.camera.snap()
        return frame, figures(frame)

    def ask(self) -> None:
        """Remember that an exposure is asked for now."""
        self.asked_wall, self.asked_s = self._wall(), self._rig.clock.now_s()

    def focus(
        self, planned: PlannedFrame, exposure_s: float, span_um: float, stopped: Callable[[], bool]
    ) -> FocusFound | None:
        """Bring the focus axis to where the scene of a frame is sharpest; it stays there.

        Returns None when stopped; raises as `focused` does.
        """
        names = (f"{planned.id} focus {number}" for number in count())

        def snapped() -> RawFrame:
            self._rig.about_to_expose(next(names))
            self.set_camera(planned, exposure_s)
            return self.camera.snap()

        found = focused(
            self._rig.stage, FOCUS, span_um, lambda: sharpness(snapped(), snapped()), stopped
        )
        if found is not None:
            self._fixed_um[FOCUS] = found.place_um
        return found

    def make_safe(self) -> None:
        """Switch the lamp off, and close a camera that was opened again; no fault is raised."""
        with suppress(DriverError, AppError):
            self.set_lamp("off")
        if self.camera is not self._rig.camera:
            with suppress(DriverError):
                self.camera.close()

    def facts(self) -> dict[str, Any]:
        """Return what the journal says of the devices of a run."""
        stage, camera, lights = self._rig.stage, self.camera, self._rig.lights
        settings = {}
        with suppress(DriverError):
            # Other values, such as the battery's, a camera may not report.
            settings = dict(getattr(camera, "details", dict)())
        return {
            "camera": {**asdict(camera.identity), "shape": list(camera.shape), "cfa": camera.cfa},
            "camera_settings": settings,
            "lights": {}
            if lights is None
            else {"name": lights.name, "colours": list(lights.colours)},
            "stage": {
                axis: {
                    "identity": asdict(identity_of(stage, axis)),
                    "limits_um": list(stage.limits_um(axis)),
                    "speed_um_s": stage.speed_um_s(axis),
                    "zero_um": self._rig.zero_um.get(axis, 0.0),
                }
                for axis in stage.axes
            },
        }

    def _driven_um(self, planned: PlannedFrame) -> dict[str, float]:
        """Return a frame's place on the axes that the stage has."""
        axes = self._rig.stage.axes
        return {axis: um for axis, um in planned.bench.offsets_um.items() if axis in axes}

    def _expose(self, planned: PlannedFrame, exposure_s: float) -> tuple[RawFrame, Figures]:
        """Expose a frame; a metering frame again and again until its exposure is found."""
        if planned.kind != "metering" or planned.id in self._rig.recorded_s:
            return self.snap(planned, exposure_s)
        low_s, high_s = self.camera.exposure_limits_s
        if planned.bench.target == "scene":
            high_s = min(high_s, self._plan.longest_s)
        for _ in range(METERING_TRIES):
            frame, found = self.snap(planned, exposure_s)
            level = level_of(frame, found)
            next_s = next_exposure_s(exposure_s, level, (low_s, high_s), METERABLE_LEVELS)
            if next_s is None:
                break
            exposure_s = next_s
        return frame, found

    def set_camera(self, planned: PlannedFrame, exposure_s: float) -> None:
        """Set gain and exposure, unless they are so; raises where the camera takes others."""
        camera, sent = self.camera, self.sent
        if sent.gain != planned.gain:
            sent.gain = None
            camera.set_gain(planned.gain)
            sent.gain = planned.gain
        if sent.exposure_s != exposure_s:
            sent.exposure_s = None
            camera.set_exposure_s(exposure_s)
            ratio = camera.exposure_s / exposure_s
            if not 1 / LARGEST_EXPOSURE_RATIO < ratio < LARGEST_EXPOSURE_RATIO:
                raise FrameRefusedError(
                    planned.id,
                    f"would be exposed for {camera.exposure_s:g} s instead of {exposure_s:g} s",
                    "set the camera to manual exposure",
                )
            sent.exposure_s = exposure_s
