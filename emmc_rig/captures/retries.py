"""Faults that are worth another try, repairs before it, and the limit of tries."""

from __future__ import annotations

from dataclasses import dataclass

from emmc_rig.captures.checks import SaturatedError
from emmc_rig.captures.plan import Retries
from emmc_rig.drivers.errors import (
    CameraClosedError,
    CameraSettingError,
    CardFullError,
    DriverError,
    EmergencyStopError,
    FolderCameraError,
    LimitExceededError,
    NotHomedError,
    PortError,
    PortPermissionError,
    SpeedLimitError,
    UnknownAxisError,
    UsbClaimedError,
    UsbGoneError,
    UsbNotFoundError,
    UsbPermissionError,
    UsbUnavailableError,
)
from emmc_rig.errors import AppError

HOPELESS = (
    CameraSettingError,
    CardFullError,
    EmergencyStopError,
    FolderCameraError,
    LimitExceededError,
    PortPermissionError,
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
    reconnect_stage: bool = False
    home: bool = False
    reopen_camera: bool = False


def mending(error: DriverError, attempt: int) -> Mending:
    """Return what has to be mended after the `attempt`-th fault in a row, counted from 1.

    A fault that only repeating has not cured is met by opening the camera again, every third time.
    """
    lost = error.loses_position or isinstance(error, NotHomedError)
    port = isinstance(error, PortError)
    gone = isinstance(error, CAMERA_GONE)
    stubborn = attempt % 3 == 0 and not (lost or port)
    wait_s = min(LONGEST_WAIT_S, FIRST_WAIT_S * 2 ** (attempt - 1))
    return Mending(wait_s, port, lost or port, gone or stubborn)


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
