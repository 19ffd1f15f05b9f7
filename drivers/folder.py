"""A camera that replays the RAW files of a folder in order, as if taken now."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from emmc_rig.drivers.camera import EXPOSURE_AGREEMENT, CameraIdentity, Limits, check_frame
from emmc_rig.drivers.capture_order import capture_order
from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.errors import CameraSettingError, FolderCameraError, RawFrameError
from emmc_rig.drivers.raw import RawFrame, decode_raw, exposure_and_time, has_raw_suffix

_log = logging.getLogger(__name__)

ANY_EXPOSURE_S: Limits = (1e-6, 3600.0)


@dataclass(frozen=True)
class Recorded:
    """Name, exposure and time of capture of a RAW file; None: not stated."""

    name: str
    exposure_s: float | None
    captured: datetime | None


def open_camera(address: str, clock: Clock, backend: object = None) -> FolderCamera:
    """Return the RAW files of a folder as a camera; see `drivers.cameras`."""
    return FolderCamera(address or ".", clock)


class FolderCamera:
    """The RAW files of a folder, in the order in which they were captured.

    All must have the shape and colours of the first file. The exposure of a recording cannot be
    chosen: the exposure of the next frame is accepted, so that a sequence can be run again; any
    exposure where the file states none. `choose` names the file that is next.
    Raises `FolderCameraError` when there is no file, and after the last one.
    """

    gain: float = 1.0
    gain_limits: Limits = (1.0, 1.0)

    def __init__(self, folder: Path | str, clock: Clock = SYSTEM_CLOCK) -> None:
        self.folder = Path(folder)
        self._clock = clock
        self._asked_s: float | None = None
        self._chosen = False
        try:
            paths = [p for p in self.folder.iterdir() if has_raw_suffix(p.name) and p.is_file()]
        except OSError as fault:
            raise FolderCameraError(str(folder), f"it cannot be read ({fault.strerror})") from fault
        found = [_recorded(path) for path in paths]
        order = capture_order([file.name for file in found], [file.captured for file in found])
        for note in order.notes:
            _log.warning("%s: %s", folder, note)
        self._files = tuple(found[place] for place in order.places)
        self._left = [paths[place] for place in reversed(order.places)]
        self._count = len(paths)
        first = self._read()
        self._next: RawFrame | None = first
        self.shape: tuple[int, int] = first.mosaic.shape
        self.cfa = first.cfa
        metadata = first.metadata
        self.identity = CameraIdentity(
            metadata.get("maker", ""), metadata.get("model", ""), metadata.get("serial", "")
        )

    @property
    def exposure_s(self) -> float:
        """Exposure of the next frame, what was asked for where its file does not say.

        Raises `CameraSettingError` where nothing was.
        """
        exposure_s = self._peek().exposure_s or self._asked_s
        if exposure_s is None:
            raise CameraSettingError("exposure", "is not stated in the recording")
        return exposure_s

    @property
    def exposure_limits_s(self) -> Limits:
        """The next frame's exposure, twice; any if the file states none, or files are chosen."""
        exposure_s = None if self._chosen else self._peek().exposure_s
        return ANY_EXPOSURE_S if exposure_s is None else (exposure_s, exposure_s)

    def set_exposure_s(self, exposure_s: float) -> None:
        """Accept the next frame's exposure.

        Raises `ValueError` unless positive, `CameraSettingError` for another.
        """
        if not exposure_s > 0:
            raise ValueError(f"the exposure of {exposure_s:g} s is not positive")
        recorded_s = self._peek().exposure_s
        if recorded_s is not None and abs(recorded_s / exposure_s - 1) > EXPOSURE_AGREEMENT:
            raise CameraSettingError(
                "exposure",
                f"was {recorded_s:g} s when this was recorded, not {exposure_s:g} s: "
                "replay it with the plan of the recording",
            )
        self._asked_s = exposure_s

    def set_gain(self, gain: float) -> None:
        """Accept a gain of 1; raises as `set_exposure_s`."""
        if not gain > 0:
            raise ValueError(f"the gain {gain:g} is not positive")
        if gain != 1:
            raise CameraSettingError("gain", "of a recording is fixed")

    def snap(self) -> RawFrame:
        """Return the next frame; raises `FolderCameraError` or `RawFrameError`.

        A file that is refused is passed over: the next call goes on after it.
        """
        try:
            frame = self._peek()
        finally:
            self._next = None
            name = self._left.pop().name if self._left else ""
        return replace(
            frame,
            host_time_s=self._clock.now_s(),
            metadata={**frame.metadata, "name": name},
        )

    def files(self) -> tuple[Recorded, ...]:
        """Return name, exposure and time of all files, in the order in which `snap` returns them.

        A damaged file has its name alone.
        """
        return self._files

    def choose(self, name: str) -> None:
        """Choose the file that the next frame is read from."""
        self._left, self._next, self._chosen = [self.folder / name], None, True

    def close(self) -> None:
        """Forget the frames that are left."""
        self._left, self._next = [], None

    def _peek(self) -> RawFrame:
        """Return the next frame and keep it."""
        if self._next is None:
            self._next = check_frame(self._read(self.shape), self.cfa)
        return self._next

    def _read(self, shape: tuple[int, int] | None = None) -> RawFrame:
        if not self._left:
            reason = (
                f"all its {self._count} frames were replayed"
                if self._count
                else "it holds no RAW file"
            )
            raise FolderCameraError(str(self.folder), reason)
        path = self._left[-1]
        try:
            return decode_raw(path.read_bytes(), shape)
        except RawFrameError as fault:
            raise RawFrameError(f"{path.name}: {fault.reason}") from fault
        except OSError as fault:
            raise FolderCameraError(str(path), f"it cannot be read ({fault.strerror})") from fault


def _recorded(path: Path) -> Recorded:
    try:
        with path.open("rb") as file:
            return Recorded(path.name, *exposure_and_time(file))
    except RawFrameError:
        return Recorded(path.name, None, None)
    except OSError as fault:
        raise FolderCameraError(str(path), f"it cannot be read ({fault.strerror})") from fault
