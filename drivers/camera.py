"""A camera that gives RAW frames: the common interface of cameras, and their common checks."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol

from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.errors import CameraClosedError, CameraSettingError, RawFrameError
from emmc_rig.drivers.raw import RawFrame, decode_raw

EXPOSURE_AGREEMENT = 0.1
"""Shutter times are nominal: a marked 1/30 s is 1/32 s, 7 per cent off."""

EXPOSURE_UNIT_S = 1e-4
"""Of PTP, which knows exposures no finer."""

Limits = tuple[float, float]


@dataclass(frozen=True)
class CameraIdentity:
    """Who made the camera; "" where it does not say."""

    maker: str = ""
    model: str = ""
    serial: str = ""
    firmware: str = ""


class Camera(Protocol):
    """A camera on manual exposure.

    Requested and actual setting differ where the camera has steps: `exposure_s` and `gain` are the
    actual settings, read back from the camera. Optional members: `stream` of `StreamingCamera`;
    `stream_at`, `rate_limits_hz`, `stop_exposure`, `set_trigger` and `set_exposure_output` as in
    `drivers.u3v.U3vCamera`.
    """

    @property
    def identity(self) -> CameraIdentity:
        """Who made it."""
        ...

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        ...

    @property
    def cfa(self) -> str:
        """Colour phase or tile name of a frame, as in `RawFrame`."""
        ...

    @property
    def exposure_s(self) -> float:
        """Exposure of the next frame."""
        ...

    @property
    def exposure_limits_s(self) -> Limits:
        """Shortest and longest exposure; equal where it cannot be chosen."""
        ...

    @property
    def gain(self) -> float:
        """Gain of the next frame, linear: ISO over base ISO, or 10^(dB/20)."""
        ...

    @property
    def gain_limits(self) -> Limits:
        """Lowest and highest gain; equal where it cannot be chosen."""
        ...

    def set_exposure_s(self, exposure_s: float) -> None:
        """Choose the exposure of the frames that follow: the nearest that the camera has.

        Raises `ValueError` unless positive, `CameraSettingError` outside the limits.
        """

    def set_gain(self, gain: float) -> None:
        """Choose the gain of the frames that follow; raises as `set_exposure_s`."""

    def snap(self) -> RawFrame:
        """Expose and return one frame; raises a `DriverError`."""
        ...

    def close(self) -> None:
        """Close the camera; closing twice is allowed."""


class StreamingCamera(Camera, Protocol):
    """A camera that sends frame after frame without being asked for each."""

    def stream(self) -> Iterator[RawFrame]:
        """Yield frames as they come; closing the generator stops the acquisition."""
        ...


def within(value: float, limits: Limits) -> bool:
    """Return whether a camera takes a value: limits in its own units come back rounded."""
    return limits[0] * (1 - 1e-9) <= value <= limits[1] * (1 + 1e-9)


def check_setting(setting: str, value: float, limits: Limits) -> None:
    """Raise `ValueError` unless positive and finite, `CameraSettingError` outside the limits."""
    if not (value > 0 and math.isfinite(value)):
        raise ValueError(f"the {setting} {value:g} is not positive")
    low, high = limits
    if not within(value, limits):
        offered = f"is fixed at {low:g}" if low == high else f"goes from {low:g} to {high:g}"
        raise CameraSettingError(setting, f"{offered}, not to {value:g}")


def check_frame(
    frame: RawFrame,
    cfa: str | None = None,
    exposure_s: float | None = None,
    tolerance_s: float = 0.0,
) -> RawFrame:
    """Return the frame; raises `RawFrameError` unless its colours and exposure are as expected.

    An exposure that the file does not state is not checked; else it may be off by
    `EXPOSURE_AGREEMENT` or `tolerance_s`, whichever is more.
    """
    if cfa is not None and frame.cfa != cfa:
        raise RawFrameError(f"its colours are {frame.cfa} instead of {cfa}")
    if (
        exposure_s is not None
        and frame.exposure_s is not None
        and abs(frame.exposure_s - exposure_s) > max(EXPOSURE_AGREEMENT * exposure_s, tolerance_s)
    ):
        raise RawFrameError(
            f"it was exposed for {frame.exposure_s:g} s instead of {exposure_s:g} s"
        )
    return frame


class ShapeFromFrames(ABC):
    """Base of cameras whose shape and colours only their RAW files show: `snap` decodes them."""

    _shape: tuple[int, int] | None = None
    _cfa: str | None = None

    @abstractmethod
    def snap(self) -> RawFrame:
        """Expose and return one frame; raises a `DriverError`."""

    def _decoded(
        self, name: str, data: bytes, exposure_s: float | None, gain: float, host_time_s: float
    ) -> RawFrame:
        """Return the frame in a RAW file, of the shape and colours of those before.

        exposure_s: what was asked for; the file's own counts where it states one, and may differ
        by `EXPOSURE_UNIT_S`. Raises `RawFrameError`.
        """
        frame = check_frame(decode_raw(data, self._shape), self._cfa, exposure_s, EXPOSURE_UNIT_S)
        self._shape, self._cfa = frame.mosaic.shape, frame.cfa
        return replace(
            frame,
            exposure_s=frame.exposure_s or exposure_s,
            gain=gain,
            host_time_s=host_time_s,
            metadata={**frame.metadata, "name": name},
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame; takes a frame if no frame was taken before."""
        if self._shape is None:
            self.snap()
        assert self._shape is not None
        return self._shape

    @property
    def cfa(self) -> str:
        """Colour phase or tile name of a frame; takes a frame if no frame was taken before."""
        if self._cfa is None:
            self.snap()
        assert self._cfa is not None
        return self._cfa


class CaptureTransport(Protocol):
    """Whatever exposes once and hands over the RAW file."""

    def capture(self, exposure_s: float) -> bytes:
        """Expose for `exposure_s` and return the file's bytes."""
        ...


class RawFileCamera:
    """A camera over a transport that yields RAW files, of one sensitivity and any exposure.

    Every frame must have the `shape` and `cfa` stated here, and the exposure that was asked for
    where the file states one; a frame that does not raises `RawFrameError`.
    """

    exposure_limits_s: Limits = (1e-6, 3600.0)
    gain: float = 1.0
    gain_limits: Limits = (1.0, 1.0)

    def __init__(
        self,
        transport: CaptureTransport,
        shape: tuple[int, int],
        cfa: str,
        exposure_s: float = 0.01,
        clock: Clock = SYSTEM_CLOCK,
        identity: CameraIdentity | None = None,
    ) -> None:
        self._transport = transport
        self._clock = clock
        self.identity = identity or CameraIdentity()
        self.shape = shape
        self.cfa = cfa
        self._closed = False
        self.set_exposure_s(exposure_s)

    def set_exposure_s(self, exposure_s: float) -> None:
        """Choose the exposure of the frames that follow.

        Raises `ValueError` unless positive, `CameraSettingError` outside the limits.
        """
        check_setting("exposure in seconds", exposure_s, self.exposure_limits_s)
        self.exposure_s = exposure_s

    def set_gain(self, gain: float) -> None:
        """Accept a gain of 1; raises as `set_exposure_s`."""
        check_setting("gain", gain, self.gain_limits)

    def snap(self) -> RawFrame:
        """Expose and return one frame; raises `RawFrameError` or an error of the transport."""
        if self._closed:
            raise CameraClosedError(self.identity.model or "the camera")
        frame = decode_raw(self._transport.capture(self.exposure_s), self.shape)
        check_frame(frame, self.cfa, self.exposure_s)
        return replace(frame, gain=self.gain, host_time_s=self._clock.now_s())

    def close(self) -> None:
        """Refuse further frames; closing twice is allowed."""
        self._closed = True
