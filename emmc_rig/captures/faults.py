"""Faults of a capture: impossible plans, wrong frames, and the faults that another try cures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.bench.hardware import Rig
from emmc_rig.captures.plan import Checks, Retries
from emmc_rig.drivers.camera import within
from emmc_rig.drivers.errors import (
    CameraClosedError,
    CameraSettingError,
    CardFullError,
    DriverError,
    EmergencyStopError,
    FolderCameraError,
    LightError,
    LimitExceededError,
    NotHomedError,
    PortError,
    PortPermissionError,
    PressedSwitchError,
    SpeedLimitError,
    UnknownAxisError,
    UsbClaimedError,
    UsbGoneError,
    UsbNotFoundError,
    UsbPermissionError,
    UsbUnavailableError,
)
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.session.journal import Figures
from emmc_rig.session.planned import PlannedFrame


class FrameRefusedError(DriverError):
    """A frame that arrived whole but cannot be right; `reason` says why."""

    def __init__(self, frame_id: str, reason: str, advice: str) -> None:
        super().__init__(f"frame {frame_id} {reason}: {advice}")
        self.reason = reason


class SaturatedError(FrameRefusedError):
    """A saturated frame: a second try at the same exposure would saturate, too."""


def check(
    planned: PlannedFrame,
    frame: RawFrame,
    found: Figures,
    before: NDArray[np.uint16] | None,
    checks: Checks,
    may_saturate: bool = False,
) -> None:
    """Raise `FrameRefusedError` unless the frame can be what was planned.

    before: the mosaic of the frame before this one. may_saturate: a longer one of a bracket.
    """
    span = frame.span_dn
    if before is not None and is_same(frame.mosaic, before):
        raise FrameRefusedError(
            planned.id,
            "is identical to the frame before it",
            "the camera sent its last frame again; if this repeats, switch it off and on",
        )
    if planned.kind == "dark":
        if found.mean_dn > checks.largest_dark * span:
            raise FrameRefusedError(
                planned.id,
                f"is not dark, on average {found.mean_dn / span:.1%} of white",
                "switch the lamp off and cover the bench",
            )
        return
    # Nothing can be metered from less than one DN.
    least_dn = max(checks.smallest_signal * span, planned.kind == "metering")
    if found.bright_dn < least_dn:
        raise FrameRefusedError(
            planned.id,
            f"is black, its brightest pixels {max(0.0, found.bright_dn) / span:.2%} of white",
            f"check lamp and lens cap, or raise {exposure_setting(planned)} in the plan",
        )
    if not may_saturate and found.saturated > checks.largest_saturated_share:
        raise SaturatedError(
            planned.id,
            f"is saturated in {found.saturated:.1%} of its pixels",
            f"lower {exposure_setting(planned)} in the plan",
        )


def exposure_setting(planned: PlannedFrame) -> str:
    """Return the key of the plan that sets a frame's exposure."""
    if planned.kind == "dark":
        return "darks.exposure_s"
    if planned.kind == "shot":
        metered = planned.exposure_s is None
        return "metering.level" if metered else f"shots.{planned.bench.shot}.exposure_s"
    if planned.kind == "metering" and planned.bench.target == "scene":
        return "metering.longest_s"
    return "whiteboards.exposure_s" if planned.metered_by is None else "whiteboards.level"


def is_same(frame: NDArray[np.uint16], other: NDArray[np.uint16]) -> bool:
    """Return whether two mosaics are equal, and not just equally empty."""
    if frame.shape != other.shape or not np.array_equal(frame[::256], other[::256]):
        return False
    return bool(frame.min() != frame.max()) and np.array_equal(frame, other)


def refuse_impossible(rig: Rig, frames: Iterable[PlannedFrame]) -> None:
    """Raise AppError for the first frame that stage, camera or lights cannot do."""
    exposures_s, gains = rig.camera.exposure_limits_s, rig.camera.gain_limits
    for frame in frames:
        if rig.lights is not None and (colour := frame.bench.lamp) not in rig.lights.colours:
            raise AppError(
                f"frame {frame.id}: the rig's lights have no {colour}, only "
                f"{', '.join(rig.lights.colours)}: name it under lights: in the rig's file, or "
                f"leave {colour} light out of the plan"
            )
        for axis, offset_um in frame.bench.offsets_um.items():
            if axis not in rig.hands | rig.left:
                _refuse_place(rig, frame, axis, offset_um)
        exposure_s = frame.exposure_s
        # A camera with a fixed exposure states it with each frame.
        chosen = exposures_s[0] < exposures_s[1]
        if chosen and exposure_s is not None and not within(exposure_s, exposures_s):
            raise AppError(
                f"frame {frame.id}: the camera exposes from {exposures_s[0]:g} to "
                f"{exposures_s[1]:g} s, not {exposure_s:g} s: change "
                f"{exposure_setting(frame)} in the plan"
            )
        if not within(frame.gain, gains):
            raise AppError(
                f"frame {frame.id}: the camera's gain goes from {gains[0]:g} to {gains[1]:g}, not "
                f"to {frame.gain:g}: change shots.{frame.bench.shot}.gain in the plan"
            )


def _refuse_place(rig: Rig, frame: PlannedFrame, axis: str, offset_um: float) -> None:
    if axis not in rig.stage.axes or axis not in rig.zero_um:
        known = ", ".join(name for name in rig.stage.axes if name in rig.zero_um)
        raise AppError(
            f"frame {frame.id} needs a stage axis '{axis}', the rig has {known or 'none'}: name it "
            "in the rig's file, with its zero_um"
        )
    low_um, high_um = rig.stage.limits_um(axis)
    if not low_um <= rig.zero_um[axis] + offset_um <= high_um:
        raise AppError(
            f"frame {frame.id}: {axis} cannot go {offset_um:g} um from its zero "
            f"({rig.zero_um[axis]:g} um), it reaches {low_um:g} to {high_um:g} um: change the "
            "place in the plan, or zero_um in the rig's file"
        )


HOPELESS = (
    CameraSettingError,
    CardFullError,
    EmergencyStopError,
    FolderCameraError,
    LimitExceededError,
    PortPermissionError,
    PressedSwitchError,
    SaturatedError,
    SpeedLimitError,
    UnknownAxisError,
    UsbClaimedError,
    UsbPermissionError,
    UsbUnavailableError,
)
"""Faults that a person has to mend before another try, the emergency stop above all."""

CAMERA_GONE = (CameraClosedError, UsbGoneError, UsbNotFoundError)
FIRST_WAIT_S, LONGEST_WAIT_S = 0.1, 5.0


class GaveUpError(AppError):
    """The capture stops because a fault stays; everything captured so far is kept."""

    def __init__(self, frame_id: str, reason: str) -> None:
        named = reason.startswith(f"frame {frame_id} ")
        super().__init__(reason if named else f"frame {frame_id}: {reason}")


@dataclass(frozen=True)
class Mending:
    """What to do before the next try."""

    wait_s: float
    reconnect_lights: bool = False
    reconnect_stage: bool = False
    home: bool = False
    reopen_camera: bool = False


def mending(error: DriverError, attempt: int) -> Mending:
    """Return what has to be mended after the `attempt`-th fault in a row, counted from 1.

    A fault that only repeating has not cured is met by opening the camera again, every third time.
    """
    if isinstance(error, LightError):
        return Mending(_wait_s(attempt), reconnect_lights=True)
    lost = error.loses_position or isinstance(error, NotHomedError)
    port = isinstance(error, PortError)
    gone = isinstance(error, CAMERA_GONE)
    stubborn = attempt % 3 == 0 and not (lost or port)
    return Mending(
        _wait_s(attempt),
        reconnect_stage=port,
        home=lost or port,
        reopen_camera=gone or stubborn,
    )


def _wait_s(attempt: int) -> float:
    return min(LONGEST_WAIT_S, FIRST_WAIT_S * 2 ** (attempt - 1))


class Budget:
    """Counts the tries; raises when there are none left."""

    def __init__(self, retries: Retries) -> None:
        self._retries = retries
        self.spent = 0

    def spend(self, frame_id: str, error: DriverError, attempt: int) -> None:
        """Count the `attempt`-th fault of a frame, from 1; raises `GaveUpError`."""
        if isinstance(error, HOPELESS):
            raise GaveUpError(frame_id, str(error)) from error
        if attempt > self._retries.per_frame:
            raise GaveUpError(
                frame_id, f"gave up after {attempt} tries, the last time because: {error}"
            ) from error
        if self.spent >= self._retries.per_session:
            raise GaveUpError(
                frame_id,
                f"all {self._retries.per_session} retries of the session are spent, the last "
                f"fault: {error}",
            ) from error
        self.spent += 1
